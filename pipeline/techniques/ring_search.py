"""Where rings are, to a pixel, and how sure that is: correlations of their light, then rivals tried one by one.

Rotations as in seed 000: samples over the whole bound at the coarse level, five at half that step at the next. An edge
mistaken for its neighbour fits as well locally; what tells them apart is all pixels at once, so neighbouring places are
compared by how much of a sample of the image rings of free brightness leave over.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.frame import Frame
from pipeline.imaging.ncc import Level, make_level, ncc_around, ncc_map, peak_of
from pipeline.options import Options
from pipeline.predict.rings import RingScene
from pipeline.records import FloatArray, Image
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.ring_bands import Lattice, LeftOver, lattice_of, left_over
from pipeline.techniques.ring_fit import RingFit, fit_rings
from pipeline.techniques.ring_solve import PIXEL_VARIANCE

# Side, in pixels of the coarse level, to which an image is reduced.
_COARSE_SIDE, _COARSE_SIDE_TURNED = 256, 128
# Light is compared after means over so many pixels of the level are taken away: what planets and skies do is wider.
_FLATTEN = 25
_CLIP_QUANTILE = 0.997
_SCAN_PX = 12
_PLACES_ELSEWHERE = 16
# Places nearer than this to the best one, in pixels across the edges, are the best one.
_SAME_PX = 0.8
_FEWEST_ROTATIONS = 11
# Steps of a walk over all rotations about a place, at the farthest edge, and the most of them.
_TURN_STEP_PX, _MOST_TURNS = 1.5, 81


class RingSearchOptions(Options):
    """How rings are looked for."""

    candidates: int = Field(6, ge=1, le=50, description="peaks of the correlation that are kept")
    followed: int = Field(3, ge=1, le=20, description="of them, how many are fitted and compared")
    rival_share: float = Field(0.75, gt=0, le=1, description="correlation of a peak worth fitting, over the highest")
    min_correlation: float = Field(0.02, ge=0, lt=1, description="correlation below which nothing was found")
    most_rotations: int = Field(61, ge=11, le=1001, description="most rotations tried at the coarse level")


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


@dataclass(frozen=True)
class _Peak:
    offset_vu: tuple[float, float]
    rotation_rad: float
    correlation: float


def find_rings(
    scene: RingScene,
    frame: Frame,
    variance: Image,
    start: tuple[FloatArray, float] | None,
    context: NavContext,
    options: RingSearchOptions,
) -> RingFix | str:
    """Search, fit the best peaks, and compare what they leave over.

    Parameters
    ----------
    scene
        Edges.
    frame
        Image.
    variance
        (rows, cols) DN^2.
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
    peaks = _peaks(scene, frame, context, options)
    if start is not None:
        # Bodies may have told the place, or may be wrong: it is one more to be compared.
        height = peaks[0].correlation if peaks else 1.0
        peaks = [_Peak((float(start[0][0]), float(start[0][1])), float(start[1]), height), *peaks]
    if not peaks:
        return "the predicted rings have no contrast inside the frame"
    if peaks[0].correlation < options.min_correlation:
        return f"best correlation {peaks[0].correlation:.2f}"
    follow = [p for p in peaks if not p.correlation < options.rival_share * peaks[0].correlation]
    fits: list[tuple[RingFit, _Peak]] = []
    problem = ""
    for peak in follow[: options.followed]:
        # Peaks on one ridge run to the same place.
        if any(_same(fit, peak) for fit, _ in fits):
            continue
        fit = fit_rings(scene, frame, variance, (np.array(peak.offset_vu), peak.rotation_rad), context, False)
        if isinstance(fit, str):
            problem = problem or fit
        else:
            fits.append((fit, peak))
    if not fits:
        return problem
    turned = _turned(scene, frame, variance, fits[0], context)
    if turned is not None:
        fits.append(turned)
    return _judged(scene, frame, variance, fits, context)


def _turned(
    scene: RingScene, frame: Frame, variance: Image, found: tuple[RingFit, _Peak], context: NavContext
) -> tuple[RingFit, _Peak] | None:
    """The best other rotation about where the rings were found: a round planet tells their place, not their turn."""
    fit, peak = found
    bound = context.max_rotation_rad
    if not bound:
        return None
    lattice = lattice_of(frame, variance)
    arm = float(np.sqrt(((fit.units.places_vu - fit.pivot_vu) ** 2).sum(axis=-1)[fit.units.present].max()))
    count = int(np.clip(np.ceil(2.0 * bound * arm / _TURN_STEP_PX), _FEWEST_ROTATIONS, _MOST_TURNS))
    turns = np.linspace(-bound, bound, count)
    poses = [
        compose(context, fit.offset_vu, fit.rotation_rad, fit.pivot_vu, np.array([0.0, 0.0, turn - fit.rotation_rad]))
        for turn in turns.tolist()
    ]
    left = np.array([left_over(scene, lattice, offset, rotation).mean for offset, rotation in poses])
    left[np.abs(turns - fit.rotation_rad) * arm < 2.0 * _TURN_STEP_PX] = np.inf
    offset, rotation = poses[int(np.argmin(left))]
    if not np.isfinite(left).any():
        return None
    other = fit_rings(scene, frame, variance, (offset, rotation), context, False)
    start = _Peak((float(offset[0]), float(offset[1])), rotation, peak.correlation)
    return None if isinstance(other, str) else (other, start)


