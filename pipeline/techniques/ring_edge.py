"""RingEdgeNav: blurred steps fitted to the edges of rings, brightness free on both sides of every piece."""

from pydantic import Field

from pipeline.predict.rings import RingScene
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueFailure, TechniqueOptions, TechniqueResult
from pipeline.techniques.ring_answer import ring_result
from pipeline.techniques.ring_peaks import RingSearchOptions
from pipeline.techniques.ring_search import RingFix

NAME = "RingEdgeNav"


class RingEdgeOptions(TechniqueOptions):
    """Options of the search that both ring techniques share, and of the fit."""

    search: RingSearchOptions = RingSearchOptions()
    min_confidence: float = Field(
        0.95, ge=0, lt=1, description="chance to be on the right edges, over neighbours and accidents, to be believed"
    )


def ring_edge_nav(
    scene: RingScene, fix: RingFix | str, context: NavContext, options: RingEdgeOptions
) -> TechniqueResult | TechniqueFailure:
    """The fit of the edges as a technique's answer.

    Parameters
    ----------
    scene
        Edges.
    fix
        Of :func:`pipeline.techniques.ring_search.find_rings`.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        About the centroid of the edges' pieces (seed 000); exactly zero information where they tell nothing.
    """
    if isinstance(fix, str):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, fix)
    if fix.confidence < options.min_confidence:
        detail = f"edges {fix.rival_shift_px:.0f} px aside fit nearly as well: log-likelihood {fix.rival_gap:.1f} apart"
        return TechniqueFailure(NAME, StatusReason.AMBIGUOUS_MATCH, detail)
    # On the same edges it counts before the template, which believes the predicted brightness.
    return ring_result(NAME, scene, fix, fix.fit, context, options, 2)
