"""Which detection is which star: assignments of stars to detections, and their odds."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import logsumexp, ndtr

from pipeline.geometry.procrustes import kabsch
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.psf import PointSources
from pipeline.options import Options
from pipeline.predict.stars import PredictedStars
from pipeline.records import BoolArray, FloatArray
from pipeline.techniques.base import NavContext

IntArray = NDArray[np.int64]

# Side of a voting cell; windows of 2x2 cells are counted, so a star may be off by this much and still count.
CELL_PX = 1.5
# Range of magnitudes over which detections of an unknown kind are taken to be spread evenly.
_MAGNITUDE_RANGE = 8.0
_KERNEL_MAG = 0.5
# Chance that the true pointing lies outside the search volume altogether.
_CHANCE_OUTSIDE = 0.01


class StarMatchOptions(Options):
    """Beliefs about stars and detections."""

    max_predicted: int = Field(60, ge=2, le=500, description="brightest predicted stars that take part in the search")
    completeness: float = Field(0.9, gt=0, lt=1, description="chance that a bright predicted star is in fact detected")
    magnitude_sigma: float = Field(
        0.35, gt=0, le=3, description="1-sigma scatter of catalogue against measured magnitude"
    )
    zero_point_sigma: float = Field(0.3, gt=0, le=3, description="1-sigma error of the camera's zero point, magnitudes")
    position_floor_px: float = Field(0.15, gt=0, le=3, description="per-axis error granted while matching, pixels")
    hypotheses: int = Field(8, ge=2, le=100, description="vote maxima that are refined")


@dataclass(frozen=True, eq=False)
class MatchProblem:
    """Predicted stars against detections, in the form that the search needs.

    Attributes
    ----------
    predicted_vu, predicted_mag
        (n, 2) pixels, (n,) instrumental magnitudes (NaN where unknown).
    place_sigma_px
        (n,) catalogue place.
    chance_detected
        (n,) chance that the star is detected where it falls on the array.
    measured_vu, measured_mag
        (m, 2) pixels, (m,) instrumental magnitudes.
    measured_covariance
        (m, 2, 2) px^2.
    measured_mag_sigma
        (m,) extra magnitude error of this detection (saturated ones).
    shape_vu
        Array.
    context
        Bounds.
    """

    predicted_vu: FloatArray
    predicted_mag: FloatArray
    place_sigma_px: FloatArray
    chance_detected: FloatArray
    measured_vu: FloatArray
    measured_mag: FloatArray
    measured_covariance: FloatArray
    measured_mag_sigma: FloatArray
    shape_vu: tuple[int, int]
    context: NavContext


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One assignment with its pointing and its odds.

    Attributes
    ----------
    star, source
        (k,) indices of the matched pairs.
    offset_vu, rotation_rad
        Similarity about the array centre.
    log_odds
        Natural logarithm of its odds against "nothing here is matched".
    """

    star: IntArray
    source: IntArray
    offset_vu: FloatArray
    rotation_rad: float
    log_odds: float


def match_problem(
    stars: PredictedStars, sources: PointSources, threshold_sigma: float, context: NavContext, options: StarMatchOptions
) -> MatchProblem:
    """Set up the search from predictions and detections.

    Parameters
    ----------
    stars
        Brightest first.
    sources
        Detections.
    threshold_sigma
        The detection threshold, for the chance that a star is seen.
    context
        Bounds.
    options
        Beliefs.

    Returns
    -------
    MatchProblem
        Of the brightest ``max_predicted`` stars.
    """
    stars = stars.take(np.arange(min(len(stars), options.max_predicted)))
    seen = ndtr((np.nan_to_num(stars.snr, nan=1e3) - threshold_sigma) / 1.5)
    chance = np.where(np.isnan(stars.snr), 0.5, seen) * options.completeness
    with np.errstate(divide="ignore"):
        predicted_mag = -2.5 * np.log10(stars.flux_dn)
        measured_mag = -2.5 * np.log10(np.maximum(sources.flux_dn, 1e-3))
    extra = np.hypot(1.0857 / np.maximum(sources.snr, 1.0), np.where(sources.saturated_pixels > 0, 0.3, 0.0))
    return MatchProblem(
        stars.position_vu, predicted_mag, stars.place_sigma_px, chance, sources.position_vu, measured_mag,
        sources.covariance_vu, extra, context.camera_model.shape_vu, context,
    )  # fmt: skip


