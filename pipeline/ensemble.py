"""All techniques' answers fused into one, in 2 or 3 degrees of freedom.

Everything works on information matrices at one common pivot, the array centre, where "not observable" is an exact
zero. The rotation is scaled to pixels at half the array's diagonal while matrices are inverted, so that a
pseudo-inverse compares like with like.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.linalg import pinvh
from scipy.special import chdtri

from pipeline.geometry.pointing import move_pivot
from pipeline.options import Options
from pipeline.records import FloatArray, Record
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueResult

# Relative size below which an eigenvalue of a scaled information matrix counts as zero.
_NULL = 1e-13
# Rotations tried where none is told.
_TURNS = 401


class EnsembleOptions(Options):
    """When answers agree, and when a second answer is a conflict."""

    link_chance: float = Field(
        1e-3, gt=0, lt=0.5, description="chance that two right answers are farther apart than the link length"
    )
    rival_share: float = Field(
        0.3, gt=0, le=1, description="strength of a second cluster, relative to the first, from which it is a conflict"
    )
    min_confidence: float = Field(0.9, ge=0, lt=1, description="confidence below which no answer is given")


@dataclass(frozen=True, eq=False)
class _CombinedEstimate(Record):
    """The fused answer at the array centre.

    Attributes
    ----------
    offset_vu
        (2,) pixels.
    rotation_rad
        None in 2 DoF runs and where no technique observed it.
    covariance
        (2, 2) of the translation, or (3, 3) where the rotation was observed. NaN when only one direction is known.
    fitted_rotation
        Whether this was a 3-DoF run.
    observable_vu
        (2,) unit vector of the one observable direction, or None where both are.
    along_px, sigma_along_px
        Offset along it and its sigma; None where both directions are observable.
    confidence
        That of the surest member.
    members, excluded
        Techniques fused; (technique, reason) of those left out.
    reason
        Why the image ends as it does.
    """

    offset_vu: FloatArray
    rotation_rad: float | None
    covariance: FloatArray
    fitted_rotation: bool
    observable_vu: FloatArray | None
    along_px: float | None
    sigma_along_px: float | None
    confidence: float
    members: tuple[str, ...]
    excluded: tuple[tuple[str, str], ...]
    reason: StatusReason

    def __post_init__(self) -> None:
        self._freeze(offset_vu=(2,), covariance=(len(self.covariance), len(self.covariance)), observable_vu=(2,))


@dataclass(frozen=True, eq=False)
class _Placed:
    """A result moved to the array centre, rotation in pixels at the arm."""

    result: TechniqueResult
    state: FloatArray
    information: FloatArray


def ensemble(
    results: Sequence[TechniqueResult],
    context: NavContext,
    options: EnsembleOptions,
    rotation_prior_rad: float | None = None,
) -> _CombinedEstimate | None:
    """Fuse techniques' answers.

    Spurious answers are dropped, those at the edge too unless nothing else is left; the rest are clustered by
    single-link Mahalanobis distance in the subspace that both observe, and the strongest cluster is fused. Of
    members that share an error source only the most informative counts.

    Parameters
    ----------
    results
        Answers, all 2-DoF or all 3-DoF.
    context
        Camera and bounds.
    options
        Limits.
    rotation_prior_rad
        A-priori 1 sigma of the rotation, used where no technique observed it; max_rotation / sqrt(3) if None.

    Returns
    -------
    _CombinedEstimate or None
        None when no answer is usable.

    Raises
    ------
    ValueError
        If 2-DoF and 3-DoF answers are mixed.
    """
    sizes = {result.degrees_of_freedom for result in results}
    if len(sizes) > 1:
        raise ValueError("2-DoF and 3-DoF results cannot be fused: one image has one number of parameters")
    usable, excluded = _usable(results)
    if not usable:
        return None
    arm = float(np.hypot(*context.camera_model.shape_vu)) / 2
    turned_rad = _turned(usable, context)
    placed = [_place(result, context, arm, turned_rad) for result in usable]
    clusters = _clusters(placed, options)
    clusters.sort(key=_strength, reverse=True)
    best = clusters[0]
    for other in clusters[1:]:
        excluded += [(p.result.technique, "disagrees") for p in other]
    members = _independent(best)
    excluded += [(p.result.technique, "dependent") for p in best if all(p is not m for m in members)]
    reason = _reason(best, clusters, options)
    return _combine(members, best, tuple(excluded), reason, context, arm, rotation_prior_rad)


def _usable(results: Sequence[TechniqueResult]) -> tuple[list[TechniqueResult], list[tuple[str, str]]]:
    excluded = [(r.technique, "spurious") for r in results if r.spurious]
    excluded += [(r.technique, "uninformative") for r in results if not r.spurious and not r.information.any()]
    sound = [r for r in results if not r.spurious and r.information.any()]
    inside = [r for r in sound if not r.at_edge]
    if inside:
        excluded += [(r.technique, "at_edge") for r in sound if r.at_edge]
    return inside or sound, excluded


def _turned(results: Sequence[TechniqueResult], context: NavContext) -> float:
    """Rotation of the answer that knows it best; where none does, the likeliest one if it decides on the place."""
    turning = [r for r in results if r.degrees_of_freedom == 3]
    seen = [r for r in turning if r.information[2, 2] > 0]
    if seen:
        return max(seen, key=lambda r: float(r.information[2, 2])).rotation_rad
    far = [r for r in turning if _arm_decides(r.pivot_vu, context)]
    return _likely_turn(max(far, key=lambda r: float(np.trace(r.information))), context) if far else 0.0


def _arm_decides(pivot_vu: FloatArray, context: NavContext) -> bool:
    """Whether an unknown rotation about a pivot moves the array's centre by more than the search's margin."""
    arm = float(np.linalg.norm(pivot_vu - context.camera_model.centre_vu))
    return arm * context.max_rotation_rad > float(np.min(context.search_margin_vu))


def _likely_turn(result: TechniqueResult, context: NavContext) -> float:
    """Rotation that leaves the array's centre and itself well within the bounds."""
    centre, bound = context.camera_model.centre_vu, context.max_rotation_rad
    turns = np.linspace(-bound, bound, _TURNS)
    moved = np.array([move_pivot(result.offset_vu, turn, result.pivot_vu, centre)[0] for turn in turns.tolist()])
    cost = ((moved / np.array(context.search_margin_vu)) ** 2).sum(axis=1) + (turns / bound) ** 2
    return float(turns[int(np.argmin(cost))])


