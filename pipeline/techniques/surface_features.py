"""SurfaceFeatureNav: maplets predicted, aligned together, found one by one, and fitted as one pointing.

The same observations then update position and attitude together; that loop looks for the landmarks again under every
new state until they stay where they are.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import bdtrc

from pipeline.camera import pixel_scale_rad, project, project_jacobian
from pipeline.frame import Frame
from pipeline.geometry.maplet import Maplet, MapletIndex, MapletView
from pipeline.geometry.pointing import corrected_attitude, move_pivot
from pipeline.geometry.rays import RayTree
from pipeline.imaging.maplet_images import MapletImageOptions
from pipeline.predict.maplet_removal import RemovalOptions, removal_reason, removed_ratio
from pipeline.predict.maplets import CullingOptions, MapletReason, Visibility, cull, maplet_jacobian, view_of
from pipeline.records import Body, BoolArray, FloatArray, Image, State
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueFailure, TechniqueOptions, TechniqueResult, edge_flags
from pipeline.techniques.landmark_state import LandmarkState, LandmarkStateOptions, update_state
from pipeline.techniques.landmark_table import LandmarkStatus, LandmarkTable
from pipeline.techniques.maplet_alignment import Alignment, align, light_of
from pipeline.techniques.maplet_correlation import REACH, CorrelationOptions, LandmarkMatch, PeakStatus, locate
from pipeline.techniques.star_fit import StarFit, StarFitOptions, fit_stars

NAME = "SurfaceFeatureNav"
# The alignment may be off by half a reduced pixel and a pixel for relief and twist; searches use four of five bins.
_ALIGNMENT_PX = 1.0
_USABLE_BINS = REACH - 1
# Radius within which a landmark counts as where the others say, for the chance that mere luck put it there.
_AGREEMENT_PX = 1.5
# What a wrong position or scale leaves of landmarks is smooth over a picture: a quadratic has six coefficients, so many
# independent draws are its misfits worth, however many the landmarks.
_SMOOTH_DRAWS = 6


class SurfaceFeatureOptions(TechniqueOptions):
    """Options of the whole technique."""

    culling: CullingOptions = CullingOptions()
    images: MapletImageOptions = MapletImageOptions()
    removal: RemovalOptions = RemovalOptions()
    correlation: CorrelationOptions = CorrelationOptions()
    fit: StarFitOptions = StarFitOptions()
    most_landmarks: int = Field(120, ge=4, le=5000, description="maplets looked for in one picture, at most")
    least_landmarks: int = Field(4, ge=1, description="landmarks that must agree")
    least_confidence: float = Field(
        0.99, ge=0, lt=1, description="one minus the expected number of places on which as many agree by luck, at least"
    )
    rounds: int = Field(2, ge=1, le=5, description="times that all landmarks are looked for, geometry renewed between")
    state: LandmarkStateOptions = LandmarkStateOptions()
    position_sigma_share: float = Field(
        0.0034, gt=0, le=1, description="1 sigma of the a-priori position per axis, share of the distance"
    )
    attitude_sigma_px: float = Field(
        20.0, gt=0, description="1 sigma of the a-priori attitude per axis where the State brings none, pixels"
    )
    state_rounds: int = Field(3, ge=0, le=20, description="rounds of looking and updating the state; 0 leaves it out")
    state_tolerance_px: float = Field(0.05, gt=0, description="largest move of a landmark that ends these rounds")
    removed_by_hand: tuple[str, ...] = Field((), description="landmarks never used (seed 001 section 3.4)")


@dataclass(frozen=True)
class MapletSource:
    """Maplets of one body.

    Attributes
    ----------
    body
        Its name, as in the State.
    index
        All maplets but their height fields.
    load
        Gives one maplet by its row.
    surface
        The body's surface and its largest diameter in km; None where no shape is known.
    """

    body: str
    index: MapletIndex
    load: Callable[[int], Maplet]
    surface: tuple[RayTree, float] | None


@dataclass(frozen=True, eq=False)
class SurfaceFix:
    """What the landmarks of one picture gave.

    Attributes
    ----------
    answer
        Pointing about the centroid of the landmarks, or why there is none.
    table
        One row per landmark looked for, None where none can be seen.
    state
        Position and attitude from the same landmarks, None without an answer.
    """

    answer: TechniqueResult | TechniqueFailure
    table: LandmarkTable | None = None
    state: LandmarkState | None = None


@dataclass(frozen=True, eq=False)
class _Search:
    """What stays the same from round to round."""

    maplets: list[Maplet]
    index: MapletIndex
    rows: NDArray[np.int64]
    picture: tuple[Image, BoolArray]
    options: SurfaceFeatureOptions


def surface_feature_nav(
    body: Body, source: MapletSource, frame: Frame, state: State, options: SurfaceFeatureOptions
) -> SurfaceFix:
    """Find a body's landmarks in a picture.

    Parameters
    ----------
    body
        As the State places it.
    source
        Its maplets.
    frame
        Image.
    state
        Geometry.
    options
        Of every stage.

    Returns
    -------
    SurfaceFix
        Pointing, landmarks and state.
    """
    context, view = NavContext.of(state), view_of(state, body)
    seen = cull(view, source.index, source.surface, options.culling)
    rows = _chosen(seen, options.most_landmarks)
    if not len(rows):
        return SurfaceFix(TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, f"{body.name}: {_tally(seen)}"))
    search = _Search([source.load(int(row)) for row in rows], source.index, rows, (frame.raw, ~frame.bad), options)
    cells = light_of(view, search.maplets, options.images)
    alignment = align(cells, search.picture, context.search_margin_vu, context.max_rotation_rad)
    if alignment is None:
        return SurfaceFix(TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, f"{body.name}: no light varies"))
    offset, _ = move_pivot(
        alignment.offset_vu, alignment.rotation_rad, alignment.pivot_vu, context.camera_model.centre_vu
    )
    answer, table, attitude = _rounds(search, view, body, context, (offset, alignment))
    if isinstance(answer, TechniqueFailure):
        return SurfaceFix(answer, table)
    prior = _prior_covariance(view, search, state.attitude.sigma_rad)
    found, table = _state(search, view, replace(view, camera_from_body=attitude), table, prior)
    return SurfaceFix(answer, table, found)


def _chosen(seen: Visibility, most: int) -> NDArray[np.int64]:
    """Rows looked for: those whose cells come nearest to a pixel first, spread evenly where there are too many."""
    rows = seen.used
    octave = np.rint(np.abs(np.log2(seen.ratio[rows]))).astype(int)
    # Multiples of the golden ratio visit any row of maplets evenly.
    spread = np.arange(len(rows)) * 0.6180339887498949 % 1.0
    return np.sort(rows[np.lexsort((spread, octave))[:most]])


def _tally(seen: Visibility) -> str:
    counts = np.bincount(seen.reason, minlength=len(MapletReason))
    return ", ".join(f"{count} {MapletReason(k).name.lower()}" for k, count in enumerate(counts) if count)


def _rounds(
    search: _Search, view: MapletView, body: Body, context: NavContext, start: tuple[FloatArray, Alignment]
) -> tuple[TechniqueResult | TechniqueFailure, LandmarkTable, FloatArray]:
    options, camera = search.options, context.camera_model
    offset, alignment = start
    attitude = corrected_attitude(camera, view.camera_from_body, offset, alignment.rotation_rad)
    uncertainty = alignment.factor / 2.0 + _ALIGNMENT_PX
    table: LandmarkTable | None = None
    fit: StarFit | None = None
    for number in range(options.rounds):
        # One look is enough where a better geometry follows.
        passes = 1 if number + 1 < options.rounds else options.correlation.passes
        table = _looked_for(search, view, replace(view, camera_from_body=attitude), (uncertainty, passes))
        found = np.flatnonzero(table.found)
        if len(found) < max(options.least_landmarks, 1):
            detail = f"{body.name}: {len(found)} of {len(table)} landmarks found"
            return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, detail), table, attitude
        fit = _fit(table, found, view, body, context, options)
        used = np.zeros(len(table), bool)
        used[found[fit.inlier]] = True
        table = replace(table, used=used)
        attitude = corrected_attitude(camera, view.camera_from_body, fit.centre_offset_vu, fit.rotation_rad)
        uncertainty = 0.0
    assert table is not None
    assert fit is not None
    return _answer(fit, table, alignment, body, context, options), table, attitude


def _prior_covariance(view: MapletView, search: _Search, sigma_rad: FloatArray | None) -> FloatArray:
    """(6, 6) of the a-priori state, body-fixed: position by its distance, attitude by the State or in pixels."""
    options = search.options
    distance = np.linalg.norm(search.index.landmark_km[search.rows] - view.position_km, axis=1).mean()
    if sigma_rad is None:
        sigma_rad = np.full(3, options.attitude_sigma_px * float(pixel_scale_rad(view.camera).max()))
        # The same pixels at the array's edge for the twist.
        sigma_rad[2] = options.attitude_sigma_px / (0.5 * max(view.camera.shape_vu))
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * (options.position_sigma_share * distance) ** 2
    covariance[3:, 3:] = view.camera_from_body.T @ np.diag(np.asarray(sigma_rad) ** 2) @ view.camera_from_body
    return covariance


def _state(
    search: _Search, before: MapletView, start: MapletView, table: LandmarkTable, prior: FloatArray
) -> tuple[LandmarkState | None, LandmarkTable]:
    """Position and attitude, landmarks looked for again until the state leaves them in place; and their last search."""
    options, places, last = search.options, start.pixels(table.landmark_km)[0], table
    for number in range(1, options.state_rounds + 1):
        found = np.flatnonzero(table.found)
        matches = (
            table.landmark_km[found], table.landmark_covariance_km2[found], table.observed_vu[found],
            table.covariance_px2[found],
        )  # fmt: skip
        updated = update_state(before, matches, prior, options.state)
        if isinstance(updated, str):
            return None, last
        used = np.zeros(len(table), bool)
        used[found[updated.used]] = True
        moved = updated.view.pixels(table.landmark_km)[0]
        if np.abs(moved - places).max() < options.state_tolerance_px or number == options.state_rounds:
            return updated, replace(table, used=used)
        places, table = moved, _looked_for(search, before, updated.view, (0.0, 2))
    return None, last


def _looked_for(search: _Search, before: MapletView, view: MapletView, reach: tuple[float, int]) -> LandmarkTable:
    """Look for every landmark under a view, as far as so many pixels and with so many passes.

    Rows carry the prediction under the a-priori view.
    """
    index, rows = search.index, search.rows
    jacobians = maplet_jacobian(view, index, rows)
    predicted, now = before.pixels(index.landmark_km[rows])[0], view.pixels(index.landmark_km[rows])[0]
    observed, covariance = np.full((len(rows), 2), np.nan), np.full((len(rows), 2, 2), np.nan)
    correlation, size = np.full(len(rows), np.nan), np.zeros(len(rows), np.int64)
    shares, ends = np.zeros((len(rows), 2)), []
    ratio = 1.0 / np.sqrt(np.abs(np.linalg.det(jacobians)))
    for k, maplet in enumerate(search.maplets):
        match, status, reason = _match(search, view, maplet, jacobians[k], float(ratio[k]), reach)
        ends.append((status.value, reason))
        correlation[k], size[k] = match.correlation, match.bin
        shares[k] = match.images.illuminated, removed_ratio(match.images)
        if status is LandmarkStatus.FOUND:
            observed[k], covariance[k] = now[k] + match.offset_vu, match.covariance_px2
    normal = index.maplet_from_body[rows, 2]
    sight = before.position_km - index.landmark_km[rows]
    emission = (normal * sight).sum(axis=1) / np.linalg.norm(sight, axis=1)
    return LandmarkTable(
        index.name[rows], index.landmark_km[rows], index.covariance_km2[rows], predicted, observed, covariance,
        correlation, size, _degrees(normal @ view.sun), _degrees(emission), ratio, shares[:, 0],
        shares[:, 1], np.zeros(len(rows), bool), *np.array(ends).T,
    )  # fmt: skip


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _match(
    search: _Search, view: MapletView, maplet: Maplet, jacobian: FloatArray, ratio: float, reach: tuple[float, int]
) -> tuple[LandmarkMatch, LandmarkStatus, str]:
    options = search.options
    size = max(1, int(np.ceil(reach[0] * ratio / _USABLE_BINS)))
    # Where the others lie tells a wrong peak better than its rivals do.
    update = {"bin_start": size, "passes": reach[1], "rival_share": 1.0}
    correlation = options.correlation.model_copy(update=update)
    match = locate(view, maplet, search.picture, jacobian, np.zeros(2), (options.images, correlation))
    reason = removal_reason(match.images, ratio, maplet.name, options.removed_by_hand, options.removal)
    if reason is not MapletReason.USED:
        return match, LandmarkStatus.REMOVED, reason.name.lower()
    if match.status is not PeakStatus.FOUND:
        return match, LandmarkStatus.NOT_FOUND, match.status.value
    return match, LandmarkStatus.FOUND, ""


def _fit(
    table: LandmarkTable, found: NDArray[np.int64], view: MapletView, body: Body, context: NavContext,
    options: SurfaceFeatureOptions,
) -> StarFit:  # fmt: skip
    """Pointing that carries the landmarks' directions onto their observed pixels."""
    sight = table.landmark_km[found] - view.position_km
    direction = sight @ body.body_from_j2000
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    camera_points = sight @ view.camera_from_body.T
    places = project_jacobian(context.camera_model, camera_points) @ view.camera_from_body
    from_places = places @ table.landmark_covariance_km2[found] @ places.transpose(0, 2, 1)
    predicted = project(context.camera_model, camera_points)[0]
    return fit_stars(
        context, direction, predicted, table.observed_vu[found], table.covariance_px2[found] + from_places, options.fit
    )


