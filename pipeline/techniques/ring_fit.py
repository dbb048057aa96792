"""Blurred steps fitted to all edges of rings at once: offset, rotation, radius errors and the blur's width.

Every unit (:mod:`pipeline.techniques.ring_units`) has brightness of its own, which is eliminated; what it says of its
edges' shifts goes into the common parameters. A feature's radius error is one unknown with the catalogue's sigma, so
that it is absorbed where other edges, or the edge's own curvature, allow it, and widens the covariance where not.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.ring_light import MOST_EDGES, unit_equations
from pipeline.predict.rings import RingScene
from pipeline.records import BoolArray, FloatArray, Record
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.ring_bands import left_over
from pipeline.techniques.ring_image import RingImage
from pipeline.techniques.ring_pixels import EdgePixels, measured, select_pixels
from pipeline.techniques.ring_solve import (
    Equations,
    calibrated,
    marginal,
    misfit,
    own_shifts,
    prior_of,
    scaled,
    step_of,
    system_of,
    unit_weights,
    without_outlier,
)
from pipeline.techniques.ring_texture import blended, change_along, edge_scatter, loosened
from pipeline.techniques.ring_units import RingUnits, make_units
from pipeline.techniques.ring_unknowns import (
    PIXEL_VARIANCE,
    USUAL_TEXTURE,
    Layout,
    Levers,
    Radii,
    first_radii,
    layout_of,
    levers_of,
    shifts_of,
    with_drifts,
)

_ROUNDS, _INNER = 10, 2
# A fit has settled when a round moves it by less than this, or by less than this share of its sigma.
_SETTLED_PX, _SETTLED_SIGMAS = 0.004, 0.1
# A last round that still moves it by more than this, in sigmas, has not found its place.
_LOST_SIGMAS = 1.0
# Widening of the blur in the first round, px^2, to reach edges that are off by a pixel or two; and what bands forgive.
_FIRST_WIDENING, _FIRST_SLACK_PX = 1.5, 1.0
# From this round on units are doubted: before, the edges have not found their places.
_DOUBT_FROM = 2
# A step sharper than the pixels that sample it would stop at the nearest gap between two of them.
_LEAST_VARIANCE_PX2, _MOST_WIDENING = PIXEL_VARIANCE + 0.05, 4.0
# Edges nearer to each other than so many blurs make one step.
_ONE_STEP_BLURS = 1.5
# Farthest that a step moves an edge across itself, and the array's centre.
_FARTHEST_ACROSS_PX, _FARTHEST_PX = 3.0, 30.0
# While a round moves the edges by more than this across themselves, their scatter is not that of the rings.
_CALM_PX = 0.2
# Rounds that learn the scatter; afterwards it stays, or fit and scatter would follow each other for ever.
_LEARNING = 3
# Units and pixels are chosen anew when the edges have moved so far.
_RENEWED_PX = 0.7
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class RingFit(Record):
    """Where the edges lie.

    Attributes
    ----------
    offset_vu, rotation_rad
        Correction at the array centre.
    pivot_vu
        (2,) centroid of the units in the image.
    information
        (2, 2) or (3, 3) about the pivot, before anything is said of what is observable.
    radius_km, radius_sigma_km
        (features,) shift of each feature's radius and its sigma after the fit.
    edge_km
        (edges,) shift of each edge beyond its feature's.
    excluded
        (features,) True where the image contradicts the catalogue and the feature told nothing.
    units
        Pieces of edges, under the fitted pointing.
    shift_px, shift_sigma_px
        (n, 10) shift of each edge that its unit alone would want beyond the fit, and its sigma (not-a-number where it
        tells nothing).
    weight
        (n,) robust weights.
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
class _Round:
    """State between linearisations."""

    offset_vu: FloatArray
    rotation_rad: float
    width: float
    radii: Radii
    moved_px: float
    moved_sigmas: float
    learned: int
    fit: RingFit | None


@dataclass(frozen=True, eq=False)
class _Job:
    """What does not change during a fit."""

    scene: RingScene
    image: RingImage
    context: NavContext
    layout: Layout
    tied: bool

    @property
    def reach_px(self) -> float:
        """Distance from an edge up to which pixels are used."""
        return 3.0 * self.blur_px + 1.5

    @property
    def blur_px(self) -> float:
        """Sigma of a blurred step."""
        return float(np.sqrt(self.layout.blur2))

    def near_px(self, first: bool) -> float:
        """Distance below which edges share a step; in the first round the blur is wider."""
        return _ONE_STEP_BLURS * float(np.sqrt(self.layout.blur2 + first * _FIRST_WIDENING))


