"""From a fit of ring edges to a technique's answer: what is observable, and the inventory of features."""

from dataclasses import dataclass

import numpy as np

from pipeline.predict.rings import RingScene, bow_px
from pipeline.records import FloatArray, Record
from pipeline.techniques.base import FeatureTable, NavContext, TechniqueOptions, TechniqueResult, edge_flags
from pipeline.techniques.body_base import about, predicted_place, rotation_shows, settle
from pipeline.techniques.ring_fit import RingFit
from pipeline.techniques.ring_search import RingFix

# Edges that depart less than this from a straight line tell one direction (a pixel's own size).
STRAIGHT_PX = 1.0
# A direction whose sigma is above this share of the margin is told by the margin.
_SEEN_SHARE = 1.0 / 6.0


@dataclass(frozen=True, eq=False)
class Observed(Record):
    """Information of a fit with exact zeros where it tells nothing.

    Attributes
    ----------
    information
        (2, 2) or (3, 3).
    pivot_vu
        (2,) in the image.
    rank
        Observable directions of offset and rotation.
    """

    information: FloatArray
    pivot_vu: FloatArray
    rank: int


def observed(fit: RingFit, context: NavContext) -> Observed:
    """What of offset and rotation the edges tell.

    Straight edges tell the offset across them; along a circle, and about its centre, nothing moves.

    Parameters
    ----------
    fit
        Of the edges.
    context
        Bounds.

    Returns
    -------
    Observed
        Ready for a result.
    """
    size = len(fit.information)
    margin = float(np.min(context.search_margin_vu))
    if is_straight(fit):
        # Along the edges and about their middle the search's own bounds are all that is known.
        bound = context.max_rotation_rad / np.sqrt(3.0)
        prior = np.diag([3.0 / margin**2, 3.0 / margin**2, 1.0 / bound**2 if bound else 0.0][:size])
        covariance = np.asarray(np.linalg.inv(fit.information + prior))
        return _one_direction(covariance[:2, :2], fit.pivot_vu, size)
    if size == 3:
        turns = np.diag([0.0, 0.0, 3.0 / context.max_rotation_rad**2])
        covariance = np.asarray(np.linalg.pinv(fit.information + turns, hermitian=True))[:2, :2]
        if np.linalg.eigvalsh(covariance)[1] > (_SEEN_SHARE * margin) ** 2:
            # A turn about the rings' own centre looks like a shift along them.
            prior = turns + np.diag([3.0 / margin**2, 3.0 / margin**2, 0.0])
            covariance = np.asarray(np.linalg.inv(fit.information + prior))[:2, :2]
            return _one_direction(covariance, fit.pivot_vu, size, _bend(fit))
        if rotation_shows(fit.information, context):
            return Observed(fit.information, fit.pivot_vu, 3)
    settled = settle(fit.information, fit.pivot_vu, context)
    values = np.linalg.eigvalsh(settled.information[:2, :2])
    if values[0] < 1.0 / (_SEEN_SHARE * margin) ** 2:
        prior = np.eye(2) * 3.0 / margin**2
        covariance = np.asarray(np.linalg.inv(settled.information[:2, :2] + prior))
        return _one_direction(covariance, settled.pivot_vu, size)
    return Observed(settled.information, settled.pivot_vu, 2)


def _one_direction(
    covariance: FloatArray, pivot_vu: FloatArray, size: int, bend_per_px: float = 0.0
) -> Observed:
    """The direction across; along a bent edge an unknown way s lifts it by half of s^2 times the bend."""
    values, vectors = np.linalg.eigh(covariance)
    across = vectors[:, 0]
    information = np.zeros((size, size))
    information[:2, :2] = np.outer(across, across) / (values[0] + (bend_per_px * values[1]) ** 2 / 2.0)
    return Observed(information, pivot_vu, 1)


def _bend(fit: RingFit) -> float:
    """Mean curvature of the edges, 1/px: how their normals turn over their places."""
    normals, places = fit.units.normal_vu[fit.units.present], fit.units.places_vu[fit.units.present]
    # Normals point outward, to one side each of the centre's: as axes they are alike.
    normals = normals * np.where(normals @ normals[0] < 0, -1.0, 1.0)[:, None]
    along = np.array([-normals[:, 1].mean(), normals[:, 0].mean()])
    along /= max(float(np.hypot(*along)), 1e-12)
    way, turn = places @ along, normals @ along
    way = way - way.mean()
    return abs(float(way @ turn)) / max(float(way @ way), 1e-12)


def is_straight(fit: RingFit) -> bool:
    """Whether all edges in the image are straight and parallel to a pixel over their length.

    Parameters
    ----------
    fit
        Of the edges.

    Returns
    -------
    bool
        Then one direction alone is observable.
    """
    units = fit.units
    told = np.isfinite(fit.shift_sigma_px) & (fit.weight > 0)[:, None] & units.present
    if not told.any():
        return False
    edge = np.where(told, units.edges[:, :1] + np.arange(told.shape[1]), -1)
    bows, lengths = [], []
    for k in np.unique(edge[told]):
        places = units.places_vu[edge == k]
        bows.append(bow_px(places))
        lengths.append(float(np.hypot(*np.ptp(places, axis=0))))
    # Normals as axes: opposite ones are parallel.
    normals = units.normal_vu[told]
    _, vectors = np.linalg.eigh(normals.T @ normals)
    aside = np.abs(normals @ vectors[:, 0])
    return max(bows) < STRAIGHT_PX and float(np.sqrt((aside**2).mean())) * max(lengths) / 2.0 < 2.0 * STRAIGHT_PX


