"""Starting poses: planes by IPPE, everything else by SQPnP, and the mirror image that a distant view cannot exclude."""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.pose.records import PnpFailure, PnpFailureError, Pose
from pipeline.pose.refine import scene_scale
from pipeline.records import FloatArray, Record

# Thickness of a scene over its width below which it is a plane.
PLANAR_THICKNESS = 0.01
# Width over length below which points are on a line: three figures of a single line fix no pose.
_COLLINEAR = 1e-3


@dataclass(frozen=True, eq=False)
class SceneShape(Record):
    """Principal axes of a set of points.

    Attributes
    ----------
    centre_km
        (3,).
    axes
        (3, 3) rows: longest, middle, shortest axis.
    extent_km
        (3,) root mean square along them.
    """

    centre_km: FloatArray
    axes: FloatArray
    extent_km: FloatArray

    def __post_init__(self) -> None:
        self._freeze(centre_km=(3,), axes=(3, 3), extent_km=(3,))

    @property
    def planar(self) -> bool:
        """Whether the points are on a plane as far as a start is concerned."""
        return bool(self.extent_km[2] < PLANAR_THICKNESS * self.extent_km[1])


def scene_shape(points_km: FloatArray) -> SceneShape:
    """Principal axes of points.

    Parameters
    ----------
    points_km
        (n, 3).

    Returns
    -------
    SceneShape
        Centre, axes and extents.
    """
    centre = points_km.mean(axis=0)
    _, size, axes = np.linalg.svd(points_km - centre, full_matrices=False)
    axes = axes * np.sign(np.linalg.det(axes))
    return SceneShape(centre, axes, size / np.sqrt(len(points_km)))


def refuse_degenerate(points_km: FloatArray, xy: FloatArray, sigma: float) -> SceneShape:
    """Make sure that points can determine a pose.

    Parameters
    ----------
    points_km
        (n, 3) body-fixed.
    xy
        (n, 2) on the ideal plane.
    sigma
        1 sigma there.

    Returns
    -------
    SceneShape
        The points' axes.

    Raises
    ------
    PnpFailureError
        If the points are on one line, or on one plane that is seen edge-on.
    """
    shape = scene_shape(points_km)
    if shape.extent_km[1] < _COLLINEAR * shape.extent_km[0] or not shape.extent_km[0] > 0:
        raise PnpFailureError(PnpFailure.DEGENERATE, "the points are on one line")
    spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False) / np.sqrt(len(xy))
    if spread[1] < max(_COLLINEAR * spread[0], 2.0 * sigma):
        kind = "one plane seen edge-on" if shape.planar else "the points are seen on one line"
        raise PnpFailureError(PnpFailure.DEGENERATE, kind)
    return shape


def starting_poses(points_km: FloatArray, xy: FloatArray, shape: SceneShape) -> list[tuple[str, Pose]]:
    """Candidates for the refinement.

    Parameters
    ----------
    points_km
        (n, 3) inliers, body-fixed.
    xy
        (n, 2) on the ideal plane.
    shape
        Their axes.

    Returns
    -------
    list of tuple
        Name of the method and pose: both answers of IPPE for a plane (Collins and Bartoli 2014); otherwise SQPnP's
        (Terzakis and Lourakis 2020) and its mirror image.
    """
    if shape.planar:
        return [("ippe", pose) for pose in _ippe(points_km, xy, shape)]
    centre, scale = scene_scale(points_km)
    found, turn, shift = cv2.solvePnP((points_km - centre) / scale, xy, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found or not np.isfinite(shift).all():
        return []
    matrix = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    pose = Pose(matrix, centre - scale * matrix.T @ shift[:, 0])
    return [("sqpnp", pose), ("sqpnp_mirrored", mirrored(pose, shape))]


def _ippe(points_km: FloatArray, xy: FloatArray, shape: SceneShape) -> list[Pose]:
    scale = float(shape.extent_km[0])
    plane = (points_km - shape.centre_km) @ shape.axes.T / scale
    plane[:, 2] = 0.0
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(plane), np.ascontiguousarray(xy), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for turn, shift in zip(turns[:found], shifts[:found], strict=True):
        if np.isfinite(turn).all() and np.isfinite(shift).all():
            matrix = cv2.Rodrigues(turn)[0] @ shape.axes
            poses.append(Pose(matrix, shape.centre_km - scale * matrix.T @ shift[:, 0]))
    return poses


def mirrored(pose: Pose, shape: SceneShape) -> Pose:
    """Pose under which a thin scene looks the same from far away: depth turned round about the plane of the scene.

    Parameters
    ----------
    pose
        A pose.
    shape
        Axes of the scene.

    Returns
    -------
    Pose
        Its Necker reversal; the scene's centre stays where it is in the camera frame.
    """
    centre = pose.camera_from_body @ (shape.centre_km - pose.position_km)
    sight = centre / np.linalg.norm(centre)
    normal = shape.axes[2]
    flip = np.eye(3) - 2.0 * np.outer(sight, sight)
    matrix = flip @ pose.camera_from_body @ (np.eye(3) - 2.0 * np.outer(normal, normal))
    return Pose(matrix, shape.centre_km - matrix.T @ centre)
