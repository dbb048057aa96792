"""Rendered bodies fitted to the image pixel by pixel.

Beside offset and rotation the fit has the brightness, light that night sides return, a sloping sky, and a correction of
the point spread's width; what the rendering cannot know is in its errors (``model_errors``).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.frame import Frame
from pipeline.imaging.noise import PixelNoise
from pipeline.predict.bodies import BodyScene
from pipeline.records import FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import (
    Cutout,
    Levels,
    compose,
    cut_out,
    rotation_lever,
    rotation_shows,
    rough_levels,
    settle,
)
from pipeline.techniques.model_errors import (
    ModelErrorOptions,
    ModelErrors,
    assumed_errors,
    correlated_sums,
    haze_px,
    measured_errors,
)

_ROUNDS = 8
_FEWEST_PIXELS = 16
_LARGEST_STEP_PX = 2.0
_SETTLED_PX = 0.01
# From this size on, smooth parts are averaged over blocks before the fit.
_MANY_PIXELS = 40_000
_BLOCK = 4
# Share of the steepest gradient from which a pixel is taken alone.
_STEEP = 0.08
# Nuisances: what a night side returns, and the slope of the sky over half the cutout, relative to the brightness; the
# width of the point spread relative to itself.
_NIGHT_SHARE, _SKY_SLOPE_SHARE, _WIDTH_SHARE = 0.02, 0.02, 0.5
_LEAST_VARIANCE_PX2 = 0.04
_PROVINCE_RADII = 1.2
# Without a sign of a haze the limb stays where it is.
_LEAST_HAZE_PX = 1e-4
# What is left of albedo of wide reach once its rise across the body is fitted.
_LEFT_OVER = 0.5


@dataclass(frozen=True, eq=False)
class TemplateFit:
    """Answer of the fit.

    Attributes
    ----------
    offset_vu, rotation_rad
        At the array centre.
    pivot_vu
        Where the information holds: centroid of the bodies' centres in the image.
    information
        (2, 2) or (3, 3) about the pivot.
    scale_dn, level_dn
        Brightness of the template's unit, and of the sky.
    night_dn
        Brightness of night sides.
    variance_px2, variance_sigma_px2
        By how much the point spread's variance should grow, and its sigma.
    correlation, expected_correlation
        Of image and template, weighted, and what it would be if noise were all that differs.
    chi2_per_sample
        With all of the model's errors.
    errors
        Of the rendering.
    cutout
        At the last template.
    """

    offset_vu: FloatArray
    rotation_rad: float
    pivot_vu: FloatArray
    information: FloatArray
    scale_dn: float
    level_dn: float
    night_dn: float
    variance_px2: float
    variance_sigma_px2: float
    correlation: float
    expected_correlation: float
    chi2_per_sample: float
    errors: ModelErrors
    cutout: Cutout

    @property
    def levels(self) -> Levels:
        """Brightness, sky and night side, DN."""
        return Levels(self.scale_dn, self.level_dn, self.night_dn)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Pixels, and means of blocks of smooth ones.

    ``planes`` is (n, 7): data, image, along v, along u, night, widening, spin; ``row`` and ``col`` count from the
    window; ``light`` and ``slope`` are the template's largest value and gradient nearby.
    """

    planes: FloatArray
    light: FloatArray
    slope: FloatArray
    row: FloatArray
    col: FloatArray
    pixels: FloatArray


@dataclass(frozen=True, eq=False)
class _Solution:
    """One weighted linear solution: changes of (dv, du[, theta], brightness, night, width, sky, its slopes, albedo's
    two, height of a haze).

    ``lever`` is (2,), the offset that goes with a rotation which the image does not show apart from it; None where it
    does, or where no rotation is fitted.
    """

    values: FloatArray
    gram: FloatArray
    prior: FloatArray
    design: FloatArray
    weight: FloatArray
    residual: FloatArray
    size: int
    lever: FloatArray | None


