"""StarUniqueMatchNav: one or two stars that nothing else in the frame can be taken for."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from pydantic import Field

from pipeline.geometry.procrustes import pair_rotation
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.psf import PointSources
from pipeline.predict.stars import PredictedStars
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueFailure, TechniqueOptions, TechniqueResult, edge_flags
from pipeline.techniques.star_fit import StarFitOptions, fit_stars
from pipeline.techniques.star_inventory import pair_covariance, star_inventory
from pipeline.techniques.star_match import (
    Hypothesis,
    IntArray,
    MatchProblem,
    StarMatchOptions,
    assignment_log_odds,
    chance_visible,
    magnitude_log_ratio,
    mask_of,
    match_problem,
    posterior,
    same_answer,
    similarity,
    transform,
)

NAME = "StarUniqueMatchNav"
# Of the detection pairs with the right separation, those whose brightness fits best; the others cannot win.
_MOST_PAIRS = 30
# Other stars this likely to be detected, this far inside the array, are asked; this near, a detection is theirs.
_SURELY_DETECTED = 0.85
_EDGE_PX = 4.0
_PRESENT_PX = 1.5
# Lost lines, variables and companions may hide some of them.
_PRESENT_SHARE = 0.7


class StarUniqueOptions(TechniqueOptions):
    """Options of the one- and two-star technique."""

    match: StarMatchOptions = StarMatchOptions()
    fit: StarFitOptions = StarFitOptions()
    brightest: int = Field(4, ge=1, le=20, description="brightest predicted stars tried")
    min_visible: float = Field(0.15, ge=0, le=1, description="least chance that a star tried is in the frame")
    max_sources: int = Field(60, ge=1, le=500, description="brightest detections tried")
    separation_px: float = Field(1.0, gt=0, le=20, description="largest error of a pair's separation, pixels")
    min_probability_pair: float = Field(0.999, gt=0.5, lt=1, description="posterior probability asked of two stars")
    min_probability_single: float = Field(0.98, gt=0.5, lt=1, description="posterior probability asked of one star")


def star_unique_nav(
    stars: PredictedStars,
    sources: PointSources,
    detection_sigma: float,
    context: NavContext,
    options: StarUniqueOptions,
) -> TechniqueResult | TechniqueFailure:
    """Match the brightest one or two stars where their brightness (and separation) leaves no second reading.

    Parameters
    ----------
    stars
        Predictions, brightest first.
    sources
        Detections, brightest first.
    detection_sigma
        Threshold with which they were found.
    context
        Camera, attitude, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        With two stars the rotation is ``atan2(cross, dot)`` about their centroid; with one it is unobservable.
    """
    if not len(stars):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, "no stars predicted")
    if not len(sources):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "no point sources detected")
    kept = sources.take(np.arange(min(len(sources), options.max_sources)))
    everything = match_problem(stars, sources, detection_sigma, context, options.match)
    # The brightest star does not help while it is off the array, wherever within the margin the camera points.
    index = np.flatnonzero(chance_visible(everything) >= options.min_visible)[: options.brightest]
    if not len(index):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, "no star that is likely to be in the frame")
    problem = match_problem(stars.take(index), kept, detection_sigma, context, options.match)
    ratio = magnitude_log_ratio(problem, options.match)
    visible = chance_visible(problem)
    best_chance = 0.0
    for find, threshold in ((_pairs, options.min_probability_pair), (_singles, options.min_probability_single)):
        hypotheses = find(problem, ratio, options)
        if not hypotheses:
            continue
        probability = posterior(np.array([h.log_odds for h in hypotheses]), visible[hypotheses[0].star])
        best_chance = max(best_chance, float(probability[0]))
        if probability[0] >= threshold:
            best = replace(hypotheses[0], star=index[hypotheses[0].star])
            if _others_present(everything, best):
                return _result(stars, sources, best, float(probability[0]), context, options)
            return TechniqueFailure(NAME, StatusReason.AMBIGUOUS_MATCH, "the other bright stars contradict the match")
    return TechniqueFailure(
        NAME, StatusReason.AMBIGUOUS_MATCH, f"no unmistakable star, best probability {best_chance:.4f}"
    )


def _pairs(problem: MatchProblem, ratio: np.ndarray, options: StarUniqueOptions) -> list[Hypothesis]:
    """Every pair of bright stars on every pair of detections with its separation and an allowed rotation."""
    found: list[Hypothesis] = []
    m = len(problem.measured_vu)
    first, second = (index.ravel() for index in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
    span = np.linalg.norm(problem.measured_vu[first] - problem.measured_vu[second], axis=1)
    for a, b in combinations(range(len(problem.predicted_vu)), 2):
        star = np.array([a, b])
        length = float(np.linalg.norm(problem.predicted_vu[a] - problem.predicted_vu[b]))
        fits = (first != second) & (np.abs(span - length) <= options.separation_px)
        fits &= (ratio[a, first] > -9) & (ratio[b, second] > -9)
        candidates = np.flatnonzero(fits)
        likely = ratio[a, first[candidates]] + ratio[b, second[candidates]]
        candidates = candidates[np.argsort(-likely, kind="stable")[:_MOST_PAIRS]]
        for j, k in zip(first[candidates], second[candidates], strict=True):
            hypothesis = _pair_hypothesis(problem, ratio, star, np.array([j, k]), options)
            if hypothesis is not None:
                found.append(hypothesis)
    return _distinct(found, problem)


def _pair_hypothesis(
    problem: MatchProblem, ratio: np.ndarray, star: IntArray, source: IntArray, options: StarUniqueOptions
) -> Hypothesis | None:
    theta = pair_rotation(problem.predicted_vu[star], problem.measured_vu[source])
    length = float(np.linalg.norm(np.diff(problem.predicted_vu[star], axis=0)))
    if abs(theta) > problem.context.max_rotation_rad + options.separation_px / max(length, 1e-6):
        return None
    theta = theta if problem.context.fit_camera_rotation else 0.0
    centre = problem.context.camera_model.centre_vu
    arm = problem.predicted_vu[star].mean(axis=0) - centre
    offset = problem.measured_vu[source].mean(axis=0) - centre - plane_rotation(theta) @ arm
    log_odds = assignment_log_odds(problem, ratio, star, source, offset, theta, options.match)
    return Hypothesis(star, source, offset, theta, log_odds) if np.isfinite(log_odds) else None


def _singles(problem: MatchProblem, ratio: np.ndarray, options: StarUniqueOptions) -> list[Hypothesis]:
    """The brightest star on every detection within the margin."""
    found: list[Hypothesis] = []
    star = np.array([0])
    for j in range(len(problem.measured_vu)):
        source = np.array([j])
        offset, _ = similarity(problem, star, source)
        log_odds = assignment_log_odds(problem, ratio, star, source, offset, 0.0, options.match, considered=star)
        if np.isfinite(log_odds):
            found.append(Hypothesis(star, source, offset, 0.0, log_odds))
    found.sort(key=lambda h: -h.log_odds)
    return found


def _others_present(everything: MatchProblem, best: Hypothesis) -> bool:
    """Whether the other stars that must be on the array under an assignment have detections at their places.

    One or two stars cannot tell that one of them has moved or has a companion; the rest of the field can. A lone match
    knows no rotation, so it stands only where no other star is to be expected.
    """
    seen = transform(everything, best.offset_vu, best.rotation_rad)
    surely = everything.chance_detected > _SURELY_DETECTED
    surely[best.star] = False
    inner = (seen > _EDGE_PX).all(axis=1) & (seen < np.array(everything.shape_vu) - 1 - _EDGE_PX).all(axis=1)
    others = seen[surely & inner]
    if not len(others) or len(best.star) == 1:
        return not len(others)
    gap = np.abs(everything.measured_vu[None, :, :] - others[:, None, :]).max(axis=2).min(axis=1)
    return bool(np.mean(gap <= _PRESENT_PX) >= _PRESENT_SHARE)


def _distinct(found: list[Hypothesis], problem: MatchProblem) -> list[Hypothesis]:
    """Best first, without those that give the same answer as a better one."""
    found.sort(key=lambda h: -h.log_odds)
    reach = float(np.hypot(*problem.shape_vu)) / 2
    distinct: list[Hypothesis] = []
    for hypothesis in found[:50]:
        if not any(same_answer(hypothesis, other, reach) for other in distinct):
            distinct.append(hypothesis)
    return distinct


def _result(
    stars: PredictedStars,
    sources: PointSources,
    best: Hypothesis,
    probability: float,
    context: NavContext,
    options: StarUniqueOptions,
) -> TechniqueResult:
    covariance = pair_covariance(stars, sources, best.star, best.source)
    fit = fit_stars(
        context, stars.direction[best.star], stars.position_vu[best.star], sources.position_vu[best.source], covariance,
        options.fit,
    )  # fmt: skip
    at_edge, at_edge_rotation = edge_flags(fit.centre_offset_vu, fit.rotation_rad, context, options)
    return TechniqueResult(
        technique=NAME, offset_vu=fit.offset_vu, rotation_rad=fit.rotation_rad, information=fit.information,
        pivot_vu=fit.pivot_vu, confidence=probability, measurements=int(fit.inlier.sum()), at_edge=at_edge,
        at_edge_rotation=at_edge_rotation,
        error_sources=("stars",),
        features=star_inventory(
            stars, sources, best.star, best.source, fit, context, mask_of(best.star, len(stars))
        ),
        diagnostics={"stars_used": len(best.star), "extra_sigma_px": fit.extra_sigma_px, "log_odds": best.log_odds},
    )  # fmt: skip
