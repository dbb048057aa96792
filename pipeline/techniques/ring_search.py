"""Where rings are, and how sure that is: peaks of correlations are ranked, fitted, and rivals tried one by one.

An edge mistaken for its neighbour fits as well locally; what tells them apart is all pixels at once, so places are
compared by how much of a sample of the image rings of free brightness leave over.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import plane_rotation
from pipeline.predict.rings import RingScene
from pipeline.records import FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.ring_bands import LeftOver, left_over
from pipeline.techniques.ring_fit import RingFit, fit_rings
from pipeline.techniques.ring_image import Lattice, RingImage
from pipeline.techniques.ring_peaks import Peak, RingSearchOptions, find_peaks
from pipeline.techniques.ring_places import (
    BEYOND_HOPE,
    Place,
    independent_pixels,
    likely_places,
    telling_pixels,
    turned_place,
    worse_by,
)

# Log-likelihood by which a fit elsewhere may be worse than the place that it started from.
_ASTRAY = 10.0
_SCAN_PX = 12
_PLACES_ELSEWHERE = 16
# Places nearer than this to the best one, in pixels across the edges, are the best one.
_SAME_PX = 0.8
# A fit nearer than this to where it started, likewise, has stayed there.
_NEAR_PX = 1.5


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
    places = likely_places(scene, image, peaks, context, options.followed)
    found = _fitted(scene, image, places, context)
    if not found.fits:
        return found.problem
    fit, place = found.fits[0]
    turned = turned_place(scene, image, fit, place.peak.correlation, context)
    if turned is not None and worse_by(image, turned.left, _as_seen(scene, image.lattice, fit)[1].mean) < BEYOND_HOPE:
        found = found.with_others(_fitted(scene, image, [turned], context))
    return _judged(scene, image, found, context)


@dataclass(frozen=True, eq=False)
class _Found:
    """Fits with the places that they started from, places without a fit, and why the first of these has none."""

    fits: list[tuple[RingFit, Place]]
    lost: list[Place]
    problem: str

    def with_others(self, others: "_Found") -> "_Found":
        return _Found(self.fits + others.fits, self.lost + others.lost, self.problem)


def _fitted(scene: RingScene, image: RingImage, places: list[Place], context: NavContext) -> _Found:
    found = _Found([], [], "")
    for place in places:
        peak = place.peak
        # Places on one ridge run to the same one.
        if any(_same(scene, fit, peak) for fit, _ in found.fits):
            continue
        start = (np.array(peak.offset_vu), peak.rotation_rad)
        fit = fit_rings(scene, image, start, context, tied=False, close=place.settled)
        if isinstance(fit, RingFit) and place.settled:
            _, seen = _as_seen(scene, image.lattice, fit)
            if not _same(scene, fit, peak) and worse_by(image, seen.mean, place.left) > _ASTRAY:
                fit = "the fit of single edges left the place that all of the light tells"
        if isinstance(fit, str):
            found = replace(found, lost=[*found.lost, place], problem=found.problem or fit)
        else:
            found.fits.append((fit, place))
    return found


def _across_px(scene: RingScene, fit: RingFit, offset_vu: FloatArray, rotation_rad: float) -> float:
    """Root mean square over a fit's units of how far another pointing lies from it across their edges."""
    centre = scene.state.camera_model.centre_vu
    places = fit.units.places_vu[:, 0]
    turn = plane_rotation(rotation_rad - fit.rotation_rad).T
    gap = centre + offset_vu + (places - centre - fit.offset_vu) @ turn - places
    return float(np.sqrt(((fit.units.normal_vu[:, 0] * gap).sum(axis=1) ** 2).mean()))


def _same(scene: RingScene, fit: RingFit, peak: Peak) -> bool:
    return _across_px(scene, fit, np.array(peak.offset_vu), peak.rotation_rad) < _NEAR_PX