def magnitude_log_ratio(problem: MatchProblem, options: StarMatchOptions) -> FloatArray:
    """How much better a detection's brightness fits each star than it fits the crowd of detections.

    Parameters
    ----------
    problem
        Stars and detections.
    options
        Magnitude scatter.

    Returns
    -------
    numpy.ndarray
        (n, m) natural log of f(mag | star) over the number of **other** detections per magnitude, which counts
        one more than were found, spread evenly.
    """
    gap = problem.measured_mag[None, :] - problem.measured_mag[:, None]
    kernel = np.exp(-0.5 * (gap / _KERNEL_MAG) ** 2) / (_KERNEL_MAG * np.sqrt(2 * np.pi))
    np.fill_diagonal(kernel, 0.0)
    others = kernel.sum(axis=1) + 1.0 / _MAGNITUDE_RANGE
    sigma = np.sqrt(options.magnitude_sigma**2 + options.zero_point_sigma**2 + problem.measured_mag_sigma**2)
    miss = (problem.measured_mag[None, :] - problem.predicted_mag[:, None]) / sigma
    # Variable stars and colours make tails: a tenth of the stars scatters four times as widely.
    narrow, wide = np.exp(-0.5 * miss**2) / sigma, np.exp(-0.5 * (miss / 4) ** 2) / (4 * sigma)
    fits = (0.9 * narrow + 0.1 * wide) / np.sqrt(2 * np.pi)
    fits = np.where(np.isnan(miss), others / max(len(gap), 1), fits)
    return np.asarray(np.log(np.maximum(fits, 1e-12)) - np.log(others))


def refine(
    problem: MatchProblem, ratio: FloatArray, offset_vu: FloatArray, rotation_rad: float, options: StarMatchOptions
) -> Hypothesis | None:
    """Turn a rough pointing into a one-to-one assignment and its odds.

    Parameters
    ----------
    problem
        Stars and detections.
    ratio
        (n, m) of :func:`magnitude_log_ratio`.
    offset_vu, rotation_rad
        Rough pointing at the array centre.
    options
        Position floor.

    Returns
    -------
    Hypothesis or None
        None where fewer than two pairs are left.
    """
    theta = rotation_rad
    pairs = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    for radius in (2 * CELL_PX, 2 * CELL_PX, CELL_PX, CELL_PX, 6 * options.position_floor_px):
        pairs = assign(problem, ratio, offset_vu, theta, radius)
        if len(pairs[0]) < 2:
            return None
        offset_vu, theta = similarity(problem, *pairs)
    log_odds = assignment_log_odds(problem, ratio, *pairs, offset_vu, theta, options)
    return Hypothesis(pairs[0], pairs[1], offset_vu, theta, log_odds)


