"""One image from start to end."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from pipeline.ensemble import EnsembleOptions, _CombinedEstimate, ensemble
from pipeline.errors import ImageFailure
from pipeline.frame import Frame, FrameOptions, make_frame, without_light_of, without_spikes
from pipeline.imaging.detect import DetectionOptions, detect_point_sources
from pipeline.options import Options
from pipeline.predict.bodies import BodyFate, BodyPredictionOptions, BodyScene, predict_bodies
from pipeline.predict.rings import RingFate, RingPredictionOptions, RingScene, predict_rings
from pipeline.predict.stars import PredictedStars, StarPredictionOptions, predict_stars
from pipeline.records import BoolArray, FloatArray, Image, StarTable, State
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, Prior, TechniqueFailure, TechniqueResult
from pipeline.techniques.body_blob import BodyBlobOptions, body_blob_nav
from pipeline.techniques.body_disc import BodyDiscOptions, DiscFix, body_disc_nav, find_disc
from pipeline.techniques.body_limb import (
    BodyLimbOptions,
    BodyTerminatorOptions,
    body_limb_nav,
    body_terminator_nav,
)
from pipeline.techniques.ring_annulus import RingAnnulusOptions, ring_annulus_nav
from pipeline.techniques.ring_edge import RingEdgeOptions, ring_edge_nav
from pipeline.techniques.ring_edges import RingEdgeTable, ring_edge_table
from pipeline.techniques.ring_image import ring_image
from pipeline.techniques.ring_search import RingFix, find_rings
from pipeline.techniques.star_field import StarFieldOptions, star_field_nav
from pipeline.techniques.star_refine import StarRefineOptions, star_refine_nav
from pipeline.techniques.star_unique import StarUniqueOptions, star_unique_nav
from pipeline.techniques.surface_features import (
    MapletSource,
    SurfaceFeatureOptions,
    SurfaceFix,
    surface_feature_nav,
    without_trust_in_place,
)


class TechniquesOptions(Options):
    """One block per technique, under the technique's own name."""

    StarFieldFromCatalogNav: StarFieldOptions = StarFieldOptions()
    StarUniqueMatchNav: StarUniqueOptions = StarUniqueOptions()
    StarRefineNav: StarRefineOptions = StarRefineOptions()
    BodyLimbNav: BodyLimbOptions = BodyLimbOptions()
    BodyTerminatorNav: BodyTerminatorOptions = BodyTerminatorOptions()
    BodyDiscCorrelateNav: BodyDiscOptions = BodyDiscOptions()
    BodyBlobNav: BodyBlobOptions = BodyBlobOptions()
    RingEdgeNav: RingEdgeOptions = RingEdgeOptions()
    RingAnnulusNav: RingAnnulusOptions = RingAnnulusOptions()
    SurfaceFeatureNav: SurfaceFeatureOptions = SurfaceFeatureOptions()


class NavigationOptions(Options):
    """Everything that steers one image."""

    frame: FrameOptions = FrameOptions()
    detection: DetectionOptions = DetectionOptions()
    stars: StarPredictionOptions = StarPredictionOptions()
    body_prediction: BodyPredictionOptions = BodyPredictionOptions()
    ring_prediction: RingPredictionOptions = RingPredictionOptions()
    techniques: TechniquesOptions = TechniquesOptions()
    ensemble: EnsembleOptions = Field(default_factory=EnsembleOptions)


@dataclass(frozen=True)
class Navigation:
    """What became of one image.

    Attributes
    ----------
    state
        Its geometry.
    frame
        The measured image, None where it was refused.
    estimate
        Fused answer, None where there is none.
    results, failures
        Techniques with and without an answer, in the order in which they ran.
    reason, detail
        How the image ends, and one line about it.
    bodies
        What became of each body of the State.
    rings
        What became of each feature of its rings.
    ring_edges
        Measured radii, None without a fit of rings.
    landmarks
        Landmarks looked for and the state from them, None where there are none.
    """

    state: State
    frame: Frame | None
    estimate: _CombinedEstimate | None
    results: tuple[TechniqueResult, ...]
    failures: tuple[TechniqueFailure, ...]
    reason: StatusReason
    detail: str
    bodies: tuple[BodyFate, ...] = ()
    rings: tuple[RingFate, ...] = ()
    ring_edges: RingEdgeTable | None = None
    landmarks: SurfaceFix | None = None