def fit_rings(
    scene: RingScene, image: RingImage, start: tuple[FloatArray, float], context: NavContext, *, tied: bool, close: bool
) -> RingFit | str:
    """Fit all edges from a start that is right to a pixel or two.

    Parameters
    ----------
    scene
        Edges.
    image
        Light and noise.
    start
        (2,) offset at the array centre and rotation.
    context
        Bounds.
    tied
        Whether a unit's contrasts are one multiple of the predicted ones (a template) or all free.
    close
        Whether the edges are within their blur already; else the first round's is wider.

    Returns
    -------
    RingFit or str
        Or in one line why there is none.
    """
    job = _Job(scene, image, context, layout_of(scene, context), tied)
    radii = first_radii(scene, job.layout)
    now = _Round(np.asarray(start[0], float), float(start[1]), 0.0, radii, np.inf, np.inf, 0, None)
    turn = int(close)
    units: RingUnits | None = None
    flat = np.zeros(0, np.int64)
    wandered = np.inf
    while turn < _ROUNDS:
        pose = scene.pose(now.offset_vu, now.rotation_rad)
        if units is None or wandered > _RENEWED_PX or turn == 1:
            units = make_units(scene, pose, 2.0 * job.reach_px)
            if units is None or not len(units):
                return "no edge is inside the array"
        if wandered > _RENEWED_PX:
            flat, wandered = select_pixels(scene, image, pose, job.reach_px), 0.0
        if not tied and (units.present[:, 1:] & ~_apart(units, job.near_px(turn == 0))).any():
            # Near edges share a step in the ratio of their contrasts: better measured than predicted.
            told = left_over(scene, image.lattice, now.offset_vu, now.rotation_rad, _FIRST_SLACK_PX * (turn == 0))
            job = replace(job, scene=replace(scene, contrasts=told.contrasts))
        pixels = measured(scene, image, pose, units, flat, job.reach_px, job.blur_px)
        after = _linearised(job, now, units, pixels, turn)
        if isinstance(after, str):
            return after
        units = _carried(units, now, after, context)
        now = after
        wandered += now.moved_px
        if not _inside(now, context):
            return "the fit ran out of the search's bounds"
        if turn >= _DOUBT_FROM and (now.moved_px < _SETTLED_PX or now.moved_sigmas < _SETTLED_SIGMAS):
            break
        turn += 1
    if now.fit is None or units is None:
        return "no edge is inside the array"
    if now.moved_sigmas > _LOST_SIGMAS and now.moved_px > _RENEWED_PX:
        return "the fit did not settle"
    return replace(now.fit, offset_vu=now.offset_vu, rotation_rad=now.rotation_rad, units=units)


def _inside(now: _Round, context: NavContext) -> bool:
    arm = float(np.hypot(*context.camera_model.shape_vu)) / 2
    bound = np.array(context.search_margin_vu) * 1.2 + 5.0 + context.max_rotation_rad * arm
    turned = abs(now.rotation_rad) <= context.max_rotation_rad * 1.2 + 5.0 / arm
    return bool(np.isfinite(now.offset_vu).all() and (np.abs(now.offset_vu) <= bound).all() and turned)


def _carried(units: RingUnits, before: _Round, after: _Round, context: NavContext) -> RingUnits:
    """Units moved along with the pointing."""
    centre = context.camera_model.centre_vu
    turn = plane_rotation(after.rotation_rad - before.rotation_rad).T
    places = centre + after.offset_vu + (units.places_vu - centre - before.offset_vu) @ turn
    return replace(units, places_vu=places, normal_vu=units.normal_vu @ turn)


