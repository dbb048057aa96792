"""Correlation of a maplet's predicted with its extracted image, and from its peak an offset with a covariance.

Source: seed 001 section 3.5 with the project's corrections. A shift s in cells means predicted(x - s) ~ extracted(x).
Beyond the document every peak carries a 2 x 2 covariance: that of a regression of the extracted image on the predicted
one and its two derivatives, and what light that the cells do not resolve may add.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numba
import numpy as np
from pydantic import Field

from pipeline.geometry.maplet import Maplet, MapletView
from pipeline.imaging.maplet_images import (
    MapletImageOptions,
    MapletImages,
    brightness_scale,
    grid_pixels,
    images_of,
    prepare_maplet,
)
from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Image, Record
from pipeline.techniques.maplet_regression import overlap, regressed_shift, unresolved_shift
from pipeline.techniques.maplet_search import stands_alone, wide_surface, widest_bin

# Shifts on each side: SPC's 11 x 11 grid.
REACH = 5
# From this search radius on the maplet's own footprint is too small a window.
_WIDE_SEARCH_PX = 40.0
# Residuals within a block of cells may be alike: at least so many cells, and so many pixels, along a side.
_BLOCK_CELLS = 6
_BLOCK_PX = 3.0
# Peak and regression farther apart than this are not averaged: the regression is linear in the shift.
_MOST_APART_CELLS = 1.0


class PeakStatus(StrEnum):
    """How a correlation ended; a column of the table ``landmarks``."""

    FOUND = "found"
    TOO_FEW_CELLS = "too_few_cells"
    NO_VARIATION = "no_variation"
    ON_BORDER = "on_border"
    NO_MAXIMUM = "no_maximum"
    LOW_CORRELATION = "low_correlation"
    AMBIGUOUS = "ambiguous"


class CorrelationOptions(Options):
    """Grid, sub-pixel method and what counts as a match."""

    bin_start: int = Field(1, ge=1, le=24, description="5 bins of this size to each side are searched first")
    every_bin: bool = Field(
        False, description="one bin after the other as in SPC; else by halves, after one wide search in small bins"
    )
    subpixel: Literal["quadratic", "taylor"] = Field("quadratic", description="fit of the peak, over 3 x 3 or per axis")
    least_correlation: float = Field(0.35, ge=-1, le=1, description="correlation below which nothing was found")
    least_cells: int = Field(100, ge=9, description="cells valid in both images that a correlation needs")
    passes: int = Field(4, ge=1, le=10, description="correlations at bin 1 at most, each on images extracted anew")
    rival_share: float = Field(
        0.6, gt=0, le=1,
        description="from bin 2 on: what a peak may lack to a correlation of 1, over what the next one lacks",
    )  # fmt: skip
    tolerance_cells: float = Field(0.1, gt=0, description="shift below which no further pass is needed, cells")


@dataclass(frozen=True, eq=False)
class Peak(Record):
    """Peak of a correlation, in unbinned cells along the maplet's x and y.

    Attributes
    ----------
    status
        Only ``found`` has figures.
    shift_cells
        (2,).
    covariance_cells2
        (2, 2).
    correlation
        At the highest sample.
    cells
        Binned cells valid in both images there.
    """

    status: PeakStatus
    shift_cells: FloatArray
    covariance_cells2: FloatArray
    correlation: float
    cells: int

    def __post_init__(self) -> None:
        self._freeze(shift_cells=(2,), covariance_cells2=(2, 2))


@dataclass(frozen=True, eq=False)
class LandmarkMatch(Record):
    """Where a landmark was found.

    Attributes
    ----------
    status
        Of the last correlation.
    offset_vu
        (2,) observed minus predicted pixel; not-a-number where nothing was found.
    covariance_px2
        (2, 2) of it.
    correlation, cells, bin
        Of the last correlation.
    images
        The last pair.
    scale, background
        What turns predicted light into DN (eq. 3.42-3.45), of the last correlation that found something; 0 before.
    """

    status: PeakStatus
    offset_vu: FloatArray
    covariance_px2: FloatArray
    correlation: float
    cells: int
    bin: int
    images: MapletImages
    scale: float = 0.0
    background: float = 0.0

    def __post_init__(self) -> None:
        self._freeze(offset_vu=(2,), covariance_px2=(2, 2))


def bin_image(values: FloatArray, valid: BoolArray, size: int) -> tuple[FloatArray, BoolArray]:
    """Means of the valid cells of square blocks (eq. 3.57 as corrected: a mask says what is valid, not the sign).

    Parameters
    ----------
    values, valid
        (n, n) light and flags.
    size
        Side of a block; what does not fill a block at the end is dropped.

    Returns
    -------
    tuple
        (n // size, n // size) means, zero where no cell is valid; flags.
    """
    if size == 1:
        return np.where(valid, values, 0.0), valid
    blocks = len(values) // size
    cut = (slice(blocks * size), slice(blocks * size))
    shape = (blocks, size, blocks, size)
    number = valid[cut].reshape(shape).sum(axis=(1, 3))
    total = np.where(valid, values, 0.0)[cut].reshape(shape).sum(axis=(1, 3))
    return total / np.maximum(number, 1), number > 0


def correlation_surface(
    predicted: tuple[FloatArray, BoolArray], extracted: tuple[FloatArray, BoolArray], least_cells: int
) -> FloatArray:
    """Normalised correlation at the 11 x 11 shifts, over cells valid in both images at each (eq. 3.58 as corrected).

    Parameters
    ----------
    predicted
        (n, n) light and flags.
    extracted
        (n + 2 w, n + 2 w) light and flags.
    least_cells
        Cells that a shift needs.

    Returns
    -------
    numpy.ndarray
        (11, 11), entry (a, b) for the shift (a - 5, b - 5); not-a-number where cells or variation are missing. Direct
        sums: for 99 x 99 cells and 121 shifts faster than transforms.
    """
    # Levels taken away beforehand keep the sums well conditioned; correlation does not see them.
    p, e = (np.where(m, v - (v[m].mean() if m.any() else 0.0), 0.0) for v, m in (predicted, extracted))
    surface = np.full((2 * REACH + 1, 2 * REACH + 1), np.nan)
    margin = (len(e) - len(p)) // 2
    masks = predicted[1].astype(float), extracted[1].astype(float)
    _surface(p, p * p, masks[0], e, e * e, masks[1], margin, least_cells, surface)
    return surface


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _surface(p, pp, mp, e, ee, me, margin, least, surface):  # type: ignore[no-untyped-def]
    n, m = p.shape[0], e.shape[0]
    for a in range(surface.shape[0]):
        di = a - REACH + margin
        for b in range(surface.shape[1]):
            dj = b - REACH + margin
            j0, j1 = max(0, -dj), min(n, m - dj)
            count = sp = se = spp = see = spe = 0.0
            for i in range(max(0, -di), min(n, m - di)):
                # Plain rows let the compiler use vector instructions.
                p0, p1, p2 = mp[i, j0:j1], p[i, j0:j1], pp[i, j0:j1]
                e0, e1, e2 = me[i + di, j0 + dj : j1 + dj], e[i + di, j0 + dj : j1 + dj], ee[i + di, j0 + dj : j1 + dj]
                for j in range(len(p0)):
                    count += p0[j] * e0[j]
                    sp += p1[j] * e0[j]
                    spp += p2[j] * e0[j]
                    se += p0[j] * e1[j]
                    see += p0[j] * e2[j]
                    spe += p1[j] * e1[j]
            if count < least:
                continue
            vp, ve = spp - sp * sp / count, see - se * se / count
            if vp > 1e-9 * spp and ve > 1e-9 * see:
                surface[a, b] = (spe - sp * se / count) / np.sqrt(vp * ve)


def taylor_peak(surface: FloatArray, place: tuple[int, int]) -> FloatArray | None:
    """Sub-pixel peak per axis where the gradient's Taylor series vanishes (eq. 3.63-3.66 as corrected).

    Parameters
    ----------
    surface
        Correlations.
    place
        Highest sample, not on the border.

    Returns
    -------
    numpy.ndarray or None
        (2,) from the sample; None where it is no maximum along both axes.
    """
    i, j = place
    steps = []
    for before, here, after in (surface[i - 1 : i + 2, j], surface[i, j - 1 : j + 2]):
        curvature = after + before - 2.0 * here
        if not curvature < 0.0:
            return None
        steps.append(-0.5 * (after - before) / curvature)
    return np.array(steps)


def quadratic_peak(surface: FloatArray, place: tuple[int, int]) -> FloatArray | None:
    """Sub-pixel peak of the quadratic through 3 x 3 samples in the sense of least squares.

    Parameters
    ----------
    surface
        Correlations.
    place
        Highest sample, not on the border.

    Returns
    -------
    numpy.ndarray or None
        (2,) from the sample; None where the quadratic has no maximum within a cell and a half.
    """
    i, j = place
    c = surface[i - 1 : i + 2, j - 1 : j + 2]
    x = np.array([-1.0, 0.0, 1.0])
    slope = np.array([(c.sum(axis=1) @ x) / 6.0, (c.sum(axis=0) @ x) / 6.0])
    bend = [c.sum(axis=axis) @ (x * x) - c.sum() * 2.0 / 3.0 for axis in (1, 0)]
    hessian = np.array([[bend[0], (x @ c @ x) / 4.0], [(x @ c @ x) / 4.0, bend[1]]])
    if not (np.isfinite(hessian).all() and hessian[0, 0] < 0 and np.linalg.det(hessian) > 0):
        return None
    step = -np.linalg.solve(hessian, slope)
    return step if np.abs(step).max() <= 1.5 else None


def correlate(
    images: MapletImages, size: int, pixels_per_cell: float, options: CorrelationOptions, with_covariance: bool = True
) -> Peak:
    """Shift between a maplet's two images.

    Parameters
    ----------
    images
        Predicted and extracted.
    size
        Bin.
    pixels_per_cell
        Root of a cell's area in pixels: tells how far the extracted image's errors are alike.
    options
        Fit and thresholds.
    with_covariance
        Without it the peak's covariance is not-a-number, and less work.

    Returns
    -------
    Peak
        In unbinned cells.
    """
    widening = (len(images.extracted) - len(images.predicted)) // 2
    spare = widening % size
    inner = slice(spare, len(images.extracted) - spare)
    predicted = bin_image(images.predicted, images.predicted_valid, size)
    extracted = bin_image(images.extracted[inner, inner], images.extracted_valid[inner, inner], size)
    least = max(9, options.least_cells // size**2)
    surface = correlation_surface(predicted, extracted, least)
    known = np.isfinite(surface)
    if not known.any():
        few = min(int(predicted[1].sum()), int(extracted[1].sum())) < least
        return _nothing(PeakStatus.TOO_FEW_CELLS if few else PeakStatus.NO_VARIATION, 0.0)
    i, j = (int(k) for k in np.unravel_index(int(np.nanargmax(surface)), surface.shape))
    height = float(surface[i, j])
    if not (0 < i < 2 * REACH and 0 < j < 2 * REACH) or not known[i - 1 : i + 2, j - 1 : j + 2].all():
        return _nothing(PeakStatus.ON_BORDER, height)
    step = (taylor_peak if options.subpixel == "taylor" else quadratic_peak)(surface, (i, j))
    if step is None:
        return _nothing(PeakStatus.NO_MAXIMUM, height)
    if height < options.least_correlation:
        return _nothing(PeakStatus.LOW_CORRELATION, height)
    if with_covariance and options.bin_start > 1 and not stands_alone(surface, (i, j), options.rival_share):
        return _nothing(PeakStatus.AMBIGUOUS, height)
    whole = np.array([i - REACH, j - REACH])
    if not with_covariance:
        return Peak(PeakStatus.FOUND, (whole + step) * size, np.full((2, 2), np.nan), height, 0)
    block = max(_BLOCK_CELLS, round(_BLOCK_PX / pixels_per_cell / size))
    regressed, covariance, cells = regressed_shift(predicted, extracted, whole + widening // size, block)
    apart = np.nan_to_num(regressed - step)
    if np.abs(apart).max() <= _MOST_APART_CELLS:
        step = step + apart / 2.0
    # Peak and regression weigh the same cells differently: what parts them is an error that the residuals do not show.
    covariance = covariance + _of_one_draw(apart)
    return Peak(PeakStatus.FOUND, (whole + step) * size, covariance * size**2, height, cells)


def _of_one_draw(error: FloatArray) -> FloatArray:
    """Covariance of an error without preferred direction, of which one draw is known."""
    return np.eye(2) * float(error @ error) / 2.0


def _nothing(status: PeakStatus, height: float) -> Peak:
    return Peak(status, np.full(2, np.nan), np.full((2, 2), np.nan), height, 0)


def ladder(start: int, every_bin: bool) -> tuple[int, ...]:
    """Bins to correlate at, down to 1.

    Parameters
    ----------
    start
        First one.
    every_bin
        One after the other as in SPC, or halved each time.

    Returns
    -------
    tuple
        E.g. 6, 3, 1.
    """
    if every_bin:
        return tuple(range(start, 0, -1))
    bins = [start]
    while bins[-1] > 1:
        bins.append(bins[-1] // 2)
    return tuple(bins)


def locate(
    view: MapletView, maplet: Maplet, picture: tuple[Image, BoolArray], jacobian: FloatArray,
    start_vu: FloatArray, options: tuple[MapletImageOptions, CorrelationOptions],
) -> LandmarkMatch:  # fmt: skip
    """Find a landmark in a picture: correlate, move, extract again, with smaller and smaller bins.

    Parameters
    ----------
    view
        Camera and body.
    maplet
        Maplet.
    picture
        (rows, cols) DN; (rows, cols) flags of good pixels.
    jacobian
        (2, 2) pixels per cell at the landmark (eq. 3.67).
    start_vu
        (2,) offset that is believed already.
    options
        For images and for correlation.

    Returns
    -------
    LandmarkMatch
        Offset from the prediction, start included.
    """
    make, match = options
    pixels_per_cell = float(np.sqrt(abs(np.linalg.det(jacobian))))
    offset, scale, background = np.asarray(start_vu, float), 0.0, 0.0
    prepared, bins = prepare_maplet(view, maplet, make), ladder(match.bin_start, match.every_bin)
    widest = widest_bin(len(maplet.heights))
    if match.bin_start > widest and not match.every_bin:
        # The pattern of few large bins is found anywhere.
        far = grid_pixels(view, maplet, REACH * match.bin_start) + offset
        images = images_of(prepared, picture, far, jacobian, make)
        peak = _far_peak(images, widest, match.rival_share)
        if peak.status is not PeakStatus.FOUND:
            return _lost(peak, widest, images)
        offset, bins = offset + jacobian @ peak.shift_cells, ladder(widest, False)
    grid, before = grid_pixels(view, maplet), 0
    for step, size in enumerate(bins + (1,) * (match.passes - 1)):
        search = REACH * size
        widening = search if search * pixels_per_cell > _WIDE_SEARCH_PX else 0
        if widening != before:
            grid, before = grid_pixels(view, maplet, widening), widening
        images = images_of(prepared, picture, grid + offset, jacobian, make, background)
        peak = correlate(images, size, pixels_per_cell, match, step >= len(bins) - 1)
        if peak.status is not PeakStatus.FOUND:
            break
        offset = offset + jacobian @ peak.shift_cells
        scale, background = _levels(images, peak, make.background_guard)
        if step >= len(bins) - 1 and np.abs(peak.shift_cells).max() < match.tolerance_cells:
            break
    if peak.status is not PeakStatus.FOUND:
        return _lost(peak, size, images, scale, background)
    unresolved = _of_one_draw(unresolved_shift(maplet, prepared, make))
    covariance = jacobian @ (peak.covariance_cells2 + unresolved) @ jacobian.T
    return LandmarkMatch(
        peak.status, offset, covariance, peak.correlation, peak.cells, size, images, scale, background
    )  # fmt: skip


def _lost(peak: Peak, size: int, images: MapletImages, scale: float = 0.0, background: float = 0.0) -> LandmarkMatch:
    nowhere, unknown = np.full(2, np.nan), np.full((2, 2), np.nan)
    return LandmarkMatch(peak.status, nowhere, unknown, peak.correlation, peak.cells, size, images, scale, background)


def _far_peak(images: MapletImages, size: int, share: float) -> Peak:
    """Best whole shift of bins of a size within the whole of a widened image, if it stands alone."""
    widening = (len(images.extracted) - len(images.predicted)) // 2
    inner = slice(widening % size, len(images.extracted) - widening % size)
    predicted = bin_image(images.predicted, images.predicted_valid, size)
    extracted = bin_image(images.extracted[inner, inner], images.extracted_valid[inner, inner], size)
    surface = wide_surface(predicted, extracted)
    place = np.array(np.unravel_index(int(surface.argmax()), surface.shape))
    height = float(surface[tuple(place)])
    if height <= -1.0:
        return _nothing(PeakStatus.NO_VARIATION, 0.0)
    if not stands_alone(surface, place, share):
        return _nothing(PeakStatus.AMBIGUOUS, height)
    shift = np.asarray((place - len(surface) // 2) * size, float)
    return Peak(PeakStatus.FOUND, shift, np.full((2, 2), np.nan), height, int(predicted[1].sum()))


def _levels(images: MapletImages, peak: Peak, guard: float) -> tuple[float, float]:
    """Scale and background of a picture at the nearest whole shift."""
    widening = (len(images.extracted) - len(images.predicted)) // 2
    here, there = overlap(
        len(images.predicted), len(images.extracted), np.rint(peak.shift_cells).astype(int) + widening
    )
    valid = images.predicted_valid[here] & images.extracted_valid[there]
    if not valid.any():
        return 0.0, 0.0
    return brightness_scale(images.predicted[here][valid], images.extracted[there][valid], peak.correlation, guard)
