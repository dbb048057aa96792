"""From an offset and a rotation at the array centre to an attitude, and back."""

import numpy as np

from pipeline.camera import project, unproject
from pipeline.geometry.rotations import plane_rotation, plane_rotation_derivative, rotation_about, smallest_rotation
from pipeline.records import CameraModel, FloatArray

# Pixels, pixels and radians by which a derivative is taken on either side.
_STEPS = (0.25, 0.25, 1e-4)


def corrected_attitude(
    camera: CameraModel, camera_from_j2000: FloatArray, offset_vu: FloatArray, rotation_rad: float = 0.0
) -> FloatArray:
    """Attitude under which predictions fall where the image shows them.

    ``Rot(q, sign(det K) theta) MinRot(p -> q) camera_from_j2000`` with p through the array centre and q through
    centre + offset.

    Parameters
    ----------
    camera
        The model.
    camera_from_j2000
        (3, 3) a-priori attitude.
    offset_vu
        (2,) offset at the array centre, pixels.
    rotation_rad
        In-plane rotation.

    Returns
    -------
    numpy.ndarray
        (3, 3) corrected camera_from_j2000.
    """
    centre = camera.centre_vu
    start, end = unproject(camera, np.stack([centre, centre + offset_vu]))[0]
    twist = rotation_about(end, camera.handedness * rotation_rad)
    result: FloatArray = twist @ smallest_rotation(start, end) @ camera_from_j2000
    return result


def attitude_information(
    camera: CameraModel, offset_vu: FloatArray, rotation_rad: float, covariance: FloatArray
) -> FloatArray:
    """Information that an offset brings about the attitude of :func:`corrected_attitude`.

    Parameters
    ----------
    camera
        The model.
    offset_vu
        (2,) offset at the array centre, pixels.
    rotation_rad
        In-plane rotation, zero where it is not known.
    covariance
        (3, 3) of (dv, du, theta), px^2 and rad^2; or (2, 2), then nothing is known of the rotation.

    Returns
    -------
    numpy.ndarray
        (3, 3) per rad^2, of the rotation between the true attitude and this one, camera axes; exactly singular along
        what is not known.
    """
    columns = []
    for axis, step in enumerate(_STEPS):
        move = np.zeros(3)
        move[axis] = step
        ends = [
            corrected_attitude(camera, np.eye(3), offset_vu + way * move[:2], rotation_rad + way * move[2])
            for way in (1.0, -1.0)
        ]
        change = ends[0] @ ends[1].T
        turn = [change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]]
        columns.append(np.array(turn) / (4.0 * step))
    inverse = np.linalg.inv(np.stack(columns, axis=1))
    size = len(covariance)
    return np.asarray(inverse[:size].T @ np.linalg.inv(covariance) @ inverse[:size])


def offset_between(camera: CameraModel, before: FloatArray, after: FloatArray) -> tuple[FloatArray, float]:
    """Offset and rotation that :func:`corrected_attitude` would need: its exact inverse.

    Parameters
    ----------
    camera
        The model.
    before, after
        (3, 3) camera_from_j2000, before and after the correction.

    Returns
    -------
    tuple
        (2,) offset at the array centre in pixels; rotation in radians.
    """
    centre = camera.centre_vu
    start = unproject(camera, centre[None])[0][0]
    change = after @ before.T
    end = change @ start
    landed, _ = project(camera, end[None])
    twist = change @ smallest_rotation(start, end).T
    side = np.cross(end, [1.0, 0.0, 0.0] if abs(end[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    turned = twist @ side
    angle = float(np.arctan2(np.cross(side, turned) @ end, side @ turned))
    return landed[0] - centre, camera.handedness * angle


def move_pivot(
    offset_vu: FloatArray, rotation_rad: float, pivot_vu: FloatArray, new_pivot_vu: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Same similarity about another pivot: ``d_c = d_p + (I - R)(p - c)``.

    Parameters
    ----------
    offset_vu
        (2,) offset about ``pivot_vu``.
    rotation_rad
        Rotation; it does not change.
    pivot_vu, new_pivot_vu
        (2,) old pivot p and new pivot c.

    Returns
    -------
    tuple
        (2,) offset about the new pivot; (3, 3) inverse Jacobian ``J^-1`` with which information moves:
        ``Lambda_c = J^-T Lambda_p J^-1``.
    """
    arm = pivot_vu - new_pivot_vu
    moved = offset_vu + (np.eye(2) - plane_rotation(rotation_rad)) @ arm
    inverse = np.eye(3)
    inverse[:2, 2] = plane_rotation_derivative(rotation_rad) @ arm
    return moved, inverse