def transform(problem: MatchProblem, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
    """Predicted pixels under a similarity about the array centre.

    Parameters
    ----------
    problem
        Stars.
    offset_vu, rotation_rad
        Pointing.

    Returns
    -------
    numpy.ndarray
        (n, 2).
    """
    centre = problem.context.camera_model.centre_vu
    return np.asarray((problem.predicted_vu - centre) @ plane_rotation(rotation_rad).T + centre + offset_vu)


def assign(
    problem: MatchProblem, ratio: FloatArray, offset_vu: FloatArray, rotation_rad: float, radius_px: float
) -> tuple[IntArray, IntArray]:
    """Pairs that are each other's best within a radius.

    Parameters
    ----------
    problem
        Stars and detections.
    ratio
        (n, m) brightness fit; pairs that fit worse than a thousandth of the crowd do not pair.
    offset_vu, rotation_rad
        Pointing at the array centre.
    radius_px
        Largest distance.

    Returns
    -------
    tuple
        (k,) star indices, (k,) source indices.
    """
    seen = transform(problem, offset_vu, rotation_rad)
    (seen_v, seen_u), (v, u) = seen.T, problem.measured_vu.T
    distance2 = (seen_v[:, None] - v) ** 2 + (seen_u[:, None] - u) ** 2
    cost = distance2 / radius_px**2 - 0.2 * ratio
    cost = np.where((distance2 <= radius_px**2) & (ratio > -9.0), cost, np.inf)
    best_source, best_star = np.argmin(cost, axis=1), np.argmin(cost, axis=0)
    star = np.flatnonzero(np.isfinite(cost.min(axis=1)) & (best_star[best_source] == np.arange(len(seen))))
    return star, best_source[star]


def similarity(problem: MatchProblem, star: IntArray, source: IntArray) -> tuple[FloatArray, float]:
    """Offset and rotation at the array centre that carry matched stars onto their detections.

    Parameters
    ----------
    problem
        Stars and detections.
    star, source
        (k,) pairs, k >= 1.

    Returns
    -------
    tuple
        (2,) pixels; radians (zero where no rotation is fitted).
    """
    predicted, measured = problem.predicted_vu[star], problem.measured_vu[source]
    if not problem.context.fit_camera_rotation or len(star) < 2:
        return np.median(measured - predicted, axis=0), 0.0
    offset, theta = kabsch(predicted, measured, np.ones(len(star)))
    arm = predicted.mean(axis=0) - problem.context.camera_model.centre_vu
    return offset + (np.eye(2) - plane_rotation(theta)) @ arm, theta


def assignment_log_odds(
    problem: MatchProblem,
    ratio: FloatArray,
    star: IntArray,
    source: IntArray,
    offset_vu: FloatArray,
    rotation_rad: float,
    options: StarMatchOptions,
    considered: IntArray | None = None,
) -> float:
    """Log-odds of an assignment: Bayes factor per pair, misses paid for, divided by the volume searched.

    Parameters
    ----------
    problem
        Stars and detections.
    ratio
        (n, m) of :func:`magnitude_log_ratio`.
    star, source
        (k,) pairs.
    offset_vu, rotation_rad
        Their pointing at the array centre.
    options
        Position floor.
    considered
        Stars whose absence counts; all by default.

    Returns
    -------
    float
        Natural logarithm.
    """
    context = problem.context
    turns = context.fit_camera_rotation and len(star) > 1
    if abs(rotation_rad) > context.max_rotation_rad + 1e-12 or _outside(offset_vu, context):
        return -np.inf
    seen = transform(problem, offset_vu, rotation_rad)
    residual2 = ((seen[star] - problem.measured_vu[source]) ** 2).sum(axis=1)
    measured2 = np.trace(problem.measured_covariance[source], axis1=1, axis2=2) / 2
    variance = measured2 + problem.place_sigma_px[star] ** 2 + options.position_floor_px**2
    # A tenth of real stars (doubles, unknown motion) misses by several times its sigma.
    near = 0.9 * np.exp(-0.5 * residual2 / variance) + 0.1 / 25 * np.exp(-0.5 * residual2 / (25 * variance))
    area = problem.shape_vu[0] * problem.shape_vu[1]
    score = float((np.log(problem.chance_detected[star]) + ratio[star, source] + np.log(area)).sum())
    score += float((np.log(np.maximum(near, 1e-30)) - np.log(2 * np.pi * variance)).sum())
    absent = np.zeros(len(seen), bool)
    absent[considered if considered is not None else slice(None)] = True
    absent[star] = False
    absent &= ((seen > 0.5) & (seen < np.array(problem.shape_vu) - 1.5)).all(axis=1)
    score += float(np.log1p(-problem.chance_detected[absent]).sum())
    return score + _log_posterior_share(problem.predicted_vu[star], 1.0 / variance, context, turns)


def _outside(offset_vu: FloatArray, context: NavContext) -> bool:
    return bool((np.abs(offset_vu) > np.asarray(context.search_margin_vu) + CELL_PX).any())


def _log_posterior_share(predicted_vu: FloatArray, weights: FloatArray, context: NavContext, turns: bool) -> float:
    """Log of the share of the search volume that the posterior of offset (and rotation) fills."""
    total = float(weights.sum())
    margin_v, margin_u = context.search_margin_vu
    share = np.log(2 * np.pi / total) - np.log(4 * margin_v * margin_u)
    if turns:
        arm = predicted_vu - weights @ predicted_vu / total
        spread = float(weights @ (arm**2).sum(axis=1))
        # Two stars on top of each other say nothing of the rotation, whose posterior then is its prior.
        share += min(0.0, 0.5 * np.log(2 * np.pi / max(spread, 1e-12)) - np.log(2 * context.max_rotation_rad))
    return float(share)


def chance_visible(problem: MatchProblem) -> FloatArray:
    """Chance that each star is on the array and detected, wherever within the margin the camera points.

    Parameters
    ----------
    problem
        Stars and bounds.

    Returns
    -------
    numpy.ndarray
        (n,) between 0 and 1.
    """
    low = np.maximum(problem.predicted_vu - problem.context.search_margin_vu, -0.5)
    high = np.minimum(problem.predicted_vu + problem.context.search_margin_vu, np.array(problem.shape_vu) - 0.5)
    inside = np.clip(high - low, 0, None) / (2 * np.asarray(problem.context.search_margin_vu))
    return np.asarray(inside.prod(axis=1) * problem.chance_detected)


def posterior(log_odds: FloatArray, null_stars_visible: FloatArray) -> FloatArray:
    """Probability of each of several exclusive assignments, with "none of them" as one more.

    Parameters
    ----------
    log_odds
        (h,) of :func:`assignment_log_odds`.
    null_stars_visible
        (k,) chance of each star that should have been seen if the pointing is anywhere in the volume.

    Returns
    -------
    numpy.ndarray
        (h,) probabilities, which add up to less than one.
    """
    unseen = float(np.log1p(-np.minimum(null_stars_visible, 0.999)).sum())
    null = logsumexp([np.log(_CHANCE_OUTSIDE), np.log(1 - _CHANCE_OUTSIDE) + unseen])
    return np.asarray(np.exp(log_odds - logsumexp(np.append(log_odds, null))))


def same_answer(a: Hypothesis, b: Hypothesis, reach_px: float) -> bool:
    """True where two hypotheses put the array's corners within a distance of each other.

    Parameters
    ----------
    a, b
        Hypotheses.
    reach_px
        Half the array's diagonal, with which a rotation counts as pixels.

    Returns
    -------
    bool
        Within three pixels.
    """
    apart = float(np.hypot(*(a.offset_vu - b.offset_vu))) + abs(a.rotation_rad - b.rotation_rad) * reach_px
    return apart < 3.0


def mask_of(indices: IntArray, length: int) -> BoolArray:
    """Boolean mask of indices.

    Parameters
    ----------
    indices
        Positions that are True.
    length
        Length of the mask.

    Returns
    -------
    numpy.ndarray
        (length,) flags.
    """
    mask = np.zeros(length, bool)
    mask[indices] = True
    return mask