def fit_template(
    scene: BodyScene,
    frame: Frame,
    start_vu: FloatArray,
    start_rad: float,
    context: NavContext,
    options: ModelErrorOptions,
) -> TemplateFit | str:
    """Fit offset and rotation of all bodies together.

    Parameters
    ----------
    scene, frame
        Bodies and image.
    start_vu, start_rad
        Pointing at the array centre, right to about a pixel.
    context
        Camera, bounds.
    options
        Assumptions about surfaces.

    Returns
    -------
    TemplateFit or str
        Or why there is none.
    """
    state = _State(np.asarray(start_vu, float), start_rad, None, None)
    haze = haze_px(scene, scene.primary(scene.views), options)
    for _ in range(_ROUNDS):
        cutout = cut_out(scene, frame, state.offset_vu, state.rotation_rad)
        if cutout is None or np.count_nonzero(cutout.good) < _FEWEST_PIXELS:
            return "too few pixels"
        last, outcome = state.offset_vu, _round(cutout, frame.noise, state, haze, context, options)
        if isinstance(outcome, str):
            return outcome
        fitted, state = outcome, outcome.state
        again = scene.quantised(state.offset_vu, state.rotation_rad)
        same = bool((again[0] == cutout.offset_vu).all()) and again[1] == cutout.rotation_rad
        if same or float(np.hypot(*(state.offset_vu - last))) < _SETTLED_PX:
            break
    return _answer(fitted, frame.noise, context)


@dataclass(frozen=True, eq=False)
class _State:
    """Pointing at the array centre, brightnesses and errors so far."""

    offset_vu: FloatArray
    rotation_rad: float
    levels: Levels | None
    errors: ModelErrors | None


@dataclass(frozen=True, eq=False)
class _Round:
    """One round: what was fitted on which template, and where it led."""

    state: _State
    levels: Levels
    errors: ModelErrors
    cutout: Cutout
    samples: _Samples
    solution: _Solution


def _round(
    cutout: Cutout, noise: PixelNoise, state: _State, haze: float, context: NavContext, options: ModelErrorOptions
) -> _Round | str:
    """Solve on one template, renew the errors, and step."""
    levels = state.levels or rough_levels(cutout)
    errors = state.errors or assumed_errors(cutout.primary, options)
    if not levels.scale > 0:
        return "the image is not bright where the template is"
    samples = _sample(cutout)
    solution = _solve(samples, cutout, noise, levels, errors, haze, context)
    k, values = solution.size, solution.values
    levels = Levels(levels.scale + values[k], levels.sky + values[k + 3], levels.night + values[k + 1])
    if not np.isfinite(values).all() or not levels.scale > 0:
        return "the fit has no solution"
    errors = _look(cutout, noise, levels, solution, options)
    step = np.zeros(3)
    step[:k] = values[:k]
    step *= min(1.0, _LARGEST_STEP_PX / max(float(np.hypot(*step[:2])), 1e-12))
    offset, rotation = compose(context, cutout.offset_vu, cutout.rotation_rad, cutout.pivot_vu, step)
    return _Round(_State(offset, rotation, levels, errors), levels, errors, cutout, samples, solution)


def _slope_length(cutout: Cutout) -> FloatArray:
    return np.asarray(np.hypot(cutout.template.along_v, cutout.template.along_u), float)