def ring_result(
    technique: str, scene: RingScene, fix: RingFix, fit: RingFit, context: NavContext, options: TechniqueOptions,
    measurements: int,
) -> TechniqueResult:  # fmt: skip
    """Answer of a fit.

    Parameters
    ----------
    technique
        Name.
    scene, fix, fit
        Edges, where they were found, and the fit that is answered for.
    context, options
        Bounds and fractions that count as their edge.
    measurements
        Of two techniques on the same edges the one with more counts.

    Returns
    -------
    TechniqueResult
        About the predicted place of the fit's centroid.
    """
    seen = observed(fit, context)
    pivot = predicted_place(context, fit.offset_vu, fit.rotation_rad, seen.pivot_vu)
    at_edge, at_edge_rotation = _at_edge(seen, fit, context, options)
    return TechniqueResult(
        technique=technique, offset_vu=about(context, fit.offset_vu, fit.rotation_rad, pivot),
        rotation_rad=fit.rotation_rad,
        information=seen.information, pivot_vu=pivot, confidence=fix.confidence, measurements=measurements,
        at_edge=at_edge, at_edge_rotation=at_edge_rotation, error_sources=(f"rings:{scene_planet(scene)}",),
        features=_inventory(scene, fit, pivot, context),
        diagnostics=_finite({
            "rank": float(seen.rank), "correlation": fix.correlation,
            "rival_gap": fix.rival_gap, "rival_shift_px": fix.rival_shift_px,
            "excess": fit.excess, "chi2_per_pixel": fit.chi2_per_pixel, "pixels": float(fit.pixels),
            "psf_variance_change_px2": fit.width_px2, "units": float(len(fit.units)),
            "excluded_features": float(fit.excluded.sum()),
        }),
    )  # fmt: skip


def _finite(figures: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def scene_planet(scene: RingScene) -> str:
    """Name of the ringed planet."""
    return scene.rings.planet if scene.rings is not None else ""


def _at_edge(
    seen: Observed, fit: RingFit, context: NavContext, options: TechniqueOptions
) -> tuple[bool, bool]:
    """Bounds count along what is observable only."""
    if seen.rank != 1 and (len(seen.information) == 2 or seen.information[2, 2] > 0):
        return edge_flags(fit.offset_vu, fit.rotation_rad, context, options)
    values, vectors = np.linalg.eigh(seen.information[:2, :2])
    told = vectors[:, values > 0]
    part = told @ (told.T @ fit.offset_vu)
    return edge_flags(np.asarray(part), 0.0, context, options)


def _inventory(scene: RingScene, fit: RingFit, pivot_vu: FloatArray, context: NavContext) -> FeatureTable:
    """One row per feature: the middle unit of its edges, shift across it, and why it was not used."""
    rows = [_row(scene, fit, k, context) for k in range(len(scene.fates))]
    columns = list(zip(*rows, strict=True))
    nan = np.full(len(rows), np.nan)
    return FeatureTable(
        name=np.array([f.name for f in scene.fates]), kind=np.array([f.kind for f in scene.fates]),
        predicted_vu=np.array(columns[0]), measured_vu=np.array(columns[1]), residual_vu=np.array(columns[2]),
        sigma_px=np.array(columns[3], float), mag=nan, snr=np.array(columns[4], float),
        used=np.array(columns[5], bool), reason=np.array(columns[6]),
    )  # fmt: skip


def _row(
    scene: RingScene, fit: RingFit, k: int, context: NavContext
) -> tuple[FloatArray, FloatArray, FloatArray, float, float, bool, str]:
    units, blank = fit.units, np.full(2, np.nan)
    fate = scene.fates[k]
    edge = units.edges[:, :1] + np.arange(units.present.shape[1])
    mine = units.present & np.isin(edge, np.nonzero(scene.feature == k)[0])
    told = mine & np.isfinite(fit.shift_sigma_px) & (fit.weight > 0)[:, None]
    if fate.reason or not mine.any():
        return blank, blank, blank, np.nan, np.nan, False, fate.reason or "outside_frame"
    if not told.any():
        return blank, blank, blank, np.nan, np.nan, False, "too_faint"
    precision = 1.0 / fit.shift_sigma_px[told] ** 2
    rows = np.argwhere(told)
    row, column = rows[len(rows) // 2]
    place, normal = units.places_vu[row, column], units.normal_vu[row, column]
    shift = float((fit.shift_px[told] * precision).sum() / precision.sum())
    shift += fit.radius_km[k] * float(units.px_per_km[row, column])
    predicted = predicted_place(context, fit.offset_vu, fit.rotation_rad, place[None])[0]
    snr = float(np.sqrt(precision.sum()))
    reason = "radius_off" if fit.excluded[k] else ""
    measured = place + shift * normal
    return predicted, measured, measured - place, 1.0 / snr, snr, not reason, reason