def _place(result: TechniqueResult, context: NavContext, arm: float, turned_rad: float) -> _Placed:
    """Move to the array centre, exactly, and measure theta in pixels at ``arm``.

    An answer without a rotation of its own holds at any: it is moved under ``turned_rad``, since over degrees the
    curvature of the arc that the move is linear in comes to pixels.
    """
    centre = context.camera_model.centre_vu
    size = result.degrees_of_freedom
    theta = result.rotation_rad if size == 2 or result.information[2, 2] > 0 else turned_rad
    offset, inverse = move_pivot(result.offset_vu, theta, result.pivot_vu, centre)
    if size == 2:
        return _Placed(result, offset, result.information)
    scale = np.diag([1.0, 1.0, 1.0 / arm])
    back = inverse @ scale
    state = np.append(offset, theta * arm)
    return _Placed(result, state, back.T @ result.information @ back)


def _distance2(a: _Placed, b: _Placed) -> tuple[float, int]:
    """Squared Mahalanobis distance in the subspace both observe, and its dimension.

    The parallel sum A (A + B)^+ B is the information of a difference, and its range is the intersection of theirs.
    """
    shared = a.information @ pinvh(a.information + b.information, rtol=_NULL) @ b.information
    gap = a.state - b.state
    values = np.linalg.eigvalsh((shared + shared.T) / 2)
    rank = int((values > _NULL * max(values.max(), 1e-300)).sum())
    return float(gap @ shared @ gap), rank


def _clusters(placed: list[_Placed], options: EnsembleOptions) -> list[list[_Placed]]:
    """Single-link clusters: two answers are linked when chance alone explains how far apart they are."""
    label = list(range(len(placed)))
    for i in range(len(placed)):
        for j in range(i):
            distance2, rank = _distance2(placed[i], placed[j])
            if rank == 0 or distance2 <= float(chdtri(rank, options.link_chance)):
                old, new = label[i], label[j]
                label = [new if entry == old else entry for entry in label]
    return [[p for p, mine in zip(placed, label, strict=True) if mine == key] for key in dict.fromkeys(label)]


def _independent(cluster: list[_Placed]) -> list[_Placed]:
    """Of members that share an error source, the most informative one."""
    kept: list[_Placed] = []
    for candidate in sorted(cluster, key=_informativeness, reverse=True):
        sources = set(candidate.result.error_sources)
        if not any(sources & set(other.result.error_sources) for other in kept):
            kept.append(candidate)
    return kept


def _informativeness(placed: _Placed) -> tuple[int, int, float]:
    """Observed directions first, then measurements, then the log-determinant over the observed subspace.

    Measurements come before the determinant: among answers from the same pixels, the one with the smallest stated
    sigma is too often the one whose sigma is too small by chance.
    """
    values = np.linalg.eigvalsh(placed.information)
    seen = values[values > _NULL * max(values.max(), 1e-300)]
    return len(seen), placed.result.measurements, float(np.log(seen).sum())