def _judged(scene: RingScene, image: RingImage, found: _Found, context: NavContext) -> RingFix:
    """The fit that leaves least, and how much more its rivals leave: other fits, and places without one."""
    fits, lattice = found.fits, image.lattice
    seen = [_as_seen(scene, lattice, fit) for fit, _ in fits]
    left = [value for _, value in seen]
    order = np.argsort([value.mean for value in left])
    fit, place = fits[int(order[0])]
    true, best = seen[int(order[0])]
    count = telling_pixels(best.pixels, best.mean)
    gaps = [
        (_gap(left[int(k)].mean, best, count), np.nan)
        for k in order[1:]
        if _across_px(scene, fit, fits[int(k)][0].offset_vu, fits[int(k)][0].rotation_rad) > _SAME_PX
    ]  # fmt: skip
    gaps += [(_gap(rival.left, best, count), np.nan) for rival in found.lost if not _same(scene, fit, rival.peak)]
    gaps += _scan(true, lattice, fit, best, count) + _elsewhere(true, lattice.halved(), fit, count, context)
    tries = float(np.prod([2.0 * m + 1.0 for m in context.search_margin_vu]))
    gain = 0.5 * independent_pixels(best.pixels, best.mean) * np.log(best.bare / best.mean)
    doubt = tries * float(np.exp(np.clip(len(scene) + 3.0 - gain, -700.0, 50.0)))
    doubt += sum(float(np.exp(-np.clip(gap, 0.0, 700.0))) for gap, _ in gaps)
    rival = min(gaps, key=lambda entry: entry[0], default=(np.inf, np.nan))
    return RingFix(fit, place.peak.correlation, 1.0 / (1.0 + doubt), float(rival[0]), float(rival[1]))


def _gap(left: float, best: LeftOver, count: float) -> float:
    """Log-likelihood by which a place is worse than the best one."""
    return 0.5 * count * float(np.log(max(left / best.mean, 1e-12)))


def _as_seen(scene: RingScene, lattice: Lattice, fit: RingFit) -> tuple[RingScene, LeftOver]:
    """Edges with the radii that a fit has found, and what they leave; as predicted where that leaves less.

    An error of the catalogue must not look like a wrong place, nor an edge that went astray.
    """
    shift = fit.radius_km[scene.feature] + fit.edge_km
    scenes = (replace(scene, curves=scene.curves + shift[:, None]), scene)
    left = [left_over(one, lattice, fit.offset_vu, fit.rotation_rad) for one in scenes]
    best = int(np.argmin([value.mean for value in left]))
    return scenes[best], left[best]


def _across(fit: RingFit) -> FloatArray:
    """(2,) direction in which most of the edges are crossed; what is known best may be another, by errors of radii."""
    normals = fit.units.normal_vu[fit.units.present]
    return np.asarray(np.linalg.eigh(normals.T @ normals)[1][:, -1])


def _scan(
    scene: RingScene, lattice: Lattice, fit: RingFit, best: LeftOver, count: float
) -> list[tuple[float, float]]:
    """Log-likelihood gaps and shifts of the dips on a walk across the edges."""
    across = _across(fit)
    shifts = np.arange(-_SCAN_PX, _SCAN_PX + 1).astype(float)
    left = [left_over(scene, lattice, fit.offset_vu + s * across, fit.rotation_rad) for s in shifts]
    mean = np.array([value.mean for value in left])
    middle: NDArray[np.int64] = np.arange(1, len(shifts) - 1)
    dips = middle[(mean[1:-1] < mean[:-2]) & (mean[1:-1] <= mean[2:]) & (np.abs(shifts[1:-1]) > 1.0)]
    return [(_gap(left[k].mean, best, count), float(shifts[k])) for k in dips]


def _elsewhere(
    scene: RingScene, lattice: Lattice, fit: RingFit, count: float, context: NavContext
) -> list[tuple[float, float]]:
    """Gaps and shifts of places all over the margin, across the edges: what any place explains of a textured image."""
    across = _across(fit)
    reach = float(np.min(np.asarray(context.search_margin_vu) / np.maximum(np.abs(across), 1e-9)))
    middle = float(across @ fit.offset_vu)
    shifts = np.linspace(-reach, reach, _PLACES_ELSEWHERE) - middle
    far = shifts[np.abs(shifts) > _SCAN_PX].tolist()
    here, *others = (
        left_over(scene, lattice, fit.offset_vu + shift * across, fit.rotation_rad) for shift in (0.0, *far)
    )
    return [(_gap(left.mean, here, count), shift) for left, shift in zip(others, far, strict=True)]
