"""Rotations of the star sample: quaternions (w, x, y, z) and camera_from_j2000 matrices."""

from __future__ import annotations

import numpy as np

from workflows.samples.cameras import FloatArray, SampleCamera, unproject

LORRI_CAMERA_FROM_INSTRUMENT = np.diag([1.0, -1.0, -1.0])
"""LORRI looks along its own -Z with +X along u and +Y along v; the camera looks along +z with y against v."""


def matrix_from_wxyz(quaternion: FloatArray) -> FloatArray:
    """Return the matrix that turns a vector by a unit quaternion (w, x, y, z): v' = q v q*."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def wxyz_from_matrix(matrix: FloatArray) -> FloatArray:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    The quaternion is the eigenvector of largest eigenvalue of Bar-Itzhack's symmetric 4x4 matrix (J. Guidance 23,
    2000), which has no special case at half turns.
    """
    m = matrix
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0.0, m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2]],
            [0.0, 0.0, m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2]],
            [0.0, 0.0, 0.0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    quaternion: FloatArray = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    return quaternion if quaternion[0] >= 0.0 else -quaternion


def turn_about(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Return the matrix that turns vectors by angle_rad, right-handed, about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: FloatArray = np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
    return turned


def shortest_turn(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the matrix of the smallest rotation that takes one unit vector to another, not opposite, one."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.eye(3)
    return turn_about(axis / sine, float(np.arctan2(sine, start @ end)))


def pointing_error(camera: SampleCamera, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
    """Return true_camera_from_apriori_camera of a planted offset and rotation about the array centre.

    What the a-priori attitude shows at the array's centre c, the true one shows at c + offset, and what lies around it
    turns by the rotation, positive from +u toward +v. A right-handed turn about the line of sight is positive in that
    sense only where the array is not mirrored; hence the sign of det K.

    Parameters
    ----------
    offset_vu
        (2,) planted (dv, du), px.
    rotation_rad
        Planted rotation, rad.
    """
    ends = np.stack([camera.centre_vu, camera.centre_vu + offset_vu])
    before, after = unproject(camera, ends)
    turn = turn_about(after, camera.handedness * rotation_rad)
    error: FloatArray = turn @ shortest_turn(before, after)
    return error


def looking_at(boresight: FloatArray, roll_rad: float) -> FloatArray:
    """Return a camera_from_j2000 whose z axis is a J2000 unit vector, rolled about it by roll_rad."""
    pole = np.array([0.0, 0.0, 1.0]) if abs(boresight[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(pole, boresight)
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(boresight, x), boresight])
    rolled: FloatArray = turn_about(np.array([0.0, 0.0, 1.0]), roll_rad) @ upright
    return rolled
