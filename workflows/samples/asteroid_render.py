"""Light of one frame of the asteroid sample: rays through parts of every pixel, the optics, and the detector."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter

from workflows.samples.asteroid_plan import AsteroidShot, eye_of
from workflows.samples.asteroid_rays import Ground, look, weight_of
from workflows.samples.cameras import FloatArray, SampleCamera, unproject
from workflows.samples.flyby_expose import Taken

SUB = 2
"""Rays along each side of a pixel; a pixel is about as wide as the cells of the body's maps."""
BORDER_PX = 6
"""Light from this far outside the array is followed: four sigma of the broad part of the point spread function."""
LIT_SHARE = 0.1
"""Pixels brighter than this share of the bright ones are the lit surface."""
FULLEST = 0.9
"""Share of the full scale that the light of a frame reaches at most."""
BYTE_TOP = 240.0
"""Frames that stay below are stored as bytes."""


@lru_cache(maxsize=2)
def _rays(camera: SampleCamera) -> FloatArray:
    """Return the unit directions (n, 3), camera frame, of all parts of all pixels of the array and its border."""
    sides = [(np.arange((size + 2 * BORDER_PX) * SUB) + 0.5) / SUB - 0.5 - BORDER_PX for size in camera.shape_vu]
    return unproject(camera, np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2))


def light_of(item: AsteroidShot, ground: Ground) -> FloatArray:
    """Return the noise-free light (rows, columns) of a frame for a brightness factor of one."""
    shot, sighting = item.shot, item.sighting()
    optics = shot.camera.optics
    rays = np.ascontiguousarray(_rays(optics) @ shot.truth @ sighting.from_j2000.T)
    sun = sighting.from_j2000 @ sighting.sun
    light = look(ground, eye_of(sighting), rays, sun, weight_of(sighting.phase_rad))
    rows, columns = (size + 2 * BORDER_PX for size in optics.shape_vu)
    fine = light.reshape(rows * SUB, columns * SUB).astype(float)
    core = gaussian_filter(fine, optics.psf_sigma_px * SUB, truncate=5.0)
    pixels = core.reshape(rows, SUB, columns, SUB).mean(axis=(1, 3))
    share, sigma = shot.camera.wings
    mixed = (1.0 - share) * pixels + share * gaussian_filter(pixels, sigma)
    return np.asarray(mixed[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX])


def _factor(item: AsteroidShot, light: FloatArray) -> tuple[float, float]:
    """Return the DN of a brightness of one, and the signal to noise of the lit surface that it gives."""
    optics = item.shot.camera.optics
    lit = float(light[light > LIT_SHARE * np.percentile(light, 99.0)].mean())
    still = optics.read_noise_dn**2 + optics.background_dn / optics.gain_e_per_dn
    half = item.shot.snr**2 / (2.0 * optics.gain_e_per_dn)
    wanted = half + np.sqrt(half**2 + item.shot.snr**2 * still)
    room = FULLEST * (optics.saturation_dn - optics.bias_dn - optics.background_dn) / float(light.max())
    factor = min(wanted / lit, room)
    return factor, factor * lit / float(np.sqrt(still + factor * lit / optics.gain_e_per_dn))


def expose(item: AsteroidShot, ground: Ground) -> tuple[Taken, float]:
    """Return the stored frame of a shot, and the signal to noise of the lit surface."""
    rng = np.random.default_rng([item.shot.seed, item.shot.index, 42])
    optics = item.shot.camera.optics
    light = light_of(item, ground)
    factor, snr = _factor(item, light)
    expected = factor * light + optics.background_dn
    electrons = rng.poisson(np.maximum(expected, 0.0) * optics.gain_e_per_dn)
    # The stated read noise holds the rounding, so the electronics' share is what is left.
    sigma = np.sqrt(optics.read_noise_dn**2 - 1.0 / 12.0)
    image = electrons / optics.gain_e_per_dn + rng.standard_normal(light.shape) * sigma + optics.bias_dn
    useless = image >= optics.saturation_dn
    # Zero stands for what was never received.
    image = np.maximum(np.rint(np.minimum(image, optics.saturation_dn)), 1.0)
    return Taken(image, useless, 0, bool(image.max() < BYTE_TOP)), snr