def _sample(cutout: Cutout) -> _Samples:
    """Single pixels where the template is steep or the image has gaps, means of blocks elsewhere."""
    t = cutout.template
    # Weights that change across a limb would turn a wrong point spread into a shift: what they are made from is held
    # over its reach.
    reach = 2 * int(np.ceil(2.0 * cutout.sigma_px)) + 1
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    slope = np.hypot(t.along_v, t.along_u)
    held = (cv2.dilate(t.image, near), cv2.dilate(slope, near))
    spin = t.image if t.spin is None else t.spin
    planes = (cutout.data, t.image, t.along_v, t.along_u, t.night, t.widening, spin, *held)
    rows, cols = cutout.good.shape
    single = cutout.good
    blocks = np.zeros((len(planes) + 3, 0))
    if cutout.good.size > _MANY_PIXELS:
        rough = (slope > _STEEP * float(slope.max())) | ~cutout.good
        tall, wide = rows // _BLOCK, cols // _BLOCK
        inner = np.s_[: tall * _BLOCK, : wide * _BLOCK]
        broken = rough[inner].reshape(tall, _BLOCK, wide, _BLOCK).any(axis=(1, 3))
        smooth = ~broken
        alone = np.ones((rows, cols), bool)
        alone[inner] = np.repeat(np.repeat(broken, _BLOCK, axis=0), _BLOCK, axis=1)
        single = cutout.good & alone
        means = [cv2.resize(p[inner], (wide, tall), interpolation=cv2.INTER_AREA)[smooth] for p in planes]
        i, j = np.nonzero(smooth)
        middle = (_BLOCK - 1) / 2
        rows_of, cols_of = i * float(_BLOCK) + middle, j * float(_BLOCK) + middle
        blocks = np.array([*means, rows_of, cols_of, np.full(len(i), float(_BLOCK**2))], float)
    i, j = np.nonzero(single)
    pixels = [*(p[single] for p in planes), i.astype(float), j.astype(float), np.ones(len(i))]
    table = np.concatenate([np.array(pixels, float), blocks], axis=1)
    return _Samples(np.ascontiguousarray(table[:7].T), *table[7:])


def _variance(samples: _Samples, noise: PixelNoise, levels: Levels, errors: ModelErrors) -> FloatArray:
    light = levels.scale * samples.light
    relief = levels.scale * errors.relief_px * samples.slope
    photon = noise.variance(levels.sky + light) / samples.pixels
    shading = np.where(samples.light > 0, errors.shading * levels.scale, 0.0)
    return np.asarray(photon + (errors.texture * light) ** 2 + shading**2 + relief**2)


def _design(samples: _Samples, cutout: Cutout, pivot_vu: FloatArray, scale: float, turns: bool) -> FloatArray:
    """(n, p): the image moved by d is T(x - d), so its derivative is minus the gradient."""
    _, image, along_v, along_u, night, widening, spin = samples.planes.T
    v, u = samples.row + cutout.window.v0, samples.col + cutout.window.u0
    columns = [-scale * along_v, -scale * along_u]
    if turns:
        # d(v, u)/d theta = (u, -v) about the pivot carries each body's centre; the body's own turn comes on top.
        centre_v, centre_u = _centres(cutout, v, u)
        carried = along_v * (centre_u - pivot_vu[1]) - along_u * (centre_v - pivot_vu[0])
        columns.append(scale * (spin - carried))
    half = max(cutout.window.rows, cutout.window.cols) / 2
    one = np.ones(len(image))
    slope_v = (samples.row - cutout.window.rows / 2) / half
    slope_u = (samples.col - cutout.window.cols / 2) / half
    # Albedo that rises across a body: the largest one's radius is the unit.
    largest = cutout.primary
    arm_v, arm_u = (2.0 * (x - c) / largest.diameter_px for x, c in zip((v, u), largest.centre_vu, strict=True))
    near = np.hypot(arm_v, arm_u) < _PROVINCE_RADII
    provinces = (np.where(near, image * arm_v, 0.0), np.where(near, image * arm_u, 0.0))
    # A haze lifts the limb all around.
    length = np.maximum(np.hypot(arm_v, arm_u), 1e-6)
    growth = np.where(near, -scale * (along_v * arm_v + along_u * arm_u) / length, 0.0)
    return np.stack([*columns, image, night, scale * widening, one, slope_v, slope_u, *provinces, growth], axis=1)


