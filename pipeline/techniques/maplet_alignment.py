"""One coarse shift and twist for all maplets of a picture, so that each of them then needs a small search only.

The predicted light of all maplets is laid over the picture as one masked template and correlated with it at every
offset within the margin, for some twists; on reduced pixels where the picture is large. Both are first freed of local
level and contrast: the broad shading of a round body looks alike at many offsets, its relief at one.
"""

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from pipeline.geometry.maplet import Maplet, MapletView
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.maplet_images import MapletImageOptions, blocked_cells, grid_pixels, predict_image
from pipeline.imaging.ncc import Level, make_level, ncc_map, peak_of
from pipeline.records import BoolArray, FloatArray, Image, Record

# Reduced pixels along the template's longer side, at most.
_LONGEST = 480
# A twist between two samples moves the template's far end by less than twice this, in reduced pixels.
_TWIST_STEP_PX = 1.0
# Side of the window of local level and contrast in reduced pixels, and the share of the whole's contrast below which a
# window's does not count.
_LOCAL_PX = 21
_LEAST_CONTRAST = 0.1
_MOST_TWISTS = 41
_CELLS_IN_PIXEL = 3.0


@dataclass(frozen=True, eq=False)
class MapletLight(Record):
    """Predicted light of many maplets' cells.

    Attributes
    ----------
    pixels_vu
        (k, 2) where they are imaged.
    light
        (k,) relative light, zero in shadow.
    """

    pixels_vu: FloatArray
    light: FloatArray

    def __post_init__(self) -> None:
        self._freeze(pixels_vu=(None, 2), light=(len(self.pixels_vu),))


@dataclass(frozen=True, eq=False)
class Alignment(Record):
    """Where all maplets together lie.

    Attributes
    ----------
    offset_vu
        (2,) at the template's middle, which is ``pivot_vu``.
    rotation_rad
        Twist about it, +u toward +v.
    pivot_vu
        (2,) pixels.
    correlation
        At the peak.
    factor
        Side of a reduced pixel: the offset is known to about half of it.
    """

    offset_vu: FloatArray
    rotation_rad: float
    pivot_vu: FloatArray
    correlation: float
    factor: int

    def __post_init__(self) -> None:
        self._freeze(offset_vu=(2,), pivot_vu=(2,))


def light_of(view: MapletView, maplets: list[Maplet], options: MapletImageOptions) -> MapletLight:
    """Predicted light of the cells that the camera sees.

    Parameters
    ----------
    view
        Camera and body.
    maplets
        Those that culling kept.
    options
        Law and shadows.

    Returns
    -------
    MapletLight
        Of all of them.
    """
    pixels, lights = [], []
    for maplet in maplets:
        to_camera = view.position_km - maplet.landmark_km
        ray = maplet.maplet_from_body @ (to_camera / np.linalg.norm(to_camera))
        light, _ = predict_image(maplet, maplet.maplet_from_body @ view.sun, ray, options)
        places = grid_pixels(view, maplet)
        seen = np.isfinite(places).all(axis=2) & np.isfinite(maplet.albedo) & ~blocked_cells(maplet.heights, ray)
        pixels.append(places[seen])
        lights.append(light[seen])
    if not pixels:
        return MapletLight(np.zeros((0, 2)), np.zeros(0))
    return MapletLight(np.concatenate(pixels), np.concatenate(lights))


def align(
    cells: MapletLight, picture: tuple[Image, BoolArray], margin_vu: tuple[float, float], max_rotation_rad: float
) -> Alignment | None:
    """Search offset and twist.

    Parameters
    ----------
    cells
        Predicted light.
    picture
        (rows, cols) DN; (rows, cols) flags of good pixels.
    margin_vu
        Largest offset along v and u.
    max_rotation_rad
        Largest twist, zero for none.

    Returns
    -------
    Alignment or None
        The highest peak; None where nothing varies.
    """
    if len(cells.light) < 9:
        return None
    low, high = cells.pixels_vu.min(axis=0), cells.pixels_vu.max(axis=0)
    pivot = (low + high) / 2.0
    # Within the array and its margin; a template far larger than the array is cut to it.
    size = np.minimum(high - low, np.array(picture[0].shape) + 2.0 * np.array(margin_vu))
    factor = max(1, int(np.ceil((size.max() + 2.0 * max(margin_vu)) / _LONGEST)))
    radius = float(np.linalg.norm(size)) / 2.0 / factor
    reduced = _flattened(make_level(*picture, factor))
    margins = tuple(int(np.ceil(m / factor)) + 1 for m in margin_vu)
    best: Alignment | None = None
    # A few cells in a reduced pixel tell its mean; odd steps do not fall into the grids' columns.
    thin = max(1, int(len(cells.light) / (_CELLS_IN_PIXEL * max(float(np.prod(size)) / factor**2, 1.0)))) // 2 * 2 + 1
    pixels, light = cells.pixels_vu[::thin] - pivot, cells.light[::thin]
    for twist in _twists(max_rotation_rad, radius):
        template, origin = _template(pixels @ plane_rotation(twist).T, light, pivot, size, factor)
        found = _search(_flattened(template), _window(reduced, origin, template.image.shape, margins), margins)
        if found is not None and (best is None or found[1] > best.correlation):
            best = Alignment(found[0] * factor, twist, pivot, found[1], factor)
    return best


