"""Background level and noise from tiles of the image."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Image

# Quantiles of a normal distribution at -1, 0 and +1 standard deviations.
_QUANTILES = (0.158655, 0.5, 0.841345)
# A tile with fewer valid samples says nothing and takes its neighbours' values.
_MIN_TILE_SAMPLES = 24
# Tiles' noise figures scatter by a few per cent: within this factor they are one figure.
_EVEN_NOISE = 1.25


class BackgroundOptions(Options):
    """How finely the background is followed."""

    tile_px: int = Field(64, ge=8, le=1024, description="side of a tile, pixels")
    samples_per_side: int = Field(16, ge=6, le=64, description="samples along each side of a tile")


@dataclass(frozen=True)
class Background:
    """Smooth level and noise of an image, and of its tiles.

    Attributes
    ----------
    level, sigma
        (rows, cols) float32, DN.
    tile_level, tile_sigma
        (tile rows, tile cols), DN.
    """

    level: Image
    sigma: Image
    tile_level: FloatArray
    tile_sigma: FloatArray


def _sample_positions(length: int, tile: int, samples: int) -> NDArray[np.int64]:
    """(tiles, samples) positions along an axis, evenly spread over each tile."""
    edges = np.linspace(0, length, max(1, round(length / tile)) + 1)
    share = (np.arange(samples) + 0.5) / samples
    return (edges[:-1, None] + np.diff(edges)[:, None] * share).astype(np.int64)


def _tile_quantiles(image: Image, bad: BoolArray, options: BackgroundOptions) -> tuple[FloatArray, FloatArray]:
    """(tiles v, tiles u) lowest valid sample, and (3, tiles v, tiles u) quantiles; NaN where too few are valid."""
    rows = _sample_positions(image.shape[0], options.tile_px, options.samples_per_side)
    cols = _sample_positions(image.shape[1], options.tile_px, options.samples_per_side)
    at = np.ix_(rows.ravel(), cols.ravel())
    shape = (len(rows), options.samples_per_side, len(cols), options.samples_per_side)
    samples = np.where(bad[at], np.float32(np.nan), image[at]).reshape(shape).transpose(0, 2, 1, 3)
    # Not-a-number sorts last, so the valid samples of a tile are its first ones.
    ordered = np.sort(samples.reshape(len(rows), len(cols), -1), axis=2)
    count = np.count_nonzero(np.isfinite(ordered), axis=2)
    usable = count >= _MIN_TILE_SAMPLES
    index = np.rint(np.multiply.outer(_QUANTILES, np.maximum(count - 1, 0))).astype(np.int64)
    picked = np.take_along_axis(ordered[None], index[..., None], axis=3)[..., 0].astype(float)
    return np.where(usable, ordered[:, :, 0], np.nan), np.where(usable, picked, np.nan)


def _fill_gaps(values: FloatArray) -> FloatArray:
    gaps = ~np.isfinite(values)
    if not gaps.any():
        return values
    return np.where(gaps, np.nanmedian(values) if not gaps.all() else 0.0, values)


def _spread(values: FloatArray, shape_vu: tuple[int, int]) -> Image:
    """Tile values at every pixel, bilinear between tile centres."""
    spread = cv2.resize(values.astype(np.float32), shape_vu[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(spread, np.float32)


def estimate_background(
    image: Image, bad: BoolArray, noise_floor_dn: float, gain_e_per_dn: float | None, options: BackgroundOptions
) -> Background:
    """Median and noise of tiles, spread over the image.

    The noise is the distance from the median down to the 16 % quantile, which stars do not touch; where the sensor
    clips that side, it is the distance up to the 84 % quantile.

    Parameters
    ----------
    image
        (rows, cols) DN, finite.
    bad
        (rows, cols) True where a pixel is not to be used.
    noise_floor_dn
        The noise is never taken to be below this (read noise and quantisation).
    gain_e_per_dn
        Unused pixels aside, the shot noise of the level raises the floor where the gain is known.
    options
        Tile size and stride.

    Returns
    -------
    Background
        Level and noise.
    """
    rows, cols = image.shape
    lowest, (low, middle, high) = _tile_quantiles(image, bad, options)
    clipped = low <= lowest
    sigma = np.where(clipped, high - middle, middle - low)
    level, sigma = _fill_gaps(middle), _fill_gaps(sigma)
    shot = np.clip(level, 0, None) / gain_e_per_dn if gain_e_per_dn else 0.0
    # Neighbouring tiles share their noise; the median over 3x3 of them steadies a figure from a few hundred samples.
    steady = cv2.medianBlur(sigma.astype(np.float32), 3) if min(sigma.shape) >= 3 else sigma
    sigma = np.maximum(steady, np.sqrt(noise_floor_dn**2 + shot))
    if sigma.max() <= _EVEN_NOISE * sigma.min():
        sigma = np.full_like(sigma, np.median(sigma))
    return Background(_spread(level, (rows, cols)), _spread(sigma, (rows, cols)), level, sigma)


def estimate_gain(background: Background, read_noise_dn: float) -> float | None:
    """Gain from how the tiles' variance grows with their level, if the image spans enough of it.

    Parameters
    ----------
    background
        Tiles of :func:`estimate_background`, made without a gain.
    read_noise_dn
        Noise at zero level.

    Returns
    -------
    float or None
        Electrons per DN; None when the levels span too little to tell (slope below three of its own sigmas).
    """
    level = background.tile_level.ravel()
    variance = background.tile_sigma.ravel() ** 2 - read_noise_dn**2
    spread = level - level.mean()
    power = float(spread @ spread)
    if len(level) < 8 or power <= 0:
        return None
    slope = float(spread @ (variance - variance.mean())) / power
    residual = variance - variance.mean() - slope * spread
    slope_sigma = float(np.sqrt(residual @ residual / max(len(level) - 2, 1) / power))
    return 1.0 / slope if slope > 3.0 * slope_sigma > 0 else None