def _answer(
    fit: StarFit, table: LandmarkTable, alignment: Alignment, body: Body, context: NavContext,
    options: SurfaceFeatureOptions,
) -> TechniqueResult | TechniqueFailure:  # fmt: skip
    agreeing = int((np.abs(fit.residual_vu[fit.inlier]).max(axis=1) < _AGREEMENT_PX).sum())
    if agreeing < options.least_landmarks:
        detail = f"{body.name}: {agreeing} of {len(table)} landmarks agree"
        return TechniqueFailure(NAME, StatusReason.NO_MATCH, detail)
    confidence = _confidence(agreeing, table, context)
    if confidence < options.least_confidence:
        detail = f"{body.name}: {agreeing} of {len(table)} landmarks agree, as they may by luck"
        return TechniqueFailure(NAME, StatusReason.NO_MATCH, detail)
    spread = table.observed_vu[table.used] - fit.pivot_vu
    information = with_misfit(fit.information, fit.extra_sigma_px, float(np.sqrt((spread**2).sum(axis=1).mean())))
    at_edge, at_edge_rotation = edge_flags(fit.centre_offset_vu, fit.rotation_rad, context, options)
    return TechniqueResult(
        technique=NAME, offset_vu=fit.offset_vu, rotation_rad=fit.rotation_rad, information=information,
        pivot_vu=fit.pivot_vu, confidence=confidence, measurements=agreeing,
        at_edge=at_edge, at_edge_rotation=at_edge_rotation, error_sources=(f"body:{body.name}",),
        diagnostics={
            "landmarks_used": int(fit.inlier.sum()), "landmarks_looked_for": len(table),
            "extra_sigma_px": fit.extra_sigma_px, "alignment_correlation": alignment.correlation,
        },
    )  # fmt: skip


