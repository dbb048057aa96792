"""BodyLimbNav and BodyTerminatorNav: pointing from the lines that lit bodies draw."""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.edges import distance_to_edges, edge_field
from pipeline.predict.bodies import BodyScene
from pipeline.predict.body_view import BodyView
from pipeline.predict.outlines import limb_outline, terminator_outline
from pipeline.records import FloatArray
from pipeline.status import StatusReason
from pipeline.techniques.base import (
    FeatureTable,
    NavContext,
    TechniqueFailure,
    TechniqueOptions,
    TechniqueResult,
)
from pipeline.techniques.body_base import (
    Cutout,
    Levels,
    about,
    body_edge_flags,
    compose,
    cut_out,
    predicted_place,
    rotation_shows,
    rough_levels,
    settle,
    turn_lever,
)
from pipeline.techniques.contour_fit import BandOptions, Segments, measure_segments
from pipeline.techniques.limb_albedo import LimbEdge, limb_albedo
from pipeline.techniques.line_search import LinePlace, search_line
from pipeline.techniques.lm import lm_subpixel_refine
from pipeline.techniques.model_errors import ModelErrorOptions, assumed_errors, haze_px
from pipeline.techniques.relief import Field_, ReliefFit, ReliefOptions, fit_relief
from pipeline.techniques.template_fit import TemplateFit

LIMB, TERMINATOR = "BodyLimbNav", "BodyTerminatorNav"
_ROUNDS = 5
_SETTLED_PX = 0.02
# Spacing at which vertices tell something new about whether the line is there at all.
_INDEPENDENT_PX = 4.0
_RIVAL_PX = 6.0
# A technique that does not search vouches for a place only so far.
_FOLLOWER = 0.99
_REACH_PX = 8.0


class BodyLimbOptions(TechniqueOptions):
    """Options of the limb."""

    band: BandOptions = BandOptions()
    relief: ReliefOptions = ReliefOptions()
    errors: ModelErrorOptions = ModelErrorOptions()
    relief_share: float = Field(2e-3, gt=0, le=0.2, description="relief over radius where no catalogue tells it")
    band_share: float = Field(0.25, gt=0, le=1, description="half-width of the band over the radius of small bodies")
    edge_sigma: float = Field(5.0, ge=2, le=50, description="gradient over its noise that makes an edge")
    min_score: float = Field(0.25, gt=0, lt=1, description="agreement with edges below which there is no limb")
    min_diameter_px: float = Field(5.0, ge=3, le=100, description="bodies below this have no limb to measure")
    min_shown_share: float = Field(0.4, gt=0, le=1, description="share of segments that must show the edge")


class BodyTerminatorOptions(TechniqueOptions):
    """Options of the terminator."""

    band: BandOptions = BandOptions(brightness_share=0.5, sky_share=0.01, largest_shift_px=20.0)
    relief: ReliefOptions = ReliefOptions(unknown_width=2.0)
    errors: ModelErrorOptions = ModelErrorOptions()
    band_share: float = Field(0.2, gt=0, le=1, description="half-width of the band over the radius")
    relief_share: float = Field(0.01, gt=0, le=0.5, description="expected wandering of the line over the radius")
    reach_deg: float = Field(4.0, gt=0, le=90, description="angle over which it wanders alike")
    min_diameter_px: float = Field(12.0, ge=3, le=200, description="bodies below this have no terminator to measure")
    min_shown_share: float = Field(0.3, gt=0, le=1, description="share of segments that must show the edge")


@dataclass(frozen=True)
class _Start:
    """Pointing at the array centre that a fit begins at, how sure it is, and what it was found by."""

    offset_vu: FloatArray
    rotation_rad: float
    confidence: float
    score: float


@dataclass(frozen=True, eq=False)
class _LineFit:
    """Settled fit of an outline; ``misfit`` is the chi-square per sample of the rendering as a whole."""

    offset_vu: FloatArray
    rotation_rad: float
    pivot_vu: FloatArray
    segments: Segments
    relief: ReliefFit
    views: tuple[BodyView, ...]
    misfit: float


