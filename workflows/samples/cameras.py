"""The cameras of the star sample and their own projection code, written apart from the navigator's.

Camera frame: right-handed, +z out of the lens. A direction (X, Y, Z) meets the photo plane at x = f X/Z, y = f Y/Z
(mm), is displaced by the lens and lands on the pixel ``u = p_u + Kx x + Kxy y``, ``v = p_v + Kyx x + Ky y``; pixels are
(v, u) = (row, column) with the centre of the first pixel at (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SampleCamera:
    """What one sample camera is and how its frames are taken.

    Attributes
    ----------
    k_px_per_mm
        ((Kx, Kxy), (Kyx, Ky)), px/mm.
    principal_point_vu
        Pixel of the optical axis (v, u).
    distortion_eps
        Owen's e1..e6 for coordinates in mm.
    psf_sigma_px
        Sigma of the Gaussian star image, before integration over the pixel.
    image_error_px
        Sigma per axis by which star images miss the pixel that the ideal camera gives them: distortion and shape of
        the PSF that nobody has calibrated. Zero where the sidecar's camera is the whole truth.
    read_noise_dn
        Sigma of all noise that does not depend on light, the rounding to integers included.
    saturation_dn
        Largest value the frame can hold; the bias is part of it for raw frames.
    missing_value
        Value that fills lost lines, or None where none are lost.
    search_margin_vu
        How far the navigator is told to look; planted offsets stay within 0.9 of it.
    exposures_s
        Exposure times a frame may have.
    faint_mags
        Range of the synthetic catalogue stars; empty where the real catalogue is dense enough.
    years, distance_au, speed_kms
        Ranges of the mission's dates, heliocentric distance and speed.
    """

    name: str
    mission: str
    instrument: str
    shape_vu: tuple[int, int]
    focal_length_mm: float
    k_px_per_mm: tuple[tuple[float, float], tuple[float, float]]
    principal_point_vu: tuple[float, float]
    distortion_eps: tuple[float, float, float, float, float, float]
    psf_sigma_px: float
    read_noise_dn: float
    gain_e_per_dn: float
    bias_dn: float
    background_dn: float
    saturation_dn: float
    missing_value: int | None
    star_dn_per_s_mag0: float
    search_margin_vu: tuple[float, float]
    fit_camera_rotation: bool
    exposures_s: tuple[float, ...]
    faint_mags: tuple[float, ...]
    image_error_px: float
    years: tuple[float, float]
    distance_au: tuple[float, float]
    speed_kms: tuple[float, float]

    @property
    def is_lorri(self) -> bool:
        """Whether frames follow LORRI level 2: float, bias taken off, pointing in the header, no sidecar."""
        return self.instrument == "LORRI"

    @property
    def centre_vu(self) -> FloatArray:
        """Centre of the array, (v, u) px."""
        return (np.array(self.shape_vu, dtype=np.float64) - 1.0) / 2.0

    @property
    def handedness(self) -> float:
        """Sign of det K: -1 where the stored array is a mirror image of the sky seen through the lens."""
        return float(np.sign(np.linalg.det(np.array(self.k_px_per_mm))))

    @property
    def rad_per_px(self) -> float:
        """Angle of one pixel on the axis, rad."""
        return float(1.0 / (self.focal_length_mm * np.sqrt(abs(np.linalg.det(np.array(self.k_px_per_mm))))))


def distort(xy_mm: FloatArray, eps: tuple[float, ...]) -> FloatArray:
    """Move ideal photo-plane points to where the lens puts them.

    Owen's model as JPL's optical navigation uses it for Cassini ISS:
    ``x' = x (1 + e1 r^2 + e2 r^4 + e3 y + e4 x) + (e5 r + e6 r^3)(-y, x)``.

    Parameters
    ----------
    xy_mm
        (n, 2) ideal points (x, y), mm.
    eps
        e1..e6 in the matching powers of 1/mm.
    """
    x, y = xy_mm[:, 0], xy_mm[:, 1]
    r = np.hypot(x, y)
    stretch = 1.0 + eps[0] * r**2 + eps[1] * r**4 + eps[2] * y + eps[3] * x
    twist = eps[4] * r + eps[5] * r**3
    return np.stack([x * stretch - y * twist, y * stretch + x * twist], axis=1)


def project(camera: SampleCamera, directions: FloatArray) -> FloatArray:
    """Return the pixels (n, 2) (v, u) of directions (n, 3) in the camera frame; behind the camera they are NaN."""
    ahead = np.where(directions[:, 2:] > 0.0, directions[:, 2:], np.nan)
    plane = distort(camera.focal_length_mm * directions[:, :2] / ahead, camera.distortion_eps)
    uv = plane @ np.array(camera.k_px_per_mm).T
    pixels_vu: FloatArray = uv[:, ::-1] + np.array(camera.principal_point_vu)
    return pixels_vu


def unproject(camera: SampleCamera, pixels_vu: FloatArray) -> FloatArray:
    """Return the unit directions (n, 3), camera frame, that land on pixels (n, 2) (v, u)."""
    uv = (pixels_vu - np.array(camera.principal_point_vu))[:, ::-1]
    wanted = np.linalg.solve(np.array(camera.k_px_per_mm), uv.T).T
    plane = wanted.copy()
    # The displacement is small and smooth, so substitution gains three digits a turn.
    for _ in range(12):
        plane += wanted - distort(plane, camera.distortion_eps)
    rays = np.column_stack([plane, np.full(len(plane), camera.focal_length_mm)])
    unit: FloatArray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit
