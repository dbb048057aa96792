"""Inventory of predicted stars after a technique has matched some of them."""

import numpy as np

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
    return FeatureTable(
        name=stars.star_id, kind=np.full(n, "star"), predicted_vu=stars.position_vu, measured_vu=measured,
        residual_vu=measured - expected, sigma_px=sigma, mag=stars.mag, snr=stars.snr, used=used, reason=reason,
    )  # fmt: skip


def _on_array(position_vu: FloatArray, camera: CameraModel) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(((position_vu > -0.5) & (position_vu < np.array(camera.shape_vu) - 0.5)).all(axis=1))
