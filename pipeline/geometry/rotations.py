"""Rotations in space and in the image plane."""

import numpy as np

from pipeline.records import FloatArray


def matrix_from_quaternion(wxyz: FloatArray) -> FloatArray:
    """Rotation matrix of a unit quaternion (w, x, y, z), SPICE's order and sense.

    Parameters
    ----------
    wxyz
        (4,) quaternion; normalised here.

    Returns
    -------
    numpy.ndarray
        (3, 3) rotation that maps a vector as ``q v q*``.
    """
    w, x, y, z = np.asarray(wxyz, dtype=float) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(matrix: FloatArray) -> FloatArray:
    """Unit quaternion (w, x, y, z) of a rotation, w >= 0.

    Parameters
    ----------
    matrix
        (3, 3) rotation.

    Returns
    -------
    numpy.ndarray
        (4,) quaternion. Computed from the largest of its four squares, so no case loses precision (Shepperd 1978).
    """
    m = matrix
    squares = np.array(
        [1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
         1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]]
    )  # fmt: skip
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = np.array(
        [
            [squares[0], x, y, z],
            [x, squares[1], xy, xz],
            [y, xy, squares[2], yz],
            [z, xz, yz, squares[3]],
        ]
    )
    quaternion = rows[int(np.argmax(squares))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return np.asarray(-quaternion if quaternion[0] < 0 else quaternion)


def rotation_about(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Active right-handed rotation about an axis (Rodrigues).

    Parameters
    ----------
    axis
        (3,) any length but zero.
    angle_rad
        Angle.

    Returns
    -------
    numpy.ndarray
        (3, 3).
    """
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * (cross @ cross))


def smallest_rotation(start: FloatArray, end: FloatArray) -> FloatArray:
    """Rotation of least angle that carries one unit vector onto another.

    Parameters
    ----------
    start, end
        (3,) unit vectors, not opposite to each other.

    Returns
    -------
    numpy.ndarray
        (3, 3).
    """
    (a, b, c), (x, y, z) = start, end
    p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
    skew = np.array([[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]])
    result: FloatArray = np.eye(3) + skew + (skew @ skew) / (1.0 + float(start @ end))
    return result


def plane_rotation(theta_rad: float) -> FloatArray:
    """R(theta) on (v, u) columns: a positive theta turns +u toward +v.

    Parameters
    ----------
    theta_rad
        Angle.

    Returns
    -------
    numpy.ndarray
        (2, 2), [[cos, sin], [-sin, cos]].
    """
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return np.array([[c, s], [-s, c]])


def plane_rotation_derivative(theta_rad: float) -> FloatArray:
    """Derivative of :func:`plane_rotation` with respect to theta.

    Parameters
    ----------
    theta_rad
        Angle.

    Returns
    -------
    numpy.ndarray
        (2, 2).
    """
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return np.array([[-s, c], [-c, -s]])
