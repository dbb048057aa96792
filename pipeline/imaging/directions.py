"""Directions of edges in an image, whichever side is the brighter, and the correlation of two such fields.

A gradient in the direction a becomes the vector (cos 2a, sin 2a), so that opposite gradients are one (Granlund 1978,
Computer Graphics and Image Processing 8, 155), as long as the gradient up to a limit: edges of any contrast count.
"""

from dataclasses import dataclass

import cv2
import numba
import numpy as np
import scipy.fft

from pipeline.imaging.ncc import Level
from pipeline.records import FloatArray, Image

# Share of an image's, and of a template's, pixels whose gradient counts as it is; stronger ones count as the limit.
_SEEN_QUANTILE, _DRAWN_QUANTILE = 0.80, 0.95
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Directions:
    """Field of directions of a level.

    Attributes
    ----------
    factor
        Pixels of the image along a side of a level's pixel.
    field
        (2, rows, cols) float32, zero where there is no weight.
    weight
        (rows, cols) float32, one where the gradient is measured.
    """

    factor: int
    field: Image
    weight: Image


def directions_of(level: Level) -> Directions:
    """Directions of an image.

    Parameters
    ----------
    level
        Light.

    Returns
    -------
    Directions
        Without the pixels beside unmeasured ones.
    """
    weight = (cv2.erode(level.weight, np.ones((3, 3), np.uint8)) > 0.5).astype(np.float32)
    return Directions(level.factor, _field(level.image, weight, _SEEN_QUANTILE), weight)


def drawn_directions(template: Image) -> Image:
    """Directions of a drawn image.

    Parameters
    ----------
    template
        (rows, cols) light whose steps all rise in one sense, so that none hides another.

    Returns
    -------
    numpy.ndarray
        (2, rows, cols) float32.
    """
    return _field(template, np.ones(template.shape, np.float32), _DRAWN_QUANTILE)


def _field(image: Image, weight: Image, quantile: float) -> Image:
    across, down = (cv2.Sobel(image, cv2.CV_32F, du, 1 - du, ksize=3) for du in (1, 0))
    length = np.hypot(across, down)
    inside = length[weight > 0]
    limit = float(np.quantile(inside, quantile)) if inside.size else 0.0
    if limit <= 0.0 and inside.size:
        limit = float(inside.max())
    scale = np.minimum(length, np.float32(limit)) * weight / np.maximum(length, np.float32(_TINY)) ** 2
    return np.asarray(np.stack([(across**2 - down**2) * scale, 2.0 * across * down * scale]), np.float32)


def direction_map(seen: Directions, drawn: Image) -> FloatArray:
    """Correlation of directions at every whole shift within the template's surplus.

    Parameters
    ----------
    seen
        Image, (rows, cols).
    drawn
        (2, rows + 2 mv, cols + 2 mu) template.

    Returns
    -------
    numpy.ndarray
        (2 mv + 1, 2 mu + 1) in -1..1; entry (i, j) belongs to the offset (i - mv, j - mu). -1 where nothing is drawn.
    """
    shape = tuple(scipy.fft.next_fast_len(n, real=True) for n in drawn.shape[1:])
    out = tuple(t - i + 1 for t, i in zip(drawn.shape[1:], seen.weight.shape, strict=True))

    def at_shifts(image: Image, template: Image) -> FloatArray:
        product = (np.conj(scipy.fft.rfft2(image, shape)) * scipy.fft.rfft2(template, shape)).sum(axis=0)
        full = scipy.fft.irfft2(product, shape)
        return np.asarray(full[: out[0], : out[1]][::-1, ::-1], float)

    cross = at_shifts(seen.field, drawn)
    power = at_shifts(seen.weight[None], (drawn**2).sum(axis=0)[None])
    own = float((seen.field.astype(float) ** 2).sum())
    usable = (power > 1e-6 * max(float(power.max()), 1e-30)) & (own > 0.0)
    return np.where(usable, cross / np.sqrt(np.where(usable, power, 1.0) * max(own, 1e-30)), -1.0)


def direction_around(seen: Directions, drawn: Image, reach: int) -> FloatArray:
    """Correlation of directions at the shifts around none.

    Parameters
    ----------
    seen
        Image, (rows, cols).
    drawn
        (2, rows + 2 reach, cols + 2 reach) template.
    reach
        Shifts on each side.

    Returns
    -------
    numpy.ndarray
        (2 reach + 1, 2 reach + 1), -1 where nothing is drawn.
    """
    result = np.empty((2 * reach + 1, 2 * reach + 1))
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            result[i, j] = _at(seen.field, seen.weight, drawn, 2 * reach - i, 2 * reach - j)
    return result


@numba.njit(cache=True, nogil=True)
def _at(field, weight, drawn, top, left):  # type: ignore[no-untyped-def]
    cross = own = power = 0.0
    for i in range(weight.shape[0]):
        for j in range(weight.shape[1]):
            if weight[i, j] == 0.0:
                continue
            a, b = field[0, i, j], field[1, i, j]
            c, d = drawn[0, top + i, left + j], drawn[1, top + i, left + j]
            cross += a * c + b * d
            own += a * a + b * b
            power += c * c + d * d
    if own <= 0.0 or power <= 0.0:
        return -1.0
    return cross / np.sqrt(own * power)