def body_limb_nav(
    scene: BodyScene, frame: Frame, fix: TemplateFit | None, context: NavContext, options: BodyLimbOptions
) -> TechniqueResult | TechniqueFailure:
    """Search for the lit limbs by their edges, bring them onto the edges, then measure them photometrically.

    Parameters
    ----------
    scene
        Bodies.
    frame
        Image.
    fix
        A fit of the rendered bodies, from which brightness and sky are taken where it agrees; never the place.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        About the centroid of the measured limb.
    """
    large = [view for view in scene.views if view.diameter_px >= options.min_diameter_px]
    if not large:
        return TechniqueFailure(LIMB, StatusReason.NO_FEATURES_PREDICTED, "no body is large enough to show a limb")
    start = _find_limb(scene, frame, context, options)
    if isinstance(start, str):
        return TechniqueFailure(LIMB, StatusReason.NO_FEATURES_DETECTED, start)
    start = _same_basin(start, fix, scene, context)
    fields = {k: _limb_field(scene, view, options) for k, view in enumerate(scene.views)}
    # Of a small body the band is to hold the limb, not all of it.
    radius = scene.primary(scene.views).diameter_px / 2
    width = float(np.clip(options.band_share * radius, 2.0, options.band.half_width_px))
    band = options.band.model_copy(update={"half_width_px": width})
    fit = _fit_line(scene, frame, fix, start, context, fields, band, options.relief, options.errors, at_limb=True)
    if isinstance(fit, str):
        return TechniqueFailure(LIMB, StatusReason.NO_FEATURES_DETECTED, fit)
    return _result(LIMB, "limb", fit, start, scene, context, options, options.min_shown_share)


def body_terminator_nav(
    scene: BodyScene,
    frame: Frame,
    fix: TemplateFit,
    confidence: float,
    context: NavContext,
    options: BodyTerminatorOptions,
) -> TechniqueResult | TechniqueFailure:
    """Measure the terminators where the rendered bodies were found: they are too soft to be searched for by edges.

    Parameters
    ----------
    scene, frame, context, options
        As for :func:`body_limb_nav`.
    fix
        Fit of the rendered bodies.
    confidence
        How sure the place is.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        About the centroid of the measured terminator.
    """
    if max(view.diameter_px for view in scene.views) < options.min_diameter_px:
        return TechniqueFailure(TERMINATOR, StatusReason.NO_FEATURES_PREDICTED, "no body is large enough")
    radius = scene.primary(scene.views).diameter_px / 2
    width = float(np.clip(options.band_share * radius, options.band.half_width_px, 60.0))
    # A line that has left its band was not measured.
    update = {"half_width_px": width, "largest_shift_px": min(options.band.largest_shift_px, width)}
    band = options.band.model_copy(update=update)
    start = _Start(fix.offset_vu, fix.rotation_rad, min(confidence, _FOLLOWER), fix.correlation)
    fields = {
        k: Field_(options.relief_share * view.diameter_px / 2, options.reach_deg, False, 0.0, of_shape=False)
        for k, view in enumerate(scene.views)
    }
    fit = _fit_line(scene, frame, fix, start, context, fields, band, options.relief, options.errors, at_limb=False)
    if isinstance(fit, str):
        return TechniqueFailure(TERMINATOR, StatusReason.NO_FEATURES_DETECTED, fit)
    place = scene.primary(scene.views).centre_vu[None]
    moved = _moved(place, fit.offset_vu, fit.rotation_rad, context)
    drift = float(np.hypot(*(moved - _moved(place, fix.offset_vu, fix.rotation_rad, context))[0]))
    if drift > width:
        reason = StatusReason.NO_FEATURES_DETECTED
        return TechniqueFailure(TERMINATOR, reason, f"the line was {drift:.0f} px from where the body was found")
    return _result(TERMINATOR, "terminator", fit, start, scene, context, options, options.min_shown_share)


def _limb_field(scene: BodyScene, view: BodyView, options: BodyLimbOptions) -> Field_:
    """Relief of a body: the catalogue's, else a share of its radius; the radius is known as well as that."""
    sigma = view.body.shape_sigma_km
    rms = options.relief_share * view.diameter_px / 2 if sigma is None else sigma * view.px_per_km
    rms = max(rms, 1e-3)
    return Field_(rms, view.body.shape_correlation_deg, sigma is not None, rms, haze_px(scene, view, options.errors))