def _centres(cutout: Cutout, v: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) row and column of the centre of the body to which each pixel is nearest, in that body's radii."""
    gaps = [np.hypot(v - view.centre_vu[0], u - view.centre_vu[1]) / view.diameter_px for view in cutout.views]
    nearest = np.argmin(np.array(gaps), axis=0)
    centres = np.array([view.centre_vu for view in cutout.views])
    return centres[nearest, 0], centres[nearest, 1]


def _solve(
    samples: _Samples,
    cutout: Cutout,
    noise: PixelNoise,
    levels: Levels,
    errors: ModelErrors,
    haze: float,
    context: NavContext,
) -> _Solution:
    turns = context.fit_camera_rotation
    size = 3 if turns else 2
    design = _design(samples, cutout, cutout.pivot_vu, levels.scale, turns)
    weight = 1.0 / _variance(samples, noise, levels, errors)
    data, image, night = samples.planes[:, 0], samples.planes[:, 1], samples.planes[:, 4]
    target = data - levels.sky - levels.scale * image - levels.night * night
    weighted = design * weight[:, None]
    gram = weighted.T @ design
    pull = weighted.T @ target
    sigma2 = max(float(cutout.sigma_px) ** 2, _LEAST_VARIANCE_PX2)
    prior = np.zeros(len(gram))
    prior[size + 8] = 1.0 / max(haze, _LEAST_HAZE_PX) ** 2
    prior[size + 6 : size + 8] = 1.0 / max(errors.wide_texture * levels.scale, 1e-30) ** 2
    prior[size + 1] = 1.0 / (_NIGHT_SHARE * levels.scale) ** 2
    prior[size + 2] = 1.0 / (_WIDTH_SHARE * sigma2) ** 2
    prior[size + 4 : size + 6] = 1.0 / (_SKY_SLOPE_SHARE * levels.scale) ** 2
    pull[size + 1] -= prior[size + 1] * levels.night
    lever = None
    if turns:
        block = _marginal(gram + np.diag(prior), size)
        if cutout.corner or not rotation_shows(block, context):
            # Where the image does not show the rotation, it stays.
            lever = rotation_lever(block)
            prior[2] = 1e6 * gram[2, 2] + 1e-12
    gram = gram + np.diag(prior + 1e-12 * np.diag(gram))
    # A body that a step has carried out of the frame leaves parameters that no pixel shows.
    seen = bool((np.diag(gram) > 0).all())
    values = np.linalg.solve(gram, pull) if seen else np.full(len(gram), np.nan)
    return _Solution(np.asarray(values), gram, prior, design, weight, target - design @ values, size, lever)


def _marginal(information: FloatArray, size: int) -> FloatArray:
    """Information on the first parameters once the others are free."""
    cross = information[:size, size:]
    rest = information[size:, size:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(rest), 1e-300))
    inverse = np.linalg.pinv(rest * np.outer(scale, scale), rcond=1e-10) * np.outer(scale, scale)
    return np.asarray(information[:size, :size] - cross @ inverse @ cross.T)


def _look(
    cutout: Cutout, noise: PixelNoise, levels: Levels, solution: _Solution, options: ModelErrorOptions
) -> ModelErrors:
    """Errors of the rendering, from the residuals of all pixels of the cutout after the step."""
    t, k = cutout.template, solution.size
    light = levels.scale * t.image.astype(float)
    model = levels.sky + light + levels.night * t.night
    moved = solution.values[0] * t.along_v + solution.values[1] * t.along_u
    model = model - levels.scale * moved + levels.scale * solution.values[k + 2] * t.widening
    residual = np.where(cutout.good, cutout.data - model, 0.0)
    excess = residual**2 - noise.variance(levels.sky + light)
    slope = levels.scale * _slope_length(cutout)
    return measured_errors(
        excess, residual, levels.scale, light, slope, cutout.good, assumed_errors(cutout.primary, options), options
    )