StageListener = Callable[[str], None]
_Outcome = TechniqueResult | TechniqueFailure


def navigate(
    pixels: Image,
    flagged: BoolArray | None,
    state: State,
    stars: StarTable,
    options: NavigationOptions,
    on_stage: StageListener = lambda stage: None,
    maplets: tuple[MapletSource, ...] = (),
) -> Navigation:
    """Navigate one image.

    Parameters
    ----------
    pixels
        (rows, cols) DN as read.
    flagged
        (rows, cols) True where the product marks a pixel as bad, or None.
    state
        Geometry.
    stars
        Catalogue rows around the field.
    options
        All stages' options.
    on_stage
        Called with a stage's name when that stage has ended; clocks live with the caller.
    maplets
        Maplets of bodies; the nearest body in the State that has some is looked at.

    Returns
    -------
    Navigation
        Always: an image that cannot be navigated says why.
    """
    context = NavContext.of(state)
    try:
        frame = make_frame(pixels, flagged, state, options.frame)
    except ImageFailure as failure:
        return Navigation(state, None, None, (), (), failure.reason, failure.detail)
    on_stage("frame")
    predicted = predict_stars(stars, state, frame, options.stars)
    scene = predict_bodies(state, frame.spread.sigma_px, options.body_prediction)
    rings = predict_rings(state, frame.spread.sigma_px, options.ring_prediction)
    on_stage("predict")
    outcomes: list[_Outcome] = []
    star_frame = frame
    fix: DiscFix | str = "no bodies"
    if len(scene):
        body_frame = without_spikes(frame)
        fix = _find(scene, body_frame, context, options.techniques)
        on_stage("body_disc")
        outcomes += _body_pass(scene, body_frame, fix, context, options.techniques, on_stage)
        if len(predicted):
            star_frame = without_light_of(_covered_pixels(fix, frame), frame, state, options.frame)
            on_stage("body_mask")
    ring_fix: RingFix | str = "no rings"
    if len(rings):
        ring_fix, answers = _ring_pass(rings, without_spikes(frame), fix, context, options.techniques)
        outcomes += answers
        on_stage("rings")
    landmarks = _landmark_pass(maplets, frame, state, options.techniques.SurfaceFeatureNav)
    if landmarks is not None:
        outcomes = _beside_landmarks(outcomes, landmarks, state, options.techniques.SurfaceFeatureNav)
        outcomes.append(landmarks.answer)
        on_stage("landmarks")
    if len(predicted) or not (len(scene) or len(rings) or landmarks):
        outcomes += _first_pass(predicted, star_frame, context, options, on_stage)
    first = _fuse(outcomes, context, state, options)
    usable = first is not None and first.reason in (StatusReason.NAVIGATED, StatusReason.NAVIGATED_AT_EDGE)
    if first is not None and usable and len(predicted):
        outcomes += _second_pass(predicted, star_frame, first, context, options)
        on_stage("refine")
    estimate = _fuse(outcomes, context, state, options)
    on_stage("ensemble")
    edges = _ring_edges(rings, ring_fix, estimate)
    return replace(
        _conclude(state, frame, estimate, outcomes), bodies=scene.fates, rings=rings.fates, ring_edges=edges,
        landmarks=landmarks,
    )  # fmt: skip


def _landmark_pass(
    maplets: tuple[MapletSource, ...], frame: Frame, state: State, options: SurfaceFeatureOptions
) -> SurfaceFix | None:
    """Landmarks of the nearest body that has a catalogue of them."""
    by_name = {source.body.upper(): source for source in maplets}
    body = next((body for body in state.bodies if body.name.upper() in by_name), None)
    if body is None or not options.enabled:
        return None
    return surface_feature_nav(body, by_name[body.name.upper()], frame, state, options)


