"""By how much a rendered body differs from a real one, and what that does to a fit.

Three things separate a perfect rendering from an image: the noise of a pixel; albedo and slopes that no catalogue knows
(a share ``texture`` of the light, alike over ``texture_px``); and a surface off its shape (``relief_px`` along the
gradient, alike over ``relief_reach_px``). All weigh the pixels; the last two are correlated, and their covariance is
carried through the fit: ``cov = G^-1 M G^-1`` with M the covariance of the weighted sums (White 1980 for the form).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from pydantic import Field

from pipeline.options import Options
from pipeline.predict.bodies import BodyScene
from pipeline.predict.body_view import BodyView
from pipeline.records import BoolArray, FloatArray, Image

# Share of the point spread's variance by which a camera's core may be wider than its record tells.
_WIDER_SHARE = 0.5
# Correlated errors are summed on blocks of about a quarter of their reach.
_BLOCKS_PER_REACH = 4.0
# Median of the square of a standard normal variable.
_MEDIAN_SQUARE = 0.455
_FEWEST_PIXELS = 30
_PATCH_SIDES = (8, 32, 128)
_FEWEST_BLOCKS = 8


class ModelErrorOptions(Options):
    """What is assumed of a surface before the image is looked at."""

    texture: float = Field(0.07, gt=0, le=1, description="rms of unknown albedo, relative (icy moons: 0.03 to 0.15)")
    texture_dof: float = Field(20.0, ge=0, le=1e4, description="weight of that figure, in independent patches")
    texture_reach: float = Field(0.15, gt=0, le=2, description="reach of albedo where it cannot be told, radii")
    wide_share: float = Field(0.7, ge=0, le=2, description="rms of albedo of wide reach, relative to all of it")
    wide_reach: float = Field(0.6, gt=0, le=3, description="that reach, radii")
    relief_share: float = Field(2e-3, ge=0, le=0.2, description="relief over radius where no catalogue tells it")


def haze_px(scene: BodyScene, view: BodyView, options: ModelErrorOptions) -> float:
    """How far a haze may have moved the limb outward: edges softer than the optics and the relief can make them.

    A haze of scale height H adds about H^2 to the variance of the edge, and H to its place.

    Parameters
    ----------
    scene
        Bodies, through the point spread that the image shows.
    view
        The body.
    options
        Assumptions.

    Returns
    -------
    float
        1 sigma of a height that its whole limb shares, pixels.
    """
    relief = assumed_errors(view, options).relief_px
    explained = (1.0 + _WIDER_SHARE) * scene.told_sigma_px**2 + relief**2
    return float(np.sqrt(max(scene.sigma_px**2 - explained, 0.0)))


@dataclass(frozen=True)
class ModelErrors:
    """Errors of the rendering: see the module's text.

    Attributes
    ----------
    texture, texture_px
        Relative rms and reach.
    wide_texture, wide_texture_px
        The same of provinces as large as hemispheres, which no single image can tell from the body's shading.
    patches
        (rms, reach in pixels) of albedo that is left in means over ever larger blocks of the face.
    shading
        1 sigma of the brightness that slopes of the surface change, relative to the template's unit; it does not fade
        toward the terminator as albedo does.
    relief_px, relief_reach_px
        1 sigma along the gradient and reach along the surface.
    """

    texture: float
    texture_px: float
    wide_texture: float
    wide_texture_px: float
    patches: tuple[tuple[float, float], ...]
    shading: float
    relief_px: float
    relief_reach_px: float


def assumed_errors(view: BodyView, options: ModelErrorOptions) -> ModelErrors:
    """Errors before the image is looked at.

    Parameters
    ----------
    view
        The body that shows most of itself.
    options
        Assumptions.

    Returns
    -------
    ModelErrors
        In pixels at the body's distance.
    """
    radius = view.diameter_px / 2
    sigma_km = view.body.shape_sigma_km
    relief = options.relief_share * radius if sigma_km is None else sigma_km * view.px_per_km
    reach = float(np.radians(view.body.shape_correlation_deg)) * radius
    narrow, wide = (max(share * radius, 1.0) for share in (options.texture_reach, options.wide_reach))
    wide_rms = options.wide_share * options.texture
    return ModelErrors(options.texture, narrow, wide_rms, wide, (), 0.0, relief, max(reach, 1.0))


def measured_errors(
    excess: FloatArray,
    residual: FloatArray,
    scale_dn: float,
    light: FloatArray,
    slope: FloatArray,
    good: BoolArray,
    assumed: ModelErrors,
    options: ModelErrorOptions,
) -> ModelErrors:
    """Texture and relief that residuals show, beside what was assumed of them.

    Parameters
    ----------
    excess
        (rows, cols) squared residual less the variance of a pixel's noise.
    residual
        (rows, cols) image less model, DN.
    scale_dn
        Brightness of the template's unit.
    light, slope
        (rows, cols) DN of the template, and length of its gradient, DN per pixel.
    good
        (rows, cols) True where measured.
    assumed
        Of :func:`assumed_errors`.
    options
        How much that counts.

    Returns
    -------
    ModelErrors
        Relief is never below what the catalogue says.
    """
    steepest, brightest = float(slope.max()), float(light.max())
    face = good & (light > 0.25 * brightest) & (slope < 0.25 * steepest)
    rms, reach, count = options.texture, assumed.texture_px, 0.0
    patches: tuple[tuple[float, float], ...] = ()
    if np.count_nonzero(face) > _FEWEST_PIXELS:
        rms = float(np.sqrt(max(excess[face].sum() / (light[face] ** 2).sum(), 0.0)))
        ratio = np.where(face, residual / np.where(face, light, 1.0), 0.0)
        reach = _reach(ratio, face, rms, assumed.texture_px)
        count = np.count_nonzero(face) / max(2.0 * np.pi * reach**2, 1.0)
        patches = _patches(ratio, face, rms, reach)
    dof = options.texture_dof
    texture = float(np.sqrt((dof * options.texture**2 + count * rms**2) / max(dof + count, 1e-9)))
    dusk = good & (light > 0.005 * brightest) & (light < 0.25 * brightest) & (slope < 0.25 * steepest)
    shading = 0.0
    if np.count_nonzero(dusk) > _FEWEST_PIXELS:
        dim = float((excess[dusk] - (texture * light[dusk]) ** 2).mean())
        shading = float(np.sqrt(max(dim, 0.0))) / scale_dn
    edge = good & (slope > 0.5 * steepest)
    relief2 = 0.0
    if np.count_nonzero(edge) > _FEWEST_PIXELS:
        left = excess[edge] - (texture * light[edge]) ** 2
        relief2 = float(np.median(left) / _MEDIAN_SQUARE / np.median(slope[edge] ** 2))
    relief = max(assumed.relief_px, float(np.sqrt(max(relief2, 0.0))))
    wide = options.wide_share * texture
    return replace(
        assumed, texture=texture, texture_px=reach, wide_texture=wide, patches=patches, shading=shading,
        relief_px=relief,
    )  # fmt: skip


def _patches(ratio: FloatArray, face: BoolArray, rms: float, reach: float) -> tuple[tuple[float, float], ...]:
    """Albedo of each size of block beyond what smaller sizes leave in a mean over it."""
    found: list[tuple[float, float]] = []
    expected = [(rms, reach)]
    filled = np.where(face, ratio, 0.0).astype(np.float32)
    for side in _PATCH_SIDES:
        rows, cols = face.shape[0] // side, face.shape[1] // side
        if min(rows, cols) < 2 or side < 3.0 * reach:
            continue
        inner = np.s_[: rows * side, : cols * side]
        whole = cv2.resize(face[inner].astype(np.float32), (cols, rows), interpolation=cv2.INTER_AREA) > 0.9
        if np.count_nonzero(whole) < _FEWEST_BLOCKS:
            continue
        means = cv2.resize(filled[inner], (cols, rows), interpolation=cv2.INTER_AREA)[whole]
        # A covariance rms^2 exp(-r/reach) integrates to 2 pi reach^2 rms^2, which a large block's mean shares out.
        known = sum(a**2 * min(1.0, 2.0 * np.pi * r**2 / side**2) for a, r in expected)
        left = float(means.var()) - known
        if left > 0:
            found.append((float(np.sqrt(left)), float(side)))
            expected.append(found[-1])
    return tuple(found)


def _reach(ratio: FloatArray, inside: BoolArray, rms: float, default: float) -> float:
    """E-folding length of an exponential covariance that gives the same mean of nearby products.

    Products are averaged at lags of 2 to a quarter of the face, to which a pixel's noise does not reach.
    """
    if rms <= 0:
        return default
    filled = np.where(inside, ratio - ratio[inside].mean(), 0.0)
    lengths = []
    for lag in np.unique(np.geomspace(2, max(3, min(inside.shape) // 4), 6).astype(int)):
        pairs = int((inside[lag:] & inside[:-lag]).sum() + (inside[:, lag:] & inside[:, :-lag]).sum())
        if pairs < _FEWEST_PIXELS:
            continue
        products = (filled[lag:] * filled[:-lag]).sum() + (filled[:, lag:] * filled[:, :-lag]).sum()
        rho = float(products / pairs) / rms**2
        if rho <= 0.05:
            lengths.append(lag / 3.0)
            break
        lengths.append(lag / -np.log(min(rho, 0.98)))
    return float(np.clip(np.median(lengths), 0.7, 3.0 * default)) if lengths else default


def correlated_sums(
    design: FloatArray, amplitude: FloatArray, places: tuple[FloatArray, FloatArray], reach_px: float
) -> FloatArray:
    """Covariance of ``sum(design * amplitude * error)`` for errors of unit variance with an exponential covariance.

    Parameters
    ----------
    design
        (n, p).
    amplitude
        (n,).
    places
        (n,) row and (n,) column of each sample, from zero.
    reach_px
        E-folding length.

    Returns
    -------
    numpy.ndarray
        (p, p).
    """
    block = max(1.0, reach_px / _BLOCKS_PER_REACH)
    row, col = ((p / block).astype(np.int64) for p in places)
    shape = (int(row.max()) + 1, int(col.max()) + 1)
    index = row * shape[1] + col
    kernel = _exponential_kernel(reach_px / block)
    fields = [
        np.bincount(index, design[:, k] * amplitude, shape[0] * shape[1]).reshape(shape).astype(np.float32)
        for k in range(design.shape[1])
    ]
    spread = [cv2.filter2D(field, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT) for field in fields]
    result = np.array([[float(np.vdot(a.astype(float), b)) for b in spread] for a in fields])
    return np.asarray((result + result.T) / 2)


def _exponential_kernel(reach: float) -> Image:
    half = max(1, int(np.ceil(4.0 * reach)))
    axis = np.arange(-half, half + 1)
    return np.asarray(np.exp(-np.hypot(axis[:, None], axis[None, :]) / reach), np.float32)
