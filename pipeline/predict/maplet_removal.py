"""Maplets that are seen but of no use: the five criteria of seed 001 section 3.4, each with its reason."""

from collections.abc import Collection
from math import degrees

from pydantic import Field

from pipeline.imaging.maplet_images import MapletImages
from pipeline.options import Options
from pipeline.predict.maplets import MapletReason


class RemovalOptions(Options):
    """Bounds of seed 001 eq. 3.53-3.56."""

    removed_permille: int = Field(700, ge=0, le=1000, description="removed data in thousandths, must stay below (3.53)")
    emission_max_deg: float = Field(75.0, gt=0, le=90, description="emission angle, must stay below, degrees (3.54)")
    illuminated_min: float = Field(0.3, ge=0, le=1, description="lit share of the predicted image, at least (3.55)")
    ratio_max: float = Field(6.0, gt=0, description="cells per pixel, must stay below (3.56)")
    ratio_min: float = Field(0.15, gt=0, description="cells per pixel, must exceed (3.56)")


def removed_ratio(images: MapletImages) -> float:
    """Share of cells that the extract filter took out (eq. 3.53).

    Parameters
    ----------
    images
        Of one maplet.

    Returns
    -------
    float
        Removed cells over the number of cells plus one.
    """
    return images.removed / (images.predicted.size + 1)


def removal_reason(
    images: MapletImages, ratio: float, name: str, by_hand: Collection[str], options: RemovalOptions
) -> MapletReason:
    """First criterion by which a maplet is not used.

    Parameters
    ----------
    images
        Of the maplet.
    ratio
        Cells per pixel.
    name
        Landmark's name.
    by_hand
        Names that the user left out.
    options
        Bounds.

    Returns
    -------
    MapletReason
        ``USED`` where every criterion holds.
    """
    checks = (
        (name not in by_hand, MapletReason.REMOVED_BY_HAND),
        (round(1000 * removed_ratio(images)) < options.removed_permille, MapletReason.TOO_MUCH_REMOVED),
        (degrees(images.emission_rad) < options.emission_max_deg, MapletReason.EMISSION),
        (images.illuminated >= options.illuminated_min, MapletReason.ILLUMINATED_FRACTION),
        (ratio < options.ratio_max, MapletReason.RESOLUTION_TOO_COARSE),
        (ratio > options.ratio_min, MapletReason.RESOLUTION_TOO_FINE),
    )
    return next((reason for holds, reason in checks if not holds), MapletReason.USED)