def _find_limb(scene: BodyScene, frame: Frame, context: NavContext, options: BodyLimbOptions) -> _Start | str:
    """Whole-pixel search, then the distance transform; pointing at the array centre."""
    reach = scene.reach_vu
    camera = context.camera_model
    views = scene.views
    template = None
    if any(view.body.mesh is not None for view in views):
        views, template = scene.template(np.zeros(2), 0.0)
    outline = limb_outline(views, camera, template)
    lit = (outline.reason != "dark") & (outline.reason != "hidden")
    if np.count_nonzero(lit) < 8:
        return "no lit limb can come into the frame"
    places, normals = outline.vertices_vu[lit], outline.normal_vu[lit]
    near = (places > -np.array(reach)).all(axis=1) & (places < np.array(camera.shape_vu) + np.array(reach)).all(axis=1)
    if np.count_nonzero(near) < 8:
        return "no lit limb can come into the frame"
    places, normals = places[near], normals[near]
    pivot = places.mean(axis=0)
    arm = np.abs(pivot - camera.centre_vu)
    turn = context.max_rotation_rad
    margin = context.search_margin_vu
    limits = (margin[0] + turn * arm[1], margin[1] + turn * arm[0])
    # Only what the limb can reach is looked at; the corner of that part is the origin of all places below.
    low = np.clip(np.floor(places.min(axis=0) - limits - _REACH_PX), 0, None).astype(int)
    high = np.clip(np.ceil(places.max(axis=0) + limits + _REACH_PX), 0, camera.shape_vu).astype(int)
    part = np.s_[low[0] : high[0], low[1] : high[1]]
    raw, bad = frame.raw[part], frame.bad[part]
    if min(raw.shape) < 8:
        return "no lit limb can come into the frame"
    noise = np.sqrt(frame.noise.variance(raw)).astype(np.float32)
    field = edge_field(raw, bad, noise, max(1.0, scene.sigma_px))
    places, pivot = places - low, pivot - low
    found = search_line(field, places, normals, np.ones(len(places)), limits, turn, pivot)
    if not found or found[0].score < options.min_score:
        return f"edges agree with the limb by {found[0].score if found else 0.0:.2f}"
    confidence = _line_confidence(found, places, limits)
    best = found[0]
    lines = distance_to_edges(field, options.edge_sigma)
    spread = float(np.sqrt(((places - pivot) ** 2).sum(axis=1).mean()))
    refined = lm_subpixel_refine(
        lines, places, np.ones(len(places)), (*best.offset_vu, best.rotation_rad), turn > 0, pivot, spread
    )
    offset, rotation = refined.offset_vu, refined.rotation_rad
    if np.abs(offset - best.offset_vu).max() > _RIVAL_PX or abs(rotation) > 1.2 * turn:
        offset, rotation = np.array(best.offset_vu), best.rotation_rad
    centre, theta = compose(context, np.zeros(2), 0.0, pivot + low, np.array([*offset, rotation]))
    return _Start(centre, theta, confidence, best.score)


def _same_basin(start: _Start, fix: TemplateFit | None, scene: BodyScene, context: NavContext) -> _Start:
    """Begin at the rendered fit where the limb was found about there: both settle in the same place, one sooner."""
    if fix is None:
        return start
    places = np.array([view.centre_vu for view in scene.major().views])
    gap = _moved(places, start.offset_vu, start.rotation_rad, context) - _moved(
        places, fix.offset_vu, fix.rotation_rad, context
    )
    near = float(np.abs(gap).max()) < _RIVAL_PX
    return _Start(fix.offset_vu, fix.rotation_rad, start.confidence, start.score) if near else start


def _moved(places_vu: FloatArray, offset_vu: FloatArray, rotation_rad: float, context: NavContext) -> FloatArray:
    centre = context.camera_model.centre_vu
    return np.asarray(centre + offset_vu + (places_vu - centre) @ plane_rotation(rotation_rad).T)


def _line_confidence(found: list[LinePlace], places: FloatArray, limits: tuple[float, float]) -> float:
    """Probability that the best place is neither an accident nor less likely than a rival."""
    best = found[0]
    count = len(places) / _INDEPENDENT_PX
    gain = -0.5 * count * np.log(max(1.0 - best.score**2, 1e-9))
    tries = max(float(np.prod([2 * n + 1 for n in limits])) / _RIVAL_PX**2, 1.0)
    doubt = tries * np.exp(-gain + 3.0)
    for rival in found[1:]:
        if np.hypot(*np.subtract(rival.offset_vu, best.offset_vu)) > _RIVAL_PX:
            other = -0.5 * count * np.log(max(1.0 - max(rival.score, 0.0) ** 2, 1e-9))
            doubt += np.exp(min(other - gain, 0.0))
    return float(1.0 / (1.0 + doubt))