def _same(fit: RingFit, peak: _Peak) -> bool:
    gap = np.array(peak.offset_vu) - fit.offset_vu
    across = np.sqrt(_mean_square_across(fit, gap))
    return bool(across < 1.5) and abs(peak.rotation_rad - fit.rotation_rad) < 0.01


def _mean_square_across(fit: RingFit, gap_vu: FloatArray) -> float:
    """Mean square over the units of a shift's part across the edges."""
    normal = fit.units.normal_vu[:, 0]
    return float(((normal @ gap_vu) ** 2).mean())


def _factor(shape: tuple[int, ...], context: NavContext) -> int:
    side = _COARSE_SIDE_TURNED if context.fit_camera_rotation else _COARSE_SIDE
    factor = 1
    while max(shape) / factor > side and factor < 8:
        factor *= 2
    return factor


def _flat(level: Level) -> Level:
    """A level without its wide structure and clipped, so that neither a planet nor a bright limb decides."""
    size = (_FLATTEN, _FLATTEN)
    share = cv2.blur(level.weight, size)
    mean = cv2.blur(level.image * level.weight, size) / np.maximum(share, np.float32(1e-6))
    flat = np.where(level.weight > 0, level.image - mean, np.float32(0.0))
    limit = float(np.quantile(np.abs(flat), _CLIP_QUANTILE))
    return Level(level.factor, np.clip(flat, -limit, limit), level.weight)


def _template(
    scene: RingScene, level: Level, surplus: tuple[int, int], offset_vu: FloatArray, rotation_rad: float
) -> Image:
    """Predicted light over a level widened by a surplus, flattened like it."""
    rows, cols = level.image.shape
    factor = level.factor
    first = np.array([(factor - 1) / 2 - factor * surplus[0], (factor - 1) / 2 - factor * surplus[1]])
    shape = (rows + 2 * surplus[0], cols + 2 * surplus[1])
    blur = float(np.sqrt(scene.sigma_px**2 + factor**2 * PIXEL_VARIANCE))
    drawn = scene.draw(scene.pose(offset_vu, rotation_rad), first, float(factor), shape, blur)
    return np.asarray(drawn - cv2.blur(drawn, (_FLATTEN, _FLATTEN)), np.float32)


