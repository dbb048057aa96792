"""BodyDiscCorrelateNav: the rendered bodies found by correlation and fitted pixel by pixel."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.predict.bodies import BodyScene
from pipeline.records import FloatArray
from pipeline.status import StatusReason
from pipeline.techniques.base import (
    FeatureTable,
    NavContext,
    TechniqueFailure,
    TechniqueOptions,
    TechniqueResult,
)
from pipeline.techniques.body_base import Settled, about, body_edge_flags, predicted_place
from pipeline.techniques.body_minor import find_rotation, start_with_rotation
from pipeline.techniques.body_search import Acquisition, BodySearchOptions, find_bodies
from pipeline.techniques.model_errors import ModelErrorOptions
from pipeline.techniques.template_fit import TemplateFit, fit_template

NAME = "BodyDiscCorrelateNav"
# A change of the point spread's variance is believed from so many of its sigmas on, and never below this core.
_WIDTH_SIGMAS = 3.0
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.25, 6.0
_WIDTH_ROUNDS = 2


class BodyDiscOptions(TechniqueOptions):
    """Options of the correlation and of the fit after it."""

    search: BodySearchOptions = BodySearchOptions()
    errors: ModelErrorOptions = ModelErrorOptions()
    min_correlation: float = Field(
        0.7, ge=0, lt=1, description="correlation of the fit, over what noise allows, below which it is spurious"
    )
    largest_relief: float = Field(
        0.03, gt=0, le=1, description="relief over the diameter above which it is not the body that was found"
    )
    largest_drift_px: float = Field(6.0, gt=0, le=100, description="how far the fit may go from where it began")


@dataclass(frozen=True, eq=False)
class DiscFix:
    """Where the rendered bodies were found: what other techniques on bodies may start from.

    Attributes
    ----------
    acquisition
        Of the search.
    fit
        Of the pixels.
    scene
        The bodies, through the point spread that the image shows.
    """

    acquisition: Acquisition
    fit: TemplateFit
    scene: BodyScene


def find_disc(scene: BodyScene, frame: Frame, context: NavContext, options: BodyDiscOptions) -> DiscFix | str:
    """Search and fit.

    Parameters
    ----------
    scene
        Bodies.
    frame
        Image.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    DiscFix or str
        Or why nothing was found.
    """
    # With a rotation to be found a small body far from a large one would be lost between two samples of it.
    part = scene.major() if context.fit_camera_rotation else scene
    fix = _find_part(part, frame, context, options)
    if isinstance(fix, str) and len(part) < len(scene):
        # The large one may be dark or outside after all.
        return _find_part(scene.minor(), frame, context, options)
    if isinstance(fix, str):
        return fix
    part, fit, found = fix.scene, fix.fit, fix.acquisition
    if len(part) < len(scene) and context.fit_camera_rotation:
        everything = scene.with_sigma(part.sigma_px)
        whole = _with_minor_bodies(everything, fit, frame, context, options)
        if whole is not None:
            return DiscFix(found, whole, everything)
    return fix


def _find_part(scene: BodyScene, frame: Frame, context: NavContext, options: BodyDiscOptions) -> DiscFix | str:
    """Search for some bodies together and fit them."""
    found = find_bodies(scene, frame, context, options.search)
    if isinstance(found, str):
        return found
    fitted = _sharpened(scene, frame, found.offset_vu, found.rotation_rad, context, options)
    if isinstance(fitted, str):
        return fitted
    sharp, fit = fitted
    # Where the rotation is open the offset at the array centre may go far without any body moving.
    before = _places(scene, found.offset_vu, found.rotation_rad)
    after = _places(scene, fit.offset_vu, fit.rotation_rad)
    drift = max((float(np.hypot(*(after[name] - before[name]))) for name in before.keys() & after.keys()), default=0.0)
    if drift > options.largest_drift_px + 0.1 * max(view.diameter_px for view in scene.views):
        return f"the fit ran {drift:.1f} px away from the correlation's peak"
    return DiscFix(found, fit, sharp)


def _places(scene: BodyScene, offset_vu: FloatArray, rotation_rad: float) -> dict[str, FloatArray]:
    """(2,) centres of the bodies under a pointing, by name; one behind the camera has none."""
    return {view.body.name: view.centre_vu for view in scene.views_at(scene.attitude(offset_vu, rotation_rad))}


def _sharpened(
    scene: BodyScene, frame: Frame, offset_vu: FloatArray, rotation_rad: float, context: NavContext,
    options: BodyDiscOptions,
) -> tuple[BodyScene, TemplateFit] | str:  # fmt: skip
    """Fit, through the point spread that the image itself shows."""
    fit = fit_template(scene, frame, offset_vu, rotation_rad, context, options.errors)
    for _ in range(_WIDTH_ROUNDS):
        if isinstance(fit, str) or abs(fit.variance_px2) < _WIDTH_SIGMAS * fit.variance_sigma_px2:
            break
        sigma = float(np.sqrt(np.clip(scene.sigma_px**2 + fit.variance_px2, _LEAST_SIGMA_PX**2, _MOST_SIGMA_PX**2)))
        if abs(sigma - scene.sigma_px) < 0.03 * scene.sigma_px:
            break
        scene = scene.with_sigma(sigma)
        fit = fit_template(scene, frame, fit.offset_vu, fit.rotation_rad, context, options.errors)
    return fit if isinstance(fit, str) else (scene, fit)


def _with_minor_bodies(
    scene: BodyScene, fit: TemplateFit, frame: Frame, context: NavContext, options: BodyDiscOptions
) -> TemplateFit | None:
    """Fit of all bodies, where the small ones are found; their rotation goes about the large ones."""
    theta = find_rotation(scene, fit, frame, context)
    if theta is None:
        return None
    offset, rotation = start_with_rotation(fit, theta, context)
    whole = fit_template(scene, frame, offset, rotation, context, options.errors)
    if isinstance(whole, str) or whole.correlation < 0.8 * fit.correlation:
        return None
    drift = float(np.hypot(*(whole.offset_vu - offset)))
    return whole if drift < options.largest_drift_px else None


def body_disc_nav(
    fix: DiscFix | str, context: NavContext, options: BodyDiscOptions
) -> TechniqueResult | TechniqueFailure:
    """The fit as a technique's answer.

    Parameters
    ----------
    fix
        Of :func:`find_disc`.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        About the centroid of the predicted centres (seed 000).
    """
    if isinstance(fix, str):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, fix)
    fit = fix.fit
    pivot = predicted_place(context, fit.offset_vu, fit.rotation_rad, fit.pivot_vu)
    settled = Settled(fit.information, fit.pivot_vu, bool(fit.information[-1, -1] > 0) and len(fit.information) == 3)
    at_edge, at_edge_rotation = body_edge_flags(settled, fit.offset_vu, fit.rotation_rad, context, options)
    return TechniqueResult(
        technique=NAME, offset_vu=about(context, fit.offset_vu, fit.rotation_rad, pivot),
        rotation_rad=fit.rotation_rad, information=fit.information, pivot_vu=pivot,
        confidence=fix.acquisition.confidence, at_edge=at_edge, at_edge_rotation=at_edge_rotation,
        spurious=_is_spurious(fit, options),
        error_sources=tuple(f"body:{name}" for name in fix.scene.names), features=_inventory(fit, context),
        diagnostics={
            "correlation": fit.correlation, "search_correlation": fix.acquisition.correlation,
            "rival_correlation": fix.acquisition.rival, "chi2_per_sample": fit.chi2_per_sample,
            "texture": fit.errors.texture, "texture_px": fit.errors.texture_px, "relief_px": fit.errors.relief_px,
            "psf_sigma_px": fix.scene.sigma_px, "brightness_dn": fit.scale_dn, "night_dn": fit.night_dn,
        },
    )  # fmt: skip


def _is_spurious(fit: TemplateFit, options: BodyDiscOptions) -> bool:
    """Whether the image is unlike the rendering beyond its noise, or like it only by a surface that no body has."""
    unlike = fit.correlation < options.min_correlation * fit.expected_correlation
    return unlike or fit.errors.relief_px > options.largest_relief * fit.cutout.primary.diameter_px


def _inventory(fit: TemplateFit, context: NavContext) -> FeatureTable:
    """One row per body: its centre, and how far it reaches over the sky's noise."""
    views = fit.cutout.views
    count = len(views)
    seen: FloatArray = np.array([view.centre_vu for view in views])
    predicted = predicted_place(context, fit.offset_vu, fit.rotation_rad, seen)
    sigma = float(np.sqrt(max(np.trace(np.linalg.inv(fit.information[:2, :2])) / 2.0, 0.0)))
    return FeatureTable(
        name=np.array([view.body.name for view in views]), kind=np.full(count, "disc"), predicted_vu=predicted,
        measured_vu=seen, residual_vu=np.zeros((count, 2)), sigma_px=np.full(count, sigma), mag=np.full(count, np.nan),
        snr=np.full(count, np.nan), used=np.ones(count, bool), reason=np.full(count, "", "U1"),
    )  # fmt: skip
