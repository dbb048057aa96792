"""Where bodies are, to a pixel: a pyramid of masked correlations over the margin and the bound of the rotation.

Schedule of rotations as in seed 000: eleven samples over the whole bound at the coarsest level, five at half that step,
three at a quarter, then the winner. A small body needs few levels: at none is it smaller than a few pixels.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.geometry.pointing import move_pivot
from pipeline.imaging.ncc import Level, highest_peaks, make_level, ncc_around, ncc_map, peak_of, reduce
from pipeline.imaging.render import Window
from pipeline.options import Options
from pipeline.predict.bodies import BodyScene
from pipeline.records import FloatArray, Image
from pipeline.techniques.base import NavContext

ROTATION_SAMPLES = (11, 5, 3, 1)
_FACTORS = (8, 4, 2, 1)
# A rival nearer than this share of the body is the same peak.
_SAME_PEAK = 0.25
_SKY_PX = 10


class BodySearchOptions(Options):
    """How bodies are looked for."""

    least_level_px: float = Field(5.0, ge=2, le=64, description="size of the largest body at the coarsest level")
    candidates: int = Field(5, ge=1, le=50, description="peaks followed from the coarsest level down")
    min_correlation: float = Field(0.05, ge=0, lt=1, description="correlation below which nothing was found")
    most_rotations: int = Field(61, ge=11, le=1001, description="most rotations tried at the coarsest level")


@dataclass(frozen=True)
class Peak:
    """A place where the predicted image fits.

    Attributes
    ----------
    offset_vu, rotation_rad
        About the scene's pivot.
    correlation
        At the finest level to which it was followed.
    compared
        At the level down to which all candidates were followed.
    """

    offset_vu: tuple[float, float]
    rotation_rad: float
    correlation: float
    compared: float


@dataclass(frozen=True)
class Acquisition:
    """Answer of the search.

    Attributes
    ----------
    offset_vu, rotation_rad
        At the array centre.
    correlation
        Of the best peak.
    confidence
        Probability that it is no rival and no accident.
    rival
        Correlation of the next best place, -1 where there is none.
    """

    offset_vu: FloatArray
    rotation_rad: float
    correlation: float
    confidence: float
    rival: float


@dataclass(frozen=True, eq=False)
class _Pyramid:
    """Image region and the template that covers it under every offset."""

    region: Window
    surplus: tuple[int, int]
    image: Image
    good: np.ndarray
    template: Image
    pivot: FloatArray
    factors: tuple[int, ...]
    rotations: int

    def level(self, factor: int) -> Level:
        return make_level(self.image, self.good, factor)

    def turned(self, factor: int, theta: float) -> Image:
        """Template at a level, turned about the scene's pivot."""
        template = reduce(self.template, factor)
        if theta == 0.0:
            return template
        # Centre of the pivot in this level's pixels, as OpenCV's (x, y).
        v, u = (self.pivot + 0.5) / factor - 0.5
        c, s = np.cos(theta), np.sin(theta)
        # +u turns toward +v: (u, v) -> (c u - s v, s u + c v).
        forward = np.array([[c, -s, u - c * u + s * v], [s, c, v - s * u - c * v]])
        size = (template.shape[1], template.shape[0])
        return np.asarray(cv2.warpAffine(template, forward, size, borderMode=cv2.BORDER_REPLICATE), np.float32)


def find_bodies(
    scene: BodyScene, frame: Frame, context: NavContext, options: BodySearchOptions
) -> Acquisition | str:
    """Search for the predicted image of all bodies.

    Parameters
    ----------
    scene
        Bodies.
    frame
        Image.
    context
        Bounds.
    options
        Limits.

    Returns
    -------
    Acquisition or str
        Or, in one line, why nothing was found.
    """
    pyramid = _prepare(scene, frame, context, options)
    if pyramid is None:
        return "no body can be inside the frame"
    peaks = _coarsest(pyramid, context, options)
    if not peaks:
        return "the predicted image has no contrast"
    for depth, factor in enumerate(pyramid.factors[1:], start=1):
        # At full size only the winner is followed; rivals are compared with it at the level above.
        follow = peaks if factor > 1 else peaks[:1]
        keep = options.candidates if factor >= 4 else 3
        followed = [_follow(peak, pyramid, factor, depth, context) for peak in follow]
        peaks = sorted(followed, key=_height, reverse=True)[:keep] if factor > 1 else [*followed, *peaks[1:]]
    if peaks[0].correlation < options.min_correlation:
        return f"best correlation {peaks[0].correlation:.2f}"
    return _judge(peaks, pyramid, scene, context)


