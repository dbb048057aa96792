"""Masked normalised cross-correlation: whole maps by FFT, single shifts by direct sums, and the pyramid under both.

An offset d means ``image(x) ~ scale * template(x - d) + level``. The template covers the image's rectangle widened by
the largest offset, so that every shift sees the whole of it: only the image needs a mask (Padfield 2012 without the
template's mask).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
import scipy.fft

from pipeline.records import BoolArray, FloatArray, Image


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the pyramid.

    Attributes
    ----------
    factor
        Pixels of the image along a side of this level's.
    image
        (rows, cols) float32, zero where there is no weight.
    weight
        (rows, cols) float32, share of good pixels.
    """

    factor: int
    image: Image
    weight: Image


def reduce(image: Image, factor: int) -> Image:
    """Means of square blocks; what does not fill a block at the end is dropped.

    Parameters
    ----------
    image
        (rows, cols) float32.
    factor
        Side of a block.

    Returns
    -------
    numpy.ndarray
        (rows // factor, cols // factor) float32.
    """
    if factor == 1:
        return image
    rows, cols = image.shape[0] // factor, image.shape[1] // factor
    cut = image[: rows * factor, : cols * factor]
    return np.asarray(cv2.resize(cut, (cols, rows), interpolation=cv2.INTER_AREA), np.float32)


def make_level(image: Image, good: BoolArray, factor: int) -> Level:
    """Weighted means over blocks.

    Parameters
    ----------
    image
        (rows, cols) DN.
    good
        (rows, cols) True where measured.
    factor
        Side of a block.

    Returns
    -------
    Level
        Of the pyramid.
    """
    weight = reduce(good.astype(np.float32), factor)
    total = reduce(np.where(good, image, np.float32(0.0)), factor)
    mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
    return Level(factor, mean, weight)


def ncc_map(level: Level, template: Image) -> FloatArray:
    """Correlation at every whole shift within the template's surplus.

    Parameters
    ----------
    level
        Image and weights, (rows, cols).
    template
        (rows + 2 mv, cols + 2 mu).

    Returns
    -------
    numpy.ndarray
        (2 mv + 1, 2 mu + 1); entry (i, j) belongs to the offset (i - mv, j - mu). -1 where nothing varies.
    """
    shape = tuple(scipy.fft.next_fast_len(n, real=True) for n in template.shape)
    out = tuple(t - i + 1 for t, i in zip(template.shape, level.image.shape, strict=True))
    # Correlation is blind to levels; taking them away first keeps float32 transforms exact enough.
    total = float(level.weight.sum())
    if total <= 0:
        return np.full(out, -1.0)
    mean = float((level.image * level.weight).sum() / total)
    centred = (level.image - np.float32(mean)) * level.weight
    base = template - np.float32(template.mean())
    image_f = np.conj(scipy.fft.rfft2(centred, shape))
    weight_f = np.conj(scipy.fft.rfft2(level.weight, shape))
    base_f = scipy.fft.rfft2(base, shape)
    square_f = scipy.fft.rfft2(base * base, shape)

    def at_shifts(product: np.ndarray) -> FloatArray:
        full = scipy.fft.irfft2(product, shape)
        return np.asarray(full[: out[0], : out[1]][::-1, ::-1], float)

    cross, first, second = (at_shifts(p) for p in (image_f * base_f, weight_f * base_f, weight_f * square_f))
    image_power = float((centred**2 / np.where(level.weight > 0, level.weight, 1.0)).sum())
    power = second - first**2 / total
    floor = 1e-6 * max(float(second.max()), 1e-30)
    usable = (power > floor) & (image_power > 0)
    return np.where(usable, cross / np.sqrt(np.where(usable, power, 1.0) * max(image_power, 1e-30)), -1.0)


@numba.njit(cache=True, nogil=True)
def _ncc_at(image, weight, template, top, left):  # type: ignore[no-untyped-def]
    s = si = st = sii = stt = sit = 0.0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            w = weight[i, j]
            if w == 0.0:
                continue
            a, t = image[i, j], template[top + i, left + j]
            s += w
            si += w * a
            st += w * t
            sii += w * a * a
            stt += w * t * t
            sit += w * a * t
    if s == 0.0:
        return -1.0
    vi, vt = sii - si * si / s, stt - st * st / s
    if vi <= 1e-9 * sii or vt <= 1e-9 * stt:
        return -1.0
    return (sit - si * st / s) / np.sqrt(vi * vt)


def ncc_around(level: Level, template: Image, offset: tuple[int, int], reach: int) -> FloatArray:
    """Correlation at the shifts around one.

    Parameters
    ----------
    level
        Image and weights, (rows, cols).
    template
        (rows + 2 mv, cols + 2 mu).
    offset
        Middle, in this level's pixels.
    reach
        Shifts on each side.

    Returns
    -------
    numpy.ndarray
        (2 reach + 1, 2 reach + 1), -1 where a shift is beyond the template's surplus.
    """
    rows, cols = level.image.shape
    mv, mu = (template.shape[0] - rows) // 2, (template.shape[1] - cols) // 2
    result = np.full((2 * reach + 1, 2 * reach + 1), -1.0)
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            top, left = mv - (offset[0] + i - reach), mu - (offset[1] + j - reach)
            if 0 <= top <= template.shape[0] - rows and 0 <= left <= template.shape[1] - cols:
                result[i, j] = _ncc_at(level.image, level.weight, template, top, left)
    return result


@dataclass(frozen=True)
class MapPeak:
    """A place higher than its neighbours on maps of correlations.

    Attributes
    ----------
    shift
        From the maps' middle, whole pixels of their level.
    layer
        Which of the maps is the highest there.
    height
        Correlation.
    """

    shift: tuple[int, int]
    layer: int
    height: float


def highest_peaks(maps: Sequence[FloatArray], most: int, least: float) -> list[MapPeak]:
    """Local maxima of the highest of several maps.

    Parameters
    ----------
    maps
        (rows, cols) each, one per rotation.
    most
        How many peaks are wanted.
    least
        Height that they exceed.

    Returns
    -------
    list of MapPeak
        Highest first.
    """
    stack = np.stack(maps)
    best, which = stack.max(axis=0), stack.argmax(axis=0)
    rows, cols = np.nonzero((best >= cv2.dilate(best, np.ones((3, 3)))) & (best > least))
    order = np.argsort(best[rows, cols])[::-1][:most]
    middle_v, middle_u = (n // 2 for n in best.shape)
    return [
        MapPeak((int(v) - middle_v, int(u) - middle_u), int(which[v, u]), float(best[v, u]))
        for v, u in zip(rows[order], cols[order], strict=True)
    ]


def peak_of(values: FloatArray) -> tuple[FloatArray, float]:
    """Sub-pixel place and height of the maximum of a (2k+1)-square of correlations, by parabolas.

    Parameters
    ----------
    values
        Square with its maximum anywhere.

    Returns
    -------
    tuple
        (2,) place relative to the middle; height at the highest sample.
    """
    i, j = np.unravel_index(int(np.argmax(values)), values.shape)
    place = np.array([i, j], float) - np.array(values.shape) // 2
    for axis, line in enumerate((values[:, j], values[i, :])):
        k = (i, j)[axis]
        if 0 < k < len(line) - 1:
            left, middle, right = line[k - 1 : k + 2]
            bend = 2.0 * middle - left - right
            if left > -1.0 and right > -1.0 and bend > 0:
                place[axis] += 0.5 * (right - left) / bend
    return place, float(values[i, j])
