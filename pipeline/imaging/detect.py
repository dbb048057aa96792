"""Blind detection of point sources: matched filter, local maxima, fits, and what is not a star."""

import cv2
import numpy as np
from pydantic import Field
from scipy.special import chdtri

from pipeline.imaging.psf import PointSources, PointSpread, fit_point_sources
from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Image

# Half-width of the window in which a saturated star's blob is measured.
_BLOB_REACH_PX = 20


class DetectionOptions(Options):
    """Thresholds of the blind search."""

    threshold_sigma: float = Field(5.0, ge=3, le=100, description="peak of the matched filter over its noise")
    max_sources: int = Field(400, ge=10, le=5000, description="brightest sources kept")
    shape_chance: float = Field(
        1e-6, gt=0, lt=0.1, description="chance below which a fit's chi-square marks a cosmic ray or a hot pixel"
    )


def kernel_of(spread: PointSpread) -> FloatArray:
    """Unit-sum matched-filter kernel of a point source.

    Parameters
    ----------
    spread
        Its shape.

    Returns
    -------
    numpy.ndarray
        (k, k) odd-sized.
    """
    radius = max(2, int(np.ceil(2.5 * spread.sigma_px + spread.trail_px / 2)))
    axis = np.arange(-radius, radius + 1, dtype=float)
    # Integrating over the pixel adds 1/12 px^2 of variance; as a filter the difference in shape is immaterial.
    width = spread.sigma_px**2 + 1.0 / 12.0
    kernel = np.zeros((len(axis), len(axis)))
    for step in range(spread.substeps):
        along = (step + 0.5) / spread.substeps - 0.5
        dv, du = axis - along * spread.trail_vu[0], axis - along * spread.trail_vu[1]
        kernel += np.exp(-(dv[:, None] ** 2 + du[None, :] ** 2) / (2 * width))
    return np.asarray(kernel / kernel.sum())


def matched_filter_snr(image: Image, bad: BoolArray, sigma: Image, spread: PointSpread) -> Image:
    """Significance of a point source centred on each pixel.

    Parameters
    ----------
    image
        (rows, cols) background-subtracted DN.
    bad
        (rows, cols) True where a pixel counts as empty background.
    sigma
        (rows, cols) noise.
    spread
        Shape of a point source.

    Returns
    -------
    numpy.ndarray
        (rows, cols) float32.
    """
    lowest, highest, _, _ = cv2.minMaxLoc(sigma)
    # Noise is the same everywhere in most frames, and a product is four times as fast as a quotient of images.
    clean = image * np.float32(1.0 / lowest) if lowest == highest else np.divide(image, sigma, dtype=np.float32)
    clean[bad] = 0.0
    kernel = kernel_of(spread)
    if spread.trail_px == 0.0:
        line = kernel.sum(axis=0).astype(np.float32)
        filtered = cv2.sepFilter2D(clean, cv2.CV_32F, line, line, borderType=cv2.BORDER_CONSTANT)
    else:
        filtered = cv2.filter2D(clean, cv2.CV_32F, kernel.astype(np.float32), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered / np.float32(np.sqrt((kernel**2).sum())), np.float32)


def local_maxima(snr: Image, threshold: float, radius_px: int, count: int) -> FloatArray:
    """Pixels that no neighbour exceeds, brightest first.

    Parameters
    ----------
    snr
        (rows, cols) filter response.
    threshold
        Least response.
    radius_px
        Reach of the comparison.
    count
        Most maxima returned.

    Returns
    -------
    numpy.ndarray
        (n, 2) pixels, refined to the parabola through the neighbours.
    """
    size = 2 * radius_px + 1
    highest = cv2.dilate(snr, np.ones((size, size), np.uint8))
    flat = snr.ravel()
    high = np.flatnonzero(flat > threshold)
    v, u = np.unravel_index(high[flat[high] >= highest.ravel()[high]], snr.shape)
    # Ties are broken by position so that the order never depends on the sort's internals.
    order = np.lexsort((u, v, -snr[v, u]))[:count]
    v, u = v[order], u[order]
    rows, cols = snr.shape
    here = snr[v, u]
    position = np.stack([v, u], axis=1).astype(float)
    for axis, (dv, du) in enumerate(((1, 0), (0, 1))):
        before = snr[np.maximum(v - dv, 0), np.maximum(u - du, 0)]
        after = snr[np.minimum(v + dv, rows - 1), np.minimum(u + du, cols - 1)]
        curve = 2 * here - before - after
        step = np.divide(after - before, 2 * curve, out=np.zeros_like(here), where=curve > 1e-6)
        position[:, axis] += np.clip(step, -0.5, 0.5)
    return position


