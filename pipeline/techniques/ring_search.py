"""Where rings are, and how sure that is: peaks of correlations are ranked, fitted, and rivals tried one by one.

An edge mistaken for its neighbour fits as well locally; what tells them apart is all pixels at once, so places are
compared by how much of a sample of the image rings of free brightness leave over.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.predict.rings import RingScene
from pipeline.records import FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.ring_bands import LeftOver, left_over
from pipeline.techniques.ring_fit import RingFit, fit_rings
from pipeline.techniques.ring_image import Lattice, RingImage
from pipeline.techniques.ring_peaks import Peak, RingSearchOptions, find_peaks

# Error of a peak's place, in pixels, that a comparison of peaks forgives.
_PEAK_PX = 1.0
# A peak that leaves over so many times as much as the best one is not fitted.
_HOPELESS = 8.0
_SCAN_PX = 12
_PLACES_ELSEWHERE = 16
# Places nearer than this to the best one, in pixels across the edges, are the best one.
_SAME_PX = 0.8
# Pixels that are enough to find and compare places.
_SEARCH_PIXELS = 60_000
# Steps of a walk over all rotations about a place, at the farthest edge, and the most of them.
_TURN_STEP_PX, _FEWEST_TURNS, _MOST_TURNS = 1.5, 11, 81


@dataclass(frozen=True, eq=False)
class RingFix:
    """Where the rings are.

    Attributes
    ----------
    fit
        Of the edges, free brightness.
    correlation
        At the peak that was followed.
    confidence
        Probability that it is no rival and no accident.
    rival_gap
        Log-likelihood by which the best rival is worse; infinite without one.
    rival_shift_px
        Where that is, across the edges.
    """

    fit: RingFit
    correlation: float
    confidence: float
    rival_gap: float
    rival_shift_px: float


def find_rings(
    scene: RingScene, image: RingImage, start: tuple[FloatArray, float] | None, context: NavContext,
    options: RingSearchOptions,
) -> RingFix | str:  # fmt: skip
    """Search, fit the best peaks, and compare what they leave over.

    Parameters
    ----------
    scene
        Edges.
    image
        Light and noise.
    start
        Offset at the array centre and rotation where bodies have told them, else None.
    context
        Bounds.
    options
        Limits.

    Returns
    -------
    RingFix or str
        Or in one line why there is none.
    """
    peaks = find_peaks(scene, image.frame, context, options)
    if start is not None:
        # Bodies may have told the place, or may be wrong: it is one more to be compared.
        height = peaks[0].correlation if peaks else 1.0
        peaks = [Peak((float(start[0][0]), float(start[0][1])), float(start[1]), height), *peaks]
    if not peaks:
        return "the predicted rings have no contrast inside the frame"
    highest = max(peak.correlation for peak in peaks)
    if highest < options.min_correlation:
        return f"best correlation {highest:.2f}"
    fits: list[tuple[RingFit, Peak]] = []
    lost: list[Peak] = []
    problem = ""
    for peak in _ranked(scene, image.lattice, peaks)[: options.followed]:
        # Peaks on one ridge run to the same place.
        if any(_same(fit, peak) for fit, _ in fits):
            continue
        start_here = (np.array(peak.offset_vu), peak.rotation_rad)
        fit = fit_rings(scene, image, start_here, context, False, _SEARCH_PIXELS)
        if isinstance(fit, str):
            problem = problem or fit
            lost.append(peak)
        else:
            fits.append((fit, peak))
    if not fits:
        return problem
    turned = _turned(scene, image, fits[0], context)
    if turned is not None:
        fits.append(turned)
    fix = _judged(scene, image, fits, lost, context)
    return replace(fix, fit=_refined(scene, image, fix.fit, context))


def _refined(scene: RingScene, image: RingImage, fit: RingFit, context: NavContext) -> RingFit:
    """The fit with as many pixels as its noise asks for, unless that leads elsewhere."""
    wanted = image.enough_pixels
    if fit.stride == 1 or wanted <= _SEARCH_PIXELS:
        return fit
    finer = fit_rings(scene, image, fit, context, False, wanted)
    return finer if isinstance(finer, RingFit) and _one_place(fit, finer) else fit


def _ranked(scene: RingScene, lattice: Lattice, peaks: list[Peak]) -> list[Peak]:
    """By what rings of free brightness leave over there, least first; those that leave by far more are dropped."""
    if len(peaks) == 1:
        return peaks
    left = [
        left_over(scene, lattice, np.array(peak.offset_vu), peak.rotation_rad, _PEAK_PX).mean for peak in peaks
    ]
    return [peaks[k] for k in np.argsort(left, kind="stable") if left[k] <= _HOPELESS * min(left)]


def _turned(
    scene: RingScene, image: RingImage, found: tuple[RingFit, Peak], context: NavContext
) -> tuple[RingFit, Peak] | None:
    """The best other rotation about where the rings were found: a round planet tells their place, not their turn."""
    fit, peak = found
    bound = context.max_rotation_rad
    if not bound:
        return None
    arm = float(np.sqrt(((fit.units.places_vu - fit.pivot_vu) ** 2).sum(axis=-1)[fit.units.present].max()))
    count = int(np.clip(np.ceil(2.0 * bound * arm / _TURN_STEP_PX), _FEWEST_TURNS, _MOST_TURNS))
    turns = np.linspace(-bound, bound, count)
    poses = [
        compose(context, fit.offset_vu, fit.rotation_rad, fit.pivot_vu, np.array([0.0, 0.0, turn - fit.rotation_rad]))
        for turn in turns.tolist()
    ]
    left = np.array([left_over(scene, image.lattice, offset, rotation).mean for offset, rotation in poses])
    left[np.abs(turns - fit.rotation_rad) * arm < 2.0 * _TURN_STEP_PX] = np.inf
    offset, rotation = poses[int(np.argmin(left))]
    if not np.isfinite(left).any():
        return None
    other = fit_rings(scene, image, (offset, rotation), context, False, _SEARCH_PIXELS)
    start = Peak((float(offset[0]), float(offset[1])), rotation, peak.correlation)
    return None if isinstance(other, str) else (other, start)


def _same(fit: RingFit, peak: Peak) -> bool:
    gap = np.array(peak.offset_vu) - fit.offset_vu
    across = np.sqrt(_mean_square_across(fit, gap))
    return bool(across < 1.5) and abs(peak.rotation_rad - fit.rotation_rad) < 0.01


def _mean_square_across(fit: RingFit, gap_vu: FloatArray) -> float:
    """Mean square over the units of a shift's part across the edges."""
    normal = fit.units.normal_vu[:, 0]
    return float(((normal @ gap_vu) ** 2).mean())