def _linearised(job: _Job, now: _Round, units: RingUnits, pixels: EdgePixels, turn: int) -> _Round | str:
    """A few Gauss-Newton steps at fixed geometry."""
    layout, first = job.layout, turn == 0
    pivot = np.asarray(units.places_vu[:, 0].mean(axis=0))
    levers = levers_of(job.scene, units, pivot, job.blur_px)
    now = replace(now, radii=with_drifts(now.radii, layout, levers.drift))
    weight = np.ones(len(units))
    base = np.append(now.offset_vu, now.rotation_rad)[: layout.size]
    values = np.concatenate([np.zeros(layout.size), [_FIRST_WIDENING if first else now.width], now.radii.values])
    for _ in range(_INNER):
        equations = _equations(job, units, pixels, levers, values, first)
        if not (equations.freedom > 0).any():
            return "no edge has enough pixels"
        loose = loosened(equations, units, layout, now.radii)
        if turn >= _DOUBT_FROM:
            weight = unit_weights(loose)
        step = step_of(system_of(loose, weight, levers, layout, values), layout, now.radii, first, base)
        if not np.isfinite(step).all():
            return "the fit is degenerate"
        values = values + step * _shortening(step, levers, layout)
        least = _LEAST_VARIANCE_PX2 - layout.blur2
        values[layout.size] = np.clip(values[layout.size], least, _MOST_WIDENING * layout.blur2)
    equations = _equations(job, units, pixels, levers, values, first)
    if turn >= _DOUBT_FROM:
        weight = unit_weights(loosened(equations, units, layout, now.radii))
    solved = (equations, weight, levers, values)
    pointing = np.concatenate([values[: layout.size], np.zeros(len(values) - layout.size)])
    across = float(np.sqrt((shifts_of(levers, layout, pointing) ** 2).mean()))
    learns = across < _CALM_PX and now.learned < _LEARNING
    fit, radii = _concluded(job, units, solved, now.radii, pivot, turn >= 1, learns)
    full = np.zeros(3)
    full[: layout.size] = values[: layout.size]
    offset, rotation = compose(job.context, now.offset_vu, now.rotation_rad, pivot, full)
    arm = float(np.hypot(*(units.places_vu[:, 0] - pivot).T).max())
    moved = float(np.hypot(*full[:2])) + abs(float(full[2])) * arm
    step_made = full[: layout.size]
    sigmas = float(np.sqrt(np.maximum(np.vdot(step_made, fit.information @ step_made), 0.0)))
    width = 0.0 if first else float(values[layout.size])
    return _Round(offset, rotation, width, radii, moved, sigmas, now.learned + learns, fit)


def _shortening(step: FloatArray, levers: Levers, layout: Layout) -> float:
    """Share of a step that leaves the edges within the reach of their blur, and the plane of the image flat."""
    pointing = np.concatenate([step[: layout.size], np.zeros(len(step) - layout.size)])
    across = float(np.abs(shifts_of(levers, layout, pointing)).max(initial=0.0))
    return min(
        1.0, _FARTHEST_ACROSS_PX / max(across, _TINY), _FARTHEST_PX / max(float(np.hypot(*step[:2])), _TINY)
    )


def _equations(
    job: _Job, units: RingUnits, pixels: EdgePixels, levers: Levers, values: FloatArray, first: bool
) -> Equations:
    layout = job.layout
    count = len(units)
    gram = np.zeros((count, MOST_EDGES + 1, MOST_EDGES + 1))
    pull, fit = np.zeros((count, MOST_EDGES + 1)), np.zeros((count, 3 + MOST_EDGES))
    step, share = _steps(units, job.scene.contrasts, job.near_px(first), job.tied)
    unit_equations(
        pixels.data, pixels.variance, pixels.distance, pixels.starts, units.edges, shifts_of(levers, layout, values),
        float(np.sqrt(layout.blur2 + values[layout.size])), step, share, job.image.lattice.amplitude, gram, pull, fit,
    )  # fmt: skip
    return blended(calibrated(gram, pull, fit, 1.0 + step.max(axis=1)), units, step)


def _apart(units: RingUnits, near_px: float) -> BoolArray:
    """(n, 9) whether each edge but the first is far enough from the one before it."""
    across = ((units.places_vu[:, 1:] - units.places_vu[:, :-1]) * units.normal_vu[:, 1:]).sum(axis=2)
    return np.asarray(np.abs(across) > near_px)


