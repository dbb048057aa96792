"""Blurred edges measured along an outline, and a pointing fitted to them with the body's own relief in the covariance.

The band of pixels around the outline is cut into segments. In each the image is a little more or less of the rendered
template, moved along the outline's normal, over a little sky: three numbers by least squares on the pixels themselves,
without any interpolation. So the edge is predicted as the camera blurs it, and no step is looked for in it, which would
lie inside the limb. The shifts of all segments then give the pointing by generalised least squares: their errors hold a
pixel's noise and the relief of the body, alike over some degrees.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.frame import Frame
from pipeline.options import Options
from pipeline.predict.outlines import Outline
from pipeline.records import BoolArray, FloatArray, Record
from pipeline.techniques.body_base import Cutout, Levels
from pipeline.techniques.model_errors import ModelErrors

_FEWEST_SEGMENTS = 4
_FEWEST_PIXELS = 6
_LEAST_MEASURED = 0.8
# Variance of a place inside a pixel.
_PIXEL_VARIANCE = 1.0 / 12.0
# Distances over their reach at which an exponential covariance is tabulated.
_LAGS = np.concatenate([np.linspace(0.0, 6.0, 49), [40.0]])


class BandOptions(Options):
    """The band around an outline and what may vary along it."""

    half_width_px: float = Field(4.0, ge=2, le=60, description="half-width of the band, beyond two sigmas of the blur")
    segment_px: float = Field(4.0, ge=2, le=50, description="shortest segment")
    segments: int = Field(120, ge=8, le=400, description="most segments")
    brightness_share: float = Field(0.3, gt=0, le=10, description="1-sigma of a segment's brightness, relative")
    sky_share: float = Field(0.03, gt=0, le=1, description="1-sigma of a segment's sky, relative to the brightness")
    largest_shift_px: float = Field(3.0, gt=0, le=50, description="shift beyond which a segment is no measurement")


@dataclass(frozen=True, eq=False)
class Segments(Record):
    """Measured pieces of outlines.

    Attributes
    ----------
    place_vu, normal_vu
        (m, 2) middle and unit normal.
    direction
        (m, 3) unit vectors from the body's centre.
    body
        (m,) index of the view.
    shift_px, sigma_px
        (m,) along the normal, and its 1 sigma from the pixels' noise.
    strength
        (m,) brightness relative to the template's, over its sigma.
    ok
        (m,) False where nothing could be measured.
    texture_lags_px, texture_px2
        (k,) distances between pieces, and covariance there of the shifts that unknown albedo makes: a gradient of
        brightness across a blurred edge moves it.
    """

    place_vu: FloatArray
    normal_vu: FloatArray
    direction: FloatArray
    body: NDArray[np.int64]
    shift_px: FloatArray
    sigma_px: FloatArray
    strength: FloatArray
    ok: BoolArray
    texture_lags_px: FloatArray
    texture_px2: FloatArray

    def __post_init__(self) -> None:
        m = len(self.place_vu)
        self._freeze(
            place_vu=(m, 2), normal_vu=(m, 2), direction=(m, 3), body=(m,), shift_px=(m,), sigma_px=(m,),
            strength=(m,), ok=(m,), texture_lags_px=(None,), texture_px2=(len(self.texture_lags_px),),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.place_vu)

    def take(self, index: NDArray[np.generic]) -> "Segments":
        """Rows of an index or mask."""
        return Segments(
            self.place_vu[index], self.normal_vu[index], self.direction[index], self.body[index],
            self.shift_px[index], self.sigma_px[index], self.strength[index], self.ok[index],
            self.texture_lags_px, self.texture_px2,
        )  # fmt: skip


def measure_segments(
    cutout: Cutout, outline: Outline, frame: Frame, levels: Levels, errors: ModelErrors, options: BandOptions
) -> Segments | str:
    """Measure how far the image's edge lies from the template's, piece by piece.

    Parameters
    ----------
    cutout
        Template and image.
    outline
        Of the template's views.
    frame
        Noise.
    levels
        Brightness of the template's unit, of the sky and of night sides.
    errors
        Of the rendering, for its unknown albedo.
    options
        Band.

    Returns
    -------
    Segments or str
        Or why there are too few.
    """
    usable = np.flatnonzero(outline.usable)
    if len(usable) < _FEWEST_SEGMENTS * 2:
        return "too little of the outline is lit and inside"
    piece = _pieces(outline, usable, options)
    pixels = _band(cutout, outline, usable, options.half_width_px + 2.0 * cutout.sigma_px)
    if pixels is None:
        return "no measured pixel near the outline"
    count = int(piece.max()) + 1
    row, col, vertex = pixels
    # Where much of the band is full or missing, what is left of an edge says little of where it is.
    total = np.bincount(piece[vertex], minlength=count)
    measured = cutout.good[row, col]
    row, col, vertex = row[measured], col[measured], vertex[measured]
    if not len(row):
        return "no measured pixel near the outline"
    group = piece[vertex]
    whole = np.bincount(group, minlength=count) >= _LEAST_MEASURED * total
    place, normal, direction, body = _middles(outline, usable, piece, count)
    template = cutout.template
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(np.ceil(2 * cutout.sigma_px)) + 1,) * 2)
    held = cv2.dilate(template.image, near)[row, col].astype(float)
    scale_dn = levels.scale
    variance = frame.noise.variance(levels.sky + scale_dn * held)
    image = template.image[row, col].astype(float)
    gradient = template.along_v[row, col] * normal[group, 0] + template.along_u[row, col] * normal[group, 1]
    residual = cutout.data[row, col] - levels.sky - scale_dn * image - levels.night * template.night[row, col]
    columns = (-scale_dn * gradient, scale_dn * image, np.full(len(image), scale_dn))
    priors = (0.0, 1.0 / options.brightness_share**2, 1.0 / options.sky_share**2)
    values, covariance, chi2, pixels_in = _local_fits(columns, residual, variance, group, count, priors)
    # Unknown albedo inside a band makes its pixels scatter more than their noise: the typical piece tells by how much.
    dense = pixels_in >= _FEWEST_PIXELS
    excess = max(1.0, float(np.median(chi2[dense]))) if dense.any() else 1.0
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0], 1e-12) * excess)
    strength = (1.0 + values[:, 1]) / np.sqrt(np.maximum(covariance[:, 1, 1] * excess, 1e-12))
    shift = values[:, 0]
    ok = dense & whole & np.isfinite(shift) & np.isfinite(sigma) & (np.abs(shift) <= options.largest_shift_px)
    ok &= sigma <= options.largest_shift_px
    lags = max(errors.texture_px, 1.0) * _LAGS
    texture = _albedo_shift(errors, cutout) ** 2 * np.exp(-_LAGS)
    segments = Segments(place, normal, direction, body, np.nan_to_num(shift), sigma, strength, ok, lags, texture)
    return segments if np.count_nonzero(ok) >= _FEWEST_SEGMENTS else "too few pieces of the outline show an edge"


def _albedo_shift(errors: ModelErrors, cutout: Cutout) -> float:
    """1 sigma of the shift of a blurred edge by albedo that varies along the normal.

    An edge of width w (a Gaussian integral) under a relative brightness g moves by int(g T T') / int(T'^2): for g alike
    over a length L < w that is tau sqrt(1.26 L w), for one alike over more it is the gradient's tau w^2 / L. Near a
    limb the surface is foreshortened: what is alike over l on it is so over l^2 / D across the limb.
    """
    width = float(np.sqrt(cutout.sigma_px**2 + _PIXEL_VARIANCE))
    diameter = cutout.primary.diameter_px
    across = min(errors.texture_px, errors.texture_px**2 / diameter)
    return errors.texture * width * min(float(np.sqrt(2.52 * across / width)), width / across)


def _pieces(outline: Outline, usable: NDArray[np.int64], options: BandOptions) -> NDArray[np.int64]:
    """(n usable,) number of the segment of each usable vertex."""
    places, body = outline.vertices_vu[usable], outline.body[usable]
    step = np.hypot(*np.diff(places, axis=0).T)
    # A gap in the line, or another body, begins a new piece.
    broken = np.concatenate([[True], (step > 4.0) | (np.diff(body) != 0)])
    length = np.concatenate([[0.0], np.where(broken[1:], 0.0, step)])
    total = float(length.sum())
    wanted = max(options.segment_px, total / options.segments)
    start = np.maximum.accumulate(np.where(broken, np.arange(len(usable)), 0))
    along = np.cumsum(length)
    local = np.floor((along - along[start]) / wanted).astype(np.int64)
    _, piece = np.unique(np.stack([start, local]), axis=1, return_inverse=True)
    return np.asarray(piece.ravel(), np.int64)


def _band(
    cutout: Cutout, outline: Outline, usable: NDArray[np.int64], half_width: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]] | None:
    """Rows and columns in the cutout of pixels near the outline, and the usable vertex nearest to each."""
    window = cutout.window
    local = np.rint(outline.vertices_vu - [window.v0, window.u0]).astype(int)
    rows, cols = cutout.good.shape
    # Dark and hidden vertices stand in the map too, so that what is nearest to them belongs to nobody.
    inside = (local >= 0).all(axis=1) & (local[:, 0] < rows) & (local[:, 1] < cols)
    source = np.ones((rows, cols), np.uint8)
    source[local[inside, 0], local[inside, 1]] = 0
    if source.all():
        return None
    distance, label = cv2.distanceTransformWithLabels(
        source, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.full(int(label.max()) + 1, -1, np.int64)
    rank = np.full(len(outline), -1, np.int64)
    rank[usable] = np.arange(len(usable))
    vertex = np.flatnonzero(inside)
    owner[label[local[vertex, 0], local[vertex, 1]]] = rank[vertex]
    row, col = np.nonzero(distance <= half_width)
    nearest = owner[label[row, col]]
    kept = nearest >= 0
    return (row[kept], col[kept], nearest[kept]) if kept.any() else None


def _middles(
    outline: Outline, usable: NDArray[np.int64], piece: NDArray[np.int64], count: int
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
    number = np.bincount(piece, minlength=count).astype(float)[:, None]

    def mean(values: FloatArray) -> FloatArray:
        sums = [np.bincount(piece, values[usable, k], count) for k in range(values.shape[1])]
        return np.asarray(np.stack(sums, axis=1) / number)

    normal, direction = mean(outline.normal_vu), mean(outline.direction)
    # Normals of a piece that folds back on itself cancel: it moves with nothing and shows no edge.
    normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    body = np.zeros(count, np.int64)
    body[piece] = outline.body[usable]
    return mean(outline.vertices_vu), normal, direction, body


def _local_fits(
    columns: tuple[FloatArray, FloatArray, FloatArray],
    residual: FloatArray,
    variance: FloatArray,
    group: NDArray[np.int64],
    count: int,
    priors: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shift, brightness and sky of each group: values (m, 3), covariances (m, 3, 3), chi2 per degree, pixels."""
    weight = 1.0 / variance
    gram = np.zeros((count, 3, 3))
    pull = np.zeros((count, 3))
    for i in range(3):
        pull[:, i] = np.bincount(group, weight * columns[i] * residual, count)
        for j in range(i, 3):
            gram[:, i, j] = gram[:, j, i] = np.bincount(group, weight * columns[i] * columns[j], count)
    gram += np.diag(priors)
    gram[:, 0, 0] += 1e-9 + 1e-12 * gram[:, 1, 1]
    covariance = np.asarray(np.linalg.inv(gram), float)
    values = np.einsum("mij,mj->mi", covariance, pull)
    left = residual - sum(columns[k] * values[group, k] for k in range(3))
    pixels = np.bincount(group, minlength=count).astype(float)
    chi2 = np.bincount(group, weight * left**2, count) / np.maximum(pixels - 3.0, 1.0)
    return values, covariance, chi2, pixels
