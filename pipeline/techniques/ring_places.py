"""Places of rings: peaks of correlations, moved to where rings of free brightness leave least of the image over.

All pixels together tell a place even where single edges are lost in noise, crowded, or nearly edge-on.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pipeline.predict.rings import RingScene
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.ring_bands import LeftOver, left_over
from pipeline.techniques.ring_fit import RingFit
from pipeline.techniques.ring_image import Lattice, RingImage
from pipeline.techniques.ring_peaks import Peak

# Error of a peak's place, in pixels, that a comparison of peaks forgives.
_PEAK_PX = 1.0
# A peak whose rivals all leave over so many times as much needs no comparison.
_HOPELESS = 8.0
# Stages of the descent: wider blur that shows the way from afar, and first steps, both in pixels; most trials.
_STAGES = ((3.0, 4.0), (1.0, 1.5), (0.0, 0.5))
_TRIALS = {2: 40, 3: 120}
# Share of the pixels in sight that a place may lose to bodies without a penalty; pixels per one of the coarser lattice.
_SEEN, _COARSER = 0.8, 4.0
# Pixels that count at most where places are compared, of the lattice's 16 000.
_MOST_TELLING = 4_000.0
# Change of log-likelihood that ends a descent.
_SETTLED_GAIN = 0.2
# Log-likelihood by which a place is so much worse than another that no fit brings it back.
BEYOND_HOPE = 25.0
# How far beyond the margin a place is followed, and the logarithm of what is left over farther out.
_BEYOND_MARGIN_PX, _OUTSIDE = 2.0, 50.0
# Places nearer to each other than this, in pixels at the image's centre and border, are one.
_SAME_PX = 1.0
# Steps of a walk over all rotations about a place, at the farthest edge, and the most of them.
_TURN_STEP_PX, _FEWEST_TURNS, _MOST_TURNS = 1.5, 11, 81


@dataclass(frozen=True)
class Place:
    """A peak and what rings of free brightness leave over there.

    Attributes
    ----------
    peak
        Offset, rotation and correlation.
    left
        Mean weighted square.
    settled
        Whether it was moved to the least of that.
    """

    peak: Peak
    left: float
    settled: bool


def likely_places(
    scene: RingScene, image: RingImage, peaks: list[Peak], context: NavContext, most: int
) -> list[Place]:
    """Distinct places, least left over first, without those that are far worse than the first.

    Parameters
    ----------
    scene, image
        Edges, light.
    peaks
        Of the correlations, at least one.
    context
        Bounds.
    most
        Peaks that are followed.

    Returns
    -------
    list of Place
        Not empty. A peak without rivals stays where it is.
    """
    bands = [_bands(scene, image.lattice, peak, _PEAK_PX) for peak in peaks]
    in_sight = max(left.pixels for left in bands)
    left = [_cost(one, in_sight) for one in bands]
    order = np.argsort(left, kind="stable").tolist()
    if len(order) == 1 or left[order[1]] > _HOPELESS * left[order[0]]:
        peak = peaks[order[0]]
        return [Place(peak, _cost(_bands(scene, image.lattice, peak, 0.0), in_sight), False)]
    places: list[Place] = []
    for k in order[:most]:
        place = settled_place(scene, image, peaks[k], in_sight, context)
        if not any(_same(place.peak, known.peak, context) for known in places):
            places.append(place)
    places.sort(key=lambda place: place.left)
    return [place for place in places if worse_by(image, place.left, places[0].left) < BEYOND_HOPE]


def worse_by(image: RingImage, left: float, best: float) -> float:
    """Log-likelihood by which a place is worse than another, by what both leave over.

    Parameters
    ----------
    image
        Light.
    left, best
        Mean weighted squares.

    Returns
    -------
    float
        Negative where it is better.
    """
    return 0.5 * telling_pixels(float((image.lattice.weight > 0).sum()), best) * float(np.log(left / best))


def independent_pixels(pixels: float, mean: float) -> float:
    """Pixels of a lattice that err on their own.

    Residuals beyond the noise are texture, which is coherent along the rings; across them a lattice has as many lines
    as its root has pixels.

    Parameters
    ----------
    pixels
        Their number.
    mean
        Mean weighted square that a fit leaves.

    Returns
    -------
    float
        At most all of them.
    """
    return max(pixels / max(1.0, mean), float(np.sqrt(pixels)))


def telling_pixels(pixels: float, mean: float) -> float:
    """Pixels that tell places of rings from each other: brightness that changes along the rings errs in all of them.

    Parameters
    ----------
    pixels, mean
        As of :func:`independent_pixels`.

    Returns
    -------
    float
        Of these a few thousand at most.
    """
    return min(independent_pixels(pixels, mean), _MOST_TELLING)


def settled_place(
    scene: RingScene, image: RingImage, peak: Peak, in_sight: float, context: NavContext
) -> Place:
    """Follow a peak to the least that rings of free brightness leave over.

    Parameters
    ----------
    scene, image
        Edges, light.
    peak
        Start.
    in_sight
        Pixels of the lattice that show the plane where most of it is seen.
    context
        Bounds.

    Returns
    -------
    Place
        Nearest minimum, found by a simplex (Nelder and Mead 1965) under a blur that narrows.
    """
    moved = _Descent(scene, image.lattice.halved(), peak, in_sight / _COARSER, context).lowest()
    start, end = (Place(one, _cost(_bands(scene, image.lattice, one, 0.0), in_sight), True) for one in (peak, moved))
    return min(start, end, key=lambda place: place.left)


@dataclass(frozen=True, eq=False)
class _Descent:
    """From a peak to the least left over, in pixels of offset and, some way from the centre, of rotation."""

    scene: RingScene
    lattice: Lattice
    peak: Peak
    in_sight: float
    context: NavContext

    def lowest(self) -> Peak:
        size = 3 if self.context.max_rotation_rad else 2
        pixels = float((self.lattice.weight > 0).sum())
        best = np.zeros(size)
        for slack, step in _STAGES:
            now = float(np.exp(self.cost(best, slack)))
            enough = 2.0 * _SETTLED_GAIN / telling_pixels(pixels, now)
            simplex = best + step * np.vstack([np.zeros(size), np.eye(size)])
            found = minimize(
                self.cost, best, (slack,), method="Nelder-Mead",
                options={"initial_simplex": simplex, "xatol": 0.05, "fatol": enough, "maxfev": _TRIALS[size]},
            )  # fmt: skip
            best = np.asarray(found.x)
        return self.at(best)

    def at(self, values: NDArray[np.float64]) -> Peak:
        arm = float(np.hypot(*self.context.camera_model.shape_vu)) / 3.0
        turn = float(values[2]) / arm if len(values) == 3 else 0.0
        moved = (self.peak.offset_vu[0] + float(values[0]), self.peak.offset_vu[1] + float(values[1]))
        return replace(self.peak, offset_vu=moved, rotation_rad=self.peak.rotation_rad + turn)

    def cost(self, values: NDArray[np.float64], slack_px: float) -> float:
        here, bound = self.at(values), 1.05 * self.context.max_rotation_rad + 1e-9
        margin = np.array(self.context.search_margin_vu) + _BEYOND_MARGIN_PX
        if (np.abs(here.offset_vu) > margin).any() or abs(here.rotation_rad) > bound:
            return _OUTSIDE
        return float(np.log(_cost(_bands(self.scene, self.lattice, here, slack_px), self.in_sight)))


def turned_place(
    scene: RingScene, image: RingImage, fit: RingFit, correlation: float, context: NavContext
) -> Place | None:
    """The best other rotation about where rings were found: a round planet tells their place, not their turn.

    Parameters
    ----------
    scene, image
        Edges, light.
    fit
        Where they were found.
    correlation
        Of its peak.
    context
        Bounds.

    Returns
    -------
    Place or None
        None for cameras whose rotation is known.
    """
    bound = context.max_rotation_rad
    if not bound:
        return None
    arm = float(np.sqrt(((fit.units.places_vu - fit.pivot_vu) ** 2).sum(axis=-1)[fit.units.present].max()))
    count = int(np.clip(np.ceil(2.0 * bound * arm / _TURN_STEP_PX), _FEWEST_TURNS, _MOST_TURNS))
    turns = np.linspace(-bound, bound, count)
    turns = turns[np.abs(turns - fit.rotation_rad) * arm >= 2.0 * _TURN_STEP_PX]
    if not len(turns):
        return None
    poses = [
        compose(context, fit.offset_vu, fit.rotation_rad, fit.pivot_vu, np.array([0.0, 0.0, turn - fit.rotation_rad]))
        for turn in turns.tolist()
    ]
    peaks = [Peak((float(offset[0]), float(offset[1])), rotation, correlation) for offset, rotation in poses]
    bands = [_bands(scene, image.lattice, peak, 0.0) for peak in peaks]
    in_sight = max(left.pixels for left in bands)
    best = int(np.argmin([_cost(left, in_sight) for left in bands]))
    return settled_place(scene, image, peaks[best], in_sight, context)


def _bands(scene: RingScene, lattice: Lattice, peak: Peak, slack_px: float) -> LeftOver:
    return left_over(scene, lattice, np.array(peak.offset_vu), peak.rotation_rad, slack_px)


def _cost(left: LeftOver, in_sight: float) -> float:
    """Mean weighted square, raised where bodies would hide much of the plane: what is hidden is easily explained."""
    return left.mean * max(1.0, _SEEN * in_sight / max(left.pixels, 1.0)) ** 4


def _same(a: Peak, b: Peak, context: NavContext) -> bool:
    arm = float(np.hypot(*context.camera_model.shape_vu)) / 2.0
    gap = float(np.hypot(*np.subtract(a.offset_vu, b.offset_vu)))
    return gap + abs(a.rotation_rad - b.rotation_rad) * arm < _SAME_PX