def _fit_line(
    scene: BodyScene,
    frame: Frame,
    fix: TemplateFit | None,
    start: _Start,
    context: NavContext,
    fields: dict[int, Field_],
    band: BandOptions,
    relief_options: ReliefOptions,
    error_options: ModelErrorOptions,
    at_limb: bool,
) -> _LineFit | str:
    """Measure, fit, predict again, until the template's own grid is reached."""
    offset, rotation = start.offset_vu, start.rotation_rad
    for _ in range(_ROUNDS):
        cutout = cut_out(scene, frame, offset, rotation)
        if cutout is None or not cutout.good.any():
            return "the body is outside the frame"
        segments = _segments(cutout, frame, fix, context, band, error_options, at_limb)
        if isinstance(segments, str):
            return segments
        pivot, relief, step = _step(segments, context, fields, relief_options)
        before = offset
        offset, rotation = compose(context, cutout.offset_vu, cutout.rotation_rad, pivot, step)
        misfit = fix.chi2_per_sample if fix is not None else 1.0
        fit = _LineFit(offset, rotation, pivot, segments, relief, cutout.views, misfit)
        if float(np.hypot(*(offset - start.offset_vu))) > 3.0 * _RIVAL_PX + band.largest_shift_px:
            return "the fit runs away from where the line was found"
        again = scene.quantised(offset, rotation)
        settled = (again[0] == cutout.offset_vu).all() and again[1] == cutout.rotation_rad
        if settled or float(np.hypot(*(offset - before))) < _SETTLED_PX:
            break
    return fit


def _segments(
    cutout: Cutout,
    frame: Frame,
    fix: TemplateFit | None,
    context: NavContext,
    band: BandOptions,
    error_options: ModelErrorOptions,
    at_limb: bool,
) -> Segments | str:
    """Pieces of the limb or the terminator, measured on a template."""
    camera = context.camera_model
    if at_limb:
        outline = limb_outline(cutout.views, camera, cutout.template)
    else:
        clear = band.half_width_px + 3.0 * cutout.sigma_px
        outline = terminator_outline(cutout.views, camera, cutout.template, clear)
    levels = _levels(cutout, fix)
    if not levels.scale > 0:
        return "the image is not bright where the body is"
    errors = fix.errors if fix is not None else assumed_errors(cutout.primary, error_options)
    segments = measure_segments(cutout, outline, frame, levels, errors, band)
    if isinstance(segments, str) or not at_limb:
        return segments
    lags, covariance = limb_albedo(errors, _limb_edge(cutout, segments, frame, levels, band))
    return replace(segments, texture_lags_px=lags, texture_px2=covariance)


def _limb_edge(cutout: Cutout, segments: Segments, frame: Frame, levels: Levels, band: BandOptions) -> LimbEdge:
    """The typical piece of a limb; on the line itself the blur leaves half of the light."""
    template, window = cutout.template, cutout.window
    at = np.clip(np.rint(segments.place_vu - [window.v0, window.u0]).astype(int), 0, np.array(template.image.shape) - 1)
    lit = 2.0 * levels.scale * float(np.median(template.image[at[:, 0], at[:, 1]]))
    bright, dark = frame.noise.variance(np.array([levels.sky + lit, levels.sky]))
    length = float(np.median(np.hypot(*np.diff(segments.place_vu, axis=0).T)))
    return LimbEdge(
        radius_px=cutout.primary.diameter_px / 2, sigma_px=cutout.sigma_px,
        half_width_px=band.half_width_px + 2.0 * cutout.sigma_px, segment_px=max(band.segment_px, length),
        sky_weight=float(bright / max(dark, 1e-30)),
    )  # fmt: skip


