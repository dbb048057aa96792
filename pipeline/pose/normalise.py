"""Pixels onto the ideal image plane at unit distance, exactly, with their covariance: here (v, u) becomes (x, y)."""

from dataclasses import dataclass

import numpy as np

from pipeline.camera import project_jacobian, unproject
from pipeline.pose.records import MatchError
from pipeline.records import BoolArray, CameraModel, FloatArray, Record


@dataclass(frozen=True, eq=False)
class PlanePoints(Record):
    """Points of the plane z = 1 of the camera frame.

    Attributes
    ----------
    xy
        (n, 2), zero where not ``ok``.
    covariance
        (n, 2, 2).
    px_from_xy
        (n, 2, 2), d(v, u)/d(x, y).
    ok
        (n,) True where the camera model could be inverted.
    """

    xy: FloatArray
    covariance: FloatArray
    px_from_xy: FloatArray
    ok: BoolArray

    def __post_init__(self) -> None:
        n = len(self.ok)
        self._freeze(xy=(n, 2), covariance=(n, 2, 2), px_from_xy=(n, 2, 2), ok=(n,))


def to_plane(camera: CameraModel, pixels_vu: FloatArray, covariance_px2: FloatArray) -> PlanePoints:
    """Undistort pixels by the model's exact inverse, and carry their covariance along.

    Parameters
    ----------
    camera
        The model.
    pixels_vu
        (n, 2).
    covariance_px2
        (n, 2, 2) in the order (v, u).

    Returns
    -------
    PlanePoints
        The same points on the ideal plane.
    """
    rays, ok = unproject(camera, pixels_vu)
    ok = ok & (rays[:, 2] > 0)
    ray = np.where(ok[:, None], rays, [0.0, 0.0, 1.0])
    plane = ray / ray[:, 2:]
    px_from_xy = project_jacobian(camera, plane)[:, :, :2]
    (a, b), (c, d) = np.moveaxis(px_from_xy, 0, 2)
    inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), 2, 0)
    covariance = inverse @ covariance_px2 @ inverse.transpose(0, 2, 1)
    return PlanePoints(plane[:, :2], covariance, px_from_xy, ok)


def pinhole_camera(k_uv: FloatArray, shape_vu: tuple[int, int]) -> CameraModel:
    """Camera of a calibration matrix as computer vision writes it.

    Parameters
    ----------
    k_uv
        (3, 3) K with (u, v, 1) = K (x, y, 1); upper triangular.
    shape_vu
        Rows and columns.

    Returns
    -------
    CameraModel
        The same without distortion: a focal length of 1 mm, so the matrix is its scale.

    Raises
    ------
    MatchError
        If the matrix is not one of a camera.
    """
    k = np.asarray(k_uv, dtype=float)
    if k.shape != (3, 3) or not np.isfinite(k).all() or not np.allclose(k[2], [0, 0, 1]) or k[1, 0] != 0:
        raise MatchError("K is not a finite upper triangular 3 by 3 matrix with a last row (0, 0, 1)")
    if not abs(k[0, 0] * k[1, 1]) > 0:
        raise MatchError("K is singular")
    return CameraModel(shape_vu, 1.0, k[:2, :2], k[1::-1, 2])