def detect_point_sources(
    image: Image,
    bad: BoolArray,
    saturated: BoolArray,
    sigma: Image,
    gain_e_per_dn: float | None,
    spread: PointSpread,
    options: DetectionOptions,
) -> PointSources:
    """Find and fit every point source that looks like a star.

    Parameters
    ----------
    image, sigma
        (rows, cols) background-subtracted DN and noise.
    bad, saturated
        (rows, cols) pixels not to be used, and those of them that are full (which do count for finding).
    gain_e_per_dn
        For shot noise.
    spread
        Shape of a point source.
    options
        Thresholds.

    Returns
    -------
    PointSources
        Brightest first; fits that failed and shapes that no star has are gone.
    """
    snr = matched_filter_snr(image, bad & ~saturated, sigma, spread)
    # A wide plateau of full pixels has several equal maxima: one search radius keeps one of them.
    radius = max(2, int(np.ceil(2 * spread.sigma_px + spread.trail_px / 2)))
    starts = local_maxima(snr, options.threshold_sigma, radius, options.max_sources)
    starts = _centre_on_saturation(starts, saturated)
    fits = fit_point_sources(image, bad, saturated, sigma, gain_e_per_dn, spread, starts)
    fits = fits.take(np.flatnonzero(fits.ok & star_like(fits, spread, options)))
    return _without_repeats(fits, spread)


def star_like(fits: PointSources, spread: PointSpread, options: DetectionOptions) -> BoolArray:
    """True where a fit's chi-square is one that a star of that brightness can have.

    Parameters
    ----------
    fits
        Fitted sources.
    spread
        How far a real star may miss the Gaussian.
    options
        Chance level.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    dof = np.maximum(fits.dof, 1)
    limit = chdtri(dof, options.shape_chance)
    # A misfit of a given share of the star's light grows with the square of its signal to noise.
    allowed = limit + (spread.misfit * fits.snr) ** 2
    return np.asarray((fits.chi2 <= allowed) & (fits.snr > 0))


def _centre_on_saturation(starts_vu: FloatArray, saturated: BoolArray) -> FloatArray:
    """Start at the middle of the saturated blob a start falls on; the filter's maximum there is arbitrary."""
    at = np.clip(np.rint(starts_vu).astype(int), 0, np.array(saturated.shape) - 1)
    moved = starts_vu.copy()
    for row in np.flatnonzero(saturated[at[:, 0], at[:, 1]]):
        low = np.maximum(at[row] - _BLOB_REACH_PX, 0)
        window = saturated[low[0] : at[row, 0] + _BLOB_REACH_PX + 1, low[1] : at[row, 1] + _BLOB_REACH_PX + 1]
        _, labels, _, centroids = cv2.connectedComponentsWithStats(window.astype(np.uint8), connectivity=8)
        inside = tuple(at[row] - low)
        moved[row] = centroids[labels[inside]][::-1] + low
    return moved


def _without_repeats(fits: PointSources, spread: PointSpread) -> PointSources:
    """Drop fits that converged onto a brighter one."""
    order = np.lexsort((fits.position_vu[:, 1], fits.position_vu[:, 0], -fits.flux_dn))
    fits = fits.take(order)
    if len(fits) < 2:
        return fits
    v, u = fits.position_vu.T
    close = (np.abs(v[:, None] - v) < spread.sigma_px) & (np.abs(u[:, None] - u) < spread.sigma_px)
    repeats = np.tril(close, k=-1).any(axis=1)
    return fits.take(np.flatnonzero(~repeats))