def without_trust_in_place(
    result: TechniqueResult, body: Body, state: State, options: SurfaceFeatureOptions
) -> TechniqueResult:
    """Answer of a technique that takes the a-priori position for granted, once landmarks have shown it to be wrong.

    Parameters
    ----------
    result
        Of any technique.
    body
        Whose landmarks were found.
    state
        Geometry.
    options
        Of the landmarks: how well the position is known.

    Returns
    -------
    TechniqueResult
        With the error of the body's apparent size added per axis, as far as the array shows the body; results on other
        bodies, and those of landmarks, stay as they are.
    """
    if result.technique == NAME or f"body:{body.name}" not in result.error_sources:
        return result
    scale = float(pixel_scale_rad(state.camera_model).mean())
    radius = float(body.radii_km.mean()) / float(np.linalg.norm(body.position_km)) / scale
    error_px = options.position_sigma_share * min(radius, float(max(state.camera_model.shape_vu)))
    added = np.diag([error_px**2, error_px**2, 0.0][: len(result.information)])
    # (S + D)^-1 = (1 + S^-1 D)^-1 S^-1, also where S^-1 is singular.
    widened = np.linalg.solve(np.eye(len(added)) + result.information @ added, result.information)
    return replace(result, information=(widened + widened.T) / 2.0)