def _step(
    segments: Segments, context: NavContext, fields: dict[int, Field_], options: ReliefOptions
) -> tuple[FloatArray, ReliefFit, FloatArray]:
    """Pivot, fit and (3,) step from measured pieces; a rotation that the line does not show stays."""
    good = segments.take(segments.ok)
    weight = 1.0 / good.sigma_px**2
    pivot = weight @ good.place_vu / weight.sum()
    if not context.fit_camera_rotation:
        relief = fit_relief(good, None, fields, options)
        return pivot, relief, np.append(relief.step, 0.0)
    relief = fit_relief(good, turn_lever(good.place_vu, pivot), fields, options)
    if rotation_shows(relief.information, context):
        return pivot, relief, relief.step
    return pivot, relief, np.append(fit_relief(good, None, fields, options).step, 0.0)


def _levels(cutout: Cutout, fix: TemplateFit | None) -> Levels:
    """Those of the rendered fit where it is about the same place, else a plain regression."""
    if fix is not None and float(np.hypot(*(fix.offset_vu - cutout.offset_vu))) < _RIVAL_PX:
        return fix.levels
    return rough_levels(cutout)


def _result(
    name: str,
    kind: str,
    fit: _LineFit,
    start: _Start,
    scene: BodyScene,
    context: NavContext,
    options: TechniqueOptions,
    min_shown_share: float,
) -> TechniqueResult | TechniqueFailure:
    segments = fit.segments
    shown = segments.ok & (segments.strength > 3.0)
    share = float(shown.mean())
    if share < min_shown_share:
        detail = f"{share:.0%} of the {kind} shows the expected edge"
        return TechniqueFailure(name, StatusReason.NO_FEATURES_DETECTED, detail)
    # Segments that scatter more than all that was granted to them, or that belong to a rendering which as a whole does
    # (a haze, a wrong law), are as much less certain (Birge 1932).
    information = fit.relief.information / max(fit.relief.chi2_per_segment, fit.misfit, 1.0)
    settled = settle(information, fit.pivot_vu, context)
    pivot = predicted_place(context, fit.offset_vu, fit.rotation_rad, settled.pivot_vu)
    at_edge, at_edge_rotation = body_edge_flags(settled, fit.offset_vu, fit.rotation_rad, context, options)
    radius = max(view.diameter_px for view in fit.views) / 2
    return TechniqueResult(
        technique=name, offset_vu=about(context, fit.offset_vu, fit.rotation_rad, pivot),
        rotation_rad=fit.rotation_rad, information=settled.information, pivot_vu=pivot, confidence=start.confidence,
        at_edge=at_edge, at_edge_rotation=at_edge_rotation,
        spurious=fit.relief.rms_px + fit.relief.long_px > 0.3 * radius,
        error_sources=tuple(f"body:{name}" for name in scene.names),
        features=_inventory(fit, kind, context),
        diagnostics={
            "score": start.score, "relief_px": fit.relief.rms_px, "long_wave_px": fit.relief.long_px,
            "common_px": float(np.abs(fit.relief.common_px).max(initial=0.0)),
            "chi2_per_segment": fit.relief.chi2_per_segment, "shown_share": share,
            "extra_sigma_px": float(np.hypot(fit.relief.rms_px, fit.relief.long_px)),
        },
    )  # fmt: skip


def _inventory(fit: _LineFit, kind: str, context: NavContext) -> FeatureTable:
    """Segments as rows: predicted under the a-priori pointing, measured along the normal."""
    segments = fit.segments
    count = len(segments)
    names = np.array([fit.views[b].body.name for b in segments.body.tolist()])
    predicted = predicted_place(context, fit.offset_vu, fit.rotation_rad, segments.place_vu)
    nothing = np.full((count, 2), np.nan)
    measured, residual = nothing.copy(), nothing.copy()
    measured[segments.ok] = (segments.place_vu + segments.shift_px[:, None] * segments.normal_vu)[segments.ok]
    residual[segments.ok] = fit.relief.residual_px[:, None] * segments.normal_vu[segments.ok]
    used = segments.ok.copy()
    used[segments.ok] = fit.relief.weight > 0.0
    reason = np.where(used, "", np.where(segments.ok, "outlier", "no_edge"))
    return FeatureTable(
        name=names, kind=np.full(count, kind), predicted_vu=predicted, measured_vu=measured, residual_vu=residual,
        sigma_px=np.where(segments.ok, segments.sigma_px, np.nan), mag=np.full(count, np.nan),
        snr=np.where(segments.ok, segments.strength, np.nan), used=used, reason=reason,
    )  # fmt: skip
