"""Blurred steps fitted to all edges of rings at once: offset, rotation, radius errors and the blur's width.

Every unit (:mod:`pipeline.techniques.ring_units`) has brightness of its own, which is eliminated; what it says of its
edges' shifts goes into the common parameters. A feature's radius error is one unknown with the catalogue's sigma, so
that it is absorbed where other edges, or the edge's own curvature, allow it, and widens the covariance where not.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.frame import Frame
from pipeline.geometry.rotations import plane_rotation_derivative
from pipeline.imaging.ring_light import MOST_EDGES, measure, near_edges, unit_equations
from pipeline.predict.rings import RingPose, RingScene
from pipeline.records import BoolArray, FloatArray, Image, Record
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.lm import tukey_weight
from pipeline.techniques.ring_units import RingUnits, make_units

# A pixel integrates over its square: as much variance, in square pixels, on each axis.
PIXEL_VARIANCE = 1.0 / 12.0
_ROUNDS, _INNER = 6, 3
_SETTLED_PX = 0.004
# Widening of the blur in the first round, to reach edges that are off by a pixel or two.
_FIRST_WIDENING = 1.5
# Prior of the blur's variance, relative to itself.
_WIDTH_SHARE = 0.3
# A step sharper than the pixels that sample it would stop at the nearest gap between two of them.
_LEAST_VARIANCE_PX2 = PIXEL_VARIANCE + 0.05
_MOST_PIXELS = 400_000
_FARTHEST_STEP_PX = 3.0
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class RingFit(Record):
    """Where the edges lie.

    Attributes
    ----------
    offset_vu, rotation_rad
        Correction at the array centre.
    pivot_vu
        (2,) weighted centroid of the units in the image.
    information
        (2, 2) or (3, 3) about the pivot, before anything is said of what is observable.
    radius_km, radius_sigma_km
        (features,) shift of each feature's radius and its sigma after the fit.
    edge_km
        (edges,) shift of each edge beyond its feature's.
    excluded
        (features,) True where the image contradicts the catalogue and the feature told nothing.
    units, shift_px, shift_sigma_px, weight
        (n, ...) units; (n, 10) shift of each edge that its unit alone would want beyond the fit, and its sigma (NaN
        where it tells nothing); (n,) robust weight.
    contrast_dn
        (n, 10) step outward.
    excess
        Variance of the units' shifts over what noise allows.
    chi2_per_pixel
        Median of the units.
    pixels
        Pixels in the fit.
    width_px2
        Change of the blur's variance.
    significance
        Light explained by the steps over level and slope, chi-square.
    """

    offset_vu: FloatArray
    rotation_rad: float
    pivot_vu: FloatArray
    information: FloatArray
    radius_km: FloatArray
    radius_sigma_km: FloatArray
    edge_km: FloatArray
    excluded: BoolArray
    units: RingUnits
    shift_px: FloatArray
    shift_sigma_px: FloatArray
    weight: FloatArray
    contrast_dn: FloatArray
    excess: float
    chi2_per_pixel: float
    pixels: int
    width_px2: float
    significance: float


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels near edges, sorted by unit."""

    data: FloatArray
    variance: FloatArray
    distance: FloatArray
    starts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Equations of the units, with what was fitted."""

    gram: FloatArray
    pull: FloatArray
    fit: FloatArray
    freedom: FloatArray


@dataclass(frozen=True, eq=False)
class _Radii:
    """Unknown radius errors in km: of the scene's features, then of its edges alone.

    An edge alone is off where its blur, or light beside it, is not what a step has; its sigma is what all edges of the
    image show, see :func:`_edge_scatter`.
    """

    used: NDArray[np.int64]
    values: FloatArray
    sigma: FloatArray
    free: BoolArray

    @property
    def features(self) -> int:
        """Number of features; the edges follow."""
        return len(self.used)


@dataclass(frozen=True, eq=False)
class _Solution:
    """Normal equations in (dv, du[, theta], width, radii)."""

    gram: FloatArray
    prior: FloatArray
    pull: FloatArray
    size: int


def fit_reach_px(sigma_px: float) -> float:
    """Distance from an edge up to which pixels are used."""
    return 3.0 * float(np.sqrt(sigma_px**2 + PIXEL_VARIANCE)) + 1.5


def smoothed_variance(frame: Frame) -> Image:
    """Variance of each pixel by its neighbourhood's level, which its own noise hardly moves.

    Parameters
    ----------
    frame
        Image.

    Returns
    -------
    numpy.ndarray
        (rows, cols) DN^2.
    """
    return np.asarray(frame.noise.variance(cv2.blur(frame.raw, (3, 3))), np.float32)


def fit_rings(
    scene: RingScene,
    frame: Frame,
    variance: Image,
    start: tuple[FloatArray, float],
    context: NavContext,
    tied: bool,
    rounds: int = _ROUNDS,
) -> RingFit | str:
    """Fit all edges from a start that is right to a pixel or two.

    Parameters
    ----------
    scene
        Edges.
    frame
        Image.
    variance
        Of :func:`smoothed_variance`.
    start
        (2,) offset at the array centre and rotation.
    context
        Bounds.
    tied
        Whether a unit's contrasts are one multiple of the predicted ones (a template) or all free.
    rounds
        Most linearisations.

    Returns
    -------
    RingFit or str
        Or in one line why there is none.
    """
    offset, rotation = np.asarray(start[0], float), float(start[1])
    reach = fit_reach_px(scene.sigma_px)
    flat: NDArray[np.int64] | None = None
    wandered = 0.0
    radii = _radii(scene)
    width = 0.0
    outcome: RingFit | str = "no edge is inside the array"
    for turn in range(rounds):
        pose = scene.pose(offset, rotation)
        units = make_units(scene, pose, 2.0 * reach)
        if units is None or not len(units):
            return "no edge is inside the array"
        if flat is None or wandered > 1.0:
            flat, wandered = _select(scene, pose, frame, reach + 2.0), 0.0
        pixels = _measured(scene, pose, units, flat, frame, variance, reach)
        first = turn == 0
        fitted = _inner(scene, units, pixels, radii, _FIRST_WIDENING if first else width, context, tied, turn)
        if isinstance(fitted, str):
            return fitted
        step, width, radii, outcome = fitted
        offset, rotation = compose(context, offset, rotation, outcome.pivot_vu, step)
        arm = float(np.hypot(*context.camera_model.shape_vu)) / 2
        moved = float(np.hypot(*step[:2])) + abs(float(step[2])) * arm
        wandered += moved
        bound = np.array(context.search_margin_vu) * 1.2 + 5.0 + context.max_rotation_rad * arm
        if not np.isfinite(offset).all() or (np.abs(offset) > bound).any():
            return "the fit ran out of the search's bounds"
        if not first and moved < _SETTLED_PX:
            break
    return _with_place(outcome, offset, rotation)


def _with_place(fit: RingFit | str, offset: FloatArray, rotation: float) -> RingFit | str:
    if isinstance(fit, str):
        return fit
    values = {name: getattr(fit, name) for name in fit.__dataclass_fields__}
    return RingFit(**(values | {"offset_vu": offset, "rotation_rad": rotation}))


def _radii(scene: RingScene) -> _Radii:
    used, first = np.unique(scene.feature, return_index=True)
    loose = np.full(len(scene), _LOOSE_PX * _km_per_px(scene))
    sigma = np.concatenate([scene.sigma_km[first], loose])
    return _Radii(used, np.zeros(len(sigma)), sigma, np.zeros(len(sigma), bool))


def _km_per_px(scene: RingScene) -> float:
    """Kilometres per pixel at the planet's distance."""
    camera, rings = scene.state.camera_model, scene.rings
    assert rings is not None
    scale = camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm)))
    return float(np.linalg.norm(rings.position_km) / scale)