def _steps(
    units: RingUnits, contrasts: FloatArray, near_px: float, tied: bool
) -> tuple[NDArray[np.int64], FloatArray]:
    """(n, 10) step that each edge belongs to, and its share; the light between near edges is known by their sum only.

    Such edges, and with ``tied`` all of a unit, keep their predicted contrasts' ratios.
    """
    apart = _apart(units, near_px) & units.present[:, 1:] & (not tied)
    step = np.concatenate([np.zeros((len(units), 1), np.int64), np.cumsum(apart, axis=1)], axis=1)
    edge = np.minimum(units.edges[:, :1] + np.arange(MOST_EDGES), len(contrasts) - 1)
    share = np.where(units.present, contrasts[edge], 0.0)
    largest = np.zeros((len(units), MOST_EDGES))
    rows = np.broadcast_to(np.arange(len(units))[:, None], step.shape)
    np.maximum.at(largest, (rows, step), np.abs(share))
    share = share / np.maximum(np.take_along_axis(largest, step, axis=1), _TINY)
    alone = np.zeros((len(units), MOST_EDGES), np.int64)
    np.add.at(alone, (rows, step), units.present.astype(np.int64))
    single = np.take_along_axis(alone, step, axis=1) == 1
    return step, np.where(single & (not tied), 1.0 * units.present, share)


def _concluded(
    job: _Job, units: RingUnits, solved: tuple[Equations, FloatArray, Levers, FloatArray], radii: Radii,
    pivot: FloatArray, doubting: bool, learns: bool,
) -> tuple[RingFit, Radii]:  # fmt: skip
    """Information at the end, with what the units' and features' scatter says of their sigmas."""
    equations, weight, levers, values = solved
    layout = job.layout
    size, features = layout.size, layout.features
    chi2, rank = misfit(loosened(equations, units, layout, radii))
    freedom = float((weight * rank).sum())
    excess = max(1.0, float((weight * chi2).sum()) / max(freedom - min(float(size), freedom / 2), 1.0))
    calm = scaled(equations, excess)
    radii = replace(radii, values=values[layout.radii])
    if learns:
        radii = change_along(calm, units, layout, radii)
    system = system_of(loosened(calm, units, layout, radii), weight, levers, layout, values)
    scale = _scales(levers, layout)
    texture = USUAL_TEXTURE
    if learns:
        radii, texture = edge_scatter(system, layout, radii)
    if doubting:
        radii = without_outlier(system, layout, radii, scale[0], texture)
    prior = prior_of(layout, radii, False)
    total = system.gram + np.diag(prior)
    bound = np.concatenate([1.0 / layout.bounds**2, np.zeros(len(total) - size)])
    spare = np.linalg.pinv(total + np.diag(bound), hermitian=True)
    radius_sigma = np.sqrt(np.maximum(np.diag(spare)[layout.radii], 0.0))
    shift, shift_sigma = own_shifts(calm, units)
    known = len(job.scene.fates)
    radius, sigma, excluded = np.zeros(known), np.zeros(known), np.zeros(known, bool)
    radius[layout.used], sigma[layout.used] = radii.values[:features], radius_sigma[:features]
    excluded[layout.used] = radii.free[:features]
    edge_km = np.where(scale[1] > 0, radii.values[layout.shifts] / np.maximum(scale[1], _TINY), 0.0)
    # What drifts is the edge's own, not the fit's.
    edge = np.minimum(levers.edges[:, :1] + np.arange(MOST_EDGES), len(layout.column) - 1)
    shift = shift + radii.values[layout.drifts][edge] * levers.way
    some = equations.freedom > 0
    figure = float(np.median(equations.fit[some, 0] / equations.freedom[some])) if some.any() else np.nan
    fit = RingFit(
        np.zeros(2), 0.0, pivot, marginal(total, size), radius, sigma, edge_km, excluded, units, shift,
        shift_sigma, weight, equations.fit[:, 3:], excess, figure, int(equations.fit[:, 1].sum()),
        float(values[size]), float((equations.fit[:, 2] * (weight > 0)).sum()),
    )  # fmt: skip
    return fit, radii


def _scales(levers: Levers, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """(features,) largest shift per kilometre, and (edges,) the mean one; zero where none is in the image."""
    present = levers.scale > 0
    edge = (levers.edges[:, :1] + np.arange(MOST_EDGES))[present]
    count = len(layout.column)
    sums: FloatArray = np.bincount(edge, weights=levers.scale[present], minlength=count).astype(float)
    mean = np.asarray(sums / np.maximum(np.bincount(edge, minlength=count), 1))
    largest = np.zeros(layout.features)
    np.maximum.at(largest, layout.column[edge], levers.scale[present])
    return largest, mean