def _beside_landmarks(
    outcomes: list[_Outcome], landmarks: SurfaceFix, state: State, options: SurfaceFeatureOptions
) -> list[_Outcome]:
    """Other techniques' outcomes, less sure of what a wrong position changes where landmarks have solved for it."""
    answer = landmarks.answer
    if landmarks.state is None or isinstance(answer, TechniqueFailure):
        return outcomes
    body = next(body for body in state.bodies if f"body:{body.name}" in answer.error_sources)
    return [
        without_trust_in_place(outcome, body, state, options) if isinstance(outcome, TechniqueResult) else outcome
        for outcome in outcomes
    ]


def _ring_pass(
    rings: RingScene, frame: Frame, disc: DiscFix | str, context: NavContext, techniques: TechniquesOptions
) -> tuple[RingFix | str, list[_Outcome]]:
    """Techniques on rings."""
    edge, annulus = techniques.RingEdgeNav, techniques.RingAnnulusNav
    if not (edge.enabled or annulus.enabled):
        return "not looked for", []
    image = ring_image(frame)
    # From where bodies were found, and from everywhere: each may be wrong.
    start = (disc.fit.offset_vu, disc.fit.rotation_rad) if isinstance(disc, DiscFix) else None
    fix = find_rings(rings, image, start, context, edge.search)
    outcomes: list[_Outcome] = []
    if edge.enabled:
        outcomes.append(ring_edge_nav(rings, fix, context, edge))
    if annulus.enabled:
        outcomes.append(ring_annulus_nav(rings, image, fix, context, annulus))
    return fix, outcomes


def _ring_edges(rings: RingScene, fix: RingFix | str, estimate: _CombinedEstimate | None) -> RingEdgeTable | None:
    """Radii under the image's pointing, or, where that knows one direction, under the rings' own."""
    if isinstance(fix, str) or estimate is None:
        return None
    if estimate.observable_vu is not None:
        return ring_edge_table(rings, fix.fit, fix.fit.offset_vu, fix.fit.rotation_rad)
    return ring_edge_table(rings, fix.fit, estimate.offset_vu, estimate.rotation_rad or 0.0)


def _find(scene: BodyScene, frame: Frame, context: NavContext, techniques: TechniquesOptions) -> DiscFix | str:
    """Rendered bodies searched for and fitted, whoever uses that."""
    users = (techniques.BodyDiscCorrelateNav, techniques.BodyLimbNav, techniques.BodyTerminatorNav)
    if not any(user.enabled for user in users):
        return "not looked for"
    return find_disc(scene, frame, context, techniques.BodyDiscCorrelateNav)


def _body_pass(
    scene: BodyScene,
    frame: Frame,
    fix: DiscFix | str,
    context: NavContext,
    techniques: TechniquesOptions,
    on_stage: StageListener,
) -> list[_Outcome]:
    """Techniques on planets and moons; through the point spread that the disc shows, where it was found."""
    outcomes: list[_Outcome] = []
    found = fix if isinstance(fix, DiscFix) else None
    if found:
        scene = found.scene
    elif context.fit_camera_rotation:
        scene = scene.major()
    if techniques.BodyDiscCorrelateNav.enabled:
        outcomes.append(body_disc_nav(fix, context, techniques.BodyDiscCorrelateNav))
    if techniques.BodyLimbNav.enabled:
        outcomes.append(body_limb_nav(scene, frame, found.fit if found else None, context, techniques.BodyLimbNav))
        on_stage("body_limb")
    if techniques.BodyTerminatorNav.enabled and found:
        confidence, options = found.acquisition.confidence, techniques.BodyTerminatorNav
        outcomes.append(body_terminator_nav(scene, frame, found.fit, confidence, context, options))
        on_stage("body_terminator")
    if techniques.BodyBlobNav.enabled:
        outcomes.append(body_blob_nav(scene, frame, found.fit if found else None, context, techniques.BodyBlobNav))
        on_stage("body_blob")
    return outcomes


def _covered_pixels(fix: DiscFix | str, frame: Frame) -> BoolArray:
    """Pixels that bodies cover where they were found; where they were not, no pixel is known to be a body's."""
    covered = np.zeros(frame.raw.shape, bool)
    if isinstance(fix, DiscFix):
        cutout = fix.fit.cutout
        window = cutout.window
        body = (cutout.template.image > 0) | (cutout.template.night > 0)
        covered[window.v0 : window.v0 + window.rows, window.u0 : window.u0 + window.cols] = body
    return covered