def _select(scene: RingScene, pose: RingPose, frame: Frame, reach: float) -> NDArray[np.int64]:
    """Flat indices of good pixels near edges."""
    assert scene.rays is not None
    flat = np.zeros(frame.raw.size, np.int64)
    shape = np.array(frame.raw.shape)
    count = near_edges(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, shape, scene.curves, scene.means, scene.spread,
        reach, flat,
    )  # fmt: skip
    flat = flat[:count]
    flat = flat[~frame.bad.ravel()[flat]]
    # Of very many pixels a regular part is enough.
    return np.ascontiguousarray(flat[:: max(1, len(flat) // _MOST_PIXELS + (len(flat) > _MOST_PIXELS))])


def _measured(
    scene: RingScene, pose: RingPose, units: RingUnits, flat: NDArray[np.int64], frame: Frame, variance: Image,
    reach: float,
) -> _Pixels:  # fmt: skip
    assert scene.rays is not None
    unit = np.full(len(flat), -1, np.int64)
    distance = np.zeros((len(flat), MOST_EDGES))
    blur = float(np.sqrt(scene.sigma_px**2 + PIXEL_VARIANCE))
    measure(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, frame.raw.shape[1], flat, scene.curves,
        units.cell_of, units.span, units.unit_of, units.edges, reach, blur, scene.forms, scene.sun, unit, distance,
    )  # fmt: skip
    order = np.argsort(unit, kind="stable")
    order = order[np.searchsorted(unit[order], 0) :]
    starts = np.searchsorted(unit[order], np.arange(len(units) + 1))
    chosen = flat[order]
    return _Pixels(
        frame.raw.ravel()[chosen].astype(float), variance.ravel()[chosen].astype(float), distance[order], starts
    )


def _inner(
    scene: RingScene, units: RingUnits, pixels: _Pixels, radii: _Radii, width: float, context: NavContext,
    tied: bool, turn: int,
) -> tuple[FloatArray, float, _Radii, RingFit] | str:  # fmt: skip
    """A few Gauss-Newton steps at fixed geometry; units are doubted once the edges have found their places."""
    first, robust = turn == 0, turn >= 2
    size = 3 if context.fit_camera_rotation else 2
    weight = np.ones(len(units))
    step = np.zeros(size)
    pivot = _pivot(units, weight)
    jacobian = _jacobian(scene, units, radii, pivot, size)
    sigma2 = scene.sigma_px**2 + PIXEL_VARIANCE
    solution: _Solution | None = None
    for _ in range(_INNER):
        values = np.concatenate([step, [width], radii.values])
        equations = _unit_equations(scene, units, pixels, jacobian, values, tied)
        if not (equations.freedom > 0).any():
            return "no edge has enough pixels"
        if robust:
            weight = _weights(equations, units)
        solution = _assembled(equations, weight, jacobian, values, radii, sigma2, size, first, context)
        change = np.linalg.solve(solution.gram + np.diag(solution.prior), solution.pull)
        if not np.isfinite(change).all():
            return "the fit is degenerate"
        longest = float(np.hypot(*change[:2]))
        change *= min(1.0, _FARTHEST_STEP_PX / max(longest, _TINY))
        step = step + change[:size]
        width = float(np.clip(width + change[size], _LEAST_VARIANCE_PX2 - sigma2, 4.0 * sigma2))
        radii = _Radii(radii.used, radii.values + change[size + 1 :], radii.sigma, radii.free)
    assert solution is not None
    values = np.concatenate([step, [width], radii.values])
    equations = _unit_equations(scene, units, pixels, jacobian, values, tied)
    weight = _weights(equations, units) if robust else weight
    fit, radii = _concluded(
        scene, units, pixels, equations, weight, jacobian, values, radii, sigma2, size, pivot, context
    )
    full = np.zeros(3)
    full[:size] = step
    return full, (0.0 if first else width), radii, fit


def _pivot(units: RingUnits, weight: FloatArray) -> FloatArray:
    """(2,) centroid of the units' first edges."""
    return np.asarray(np.average(units.places_vu[:, 0], axis=0, weights=np.maximum(weight, _TINY)))


def _jacobian(scene: RingScene, units: RingUnits, radii: _Radii, pivot: FloatArray, size: int) -> FloatArray:
    """(n, 11, size + 1 + features): shifts of the units' edges, and the blur's variance, by the parameters."""
    count = len(units)
    result = np.zeros((count, MOST_EDGES + 1, size + 1 + len(radii.values)))
    result[:, :MOST_EDGES, :2] = units.normal_vu
    if size == 3:
        lever = (units.places_vu - pivot) @ plane_rotation_derivative(0.0).T
        result[:, :MOST_EDGES, 2] = (lever * units.normal_vu).sum(axis=2)
    column = np.searchsorted(radii.used, scene.feature)
    edge = np.minimum(units.edges[:, :1] + np.arange(MOST_EDGES), len(scene) - 1)
    rows, places = np.indices(edge.shape)
    result[rows, places, size + 1 + column[edge]] = units.px_per_km
    result[rows, places, size + 1 + radii.features + edge] = units.px_per_km
    result[:, :MOST_EDGES][~units.present] = 0.0
    # The blur is the parameter behind a unit's last edge.
    last = units.present.sum(axis=1)
    result[np.arange(count), last] = 0.0
    result[np.arange(count), last, size] = 1.0
    return result


def _unit_equations(
    scene: RingScene, units: RingUnits, pixels: _Pixels, jacobian: FloatArray, values: FloatArray, tied: bool
) -> _Equations:
    size = jacobian.shape[2] - 1 - len(np.unique(scene.feature)) - len(scene)
    width = float(values[size])
    moved = values.copy()
    moved[size] = 0.0
    shifts = jacobian[:, :MOST_EDGES] @ moved
    count = len(units)
    gram = np.zeros((count, MOST_EDGES + 1, MOST_EDGES + 1))
    pull, fit = np.zeros((count, MOST_EDGES + 1)), np.zeros((count, 3 + MOST_EDGES))
    blur = float(np.sqrt(scene.sigma_px**2 + PIXEL_VARIANCE))
    amplitude = float(np.ptp(np.quantile(pixels.data, (0.02, 0.98)))) if len(pixels.data) else 1.0
    unit_equations(
        pixels.data, pixels.variance, pixels.distance, pixels.starts, units.edges, shifts, width, blur,
        scene.contrasts, tied, max(amplitude, 1e-6), gram, pull, fit,
    )  # fmt: skip
    steps = np.ones(count) if tied else units.present.sum(axis=1).astype(float)
    freedom = np.where(fit[:, 1] > 0, fit[:, 1] - 2.0 - steps, 0.0)
    noise = np.maximum(fit[:, 0] / np.maximum(freedom, 1.0), 1.0)
    told = fit[:, 2] / noise
    # Contrasts that are noise make the squares of the slopes as large as their errors do; that part tells nothing.
    sure = np.clip(1.0 - 2.0 * steps / np.maximum(told, _TINY), 0.0, 1.0) / noise
    return _Equations(gram * sure[:, None, None], pull * sure[:, None], fit, np.where(sure > 0, freedom, 0.0))


def _misfit(equations: _Equations) -> tuple[FloatArray, FloatArray]:
    """(n,) chi-square by which each unit's own shifts would lower its misfit, and their number."""
    size = equations.gram.shape[1]
    trace = np.trace(equations.gram, axis1=1, axis2=2)
    ridge = 1e-6 * trace[:, None, None] * np.eye(size) + (trace <= 0)[:, None, None] * np.eye(size)
    own = np.linalg.solve(equations.gram + ridge, equations.pull[:, :, None])[:, :, 0]
    values = np.linalg.eigvalsh(equations.gram)
    rank = (values > 1e-3 * values[:, -1:]).sum(axis=1) * (trace > 0)
    return np.maximum((own * equations.pull).sum(axis=1), 0.0), rank.astype(float)


def _weights(equations: _Equations, units: RingUnits) -> FloatArray:
    """(n,) Tukey weights by the units' misfit."""
    chi2, rank = _misfit(equations)
    ratio = np.sqrt(chi2 / np.maximum(rank, 1.0))
    some = rank > 0
    if not some.any():
        return np.ones(len(units))
    # The median of |normal| is 0.674.
    scale = max(1.0, float(np.median(ratio[some])) / 0.8)
    return tukey_weight(ratio, scale) * some


def _assembled(
    equations: _Equations, weight: FloatArray, jacobian: FloatArray, values: FloatArray, radii: _Radii, sigma2: float,
    size: int, first: bool, context: NavContext,
) -> _Solution:  # fmt: skip
    scaled = equations.gram * weight[:, None, None]
    columns = jacobian.shape[2]
    half = scaled @ jacobian
    gram = jacobian.reshape(-1, columns).T @ half.reshape(-1, columns)
    pull = jacobian.reshape(-1, columns).T @ (equations.pull * weight[:, None]).ravel()
    prior = np.zeros(columns)
    prior[:2] = 1.0 / np.array(context.search_margin_vu) ** 2
    if size == 3:
        prior[2] = 1.0 / context.max_rotation_rad**2
    prior[size] = 1e12 if first else 1.0 / (_WIDTH_SHARE * sigma2) ** 2
    known = np.maximum(radii.sigma, 1e-9)
    prior[size + 1 :] = np.where(radii.free, 1e-12, 1.0 / known**2)
    # The shift's own prior only keeps a step short where an edge does not show it: it always starts here.
    target = prior * values
    target[:size] = 0.0
    if first:
        target[size] = 0.0
    return _Solution(gram, prior + _TINY * np.diag(gram), pull - target, size)


def _concluded(
    scene: RingScene, units: RingUnits, pixels: _Pixels, equations: _Equations, weight: FloatArray,
    jacobian: FloatArray, values: FloatArray, radii: _Radii, sigma2: float, size: int, pivot: FloatArray,
    context: NavContext,
) -> tuple[RingFit, _Radii]:  # fmt: skip
    """Information at the end, with what the units' and features' scatter says of their sigmas."""
    chi2, rank = _misfit(equations)
    spent = min(float(size), float((weight * rank).sum()) / 2)
    excess = max(1.0, float((weight * chi2).sum()) / max(float((weight * rank).sum()) - spent, 1.0))
    calm = _Equations(equations.gram / excess, equations.pull / excess, equations.fit, equations.freedom)
    radii = _judged(calm, weight, jacobian, values, radii, sigma2, size, context)
    radii = _edge_scatter(calm, weight, jacobian, values, radii, sigma2, size, context, _km_per_px(scene))
    solution = _assembled(calm, weight, jacobian, values, radii, sigma2, size, False, context)
    total = solution.gram + np.diag(np.concatenate([np.zeros(size), solution.prior[size:]]))
    information = _marginal(total, size)
    whole = total + np.diag(np.concatenate([solution.prior[:size], np.zeros(len(total) - size)]))
    radius_sigma = np.sqrt(np.maximum(np.diag(np.linalg.inv(whole))[size + 1 :], 0.0))
    shift, shift_sigma = _own_shifts(calm, units)
    features = len(scene.rings.features) if scene.rings is not None else 0
    columns = [np.zeros(features), np.zeros(features)]
    mine = slice(0, radii.features)
    columns[0][radii.used], columns[1][radii.used] = radii.values[mine], radius_sigma[mine]
    excluded = np.zeros(features, bool)
    excluded[radii.used] = radii.free[mine]
    some = equations.freedom > 0
    figure = float(np.median(equations.fit[some, 0] / equations.freedom[some])) if some.any() else np.nan
    return RingFit(
        np.zeros(2), 0.0, pivot, information, columns[0], columns[1], radii.values[radii.features :],
        excluded, units, shift, shift_sigma, weight,
        equations.fit[:, 3:], excess, figure, len(pixels.data), float(values[size]),
        float((equations.fit[:, 2] * (weight > 0)).sum()),
    ), radii  # fmt: skip


def _marginal(total: FloatArray, size: int) -> FloatArray:
    """Information on the first parameters once the others are free."""
    rest = total[size:, size:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(rest), 1e-300))
    inverse = np.linalg.pinv(rest * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    cross = total[:size, size:]
    result = total[:size, :size] - cross @ inverse @ cross.T
    return np.asarray((result + result.T) / 2)


# A feature is left out from so many sigmas on, if also by so many pixels, and if enough others agree.
_OUTLIER_SIGMAS, _LEAST_OTHERS = 4.0, 2
_LEAST_TROUBLE_PX = 0.25
# Sigma of single edges: at the start, while features are judged, and scale of its prior.
_LOOSE_PX, _TIGHT_PX, _USUAL_EDGE_PX = 0.3, 0.02, 0.003


def _judged(
    equations: _Equations, weight: FloatArray, jacobian: FloatArray, values: FloatArray, radii: _Radii, sigma2: float,
    size: int, context: NavContext,
) -> _Radii:  # fmt: skip
    """Features that contradict all others by far get a free radius."""
    count = radii.features
    if count <= _LEAST_OTHERS:
        return radii
    tight = radii.sigma.copy()
    px_per_km = np.abs(jacobian[:, :MOST_EDGES, size + 1 :]).max(axis=(0, 1))
    tight[count:] = _TIGHT_PX / np.maximum(px_per_km[count:], 1e-300)
    strict = _Radii(radii.used, radii.values, tight, radii.free)
    solution = _assembled(equations, weight, jacobian, values, strict, sigma2, size, False, context)
    gap, sigma = np.zeros(count), np.full(count, np.inf)
    for k in range(count):
        at = size + 1 + k
        if solution.gram[at, at] <= 0 or radii.free[k]:
            continue
        prior, pull = solution.prior.copy(), solution.pull.copy()
        prior[at] = 1e-12
        pull[at] += solution.prior[at] * radii.values[k]
        inverse = np.linalg.inv(solution.gram + np.diag(prior))
        gap[k] = radii.values[k] + float(inverse[at] @ pull)
        sigma[k] = float(np.hypot(np.sqrt(max(inverse[at, at], 0.0)), radii.sigma[k]))
    ratio = np.abs(gap) / sigma
    worst = int(np.argmax(ratio))
    others = count - 1 - int(radii.free.sum())
    off = abs(gap[worst]) * px_per_km[worst] > _LEAST_TROUBLE_PX
    if ratio[worst] <= _OUTLIER_SIGMAS or others < _LEAST_OTHERS or not off:
        return radii
    free = radii.free.copy()
    free[worst] = True
    return _Radii(radii.used, radii.values, radii.sigma, free)


def _edge_scatter(
    equations: _Equations, weight: FloatArray, jacobian: FloatArray, values: FloatArray, radii: _Radii, sigma2: float,
    size: int, context: NavContext, km_per_px: float,
) -> _Radii:  # fmt: skip
    """Sigma of single edges: the most likely one, all other parameters being free (restricted maximum likelihood).

    With the edges' own errors w of sigma s, information A and pull b on them, the likelihood is
    ``det(I + s^2 A)^(-1/2) exp(b (A + I / s^2)^-1 b / 2)`` (Patterson and Thompson 1971, Biometrika 58, 545); a Cauchy
    prior keeps s small where an image has too few edges to tell.
    """
    first = size + 1 + radii.features
    solution = _assembled(equations, weight, jacobian, values, radii, sigma2, size, False, context)
    edges = np.arange(first, len(solution.prior))
    bare = solution.prior.copy()
    pull = solution.pull.copy()
    pull[edges] += bare[edges] * values[edges]
    bare[edges] = 0.0
    # About zero errors, not about the present ones.
    gram = solution.gram + np.diag(bare)
    pull = pull + solution.gram[:, edges] @ values[edges]
    others = np.arange(first)
    inner = np.linalg.solve(gram[np.ix_(others, others)], np.column_stack([gram[np.ix_(others, edges)], pull[others]]))
    block = gram[np.ix_(edges, edges)] - gram[np.ix_(edges, others)] @ inner[:, :-1]
    told = pull[edges] - gram[np.ix_(edges, others)] @ inner[:, -1]
    size_, vectors = np.linalg.eigh((block + block.T) / 2 * km_per_px**2)
    size_ = np.maximum(size_, 0.0)
    along = (vectors.T @ told) * km_per_px
    grid = np.geomspace(1e-3, 3.0, 60)[:, None]
    likely = (-0.5 * np.log1p(grid**2 * size_) + 0.5 * along**2 / (size_ + 1.0 / grid**2)).sum(axis=1)
    likely -= np.log1p((grid[:, 0] / _USUAL_EDGE_PX) ** 2)
    best = float(grid[int(np.argmax(likely)), 0])
    sigma = radii.sigma.copy()
    sigma[radii.features :] = best * km_per_px
    return _Radii(radii.used, radii.values, sigma, radii.free)


def _own_shifts(equations: _Equations, units: RingUnits) -> tuple[FloatArray, FloatArray]:
    """(n, 10) shifts that the units want beyond the fit, and their sigmas; not-a-number where they tell nothing."""
    size = equations.gram.shape[1]
    diagonal = np.diagonal(equations.gram, axis1=1, axis2=2)
    silent = diagonal <= 1e-6 * diagonal.max(axis=1, keepdims=True)
    regular = equations.gram + silent[:, :, None] * np.eye(size) + 1e-6 * diagonal[:, :, None] * np.eye(size)
    regular = regular + (diagonal.max(axis=1) <= 0)[:, None, None] * np.eye(size)
    inverse = np.linalg.inv(regular)
    shift = (inverse @ equations.pull[:, :, None])[:, :MOST_EDGES, 0]
    sigma = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2)[:, :MOST_EDGES], 0.0))
    unknown = silent[:, :MOST_EDGES] | ~units.present
    return np.where(unknown, np.nan, shift), np.where(unknown, np.nan, sigma)