def _covariance(
    samples: _Samples, solution: _Solution, noise: PixelNoise, levels: Levels, errors: ModelErrors
) -> FloatArray:
    """Covariance of offset, rotation and point spread with the model's errors correlated as they are."""
    light = levels.scale * samples.planes[:, 1]
    slope = levels.scale * np.hypot(samples.planes[:, 2], samples.planes[:, 3])
    photon = noise.variance(levels.sky + light) / samples.pixels
    wanted = [*range(solution.size), solution.size + 2]
    # What each sample's residual adds to the wanted parameters.
    inverse = np.linalg.inv(solution.gram)[:, wanted]
    influence = (solution.design @ inverse) * solution.weight[:, None]
    # Nuisances are off by as much as their priors say.
    nuisances = slice(solution.size + 1, None)
    total = (inverse[nuisances] * solution.prior[nuisances, None]).T @ inverse[nuisances]
    total += (influence * photon[:, None]).T @ influence
    places = (samples.row, samples.col)
    total += correlated_sums(influence, errors.texture * light, places, errors.texture_px)
    total += correlated_sums(influence, _LEFT_OVER * errors.wide_texture * light, places, errors.wide_texture_px)
    for rms, reach in errors.patches:
        total += correlated_sums(influence, rms * light, places, reach)
    lit = np.where(samples.planes[:, 1] > 0, errors.shading * levels.scale, 0.0)
    total += correlated_sums(influence, lit, places, errors.texture_px)
    total += correlated_sums(influence, errors.relief_px * slope, places, errors.relief_reach_px)
    return np.asarray(total)


def _answer(fitted: _Round, noise: PixelNoise, context: NavContext) -> TemplateFit | str:
    """Information, point spread and figures of the last round."""
    samples, solution, levels, errors = fitted.samples, fitted.solution, fitted.levels, fitted.errors
    size = solution.size
    full = _covariance(samples, solution, noise, levels, errors)
    seen = size == 2 or solution.lever is None
    covariance = full[:size, :size] if seen else full[:2, :2]
    if not np.isfinite(covariance).all() or (np.linalg.eigvalsh(covariance) <= 0).any():
        return "the fit is degenerate"
    information = np.zeros((size, size))
    information[: len(covariance), : len(covariance)] = np.linalg.inv(covariance)
    if solution.lever is not None:
        # What is known is the offset that goes with each rotation.
        bind = np.column_stack([np.eye(2), solution.lever])
        information = bind.T @ information[:2, :2] @ bind
    weight, model = solution.weight, levels.scale * samples.planes[:, 1]
    chi2 = float((weight * solution.residual**2).mean())
    # A rendering that fits worse than all that was granted to it is as much less certain (Birge 1932).
    settled = settle(information / max(chi2, 1.0), fitted.cutout.pivot_vu, context)
    data = model + solution.residual
    dm, dd = model - np.average(model, weights=weight), data - np.average(data, weights=weight)
    power = float(np.sqrt((weight * dm**2).sum() * (weight * dd**2).sum()))
    signal = float((weight * dm**2).sum())
    grain = float((weight * noise.variance(levels.sky + model) / samples.pixels).sum())
    return TemplateFit(
        offset_vu=fitted.state.offset_vu, rotation_rad=fitted.state.rotation_rad, pivot_vu=settled.pivot_vu,
        information=settled.information, scale_dn=levels.scale, level_dn=levels.sky, night_dn=levels.night,
        variance_px2=float(solution.values[size + 2]),
        variance_sigma_px2=float(np.sqrt(max(full[size, size], 0.0))),
        correlation=float((weight * dm * dd).sum()) / power if power > 0 else 0.0,
        expected_correlation=float(np.sqrt(signal / max(signal + grain, 1e-30))), chi2_per_sample=chi2, errors=errors,
        cutout=fitted.cutout,
    )  # fmt: skip