def _strength(cluster: list[_Placed]) -> tuple[float, int, float]:
    """Surest independent witnesses first; ties go to the larger, then the more informative cluster."""
    members = _independent(cluster)
    doubt = sum(-np.log(max(1.0 - m.result.confidence, 1e-12)) for m in members)
    return float(doubt), len(cluster), max(_informativeness(m)[2] for m in members)


def _reason(best: list[_Placed], clusters: list[list[_Placed]], options: EnsembleOptions) -> StatusReason:
    if max(p.result.confidence for p in best) < options.min_confidence:
        return StatusReason.LOW_CONFIDENCE
    if any(_strength(other)[0] >= options.rival_share * _strength(best)[0] for other in clusters if other is not best):
        return StatusReason.TECHNIQUES_DISAGREE
    # Only where nothing else is left do such answers come this far; the rank says what to think of them.
    return StatusReason.NAVIGATED_AT_EDGE if all(p.result.at_edge for p in best) else StatusReason.NAVIGATED


def _combine(
    members: list[_Placed],
    cluster: list[_Placed],
    excluded: tuple[tuple[str, str], ...],
    reason: StatusReason,
    context: NavContext,
    arm: float,
    rotation_prior_rad: float | None,
) -> _CombinedEstimate:
    information = np.sum([m.information for m in members], axis=0)
    pull = np.sum([m.information @ m.state for m in members], axis=0)
    turns = len(information) == 3
    observed = turns and _theta_observed(information)
    if turns and not observed:
        prior = rotation_prior_rad or context.max_rotation_rad / np.sqrt(3.0)
        information = information + np.diag([0.0, 0.0, 1.0 / (prior * arm) ** 2])
    covariance = pinvh(information, rtol=_NULL)
    state = covariance @ pull
    null_vu = _null_direction(information)
    blank = _CombinedEstimate(
        offset_vu=state[:2], rotation_rad=None, covariance=np.full((2, 2), np.nan), fitted_rotation=turns,
        observable_vu=None, along_px=None, sigma_along_px=None, confidence=max(p.result.confidence for p in cluster),
        members=tuple(m.result.technique for m in members), excluded=excluded, reason=reason,
    )  # fmt: skip
    if null_vu is not None:
        return _one_direction(blank, null_vu, state[:2], covariance[:2, :2])
    pivots = [m.result.pivot_vu for m in members]
    if turns and not observed and all(_arm_decides(pivot, context) for pivot in pivots):
        # The turn looks like a shift along an arc about a far pivot, which the margin alone limits.
        vectors = np.linalg.eigh(covariance[:2, :2])[1]
        arm_px = min(float(np.linalg.norm(pivot - context.camera_model.centre_vu)) for pivot in pivots)
        bow = float(np.max(context.search_margin_vu)) ** 2 / 3.0 / arm_px
        lifted = covariance[:2, :2] + np.outer(vectors[:, 0], vectors[:, 0]) * bow**2 / 2.0
        return _one_direction(blank, vectors[:, 1], state[:2], lifted)
    size = 3 if observed else 2
    scale = np.diag([1.0, 1.0, 1.0 / arm])[:size, :size]
    return replace(
        blank, rotation_rad=float(state[2] / arm) if observed else None,
        covariance=scale @ covariance[:size, :size] @ scale,
    )  # fmt: skip


def _one_direction(
    blank: _CombinedEstimate, null_vu: FloatArray, offset_vu: FloatArray, covariance: FloatArray
) -> _CombinedEstimate:
    """Answer along the only direction that is known: the one across the null direction."""
    along = np.array([-null_vu[1], null_vu[0]])
    along = along if along[np.argmax(np.abs(along))] > 0 else -along
    reason = blank.reason
    return replace(
        blank, offset_vu=along * float(along @ offset_vu), observable_vu=along, along_px=float(along @ offset_vu),
        sigma_along_px=float(np.sqrt(along @ covariance @ along)),
        reason=StatusReason.NAVIGATED_ONE_DIRECTION if reason is StatusReason.NAVIGATED else reason,
    )  # fmt: skip


def _theta_observed(information: FloatArray) -> bool:
    """Whether theta is determined once the translation is free: its Schur complement is not zero."""
    translation, cross = information[:2, :2], information[:2, 2]
    left = float(information[2, 2] - cross @ pinvh(translation, rtol=_NULL) @ cross)
    return left > 1e-9 * max(float(information[2, 2]), float(np.trace(translation)), 1e-300)


def _null_direction(information: FloatArray) -> FloatArray | None:
    """Unit (v, u) along which the offset is unknown, None where both directions are known."""
    values, vectors = np.linalg.eigh(information)
    null = vectors[:, values <= _NULL * max(values.max(), 1e-300)]
    if not null.shape[1]:
        return None
    direction = null[:2, int(np.argmax(np.abs(null[:2]).max(axis=0)))]
    return np.asarray(direction / np.linalg.norm(direction))
