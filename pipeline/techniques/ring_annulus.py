"""RingAnnulusNav: the rendered annulus fitted pixel by pixel, its relative brightness as predicted."""

from pydantic import Field

from pipeline.predict.rings import RingScene
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueFailure, TechniqueOptions, TechniqueResult
from pipeline.techniques.ring_answer import ring_result
from pipeline.techniques.ring_fit import fit_rings
from pipeline.techniques.ring_image import RingImage
from pipeline.techniques.ring_search import RingFix

NAME = "RingAnnulusNav"


class RingAnnulusOptions(TechniqueOptions):
    """Options of the template."""

    min_confidence: float = Field(
        0.95, ge=0, lt=1, description="chance to be on the right edges, over neighbours and accidents, to be believed"
    )
    min_told_share: float = Field(
        0.5, ge=0, le=1, description="share of the light told by free edges that the template must tell, else spurious"
    )


def ring_annulus_nav(
    scene: RingScene, image: RingImage, fix: RingFix | str, context: NavContext, options: RingAnnulusOptions
) -> TechniqueResult | TechniqueFailure:
    """The template's fit as a technique's answer.

    Parameters
    ----------
    scene
        Edges with predicted contrasts.
    image
        Light and noise.
    fix
        Peak of the correlation, refined on the edges.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        Of the same catalogue as :mod:`pipeline.techniques.ring_edge`: not independent of it.
    """
    if isinstance(fix, str):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, fix)
    if fix.confidence < options.min_confidence:
        return TechniqueFailure(NAME, StatusReason.AMBIGUOUS_MATCH, "another place fits nearly as well")
    start = (fix.fit.offset_vu, fix.fit.rotation_rad)
    fit = fit_rings(scene, image, start, context, tied=True, close=True)
    if isinstance(fit, str):
        return TechniqueFailure(NAME, StatusReason.NO_MATCH, fit)
    result = ring_result(NAME, scene, fix, fit, context, options, 1)
    return result if fit.significance >= options.min_told_share * fix.fit.significance else _spurious(result)


def _spurious(result: TechniqueResult) -> TechniqueResult:
    """A template whose brightness is not that of the image."""
    values = {name: getattr(result, name) for name in result.__dataclass_fields__}
    return TechniqueResult(**(values | {"spurious": True}))