def _flattened(level: Level) -> Level:
    """Light less its local mean, over its local scatter."""
    side = (_LOCAL_PX, _LOCAL_PX)

    def local(values: Image) -> Image:
        summed = cv2.boxFilter(values, cv2.CV_32F, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, np.float32)

    weight = np.maximum(local(level.weight), np.float32(1e-3))
    known = level.weight > 0
    rest = np.where(known, level.image - local(level.image * level.weight) / weight, np.float32(0.0))
    scatter = local(rest * rest * level.weight) / weight
    floor = _LEAST_CONTRAST**2 * float(scatter[known].mean()) if known.any() else 0.0
    flat = rest / np.sqrt(scatter + np.float32(max(floor, 1e-30)))
    return Level(level.factor, np.where(known, flat, np.float32(0.0)), level.weight)


def _twists(largest: float, radius: float) -> FloatArray:
    """Samples of the twist, symmetric about none."""
    sides = min(int(np.ceil(largest * radius / (2.0 * _TWIST_STEP_PX))), _MOST_TWISTS // 2)
    return np.linspace(-largest, largest, 2 * sides + 1) if sides else np.zeros(1)


def _template(
    turned: FloatArray, light: FloatArray, pivot: FloatArray, size: FloatArray, factor: int
) -> tuple[Level, np.ndarray]:
    """Mean light per reduced pixel about the pivot, and the reduced pixel at its corner."""
    half = np.ceil(size / 2.0 / factor).astype(int) + 2
    # Reduced pixel k covers pixels k factor to (k + 1) factor - 1.
    middle = np.floor((pivot + 0.5) / factor).astype(int)
    origin = middle - half
    places = np.floor((turned + pivot + 0.5) / factor).astype(np.int64) - origin
    total, number = np.zeros(tuple(2 * half + 1)), np.zeros(tuple(2 * half + 1))
    _gather(places, light, total, number)
    mean = np.where(number > 0, total / np.maximum(number, 1.0), 0.0)
    return Level(factor, mean.astype(np.float32), (number > 0).astype(np.float32)), origin


@numba.njit(cache=True, nogil=True)
def _gather(places, light, total, number):  # type: ignore[no-untyped-def]
    for k in range(len(light)):
        i, j = places[k, 0], places[k, 1]
        if 0 <= i < total.shape[0] and 0 <= j < total.shape[1]:
            total[i, j] += light[k]
            number[i, j] += 1.0


def _window(reduced: Level, origin: np.ndarray, shape: tuple[int, ...], margins: tuple[int, ...]) -> Image:
    """Flattened picture under the template and its margins; zero, the mean, where nothing is known."""
    window = np.zeros(tuple(shape[k] + 2 * margins[k] for k in range(2)), np.float32)
    start = [int(origin[k]) - margins[k] for k in range(2)]
    low = [max(0, -start[k]) for k in range(2)]
    high = [min(window.shape[k], reduced.image.shape[k] - start[k]) for k in range(2)]
    if high[0] > low[0] and high[1] > low[1]:
        there = (slice(start[0] + low[0], start[0] + high[0]), slice(start[1] + low[1], start[1] + high[1]))
        window[low[0] : high[0], low[1] : high[1]] = reduced.image[there]
    return window


def _search(template: Level, window: Image, margins: tuple[int, ...]) -> tuple[FloatArray, float] | None:
    """Offset in reduced pixels and the correlation there.

    The map gives offsets of the masked image within the wider one: the picture's own offset is their opposite.
    """
    surface = ncc_map(template, window)
    if surface.max() <= 0.0:
        return None
    i, j = np.unravel_index(int(np.argmax(surface)), surface.shape)
    around = surface[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
    place = np.array([i - margins[0], j - margins[1]], float)
    if around.shape == (3, 3):
        place = place + peak_of(around)[0]
    return -place, float(surface[i, j])
