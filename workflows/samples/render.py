"""Draw one frame of the star sample: stars by brute force over sub-pixels and sub-exposures, then the detector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workflows.samples.cameras import FloatArray, SampleCamera, project, unproject
from workflows.samples.photometry import Exposure
from workflows.samples.scene import Hits, Sources

SUB_PIXELS = 9
"""Samples per pixel and axis; good to 1e-2 of a percent of the peak for sigma >= 0.5 px."""
TRAIL_STEPS_PER_PX = 8
"""Positions per pixel along a trail, finer than any PSF here."""
FAINTEST_DN = 0.003
"""A stamp reaches to where the star adds less than this to a pixel."""


def trails(camera: SampleCamera, pixels_vu: FloatArray, exposure: Exposure) -> FloatArray:
    """Return how far (n, 2) (dv, du) px the light of stars at pixels (n, 2) at mid-exposure runs during all of it.

    A camera that turns by w t about its own axes sees a direction s move to s - w t x s.
    """
    rays = unproject(camera, pixels_vu)
    half = np.cross(exposure.rate_rad_s, rays) * exposure.seconds / 2.0
    return project(camera, rays - half) - project(camera, rays + half)


def _profile(centres: FloatArray, sigma: float, first: int, count: int) -> FloatArray:
    """Return the share (t, count) of unit Gaussians at centres (t,) that falls into count pixels from `first` on."""
    fine = (np.arange(count * SUB_PIXELS) + 0.5) / SUB_PIXELS - 0.5 + first
    density = np.exp(-0.5 * ((fine - centres[:, None]) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    share: FloatArray = density.reshape(len(centres), count, SUB_PIXELS).mean(axis=2)
    return share


def star_stamp(sigma: float, vu: FloatArray, trail_vu: FloatArray, flux_dn: float) -> tuple[int, int, FloatArray]:
    """Return the first row, the first column and the DN of the pixels one star lights.

    Parameters
    ----------
    sigma
        Of the Gaussian core, px.
    vu, trail_vu
        (2,) middle of the trail and its extent, px.
    flux_dn
        Total DN.
    """
    steps = max(1, int(np.ceil(TRAIL_STEPS_PER_PX * float(np.hypot(*trail_vu)))))
    along = (np.arange(steps) + 0.5) / steps - 0.5
    peak = flux_dn / (2.0 * np.pi * sigma**2)
    reach = 1.0 + sigma * np.sqrt(2.0 * np.log(max(peak / FAINTEST_DN, 2.0)))
    first = np.floor(vu - np.abs(trail_vu) / 2.0 - reach).astype(int)
    count = np.ceil(vu + np.abs(trail_vu) / 2.0 + reach).astype(int) - first + 1
    # A Gaussian factors into rows and columns at each instant, so the sum over instants is a matrix product.
    rows = _profile(vu[0] + along * trail_vu[0], sigma, int(first[0]), int(count[0]))
    columns = _profile(vu[1] + along * trail_vu[1], sigma, int(first[1]), int(count[1]))
    return int(first[0]), int(first[1]), flux_dn / steps * (rows.T @ columns)


def add_stars(light: FloatArray, camera: SampleCamera, stars: Sources, exposure: Exposure) -> None:
    """Add the stars' DN to an image (rows, columns) in place."""
    extents = trails(camera, stars.vu, exposure)
    for vu, extent, flux in zip(stars.vu, extents, stars.flux_dn, strict=True):
        row, column, stamp = star_stamp(camera.psf_sigma_px, vu, extent, float(flux))
        top, left = max(row, 0), max(column, 0)
        bottom, right = min(row + stamp.shape[0], light.shape[0]), min(column + stamp.shape[1], light.shape[1])
        if top < bottom and left < right:
            light[top:bottom, left:right] += stamp[top - row : bottom - row, left - column : right - column]


def sky_background(camera: SampleCamera, rng: np.random.Generator) -> FloatArray:
    """Return the smooth background (rows, columns), DN: a level and slopes of up to a fifth of it edge to edge."""
    level = camera.background_dn * rng.uniform(0.7, 1.3)
    slope_v, slope_u = level * rng.uniform(-0.1, 0.1, 2)
    v = np.linspace(-1.0, 1.0, camera.shape_vu[0])[:, None]
    u = np.linspace(-1.0, 1.0, camera.shape_vu[1])[None, :]
    background: FloatArray = level + slope_v * v + slope_u * u
    return background


def expose(light: FloatArray, camera: SampleCamera, hits: Hits, rng: np.random.Generator) -> FloatArray:
    """Return a stored frame (rows, columns), DN: photon noise, read noise, stray charge, bias, saturation, rounding.

    Raw cameras round to integers and cut at zero; LORRI level 2 stays real and keeps negative values.
    """
    noisy = rng.poisson(light * camera.gain_e_per_dn) / camera.gain_e_per_dn
    np.add.at(noisy, (hits.pixels[:, 0], hits.pixels[:, 1]), hits.dn)
    rounding = 0.0 if camera.is_lorri else 1.0 / 12.0
    # The stated read noise holds the rounding, so the electronics' share is what is left.
    noisy += rng.standard_normal(noisy.shape) * np.sqrt(camera.read_noise_dn**2 - rounding)
    noisy += camera.bias_dn
    if camera.is_lorri:
        return np.minimum(noisy, camera.saturation_dn)
    return np.clip(np.rint(noisy), 0.0, camera.saturation_dn)


def lose_lines(
    camera: SampleCamera, stars_vu: FloatArray, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Draw what of a frame never arrived: up to three runs of whole lines and one block.

    At most one detectable star in five is lost, so that a thin field stays a field.

    Parameters
    ----------
    stars_vu
        (n, 2) detectable stars, px.

    Returns
    -------
    missing (rows, columns) and, per star, whether its centre is among it.
    """
    missing = np.zeros(camera.shape_vu, dtype=np.bool_)
    at = tuple(np.rint(stars_vu).astype(int).T)
    if camera.missing_value is None:
        return missing, missing[at]
    rows, columns = camera.shape_vu
    for _ in range(int(rng.integers(0, 4))):
        top = int(rng.integers(0, rows - 6))
        trial = missing.copy()
        trial[top : top + int(rng.integers(1, 7))] = True
        missing = trial if trial[at].sum() <= len(stars_vu) // 5 else missing
    if rng.random() < 0.3:
        top, left = int(rng.integers(0, rows - 40)), int(rng.integers(0, columns - 200))
        trial = missing.copy()
        trial[top : top + int(rng.integers(8, 40)), left : left + int(rng.integers(40, 200))] = True
        missing = trial if trial[at].sum() <= len(stars_vu) // 5 else missing
    return missing, missing[at]
