"""Inventory of predicted stars after a technique has matched some of them."""

import numpy as np
from numpy.typing import NDArray

from pipeline.imaging.psf import PointSources
from pipeline.predict.stars import PredictedStars
from pipeline.records import BoolArray, CameraModel, FloatArray
from pipeline.techniques.base import FeatureTable, NavContext
from pipeline.techniques.star_fit import StarFit, predict_at
from pipeline.techniques.star_match import IntArray

NOT_SEARCHED = "not_searched"
OUTSIDE_FRAME = "outside_frame"
NOT_DETECTED = "not_detected"
PLACE_DISAGREES = "place_disagrees"

# A star that was to be seen this clearly and is not there is looked for this far away, at up to a factor in flux.
_CLEARLY_SEEN_SNR = 15.0
_DISPLACED_PX = 30.0
_FLUX_FACTOR = 3.0
_CHANCE_NEIGHBOUR = 0.1


def pair_covariance(stars: PredictedStars, sources: PointSources, star: IntArray, source: IntArray) -> FloatArray:
    """Covariance of each matched pair: the centroid's and the catalogue place's.

    Parameters
    ----------
    stars, sources
        Predictions and detections.
    star, source
        (k,) indices.

    Returns
    -------
    numpy.ndarray
        (k, 2, 2) px^2.
    """
    place = stars.place_sigma_px[star] ** 2
    return np.asarray(sources.covariance_vu[source] + place[:, None, None] * np.eye(2))


def star_inventory(
    stars: PredictedStars,
    sources: PointSources,
    star: IntArray,
    source: IntArray,
    fit: StarFit,
    context: NavContext,
    searched: BoolArray | None = None,
) -> FeatureTable:
    """One row per predicted star: where it was found, how far off, and why it was not used.

    A star that no detection was assigned to but that has been seen close by says so: its place disagrees.

    Parameters
    ----------
    stars
        Predictions, all of them.
    sources
        Detections.
    star, source
        (k,) matched pairs that went into ``fit``, in its order.
    fit
        Pointing.
    context
        Camera.
    searched
        (n,) False for stars that the technique did not look at.

    Returns
    -------
    FeatureTable
        In the order of ``stars``.
    """
    n = len(stars)
    expected = predict_at(context, stars.direction, fit.centre_offset_vu, fit.rotation_rad)
    measured = np.full((n, 2), np.nan)
    sigma = np.full(n, np.nan)
    measured[star] = sources.position_vu[source]
    sigma[star] = np.sqrt(np.trace(sources.covariance_vu[source], axis1=1, axis2=2) / 2)
    used = np.zeros(n, bool)
    used[star] = fit.inlier
    reason = np.full(n, NOT_DETECTED, dtype="U32")
    reason[~_on_array(expected, context.camera_model)] = OUTSIDE_FRAME
    if searched is not None:
        reason[~searched] = NOT_SEARCHED
    reason[star] = np.where(fit.inlier, "", PLACE_DISAGREES)
    _find_displaced(stars, sources, source, expected, measured, reason)
    return FeatureTable(
        name=stars.star_id, kind=np.full(n, "star"), predicted_vu=stars.position_vu, measured_vu=measured,
        residual_vu=measured - expected, sigma_px=sigma, mag=stars.mag, snr=stars.snr, used=used, reason=reason,
    )  # fmt: skip


def _on_array(position_vu: FloatArray, camera: CameraModel) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(((position_vu > -0.5) & (position_vu < np.array(camera.shape_vu) - 0.5)).all(axis=1))


def _find_displaced(
    stars: PredictedStars,
    sources: PointSources,
    matched: IntArray,
    expected_vu: FloatArray,
    measured_vu: FloatArray,
    reason: NDArray[np.str_],
) -> None:
    """Say where a missing star shines instead: the one unmatched source of its brightness near its place.

    Only where chance would hardly put such a source there, by the density of unmatched sources at least as bright.
    """
    free = np.setdiff1d(np.arange(len(sources)), matched)
    for k in np.flatnonzero((reason == NOT_DETECTED) & (stars.snr > _CLEARLY_SEEN_SNR)):
        ratio = sources.flux_dn[free] / stars.flux_dn[k]
        alike = free[(ratio > 1.0 / _FLUX_FACTOR) & (ratio < _FLUX_FACTOR)]
        away = np.hypot(*(sources.position_vu[alike] - expected_vu[k]).T)
        near = int(np.argmin(away)) if len(away) else -1
        if near < 0 or away[near] > _DISPLACED_PX:
            continue
        span = np.ptp(sources.position_vu, axis=0)
        if len(alike) * np.pi * away[near] ** 2 < _CHANCE_NEIGHBOUR * float(max(span.prod(), 1.0)):
            reason[k] = PLACE_DISAGREES
            measured_vu[k] = sources.position_vu[alike[near]]
