"""Background level and noise from tiles of the image."""

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from pydantic import Field

from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Image

# Quantiles of a normal distribution at -1, 0 and +1 standard deviations.
_QUANTILES = (0.158655, 0.5, 0.841345)
# A tile with fewer valid samples says nothing and takes its neighbours' values.
_MIN_TILE_SAMPLES = 24


class BackgroundOptions(Options):
    """How finely the background is followed."""

    tile_px: int = Field(64, ge=8, le=1024, description="side of a tile, pixels")
    stride_px: int = Field(4, ge=1, le=16, description="spacing of the samples inside a tile, pixels")


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


@numba.njit(cache=True, nogil=True)
def _tile_quantiles(image, bad, edges_v, edges_u, stride, quantiles, out):  # type: ignore[no-untyped-def]
    longest_v, longest_u = np.diff(edges_v).max(), np.diff(edges_u).max()
    sample = np.empty((longest_v // stride + 1) * (longest_u // stride + 1), dtype=np.float32)
    for i in range(len(edges_v) - 1):
        for j in range(len(edges_u) - 1):
            count = 0
            for v in range(edges_v[i], edges_v[i + 1], stride):
                for u in range(edges_u[j], edges_u[j + 1], stride):
                    if not bad[v, u]:
                        sample[count] = image[v, u]
                        count += 1
            if count < _MIN_TILE_SAMPLES:
                out[i, j, :] = np.nan
                continue
            ordered = np.sort(sample[:count])
            out[i, j, 0] = ordered[0]
            for k in range(len(quantiles)):
                out[i, j, k + 1] = ordered[int(quantiles[k] * (count - 1) + 0.5)]


def _edges(length: int, tile: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.linspace(0, length, max(1, round(length / tile)) + 1).astype(np.int64)


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
    edges_v, edges_u = _edges(rows, options.tile_px), _edges(cols, options.tile_px)
    out = np.empty((len(edges_v) - 1, len(edges_u) - 1, 4))
    _tile_quantiles(image, bad, edges_v, edges_u, options.stride_px, np.array(_QUANTILES), out)
    lowest, low, middle, high = np.moveaxis(out, 2, 0)
    clipped = low <= lowest
    sigma = np.where(clipped, high - middle, middle - low)
    level, sigma = _fill_gaps(middle), _fill_gaps(sigma)
    shot = np.clip(level, 0, None) / gain_e_per_dn if gain_e_per_dn else 0.0
    # Neighbouring tiles share their noise; the median over 3x3 of them steadies a figure from a few hundred samples.
    steady = cv2.medianBlur(sigma.astype(np.float32), 3) if min(sigma.shape) >= 3 else sigma
    sigma = np.maximum(steady, np.sqrt(noise_floor_dn**2 + shot))
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
