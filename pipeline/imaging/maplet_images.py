"""The two images of a maplet: what it should look like, and what the picture shows of it.

Both lie on the maplet's own grid, each with a mask of valid cells beside it. Source: seed 001 sections 3.3 and 3.4 with
the project's corrections; a cell that covers several pixels gets the mean of samples spread evenly over its area.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import ceil, floor, sqrt

import numba
import numpy as np
from pydantic import Field

from pipeline.geometry.maplet import Maplet, MapletView, maplet_points_km
from pipeline.imaging.illumination import LAMBERT, LOMMEL_SEELIGER, LUNAR_LAMBERT, MINNAERT, reflectance
from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Image, Record

# SPC's weight between Lambert and Lommel-Seeliger falls by e over this phase (eq. 3.41).
_PHASE_SCALE_DEG = 60.0
_FIXED_BETA = 0.65
_MINNAERT_K = 0.7
# Samples along a side of a cell that covers several pixels, at most.
_MOST_SAMPLES = 6
# Cells toward the Sun that must be dark behind the end of a shadow; widening on both sides of what is cut there.
_SHADOW_RUN = 3
_SHADOW_WIDENING = 2


class MapletLaw(StrEnum):
    """Photometric function of a predicted image."""

    MCEWEN = "mcewen"
    FIXED_BETA = "fixed_beta"
    LUNAR_LAMBERT = "lunar_lambert"
    LOMMEL_SEELIGER = "lommel_seeliger"
    LAMBERT = "lambert"
    MINNAERT = "minnaert"


class MapletImageOptions(Options):
    """Prediction, extraction and filter of maplet images."""

    law: MapletLaw = Field(MapletLaw.MCEWEN, description="photometric function of the predicted image (3.41)")
    least_emission: float = Field(0.1, ge=0, lt=1, description="cosine of emission below which a cell is not used")
    shadow_level: float = Field(0.05, ge=0, lt=1, description="share of the mean light up to which a cell is dark")
    cast_shadows: bool = Field(True, description="predict shadows along the incidence ray too")
    background_guard: float = Field(0.5, ge=-1, le=1, description="correlation from which background is fitted (3.43)")


@dataclass(frozen=True, eq=False)
class MapletImages(Record):
    """Predicted and extracted image of one maplet.

    Attributes
    ----------
    predicted, extracted
        (n, n) relative light; (m, m) DN, with m = n + 2 widening.
    predicted_valid, extracted_valid
        Cells that count.
    removed
        Cells within the maplet that the extract filter took out.
    illuminated
        Share of the maplet's cells with light in the predicted image (eq. 3.55).
    emission_rad
        Angle between the maplet's z axis and the direction to the camera (eq. 3.54).
    """

    predicted: FloatArray
    extracted: FloatArray
    predicted_valid: BoolArray
    extracted_valid: BoolArray
    removed: int
    illuminated: float
    emission_rad: float

    def __post_init__(self) -> None:
        n, m = len(self.predicted), len(self.extracted)
        self._freeze(predicted=(n, n), predicted_valid=(n, n), extracted=(m, m), extracted_valid=(m, m))


def law_of_maplet(law: MapletLaw, phase_rad: float) -> tuple[int, float, float]:
    """Compiled law, its parameter and a factor for the value of eq. 3.41.

    Parameters
    ----------
    law
        Photometric function.
    phase_rad
        Phase angle.

    Returns
    -------
    tuple
        Number of the law, its parameter, factor. SPC's (1 - b) cos i + b cos i/(cos i + cos e) is the lunar-Lambert law
        of weight b/(2 - b) times (2 - b)/2; McEwen's own has 2 b in its second term, which is that of weight b.
    """
    if law in (MapletLaw.MCEWEN, MapletLaw.FIXED_BETA):
        beta = _FIXED_BETA if law is MapletLaw.FIXED_BETA else float(np.exp(-np.degrees(phase_rad) / _PHASE_SCALE_DEG))
        return LUNAR_LAMBERT, beta / (2.0 - beta), (2.0 - beta) / 2.0
    if law is MapletLaw.LUNAR_LAMBERT:
        return LUNAR_LAMBERT, float(np.exp(-np.degrees(phase_rad) / _PHASE_SCALE_DEG)), 1.0
    simple = {MapletLaw.LOMMEL_SEELIGER: LOMMEL_SEELIGER, MapletLaw.LAMBERT: LAMBERT, MapletLaw.MINNAERT: MINNAERT}
    return simple[law], _MINNAERT_K, 1.0


def predict_image(
    maplet: Maplet, sun: FloatArray, ray: FloatArray, options: MapletImageOptions
) -> tuple[FloatArray, BoolArray]:
    """Light of a maplet's cells (eq. 3.36-3.41).

    Parameters
    ----------
    maplet
        Maplet.
    sun, ray
        (3,) unit vectors to the Sun and to the camera, maplet frame.
    options
        Law and shadows.

    Returns
    -------
    tuple
        (n, n) relative light, zero in shadow; (n, n) True where height and albedo are known and the Sun shines.
    """
    phase = float(np.arccos(np.clip(sun @ ray, -1.0, 1.0)))
    light = np.zeros(maplet.heights.shape)
    lit = np.zeros(light.shape, np.bool_)
    _shade(maplet.heights, maplet.albedo, sun, ray, law_of_maplet(options.law, phase), light, lit)
    if options.cast_shadows:
        lit &= ~blocked_cells(maplet.heights, sun)
        light[~lit] = 0.0
    return light, lit


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    if before == before and after == after:
        return 0.5 * (after - before)
    return after - here if after == after else here - before


@numba.njit(cache=True, nogil=True)
def _normal(heights, i, j):  # type: ignore[no-untyped-def]
    """Normal of a cell, eq. 3.37; not-a-number where no difference can be taken."""
    n = heights.shape[0]
    here = heights[i, j]
    x = _slope(heights[i - 1, j] if i else np.nan, here, heights[i + 1, j] if i + 1 < n else np.nan)
    y = _slope(heights[i, j - 1] if j else np.nan, here, heights[i, j + 1] if j + 1 < n else np.nan)
    norm = sqrt(x * x + y * y + 1.0)
    return -x / norm, -y / norm, 1.0 / norm


@numba.njit(cache=True, nogil=True)
def _shade(heights, albedo, sun, ray, scattering, light, lit):  # type: ignore[no-untyped-def]
    law, parameter, factor = scattering
    for i in range(heights.shape[0]):
        for j in range(heights.shape[0]):
            x, y, z = _normal(heights, i, j)
            mu0 = x * sun[0] + y * sun[1] + z * sun[2]
            mu = x * ray[0] + y * ray[1] + z * ray[2]
            value = albedo[i, j]
            if mu0 > 0.0 and value == value and mu == mu:
                light[i, j] = value * factor * reflectance(law, parameter, mu0, mu)
                lit[i, j] = True


def blocked_cells(heights: FloatArray, direction: FloatArray) -> BoolArray:
    """Cells from which the maplet itself stands in the way along a direction.

    Parameters
    ----------
    heights
        (n, n) cells.
    direction
        (3,) unit vector, maplet frame, toward the camera or the Sun.

    Returns
    -------
    numpy.ndarray
        (n, n) flags. The ray is followed by steps of one cell until it leaves the maplet or rises above its highest
        cell.
    """
    blocked = np.zeros(heights.shape, np.bool_)
    if np.isfinite(heights).any() and np.hypot(direction[0], direction[1]) > 1e-6:
        _march(heights, direction, float(np.nanmax(heights)), blocked)
    return blocked


@numba.njit(cache=True, nogil=True)
def _march(heights, direction, highest, blocked):  # type: ignore[no-untyped-def]
    n = heights.shape[0]
    dx, dy, dz = direction[0], direction[1], direction[2]
    for i in range(n):
        for j in range(n):
            x, y, h = float(i), float(j), heights[i, j]
            while h == h:
                x, y, h = x + dx, y + dy, h + dz
                a, b = int(x), int(y)
                if h > highest or x < 0.0 or y < 0.0 or a + 1 >= n or b + 1 >= n:
                    break
                s, t = x - a, y - b
                low = heights[a, b] * (1.0 - t) + heights[a, b + 1] * t
                high = heights[a + 1, b] * (1.0 - t) + heights[a + 1, b + 1] * t
                if low * (1.0 - s) + high * s > h:
                    blocked[i, j] = True
                    break


def grid_pixels(view: MapletView, maplet: Maplet, widening: int = 0) -> FloatArray:
    """Pixels of a maplet's cells, through the whole camera model (eq. 3.46).

    Parameters
    ----------
    view
        Camera and body.
    maplet
        Maplet.
    widening
        Cells to go on for beyond each side, at the height of the nearest one.

    Returns
    -------
    numpy.ndarray
        (m, m, 2), not-a-number where there is no height.
    """
    wide = maplet
    if widening:
        heights, albedo = (np.pad(values, widening, mode="edge") for values in (maplet.heights, maplet.albedo))
        wide = Maplet(
            maplet.name, maplet.landmark_km, maplet.maplet_from_body, maplet.scale_km, heights, albedo,
            maplet.covariance_km2,
        )  # fmt: skip
    points = maplet_points_km(wide)
    return view.pixels(points.reshape(-1, 3))[0].reshape(*points.shape[:2], 2)


def extract_image(
    image: Image, good: BoolArray, pixels_vu: FloatArray, pixels_per_cell: float
) -> tuple[FloatArray, BoolArray]:
    """Light of a picture at a maplet's cells (eq. 3.47-3.51).

    Parameters
    ----------
    image
        (rows, cols) DN.
    good
        (rows, cols) False where a pixel must not be used.
    pixels_vu
        (m, m, 2) places of the cells.
    pixels_per_cell
        Root of the area of a cell in pixels: up to 1 the picture is interpolated bilinearly, above it is averaged over
        the cell.

    Returns
    -------
    tuple
        (m, m) DN, zero where invalid; (m, m) True where all pixels under the cell are there and good.
    """
    samples = int(np.clip(ceil(pixels_per_cell - 1e-6), 1, _MOST_SAMPLES))
    values = np.zeros(pixels_vu.shape[:2])
    valid = np.zeros(pixels_vu.shape[:2], np.bool_)
    _sample(image, good, pixels_vu, samples, values, valid)
    return values, valid


@numba.njit(cache=True, nogil=True, inline="always")
def _bilinear(image, good, v, u):  # type: ignore[no-untyped-def]
    """Eq. 3.47-3.51; not-a-number beyond the array or beside a bad pixel."""
    # Not-a-number must not reach the conversion to a whole number.
    if not (0.0 <= v <= image.shape[0] - 1 and 0.0 <= u <= image.shape[1] - 1):
        return np.nan
    a, b = min(int(v), image.shape[0] - 2), min(int(u), image.shape[1] - 2)
    if not (good[a, b] and good[a + 1, b] and good[a, b + 1] and good[a + 1, b + 1]):
        return np.nan
    x, y = u - b, v - a
    i0, i1, i2, i3 = float(image[a, b]), float(image[a, b + 1]), float(image[a + 1, b]), float(image[a + 1, b + 1])
    return i0 + (i1 - i0) * x + (i2 - i0) * y + (i0 + i3 - i1 - i2) * x * y


@numba.njit(cache=True, nogil=True)
def _sample(image, good, pixels, samples, values, valid):  # type: ignore[no-untyped-def]
    m = pixels.shape[0]
    for i in range(m):
        i0, i1 = max(i - 1, 0), min(i + 1, m - 1)
        for j in range(m):
            v, u = pixels[i, j, 0], pixels[i, j, 1]
            if samples == 1:
                value = _bilinear(image, good, v, u)
            else:
                j0, j1 = max(j - 1, 0), min(j + 1, m - 1)
                vi, ui = (pixels[i1, j] - pixels[i0, j]) / (i1 - i0)
                vj, uj = (pixels[i, j1] - pixels[i, j0]) / (j1 - j0)
                value = 0.0
                for a in range(samples):
                    for b in range(samples):
                        p, q = (a + 0.5) / samples - 0.5, (b + 0.5) / samples - 0.5
                        value += _bilinear(image, good, v + p * vi + q * vj, u + p * ui + q * uj)
                value /= samples * samples
            if value == value:
                values[i, j], valid[i, j] = value, True


def shadow_reach(ratio: float) -> int:
    """Cells by which a shadow is extended (eq. 3.52 as corrected: det J is an area).

    Parameters
    ----------
    ratio
        Cells per pixel.

    Returns
    -------
    int
        3 + floor(cells per pixel).
    """
    return 3 + floor(ratio)


def extend_shadows(dark: BoolArray, sun: FloatArray, reach: int) -> BoolArray:
    """Cells at the far ends of shadows, where light and dark are mixed.

    Parameters
    ----------
    dark
        (m, m) cells in shadow.
    sun
        (3,) unit vector to the Sun, maplet frame.
    reach
        Cells to go on away from the Sun.

    Returns
    -------
    numpy.ndarray
        (m, m) cells to leave out: from every lit cell with three dark ones toward the Sun, ``reach`` cells away from
        the Sun and two more on both ends, all along the Sun's direction over the maplet.
    """
    across = float(np.hypot(sun[0], sun[1]))
    cut = np.zeros(dark.shape, np.bool_)
    if across > 1e-6:
        _extend(dark, sun[0] / across, sun[1] / across, reach, cut)
    return cut


@numba.njit(cache=True, nogil=True)
def _extend(dark, dx, dy, reach, cut):  # type: ignore[no-untyped-def]
    m = dark.shape[0]
    for i in range(m):
        for j in range(m):
            end = not dark[i, j]
            for k in range(1, _SHADOW_RUN + 1):
                a, b = round(i + k * dx), round(j + k * dy)
                end = end and 0 <= a < m and 0 <= b < m and dark[a, b]
            if not end:
                continue
            for k in range(-_SHADOW_WIDENING, reach + _SHADOW_WIDENING + 1):
                a, b = round(i - k * dx), round(j - k * dy)
                if 0 <= a < m and 0 <= b < m:
                    cut[a, b] = True


@dataclass(frozen=True, eq=False)
class PreparedMaplet(Record):
    """What does not depend on where in the picture a maplet is looked for.

    Attributes
    ----------
    predicted, lit
        See :func:`predict_image`.
    hidden
        (n, n) cells seen at a grazing angle, from behind, or not at all.
    ray, sun
        (3,) unit vectors to camera and Sun, maplet frame.
    """

    predicted: FloatArray
    lit: BoolArray
    hidden: BoolArray
    ray: FloatArray
    sun: FloatArray

    def __post_init__(self) -> None:
        n = len(self.predicted)
        self._freeze(predicted=(n, n), lit=(n, n), hidden=(n, n), ray=(3,), sun=(3,))


def prepare_maplet(view: MapletView, maplet: Maplet, options: MapletImageOptions) -> PreparedMaplet:
    """Predict a maplet and find its hidden cells.

    Parameters
    ----------
    view
        Camera and body.
    maplet
        Maplet.
    options
        Law and filter.

    Returns
    -------
    PreparedMaplet
        For :func:`images_of`, as often as it is looked for.
    """
    to_camera = view.position_km - maplet.landmark_km
    ray = maplet.maplet_from_body @ (to_camera / np.linalg.norm(to_camera))
    sun = maplet.maplet_from_body @ view.sun
    predicted, lit = predict_image(maplet, sun, ray, options)
    return PreparedMaplet(predicted, lit, _hidden(maplet.heights, ray, options.least_emission), ray, sun)


def images_of(
    prepared: PreparedMaplet, picture: tuple[Image, BoolArray], pixels_vu: FloatArray, jacobian: FloatArray,
    options: MapletImageOptions, background: float = 0.0,
) -> MapletImages:  # fmt: skip
    """Extract and filter one maplet.

    Parameters
    ----------
    prepared
        Prediction.
    picture
        (rows, cols) DN; (rows, cols) flags of good pixels.
    pixels_vu
        (m, m, 2) places of the cells, m = n + 2 widening (see :func:`grid_pixels`).
    jacobian
        (2, 2) pixels per cell at the landmark.
    options
        Filter.
    background
        DN that a cell without light has (3.43): what is dark is told above it.

    Returns
    -------
    MapletImages
        Ready for correlation.
    """
    widening = (len(pixels_vu) - len(prepared.predicted)) // 2
    area = abs(float(np.linalg.det(jacobian)))
    extracted, there = extract_image(*picture, pixels_vu, sqrt(area))
    cut = np.pad(prepared.hidden, widening)
    mean = float(extracted[there].mean()) if there.any() else 0.0
    dark = there & (extracted - background <= options.shadow_level * (mean - background))
    cut |= dark | extend_shadows(dark, prepared.sun, shadow_reach(1.0 / sqrt(area)))
    inner = slice(widening, widening + len(prepared.predicted))
    valid = there & ~cut
    return MapletImages(
        prepared.predicted, np.where(valid, extracted, 0.0), prepared.lit, valid,
        int((there & cut)[inner, inner].sum()), float((prepared.predicted > 0).mean()),
        float(np.arccos(np.clip(prepared.ray[2], -1.0, 1.0))),
    )  # fmt: skip


def maplet_images(
    view: MapletView, maplet: Maplet, picture: tuple[Image, BoolArray], shift_vu: FloatArray, jacobian: FloatArray,
    options: MapletImageOptions, widening: int = 0,
) -> MapletImages:  # fmt: skip
    """Predict, extract and filter one maplet.

    Parameters
    ----------
    view
        Camera and body.
    maplet
        Maplet.
    picture
        (rows, cols) DN; (rows, cols) flags of good pixels.
    shift_vu
        (2,) pixels by which the picture is believed to lie off the prediction already.
    jacobian
        (2, 2) pixels per cell at the landmark.
    options
        Law and filter.
    widening
        Cells by which the extracted image is wider than the maplet on each side, for searches as wide.

    Returns
    -------
    MapletImages
        Ready for correlation.
    """
    pixels = grid_pixels(view, maplet, widening) + shift_vu
    return images_of(prepare_maplet(view, maplet, options), picture, pixels, jacobian, options)


def _hidden(heights: FloatArray, ray: FloatArray, least_emission: float) -> BoolArray:
    """Cells seen at a grazing angle, from behind, or not at all because the maplet stands before them."""
    cut = blocked_cells(heights, ray)
    _grazing(heights, ray, least_emission, cut)
    return cut


@numba.njit(cache=True, nogil=True)
def _grazing(heights, ray, least, cut):  # type: ignore[no-untyped-def]
    for i in range(heights.shape[0]):
        for j in range(heights.shape[0]):
            x, y, z = _normal(heights, i, j)
            if not (x * ray[0] + y * ray[1] + z * ray[2] >= least):
                cut[i, j] = True


def brightness_scale(
    predicted: FloatArray, extracted: FloatArray, correlation: float, guard: float
) -> tuple[float, float]:
    """Scale and background that turn a predicted image into the extracted one (eq. 3.42-3.45 as corrected).

    Parameters
    ----------
    predicted, extracted
        (k,) light of cells valid in both.
    correlation
        Their correlation.
    guard
        The background is fitted only from this correlation on.

    Returns
    -------
    tuple
        Scale and background: the regression of extracted on predicted, or the ratio of means and zero.
    """
    mean_p, mean_e = float(predicted.mean()), float(extracted.mean())
    variance = float((predicted**2).mean()) - mean_p**2
    if mean_p <= 0.0:
        return 0.0, mean_e
    if correlation < guard or variance <= 1e-12 * mean_p**2:
        return mean_e / mean_p, 0.0
    cross = float((predicted * extracted).mean())
    background = (mean_e * float((predicted**2).mean()) - mean_p * cross) / variance
    return (mean_e - background) / mean_p, background
