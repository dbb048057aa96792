"""Pixels near ring edges: which are used, and how far each is from the edges of its unit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.imaging.ring_light import MOST_EDGES, measure, near_edges
from pipeline.predict.rings import RingPose, RingScene
from pipeline.records import FloatArray
from pipeline.techniques.ring_image import RingImage
from pipeline.techniques.ring_units import RingUnits

# Square lattices of pixels: pixels of the image for one of theirs, and how far each row is shifted against the last.
_LATTICES = ((1, 0), (2, 1), (5, 2), (10, 3))
# Edges may move so far until pixels are chosen anew.
_SLACK_PX = 2.0

@dataclass(frozen=True, eq=False)
class EdgePixels:
    """Pixels near edges, sorted by unit.

    Attributes
    ----------
    data, variance
        (n,) DN and DN^2.
    distance
        (n, 10) pixels to the edges of their unit, positive outward.
    starts
        (units + 1,) first pixel of each unit.
    """

    data: FloatArray
    variance: FloatArray
    distance: FloatArray
    starts: NDArray[np.int64]


def select_pixels(scene: RingScene, image: RingImage, pose: RingPose, reach_px: float) -> NDArray[np.int64]:
    """Good pixels near edges, on a lattice where there are very many.

    Parameters
    ----------
    scene, image
        Edges, light.
    pose
        Pointing.
    reach_px
        Distance from an edge up to which pixels are used.

    Returns
    -------
    numpy.ndarray
        (n,) indices of the flattened image.
    """
    estimate = len(_near(scene, image, pose, reach_px, *_LATTICES[-1])) * _LATTICES[-1][0]
    enough = [lattice for lattice in _LATTICES if estimate <= image.enough_pixels * lattice[0]]
    flat = _near(scene, image, pose, reach_px, *(enough or _LATTICES[-1:])[0])
    return np.ascontiguousarray(flat[~image.frame.bad.ravel()[flat]])


def _near(
    scene: RingScene, image: RingImage, pose: RingPose, reach_px: float, stride: int, slant: int
) -> NDArray[np.int64]:
    assert scene.rays is not None
    raw = image.frame.raw
    flat = np.zeros(raw.size, np.int64)
    count = near_edges(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, np.array(raw.shape), scene.curves,
        scene.means, scene.spread, reach_px + _SLACK_PX, stride, slant, flat,
    )  # fmt: skip
    return flat[:count]


def measured(
    scene: RingScene, image: RingImage, pose: RingPose, units: RingUnits, flat: NDArray[np.int64], reach_px: float,
    blur_px: float,
) -> EdgePixels:  # fmt: skip
    """Pixels with their distances.

    Parameters
    ----------
    scene, image
        Edges, light.
    pose, units
        Pointing, and pieces of edges under it.
    flat
        (n,) indices of the flattened image.
    reach_px, blur_px
        Distance up to which pixels are used, and sigma of a blurred step.

    Returns
    -------
    EdgePixels
        Those within reach of a unit.
    """
    assert scene.rays is not None
    unit = np.full(len(flat), -1, np.int64)
    distance = np.zeros((len(flat), MOST_EDGES))
    measure(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, image.frame.raw.shape[1], flat, scene.curves,
        scene.means, scene.spread, units.cell_of, units.span, units.unit_of, units.edges, reach_px, blur_px,
        scene.forms, scene.sun, unit, distance,
    )  # fmt: skip
    order = np.argsort(unit, kind="stable")
    order = order[np.searchsorted(unit[order], 0) :]
    starts = np.searchsorted(unit[order], np.arange(len(units) + 1))
    chosen = flat[order]
    data, variance = (values.ravel()[chosen].astype(float) for values in (image.frame.raw, image.variance))
    return EdgePixels(data, variance, distance[order], starts)
