"""Places and rotations at which rings may be: peaks of two correlations over the margin, followed to a finer level.

The predicted light tells most where its brightness is right, the directions of edges where it is not (unlit sides,
dust, crowded rings). Rotations as in seed 000: samples over the whole bound at the coarse level, five at half that step
at the next.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.imaging.directions import Directions, direction_around, direction_map, directions_of, drawn_directions
from pipeline.imaging.ncc import Level, highest_peaks, make_level, ncc_around, ncc_map, peak_of
from pipeline.options import Options
from pipeline.predict.rings import RingScene
from pipeline.records import FloatArray, Image
from pipeline.techniques.base import NavContext
from pipeline.techniques.ring_unknowns import PIXEL_VARIANCE

# Side, in pixels of the coarse level, to which an image is reduced.
_COARSE_SIDE, _COARSE_SIDE_TURNED = 256, 128
# Light is compared after means over so many pixels of the level are taken away: what planets and skies do is wider.
_FLATTEN = 25
_CLIP_QUANTILE = 0.997
_FEWEST_ROTATIONS = 11
# Shifts, in pixels of the finer level, over which a peak is followed.
_REACH = 2


class RingSearchOptions(Options):
    """How rings are looked for."""

    candidates: int = Field(6, ge=1, le=50, description="peaks of each correlation that are kept")
    followed: int = Field(5, ge=1, le=50, description="of them, how many are compared by what they leave over")
    rival_share: float = Field(0.75, gt=0, le=1, description="correlation of a peak worth following, over the highest")
    min_correlation: float = Field(0.02, ge=0, lt=1, description="correlation below which nothing was found")
    most_rotations: int = Field(61, ge=11, le=1001, description="most rotations tried at the coarse level")


@dataclass(frozen=True)
class Peak:
    """Where rings may be.

    Attributes
    ----------
    offset_vu, rotation_rad
        At the array centre, pixels; radians.
    correlation
        Height.
    """

    offset_vu: tuple[float, float]
    rotation_rad: float
    correlation: float


@dataclass(frozen=True, eq=False)
class _Light:
    """Light of a level against the predicted one."""

    level: Level
    scene: RingScene

    @property
    def factor(self) -> int:
        return self.level.factor

    def over_margin(self, surplus: tuple[int, int], rotation_rad: float) -> FloatArray:
        drawn = _drawn(self.scene, self.level, surplus, np.zeros(2), rotation_rad)
        return ncc_map(self.level, _without_wide(drawn))

    def around(self, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
        drawn = _drawn(self.scene, self.level, (_REACH, _REACH), offset_vu, rotation_rad)
        return ncc_around(self.level, _without_wide(drawn), (0, 0), _REACH)


@dataclass(frozen=True, eq=False)
class _Edges:
    """Directions of a level's edges against those of all predicted ones, whatever their contrasts."""

    level: Level
    scene: RingScene
    seen: Directions

    @property
    def factor(self) -> int:
        return self.level.factor

    def over_margin(self, surplus: tuple[int, int], rotation_rad: float) -> FloatArray:
        drawn = _drawn(self.scene, self.level, surplus, np.zeros(2), rotation_rad)
        return direction_map(self.seen, drawn_directions(drawn))

    def around(self, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
        drawn = _drawn(self.scene, self.level, (_REACH, _REACH), offset_vu, rotation_rad)
        return direction_around(self.seen, drawn_directions(drawn), _REACH)


_Sight = _Light | _Edges


def find_peaks(scene: RingScene, frame: Frame, context: NavContext, options: RingSearchOptions) -> list[Peak]:
    """Highest peaks over offset and rotation.

    Parameters
    ----------
    scene
        Edges.
    frame
        Image.
    context
        Bounds.
    options
        Limits.

    Returns
    -------
    list of Peak
        Those of the light, highest first, then those of the directions that are elsewhere.
    """
    coarse = _factor(frame.raw.shape, context)
    levels = {factor: make_level(frame.raw, ~frame.bad, factor) for factor in _factors(coarse, context)}
    light: dict[int, _Sight] = {factor: _Light(_flat(level), scene) for factor, level in levels.items()}
    rising = replace(scene, contrasts=np.ones(len(scene)))
    edges: dict[int, _Sight] = {factor: _Edges(level, rising, directions_of(level)) for factor, level in levels.items()}
    thetas = _rotations(frame.raw.shape, coarse, context.max_rotation_rad, options)
    step = float(thetas[1] - thetas[0]) if len(thetas) > 1 else 0.0
    first = _coarse_peaks(light[coarse], thetas, context, options)
    other = [
        peak for peak in _worth(_coarse_peaks(edges[coarse], thetas, context, options), options)
        if not any(_same(peak, known, coarse, step) for known in first)
    ]  # fmt: skip
    return [
        peak for sights, peaks in ((light, first), (edges, other))
        for peak in _followed_down(sights, peaks, coarse, step, context, options)
    ]  # fmt: skip


def _same(a: Peak, b: Peak, factor: int, step_rad: float) -> bool:
    """Whether following both would lead to one place."""
    gap = np.subtract(a.offset_vu, b.offset_vu)
    return bool((np.abs(gap) <= factor).all()) and abs(a.rotation_rad - b.rotation_rad) <= step_rad / 2.0


def _factor(shape: tuple[int, ...], context: NavContext) -> int:
    side = _COARSE_SIDE_TURNED if context.fit_camera_rotation else _COARSE_SIDE
    factor = 1
    while max(shape) / factor > side and factor < 8:
        factor *= 2
    return factor


def _factors(coarse: int, context: NavContext) -> list[int]:
    """The coarse level, and those that peaks are followed to: two where rotations are to be told, too."""
    return sorted({coarse, max(1, coarse // 2)} | ({max(1, coarse // 4)} if context.max_rotation_rad else set()))


def _flat(level: Level) -> Level:
    """A level without its wide structure and clipped, so that neither a planet nor a bright limb decides."""
    size = (_FLATTEN, _FLATTEN)
    share = cv2.blur(level.weight, size)
    mean = cv2.blur(level.image * level.weight, size) / np.maximum(share, np.float32(1e-6))
    flat = np.where(level.weight > 0, level.image - mean, np.float32(0.0))
    limit = float(np.quantile(np.abs(flat), _CLIP_QUANTILE))
    return Level(level.factor, np.clip(flat, -limit, limit), level.weight)


def _without_wide(drawn: Image) -> Image:
    return np.asarray(drawn - cv2.blur(drawn, (_FLATTEN, _FLATTEN)), np.float32)


def _drawn(
    scene: RingScene, level: Level, surplus: tuple[int, int], offset_vu: FloatArray, rotation_rad: float
) -> Image:
    """Predicted light over a level widened by a surplus."""
    rows, cols = level.image.shape
    factor = level.factor
    first = np.array([(factor - 1) / 2 - factor * surplus[0], (factor - 1) / 2 - factor * surplus[1]])
    shape = (rows + 2 * surplus[0], cols + 2 * surplus[1])
    blur = float(np.sqrt(scene.sigma_px**2 + factor**2 * PIXEL_VARIANCE))
    return scene.draw(scene.pose(offset_vu, rotation_rad), first, float(factor), shape, blur)


def _followed_down(
    sights: Mapping[int, _Sight], peaks: list[Peak], factor: int, step_rad: float, context: NavContext,
    options: RingSearchOptions,
) -> list[Peak]:  # fmt: skip
    """Peaks at the finest level, highest first."""
    turns = step_rad > 0.0
    for depth in (1, 2) if turns else (1,):
        if not peaks or (factor == 1 and not turns):
            break
        factor = max(1, factor // 2)
        samples = (5, 3)[depth - 1] if turns else 1
        kept = _worth(peaks, options)[: max(1, options.candidates // depth)]
        peaks = [_followed(sights[factor], peak, samples, step_rad / 2.0**depth, context) for peak in kept]
        peaks.sort(key=lambda peak: -peak.correlation)
    return _worth(peaks, options)


def _worth(peaks: list[Peak], options: RingSearchOptions) -> list[Peak]:
    return [peak for peak in peaks if not peak.correlation < options.rival_share * peaks[0].correlation]


def _coarse_peaks(
    sight: _Sight, thetas: FloatArray, context: NavContext, options: RingSearchOptions
) -> list[Peak]:
    factor = sight.factor
    surplus = tuple(int(np.ceil(margin / factor)) + 1 for margin in context.search_margin_vu)
    maps = [sight.over_margin((surplus[0], surplus[1]), float(theta)) for theta in thetas]
    return [
        Peak(
            (float(found.shift[0] * factor), float(found.shift[1] * factor)), float(thetas[found.layer]), found.height
        )
        for found in highest_peaks(maps, options.candidates, 0.0)
    ]  # fmt: skip


def _rotations(shape: tuple[int, ...], factor: int, bound: float, options: RingSearchOptions) -> FloatArray:
    """The seed's eleven, more where they would move the corners by more than a few coarse pixels; none without."""
    if not bound:
        return np.zeros(1)
    wanted = int(np.ceil(bound * float(np.linalg.norm(shape)) / (4.0 * factor))) + 1
    count = int(np.clip(wanted, _FEWEST_ROTATIONS, options.most_rotations)) | 1
    return np.linspace(-bound, bound, count)


def _followed(sight: _Sight, peak: Peak, samples: int, step_rad: float, context: NavContext) -> Peak:
    """Best place around a peak, at a finer level."""
    best = Peak(peak.offset_vu, peak.rotation_rad, -1.0)
    bound = context.max_rotation_rad
    for k in range(samples):
        theta = float(np.clip(peak.rotation_rad + step_rad * (k - samples // 2), -bound, bound))
        place, height = peak_of(sight.around(np.array(peak.offset_vu), theta))
        if height > best.correlation:
            moved = np.array(peak.offset_vu) + place * sight.factor
            best = Peak((float(moved[0]), float(moved[1])), theta, height)
    return best
