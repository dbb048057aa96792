"""StarFieldFromCatalogNav: many stars at once, without any prior but the search margin."""

import numpy as np
from pydantic import Field

from pipeline.imaging.psf import PointSources
from pipeline.predict.stars import PredictedStars
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueFailure, TechniqueOptions, TechniqueResult, edge_flags
from pipeline.techniques.star_fit import StarFit, StarFitOptions, fit_stars
from pipeline.techniques.star_inventory import pair_covariance, star_inventory
from pipeline.techniques.star_match import (
    Hypothesis,
    MatchProblem,
    StarMatchOptions,
    chance_visible,
    magnitude_log_ratio,
    match_problem,
    posterior,
    refine,
    same_answer,
)
from pipeline.techniques.star_search import search

NAME = "StarFieldFromCatalogNav"


class StarFieldOptions(TechniqueOptions):
    """Options of the star-field technique."""

    match: StarMatchOptions = StarMatchOptions()
    fit: StarFitOptions = StarFitOptions()
    min_stars: int = Field(3, ge=2, le=50, description="fewest matched stars for an answer")
    min_probability: float = Field(
        0.9999, gt=0.5, lt=1, description="posterior probability below which it is no answer"
    )


def star_field_nav(
    stars: PredictedStars,
    sources: PointSources,
    detection_sigma: float,
    context: NavContext,
    options: StarFieldOptions,
) -> TechniqueResult | TechniqueFailure:
    """Match a pattern of catalogue stars to detections and fit offset and rotation (seed 000: Kabsch).

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
        The pivot is the weighted centroid of the inliers.
    """
    if len(stars) < options.min_stars:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, f"{len(stars)} stars predicted")
    if len(sources) < options.min_stars:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, f"{len(sources)} point sources detected")
    problem = match_problem(stars, sources, detection_sigma, context, options.match)
    hypotheses = _hypotheses(problem, options)
    if not hypotheses:
        return TechniqueFailure(NAME, StatusReason.NO_MATCH, "no pointing matches enough stars")
    probability = posterior(np.array([h.log_odds for h in hypotheses]), chance_visible(problem))
    best = hypotheses[0]
    detail = f"{len(best.star)} stars matched, probability {probability[0]:.6f}"
    if probability[0] < options.min_probability:
        rival = len(hypotheses) > 1 and probability[1] > (1 - probability[0]) / 2
        return TechniqueFailure(NAME, StatusReason.AMBIGUOUS_MATCH if rival else StatusReason.NO_MATCH, detail)
    return _result(stars, sources, best, float(probability[0]), context, options)


def _hypotheses(problem: MatchProblem, options: StarFieldOptions) -> list[Hypothesis]:
    """Distinct assignments of enough stars, best first."""
    ratio = magnitude_log_ratio(problem, options.match)
    refined = [
        refine(problem, ratio, offset, theta, options.match) for offset, theta in search(problem, ratio, options.match)
    ]
    found = [h for h in refined if h is not None and len(h.star) >= options.min_stars and np.isfinite(h.log_odds)]
    found.sort(key=lambda h: -h.log_odds)
    reach = float(np.hypot(*problem.shape_vu)) / 2
    distinct: list[Hypothesis] = []
    for hypothesis in found:
        if not any(same_answer(hypothesis, other, reach) for other in distinct):
            distinct.append(hypothesis)
    return distinct


def _result(
    stars: PredictedStars,
    sources: PointSources,
    best: Hypothesis,
    probability: float,
    context: NavContext,
    options: StarFieldOptions,
) -> TechniqueResult | TechniqueFailure:
    covariance = pair_covariance(stars, sources, best.star, best.source)
    fit: StarFit = fit_stars(
        context, stars.direction[best.star], stars.position_vu[best.star], sources.position_vu[best.source], covariance,
        options.fit,
    )  # fmt: skip
    if fit.inlier.sum() < options.min_stars:
        return TechniqueFailure(NAME, StatusReason.NO_MATCH, f"only {int(fit.inlier.sum())} of the matches agree")
    at_edge, at_edge_rotation = edge_flags(fit.centre_offset_vu, fit.rotation_rad, context, options)
    searched = np.arange(len(stars)) < options.match.max_predicted
    return TechniqueResult(
        technique=NAME, offset_vu=fit.offset_vu, rotation_rad=fit.rotation_rad, information=fit.information,
        pivot_vu=fit.pivot_vu, confidence=probability, measurements=int(fit.inlier.sum()), at_edge=at_edge,
        at_edge_rotation=at_edge_rotation,
        error_sources=("stars",),
        features=star_inventory(stars, sources, best.star, best.source, fit, context, searched),
        diagnostics={"stars_used": int(fit.inlier.sum()), "extra_sigma_px": fit.extra_sigma_px,
                     "log_odds": best.log_odds},
    )  # fmt: skip