def _peaks(scene: RingScene, frame: Frame, context: NavContext, options: RingSearchOptions) -> list[_Peak]:
    """Highest peaks over offset and rotation, followed one level down."""
    factor = _factor(frame.raw.shape, context)
    level = _flat(make_level(frame.raw, ~frame.bad, factor))
    bound = context.max_rotation_rad
    count = _rotations(frame.raw.shape, factor, bound, options)
    thetas = np.linspace(-bound, bound, count) if bound else np.zeros(1)
    surplus = tuple(int(np.ceil(margin / factor)) + 1 for margin in context.search_margin_vu)
    maps = np.stack(
        [ncc_map(level, _template(scene, level, (surplus[0], surplus[1]), np.zeros(2), float(t))) for t in thetas]
    )
    best, which = maps.max(axis=0), maps.argmax(axis=0)
    rows, cols = np.nonzero((best >= cv2.dilate(best, np.ones((3, 3)))) & (best > 0.0))
    order = np.argsort(best[rows, cols])[::-1][: options.candidates]
    peaks = [
        _Peak(
            (float((rows[k] - surplus[0]) * factor), float((cols[k] - surplus[1]) * factor)),
            float(thetas[which[rows[k], cols[k]]]), float(best[rows[k], cols[k]]),
        )
        for k in order
    ]  # fmt: skip
    step = 2.0 * bound / max(count - 1, 1)
    if not peaks:
        return []
    for depth in (1, 2):
        if factor == 1 and not bound:
            break
        factor = max(1, factor // 2)
        fine = _flat(make_level(frame.raw, ~frame.bad, factor))
        samples = (5, 3)[depth - 1] if bound else 1
        worth = [p for p in peaks if p.correlation >= options.rival_share * peaks[0].correlation]
        kept = worth[: options.candidates // depth]
        peaks = [_followed(scene, fine, peak, samples, step / 2.0**depth, context) for peak in kept]
        peaks.sort(key=lambda peak: -peak.correlation)
        if not bound:
            break
    return peaks


def _rotations(shape: tuple[int, ...], factor: int, bound: float, options: RingSearchOptions) -> int:
    """The seed's eleven, more where they would move the corners by more than a few coarse pixels."""
    wanted = int(np.ceil(bound * float(np.linalg.norm(shape)) / (4.0 * factor))) + 1
    return int(np.clip(wanted, _FEWEST_ROTATIONS, options.most_rotations)) | 1


def _followed(
    scene: RingScene, level: Level, peak: _Peak, samples: int, step_rad: float, context: NavContext
) -> _Peak:
    """Best place around a peak, at a finer level."""
    best = _Peak(peak.offset_vu, peak.rotation_rad, -1.0)
    bound = context.max_rotation_rad
    reach = 2
    for k in range(samples):
        theta = float(np.clip(peak.rotation_rad + step_rad * (k - samples // 2), -bound, bound))
        template = _template(scene, level, (reach, reach), np.array(peak.offset_vu), theta)
        values = ncc_around(level, template, (0, 0), reach)
        place, height = peak_of(values)
        if height > best.correlation:
            moved = np.array(peak.offset_vu) + place * level.factor
            best = _Peak((float(moved[0]), float(moved[1])), theta, height)
    return best


def _judged(
    scene: RingScene, frame: Frame, variance: Image, fits: list[tuple[RingFit, _Peak]], context: NavContext
) -> RingFix:
    """The fit that leaves least, and how much more its rivals leave."""
    lattice = lattice_of(frame, variance)
    left = [left_over(_corrected(scene, fit), lattice, fit.offset_vu, fit.rotation_rad) for fit, _ in fits]
    order = np.argsort([value.mean for value in left])
    fit, peak = fits[int(order[0])]
    best = left[int(order[0])]
    # Residuals beyond the noise are texture, whose pixels do not err one by one.
    count = best.pixels / max(1.0, best.mean)
    gaps = [
        (0.5 * count * np.log(left[int(k)].mean / best.mean), np.nan)
        for k in order[1:] if not _one_place(fit, fits[int(k)][0])
    ]  # fmt: skip
    true = _corrected(scene, fit)
    gaps += _scan(true, lattice, fit, best, count) + _elsewhere(true, lattice, fit, best, count, context)
    tries = float(np.prod([2.0 * m + 1.0 for m in context.search_margin_vu]))
    gain = 0.5 * count * np.log(best.bare / best.mean)
    doubt = tries * float(np.exp(np.clip(len(scene) + 3.0 - gain, -700.0, 50.0)))
    doubt += sum(float(np.exp(-np.clip(gap, 0.0, 700.0))) for gap, _ in gaps)
    rival = min(gaps, key=lambda entry: entry[0], default=(np.inf, np.nan))
    return RingFix(fit, peak.correlation, 1.0 / (1.0 + doubt), float(rival[0]), float(rival[1]))


def _one_place(a: RingFit, b: RingFit) -> bool:
    return _mean_square_across(a, b.offset_vu - a.offset_vu) < _SAME_PX**2


def _corrected(scene: RingScene, fit: RingFit) -> RingScene:
    """Edges with the radii that a fit has found: an error of the catalogue must not look like a wrong place."""
    shift = fit.radius_km[scene.feature] + fit.edge_km
    return replace(scene, curves=scene.curves + shift[:, None])


def _scan(
    scene: RingScene, lattice: Lattice, fit: RingFit, best: LeftOver, count: float
) -> list[tuple[float, float]]:
    """Log-likelihood gaps and shifts of the dips on a walk across the edges."""
    values, vectors = np.linalg.eigh(fit.information[:2, :2])
    across = vectors[:, int(np.argmax(values))]
    shifts = np.arange(-_SCAN_PX, _SCAN_PX + 1).astype(float)
    left = np.array([left_over(scene, lattice, fit.offset_vu + s * across, fit.rotation_rad).mean for s in shifts])
    middle: NDArray[np.int64] = np.arange(1, len(shifts) - 1)
    dips = middle[(left[1:-1] < left[:-2]) & (left[1:-1] <= left[2:]) & (np.abs(shifts[1:-1]) > 1.0)]
    return [(0.5 * count * float(np.log(max(left[k] / best.mean, 1e-12))), float(shifts[k])) for k in dips]


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
        result.append((0.5 * count * float(np.log(max(left.mean / best.mean, 1e-12))), float(shift)))
    return result