def _judged(
    scene: RingScene, image: RingImage, fits: list[tuple[RingFit, Peak]], lost: list[Peak],
    context: NavContext,
) -> RingFix:  # fmt: skip
    """The fit that leaves least, and how much more its rivals leave: other fits, and peaks without one."""
    lattice = image.lattice
    seen = [_as_seen(scene, lattice, fit) for fit, _ in fits]
    left = [value for _, value in seen]
    order = np.argsort([value.mean for value in left])
    fit, peak = fits[int(order[0])]
    true, best = seen[int(order[0])]
    # Residuals beyond the noise are texture, whose pixels do not err one by one.
    count = best.pixels / max(1.0, best.mean)
    gaps = [
        (_gap(left[int(k)], best, count), np.nan)
        for k in order[1:] if not _one_place(fit, fits[int(k)][0])
    ]  # fmt: skip
    gaps += [
        (_gap(left_over(scene, lattice, np.array(rival.offset_vu), rival.rotation_rad), best, count), np.nan)
        for rival in lost if not _same(fit, rival)
    ]  # fmt: skip
    gaps += _scan(true, lattice, fit, best, count) + _elsewhere(true, lattice, fit, best, count, context)
    tries = float(np.prod([2.0 * m + 1.0 for m in context.search_margin_vu]))
    gain = 0.5 * count * np.log(best.bare / best.mean)
    doubt = tries * float(np.exp(np.clip(len(scene) + 3.0 - gain, -700.0, 50.0)))
    doubt += sum(float(np.exp(-np.clip(gap, 0.0, 700.0))) for gap, _ in gaps)
    rival = min(gaps, key=lambda entry: entry[0], default=(np.inf, np.nan))
    return RingFix(fit, peak.correlation, 1.0 / (1.0 + doubt), float(rival[0]), float(rival[1]))


def _gap(left: LeftOver, best: LeftOver, count: float) -> float:
    """Log-likelihood by which a place is worse than the best one."""
    return 0.5 * count * float(np.log(max(left.mean / best.mean, 1e-12)))


def _one_place(a: RingFit, b: RingFit) -> bool:
    return _mean_square_across(a, b.offset_vu - a.offset_vu) < _SAME_PX**2


def _as_seen(scene: RingScene, lattice: Lattice, fit: RingFit) -> tuple[RingScene, LeftOver]:
    """Edges with the radii that a fit has found, and what they leave; as predicted where that leaves less.

    An error of the catalogue must not look like a wrong place, nor an edge that went astray.
    """
    shift = fit.radius_km[scene.feature] + fit.edge_km
    scenes = (replace(scene, curves=scene.curves + shift[:, None]), scene)
    left = [left_over(one, lattice, fit.offset_vu, fit.rotation_rad) for one in scenes]
    best = int(np.argmin([value.mean for value in left]))
    return scenes[best], left[best]


def _scan(
    scene: RingScene, lattice: Lattice, fit: RingFit, best: LeftOver, count: float
) -> list[tuple[float, float]]:
    """Log-likelihood gaps and shifts of the dips on a walk across the edges."""
    values, vectors = np.linalg.eigh(fit.information[:2, :2])
    across = vectors[:, int(np.argmax(values))]
    shifts = np.arange(-_SCAN_PX, _SCAN_PX + 1).astype(float)
    left = [left_over(scene, lattice, fit.offset_vu + s * across, fit.rotation_rad) for s in shifts]
    mean = np.array([value.mean for value in left])
    middle: NDArray[np.int64] = np.arange(1, len(shifts) - 1)
    dips = middle[(mean[1:-1] < mean[:-2]) & (mean[1:-1] <= mean[2:]) & (np.abs(shifts[1:-1]) > 1.0)]
    return [(_gap(left[k], best, count), float(shifts[k])) for k in dips]


def _elsewhere(
    scene: RingScene, lattice: Lattice, fit: RingFit, best: LeftOver, count: float, context: NavContext
) -> list[tuple[float, float]]:
    """Gaps and shifts of places all over the margin, across the edges: what any place explains of a textured image."""
    values, vectors = np.linalg.eigh(fit.information[:2, :2])
    across = vectors[:, int(np.argmax(values))]
    reach = float(np.min(np.asarray(context.search_margin_vu) / np.maximum(np.abs(across), 1e-9)))
    middle = float(across @ fit.offset_vu)
    shifts = np.linspace(-reach, reach, _PLACES_ELSEWHERE) - middle
    result = []
    for shift in shifts[np.abs(shifts) > _SCAN_PX]:
        left = left_over(scene, lattice, fit.offset_vu + shift * across, fit.rotation_rad)
        result.append((_gap(left, best, count), float(shift)))
    return result
