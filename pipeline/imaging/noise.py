"""Noise of a pixel as a function of its level, for extended light where a background's scatter says nothing."""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.records import BoolArray, FloatArray, Image

# Immerkaer 1996: this filter is blind to planes and has a norm of six.
_LAPLACIAN = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_TILE = 16
# Standard deviation over mean absolute value of a normal variable.
_MEAN_TO_SIGMA = 1.2533
# Levels are binned so that each bin's noise is a quantile over many tiles: texture only ever adds to it.
_BINS = 12
_QUIET_QUANTILE = 0.3
_LEAST_TILES = 3


@dataclass(frozen=True)
class PixelNoise:
    """``variance = read^2 + max(level - bias, 0) / gain``.

    Attributes
    ----------
    read_dn
        Noise without light, rounding included.
    dn2_per_dn
        Variance per level: one over the gain.
    bias_dn
        Level without light.
    """

    read_dn: float
    dn2_per_dn: float
    bias_dn: float

    def variance(self, level_dn: Image | FloatArray) -> FloatArray:
        """Variance of pixels whose expected level is known, same shape."""
        return np.asarray(self.read_dn**2 + self.dn2_per_dn * np.clip(level_dn - self.bias_dn, 0.0, None))


def pixel_noise(
    image: Image, bad: BoolArray, read_dn: float | None, gain_e_per_dn: float | None, bias_dn: float
) -> PixelNoise:
    """Noise from the camera's figures, and from the image where they are unknown.

    Parameters
    ----------
    image
        (rows, cols) DN as read.
    bad
        (rows, cols) True where not to look.
    read_dn, gain_e_per_dn
        None where unknown.
    bias_dn
        Level without light.

    Returns
    -------
    PixelNoise
        Its variance is never zero.
    """
    if read_dn is not None and gain_e_per_dn is not None:
        return PixelNoise(max(read_dn, 1e-12), 1.0 / gain_e_per_dn, bias_dn)
    level, variance = _tiles(image, bad)
    if not len(level):
        return PixelNoise(read_dn or 1.0, 1.0 / gain_e_per_dn if gain_e_per_dn else 0.0, bias_dn)
    slope = 1.0 / gain_e_per_dn if gain_e_per_dn else _slope(level, variance, read_dn, bias_dn)
    if read_dn is None:
        left = variance - slope * np.clip(level - bias_dn, 0.0, None)
        low = level <= np.quantile(level, 0.5)
        read_dn = float(np.sqrt(max(np.median(left[low]), 0.0)))
    floor = 1e-6 * float(np.abs(level).max()) + 1e-12
    return PixelNoise(max(read_dn, floor), slope, bias_dn)


def _tiles(image: Image, bad: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Level and noise variance of square tiles without bad pixels, the quietest of each level."""
    rows, cols = (n // _TILE * _TILE for n in image.shape)
    if not rows or not cols:
        return np.zeros(0), np.zeros(0)
    size = (cols // _TILE, rows // _TILE)
    rough = np.abs(cv2.filter2D(image, cv2.CV_32F, _LAPLACIAN))[:rows, :cols]
    touched = cv2.dilate(bad.astype(np.uint8), np.ones((3, 3), np.uint8))[:rows, :cols].astype(np.float32)
    means = [cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in (image[:rows, :cols], rough, touched)]
    clean = means[2] == 0
    level, spread = (plane[clean].astype(float) for plane in means[:2])
    variance = (_MEAN_TO_SIGMA * spread) ** 2
    return _quiet(level, variance)


def _quiet(level: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bins of level with the noise of their quieter tiles."""
    if len(level) < _LEAST_TILES or np.ptp(level) == 0:
        return level, variance
    edges = np.linspace(level.min(), level.max(), _BINS + 1)
    index = np.clip(np.digitize(level, edges) - 1, 0, _BINS - 1)
    kept = [k for k in range(_BINS) if np.count_nonzero(index == k) >= _LEAST_TILES]
    middle = np.array([level[index == k].mean() for k in kept])
    return middle, np.array([np.quantile(variance[index == k], _QUIET_QUANTILE) for k in kept])


def _slope(level: FloatArray, variance: FloatArray, read_dn: float | None, bias_dn: float) -> float:
    """Variance per level: median slope of the bins from their zero point, never negative."""
    light = level - bias_dn
    if read_dn is not None:
        use = light > 0.2 * light.max()
        return max(float(np.median((variance[use] - read_dn**2) / light[use])), 0.0) if light.max() > 0 else 0.0
    pairs = [
        (variance[j] - variance[i]) / (level[j] - level[i])
        for i in range(len(level))
        for j in range(i + 1, len(level))
        if level[j] > level[i]
    ]
    return max(float(np.median(pairs)), 0.0) if pairs else 0.0