def _height(peak: Peak) -> float:
    return peak.correlation


def _prepare(scene: BodyScene, frame: Frame, context: NavContext, options: BodySearchOptions) -> _Pyramid | None:
    rows, cols = frame.raw.shape
    array = Window(0, 0, rows, cols)
    reach = _reach(scene, context)
    grown = scene.around(scene.views, scene.canvas, _SKY_PX).grown(*reach)
    region = grown.intersection(array)
    if min(region.rows, region.cols) < 8:
        return None
    largest = max(np.sqrt(view.diameter_px * max(view.lit_px, 1.0)) for view in scene.views)
    smallest_side = min(region.rows, region.cols)
    factors = tuple(
        f for f in _FACTORS if f == 1 or (largest / f >= options.least_level_px and smallest_side / f >= 16)
    )
    surplus = tuple(-(-n // factors[0]) * factors[0] for n in reach)
    window = region.grown(surplus[0], surplus[1])
    template = scene.render_coarse(window)
    rows_in, cols_in = region.slices_in(array)
    pivot = scene.pivot_vu - [window.v0, window.u0]
    return _Pyramid(
        region, (surplus[0], surplus[1]), frame.raw[rows_in, cols_in], ~frame.bad[rows_in, cols_in], template, pivot,
        factors, _rotations(scene, context, largest, options),
    )  # fmt: skip


def _rotations(scene: BodyScene, context: NavContext, size_px: float, options: BodySearchOptions) -> int:
    """Rotations at the coarsest level: the seed's eleven, more where they would jump bodies by over half their size."""
    bound = context.max_rotation_rad
    if not bound:
        return 1
    arm = max(float(np.hypot(*(view.centre_vu - scene.pivot_vu))) for view in scene.views)
    wanted = int(np.ceil(2.0 * bound * arm / max(0.5 * size_px, 2.0))) + 1
    return int(np.clip(wanted, ROTATION_SAMPLES[0], options.most_rotations)) | 1


def _reach(scene: BodyScene, context: NavContext) -> tuple[int, int]:
    """Largest offset about the scene's pivot: the margin, and what a turn about the array centre adds there."""
    arm = np.abs(scene.pivot_vu - context.camera_model.centre_vu)
    turn = context.max_rotation_rad
    margin_v, margin_u = context.search_margin_vu
    reach_v, reach_u = int(np.ceil(margin_v + turn * arm[1])), int(np.ceil(margin_u + turn * arm[0]))
    return min(reach_v, scene.reach_vu[0]), min(reach_u, scene.reach_vu[1])


def _coarsest(pyramid: _Pyramid, context: NavContext, options: BodySearchOptions) -> list[Peak]:
    """Peaks of the maps at the coarsest level, highest first."""
    factor = pyramid.factors[0]
    level = pyramid.level(factor)
    bound = context.max_rotation_rad
    thetas = np.linspace(-bound, bound, pyramid.rotations) if bound else np.zeros(1)
    maps = [ncc_map(level, pyramid.turned(factor, float(theta))) for theta in thetas]
    return [
        Peak(
            (float(found.shift[0] * factor), float(found.shift[1] * factor)), float(thetas[found.layer]),
            found.height, found.height,
        )
        for found in highest_peaks(maps, options.candidates, -1.0)
    ]  # fmt: skip


def _follow(peak: Peak, pyramid: _Pyramid, factor: int, depth: int, context: NavContext) -> Peak:
    """Best place and rotation around a peak of the level above."""
    level = pyramid.level(factor)
    bound = context.max_rotation_rad
    samples = ROTATION_SAMPLES[min(depth, len(ROTATION_SAMPLES) - 1)] if bound else 1
    step = 2.0 * bound / max(pyramid.rotations - 1, 1) / 2.0**depth
    thetas = peak.rotation_rad + step * (np.arange(samples) - samples // 2)
    start = (round(peak.offset_vu[0] / factor), round(peak.offset_vu[1] / factor))
    best = peak
    found = -2.0
    for theta in np.clip(thetas, -bound, bound):
        template = pyramid.turned(factor, float(theta))
        values = ncc_around(level, template, start, 1)
        middle = np.unravel_index(int(np.argmax(values)), values.shape)
        here = (start[0] + int(middle[0]) - 1, start[1] + int(middle[1]) - 1)
        if here != start:
            values = ncc_around(level, template, here, 1)
        place, height = peak_of(values)
        if height > found:
            found = height
            offset = ((here[0] + place[0]) * factor, (here[1] + place[1]) * factor)
            compared = peak.compared if factor == 1 else height
            best = Peak((float(offset[0]), float(offset[1])), float(theta), height, compared)
    return best


def _judge(peaks: list[Peak], pyramid: _Pyramid, scene: BodyScene, context: NavContext) -> Acquisition:
    """Turn correlations into a probability: pixels whose errors are alike count once."""
    best = peaks[0]
    factor = pyramid.factors[-2] if len(pyramid.factors) > 1 else 1
    level = pyramid.level(factor)
    count = _independent(best, level, pyramid, factor)
    dark = {fate.name for fate in scene.fates if fate.reason}
    sizes = [view.diameter_px for view in scene.views if view.body.name not in dark]
    apart = _SAME_PEAK * max(sizes, default=0.0)
    rivals = [p for p in peaks[1:] if np.hypot(*np.subtract(p.offset_vu, best.offset_vu)) > max(apart, 2.0 * factor)]
    fit = _log_misfit(best.compared)
    # A limb is as sharp as the point spread, so nearly every pixel of the margin is a try of its own.
    tries = float(np.prod([2 * n + 1 for n in pyramid.surplus]))
    # Three parameters were fitted; a place is as good as its likelihood over that of all others.
    doubt = max(tries, 1.0) * np.exp(np.clip(count / 2.0 * fit + 3.0, -700.0, 50.0))
    doubt += sum(np.exp(np.clip(count / 2.0 * (fit - _log_misfit(p.compared)), -700.0, 0.0)) for p in rivals)
    centre = context.camera_model.centre_vu
    offset = move_pivot(np.array(best.offset_vu), best.rotation_rad, scene.pivot_vu, centre)[0]
    rival = max((p.compared for p in rivals), default=-1.0)
    return Acquisition(offset, best.rotation_rad, best.correlation, float(1.0 / (1.0 + doubt)), rival)


def _log_misfit(correlation: float) -> float:
    """Logarithm of the share of variance that is left."""
    return float(np.log(max(1.0 - max(correlation, 0.0) ** 2, 1e-12)))


def _independent(peak: Peak, level: Level, pyramid: _Pyramid, factor: int) -> float:
    """Number of pixels of a level whose residuals tell something new."""
    rows, cols = level.image.shape
    template = pyramid.turned(factor, peak.rotation_rad)
    mv, mu = (template.shape[0] - rows) // 2, (template.shape[1] - cols) // 2
    top = int(np.clip(mv - round(peak.offset_vu[0] / factor), 0, 2 * mv))
    left = int(np.clip(mu - round(peak.offset_vu[1] / factor), 0, 2 * mu))
    part = template[top : top + rows, left : left + cols]
    good = level.weight > 0.5
    if good.sum() < 16:
        return 1.0
    slope, level_dn = np.polyfit(part[good].astype(float), level.image[good].astype(float), 1)
    residual = np.where(good, level.image - slope * part - level_dn, 0.0)
    power = float((residual**2).mean())
    if power <= 0:
        return float(good.sum())
    area = 1.0
    for lag in range(1, min(rows, cols) // 2):
        along = float((residual[lag:] * residual[:-lag]).mean() + (residual[:, lag:] * residual[:, :-lag]).mean())
        if along <= 0.1 * power:
            break
        # Errors that are alike over a lag are alike over a square of it.
        area += 4.0 * lag * along / power
    return float(good.sum() / area)
