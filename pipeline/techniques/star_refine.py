"""StarRefineNav: every predicted star measured again inside the prior that the first pass gave."""

import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.imaging.detect import DetectionOptions, star_like
from pipeline.imaging.psf import PointSources, fit_point_sources
from pipeline.predict.stars import PredictedStars, near_array
from pipeline.records import BoolArray, FloatArray
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, Prior, TechniqueFailure, TechniqueOptions, TechniqueResult, edge_flags
from pipeline.techniques.star_fit import StarFitOptions, fit_stars, predict_at
from pipeline.techniques.star_inventory import pair_covariance, star_inventory

NAME = "StarRefineNav"


class StarRefineOptions(TechniqueOptions):
    """Options of the refiner."""

    fit: StarFitOptions = StarFitOptions()
    min_snr: float = Field(5.0, ge=3, le=100, description="measured signal to noise below which a star is not used")
    gate_sigma: float = Field(4.0, gt=1, le=20, description="half-width of the gate in sigmas of prior and place")
    gate_floor_px: float = Field(0.6, gt=0, le=10, description="smallest half-width of the gate, pixels")
    gate_limit_px: float = Field(4.0, gt=0, le=50, description="prior too loose to refine in beyond this, pixels")


def star_refine_nav(
    stars: PredictedStars,
    frame: Frame,
    prior: Prior,
    context: NavContext,
    detection: DetectionOptions,
    options: StarRefineOptions,
) -> TechniqueResult | TechniqueFailure:
    """Re-centroid the stars where the corrected attitude puts them, then fit again.

    Parameters
    ----------
    stars
        Predictions, all of them.
    frame
        Image.
    prior
        First ensemble's answer.
    context
        Camera, attitude, bounds.
    detection
        What a star looks like.
    options
        Gates.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        About the weighted centroid of the inliers. One surviving star leaves the rotation unobservable.
    """
    expected = predict_at(context, stars.direction, prior.offset_vu, prior.rotation_rad)
    gate = _gate(expected, stars.place_sigma_px, prior.covariance, context, options)
    wanted = np.flatnonzero(near_array(expected, context.camera_model, (-1.0, -1.0)) & (gate <= options.gate_limit_px))
    wanted = wanted[_apart(expected[wanted], frame.spread.sigma_px)]
    fits = fit_point_sources(
        frame.pixels, frame.bad, frame.saturated, frame.sigma, frame.gain_e_per_dn, frame.spread, expected[wanted],
        reach_px=options.gate_limit_px,
    )  # fmt: skip
    miss = np.abs(fits.position_vu - expected[wanted]).max(axis=1, initial=0.0)
    good = fits.ok & star_like(fits, frame.spread, detection) & (fits.snr >= options.min_snr) & (miss <= gate[wanted])
    if not good.any():
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "no star inside the prior's gate")
    return _result(stars, fits.take(np.flatnonzero(good)), wanted[good], prior.confidence, context, options)


def _gate(
    expected_vu: FloatArray,
    place_sigma_px: FloatArray,
    covariance: FloatArray,
    context: NavContext,
    options: StarRefineOptions,
) -> FloatArray:
    """(n,) half-width of the gate around each star: prior at that place of the array, and the star's own place."""
    spread2 = np.full(len(expected_vu), float(max(covariance[0, 0], covariance[1, 1])))
    if len(covariance) == 3:
        spread2 += covariance[2, 2] * ((expected_vu - context.camera_model.centre_vu) ** 2).sum(axis=1)
    half = options.gate_sigma * np.sqrt(spread2 + place_sigma_px**2)
    return np.asarray(np.maximum(half, options.gate_floor_px))


def _apart(expected_vu: FloatArray, sigma_px: float) -> BoolArray:
    """False for a star that a brighter one (an earlier row) outshines: a fit there measures the brighter one."""
    v, u = expected_vu.T
    gap = np.hypot(v[:, None] - v, u[:, None] - u)
    return np.asarray(~np.tril(gap < 2.0 * sigma_px, k=-1).any(axis=1))


def _result(
    stars: PredictedStars,
    fits: PointSources,
    star: np.ndarray,
    confidence: float,
    context: NavContext,
    options: StarRefineOptions,
) -> TechniqueResult:
    source = np.arange(len(fits))
    fit = fit_stars(
        context, stars.direction[star], stars.position_vu[star], fits.position_vu,
        pair_covariance(stars, fits, star, source), options.fit,
    )  # fmt: skip
    at_edge, at_edge_rotation = edge_flags(fit.centre_offset_vu, fit.rotation_rad, context, options)
    return TechniqueResult(
        technique=NAME, offset_vu=fit.offset_vu, rotation_rad=fit.rotation_rad, information=fit.information,
        pivot_vu=fit.pivot_vu, confidence=confidence, measurements=int(fit.inlier.sum()), at_edge=at_edge,
        at_edge_rotation=at_edge_rotation,
        error_sources=("stars",), features=star_inventory(stars, fits, star, source, fit, context),
        diagnostics={"stars_used": int(fit.inlier.sum()), "extra_sigma_px": fit.extra_sigma_px},
    )  # fmt: skip