def with_misfit(information: FloatArray, extra_sigma_px: float, radius_px: float) -> FloatArray:
    """Information of a pointing once what its landmarks leave unexplained counts as few draws.

    Parameters
    ----------
    information
        (2, 2) or (3, 3) about the landmarks' centroid, singular where a direction is not observed.
    extra_sigma_px
        Per-axis scatter beyond the stated sigmas.
    radius_px
        Root mean square distance of the landmarks from their centroid.

    Returns
    -------
    numpy.ndarray
        Inverse of the covariance S + D with D the misfit's, written for S's inverse.
    """
    shares = np.array([1.0, 1.0, 1.0 / max(radius_px, 1.0) ** 2])[: len(information)]
    variance = shares * extra_sigma_px**2 / _SMOOTH_DRAWS
    if extra_sigma_px <= 0.0:
        return information
    return np.asarray(information - information @ np.linalg.inv(information + np.diag(1.0 / variance)) @ information)


def _confidence(agreeing: int, table: LandmarkTable, context: NavContext) -> float:
    """One minus the expected number of wrong offsets within the margin on which as many would agree by luck.

    A landmark that is not there peaks anywhere in its window of 11 x 11 cells.
    """
    window_px2 = ((2 * REACH + 1) / np.median(table.ratio)) ** 2
    chance = min(1.0, np.pi * _AGREEMENT_PX**2 / window_px2)
    offsets = float(np.prod(2.0 * np.array(context.search_margin_vu) / _AGREEMENT_PX))
    return float(1.0 - min(1.0, offsets * bdtrc(agreeing - 1, len(table), min(chance, 0.5))))