def _first_pass(
    predicted: PredictedStars, frame: Frame, context: NavContext, options: NavigationOptions, on_stage: StageListener
) -> list[_Outcome]:
    """Techniques on stars that need no prior."""
    techniques = options.techniques
    if not len(predicted):
        reason = StatusReason.NO_FEATURES_PREDICTED
        return [TechniqueFailure("StarFieldFromCatalogNav", reason, "no catalogue star or body in or near the frame")]
    sources = detect_point_sources(
        frame.pixels, frame.bad, frame.saturated, frame.sigma, frame.gain_e_per_dn, frame.spread, options.detection
    )
    on_stage("detect")
    threshold = options.detection.threshold_sigma
    outcomes: list[_Outcome] = []
    if techniques.StarFieldFromCatalogNav.enabled:
        outcomes.append(star_field_nav(predicted, sources, threshold, context, techniques.StarFieldFromCatalogNav))
        on_stage("star_field")
    if techniques.StarUniqueMatchNav.enabled:
        outcomes.append(star_unique_nav(predicted, sources, threshold, context, techniques.StarUniqueMatchNav))
        on_stage("star_unique")
    return outcomes


def _second_pass(
    predicted: PredictedStars,
    frame: Frame,
    prior: _CombinedEstimate,
    context: NavContext,
    options: NavigationOptions,
) -> list[_Outcome]:
    """Refiners inside the first answer, on features predicted again with the corrected attitude."""
    refine = options.techniques.StarRefineNav
    if not refine.enabled:
        return []
    start = Prior(prior.offset_vu, prior.rotation_rad or 0.0, prior.covariance, prior.confidence)
    return [star_refine_nav(predicted, frame, start, context, options.detection, refine)]


def _fuse(
    outcomes: list[_Outcome], context: NavContext, state: State, options: NavigationOptions
) -> _CombinedEstimate | None:
    results = [outcome for outcome in outcomes if isinstance(outcome, TechniqueResult)]
    return ensemble(results, context, options.ensemble, _rotation_prior(state.attitude.sigma_rad))


def _rotation_prior(sigma_rad: FloatArray | None) -> float | None:
    """A-priori sigma of the twist about the boresight, where the attitude brings one."""
    return float(sigma_rad[2]) if sigma_rad is not None and sigma_rad[2] > 0 else None


# The reason that says most about an image without an answer comes first.
_TELLING = (
    StatusReason.AMBIGUOUS_MATCH,
    StatusReason.NO_MATCH,
    StatusReason.NO_FEATURES_DETECTED,
    StatusReason.NO_FEATURES_PREDICTED,
)


def _conclude(state: State, frame: Frame, estimate: _CombinedEstimate | None, outcomes: list[_Outcome]) -> Navigation:
    results = tuple(outcome for outcome in outcomes if isinstance(outcome, TechniqueResult))
    failures = tuple(outcome for outcome in outcomes if isinstance(outcome, TechniqueFailure))
    if estimate is not None:
        detail = f"fused from {', '.join(estimate.members)}"
        return Navigation(state, frame, estimate, results, failures, estimate.reason, detail)
    if results:
        detail = f"{', '.join(result.technique for result in results)}: not to be trusted"
        return Navigation(state, frame, None, results, failures, StatusReason.NO_MATCH, detail)
    if not failures:
        return Navigation(state, frame, None, (), (), StatusReason.NO_MATCH, "no technique is enabled")
    worst = min(failures, key=lambda failure: _TELLING.index(failure.reason))
    # Among failures of one kind the pattern of many stars has said the most.
    return Navigation(state, frame, None, (), failures, worst.reason, f"{worst.technique}: {worst.detail}")


def corrected_sigma_px(estimate: _CombinedEstimate) -> FloatArray:
    """1-sigma of the fused offset along v and u.

    Parameters
    ----------
    estimate
        Fused answer.

    Returns
    -------
    numpy.ndarray
        (2,) pixels, NaN where only one direction is known.
    """
    return np.asarray(np.sqrt(np.diag(estimate.covariance)[:2]))
