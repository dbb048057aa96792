"""Pieces of ring edges that are fitted together: neighbouring edges over a short range of longitudes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rings import TURN
from pipeline.imaging.render import Window
from pipeline.imaging.ring_light import MOST_EDGES
from pipeline.predict.rings import RingPose, RingScene, visible_longitudes
from pipeline.records import BoolArray, FloatArray, Record

# Length of a piece, and how far its normal may turn.
_PIECE_PX, _PIECE_TURN_RAD = 24.0, 0.3
_BINS = 8192
# Steps of numerical derivatives: along an edge, and of its radius relative to itself.
_ARC_RAD, _STEP = 1e-5, 1e-6


@dataclass(frozen=True, eq=False)
class RingUnits(Record):
    """Pieces of one pose.

    Attributes
    ----------
    edges
        (n, 2) first edge of a unit and the one after its last.
    present
        (n, 10) True where the unit has a k-th edge.
    places_vu, normal_vu
        (n, 10, 2) pixel and outward unit normal of each edge in the middle of the unit.
    px_per_km
        (n, 10) shift of the edge per kilometre of radius.
    longitude_rad
        (n,) of the middle.
    cell_of
        (8192,) cell of each bin of longitude, -1 for none.
    span
        (2,) start and width of all bins, radians.
    unit_of
        (cells, edges) unit, -1 for none.
    """

    edges: NDArray[np.int64]
    present: BoolArray
    places_vu: FloatArray
    normal_vu: FloatArray
    px_per_km: FloatArray
    longitude_rad: FloatArray
    cell_of: NDArray[np.int64]
    span: FloatArray
    unit_of: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.edges)


def make_units(scene: RingScene, pose: RingPose, join_px: float) -> RingUnits | None:
    """Cut the edges inside the array into units.

    Parameters
    ----------
    scene
        Edges.
    pose
        Pointing.
    join_px
        Distance between edges below which they are fitted together.

    Returns
    -------
    RingUnits or None
        None where no edge is inside the array.
    """
    rows, cols = scene.state.camera_model.shape_vu
    window = Window(0, 0, rows, cols)
    seen = [visible_longitudes(scene, pose, edge, window) for edge in range(len(scene))]
    if not any(len(longitude) for longitude in seen):
        return None
    span = _span(np.concatenate(seen))
    middle = span[0] + span[1] * (np.arange(_BINS) + 0.5) / _BINS
    cell_of = _cells(scene, pose, middle, span)
    cells = int(cell_of.max()) + 1
    if cells < 1:
        return None
    counts = np.bincount(cell_of[cell_of >= 0], minlength=cells)
    centres = np.bincount(cell_of[cell_of >= 0], weights=middle[cell_of >= 0], minlength=cells) / np.maximum(counts, 1)
    lines = [_line(scene, pose, edge, centres) for edge in range(len(scene))]
    places, normals, scales = (np.stack([line[k] for line in lines], axis=1) for k in range(3))
    limit = np.array([rows, cols]) + join_px
    inside = np.asarray(((places > -1.0 - join_px) & (places < limit)).all(axis=2))
    return _grouped(inside, places, normals, scales, centres, cell_of, span, join_px)


def _span(longitude: FloatArray) -> FloatArray:
    """Shortest range of longitudes that holds all of them."""
    ordered = np.sort(longitude % TURN)
    gaps = np.diff(ordered, append=ordered[0] + TURN)
    widest = int(np.argmax(gaps))
    if gaps[widest] < 0.05:
        return np.array([0.0, TURN])
    start = ordered[(widest + 1) % len(ordered)]
    width = TURN - gaps[widest]
    pad = 0.02 * width + 1e-9
    return np.array([start - pad, width + 2.0 * pad])


def _line(
    scene: RingScene, pose: RingPose, edge: int, longitude: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels, outward normals and pixels per km of an edge; not-a-number behind the camera."""
    here, _ = scene.place(pose, edge, longitude)
    arc = _ARC_RAD
    along = (scene.place(pose, edge, longitude + arc)[0] - scene.place(pose, edge, longitude - arc)[0]) / (2.0 * arc)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.hypot(*normal.T)[:, None]
    radius = scene.radius_km(edge, longitude)
    beside = _STEP * radius
    points = np.stack([np.cos(longitude), np.sin(longitude), np.zeros(len(longitude))], axis=1)
    outer = scene.project_points(pose, points * (radius + beside)[:, None])
    inner = scene.project_points(pose, points * (radius - beside)[:, None])
    rate = ((outer - inner) * normal).sum(axis=1) / (2.0 * beside)
    sign = np.where(rate < 0, -1.0, 1.0)
    return here, normal * sign[:, None], np.abs(rate)


def _cells(scene: RingScene, pose: RingPose, middle: FloatArray, span: FloatArray) -> NDArray[np.int64]:
    """Cell of each bin, so that no edge runs too far or turns too much within one."""
    rows, cols = scene.state.camera_model.shape_vu
    use = np.zeros(len(middle))
    some = np.zeros(len(middle), bool)
    thinned = middle[::8]
    for edge in np.unique(np.linspace(0, len(scene) - 1, min(len(scene), 12)).astype(int)):
        pixels, normal, _ = _line(scene, pose, int(edge), thinned)
        with np.errstate(invalid="ignore"):
            inside = ((pixels > -2.0) & (pixels < np.array([rows, cols]) + 1.0)).all(axis=1)
        steps = np.hypot(*np.gradient(pixels, axis=0).T) / 8.0
        turns = np.hypot(*np.gradient(normal, axis=0).T) / 8.0
        need = np.where(inside, np.maximum(steps / _PIECE_PX, turns / _PIECE_TURN_RAD), 0.0)
        wide = np.repeat(np.nan_to_num(need), 8)
        use = np.maximum(use, wide)
        some |= np.repeat(inside, 8)
    cell = np.floor(np.cumsum(use)).astype(np.int64)
    # Numbers without gaps, in the order of longitude.
    _, compact = np.unique(cell[some], return_inverse=True)
    result = np.full(len(middle), -1, np.int64)
    result[some] = compact
    return result


def _grouped(
    inside: BoolArray, places: FloatArray, normals: FloatArray, scales: FloatArray, centres: FloatArray,
    cell_of: NDArray[np.int64], span: FloatArray, join_px: float,
) -> RingUnits:  # fmt: skip
    """Chains of edges nearer to each other than ``join_px`` in each cell."""
    cells, count = inside.shape
    unit_of = np.full((cells, count), -1, np.int64)
    gaps = np.abs(((places[:, 1:] - places[:, :-1]) * normals[:, 1:]).sum(axis=2))
    apart = ~(gaps < join_px) | ~inside[:, 1:] | ~inside[:, :-1]
    edges: list[tuple[int, int]] = []
    cell_list: list[int] = []
    for cell in range(cells):
        first = -1
        for k in np.nonzero(inside[cell])[0].tolist():
            if first < 0 or apart[cell, k - 1] or k - first >= MOST_EDGES or unit_of[cell, k - 1] < 0:
                first = k
                edges.append((first, first))
                cell_list.append(cell)
            edges[-1] = (first, k + 1)
            unit_of[cell, k] = len(edges) - 1
    bounds, owner = np.array(edges, np.int64).reshape(-1, 2), np.array(cell_list, np.int64)
    offset = np.arange(MOST_EDGES)
    present = offset < (bounds[:, 1] - bounds[:, 0])[:, None]
    column = np.minimum(bounds[:, :1] + offset, count - 1)
    pick = (owner[:, None], column)
    return RingUnits(
        bounds, present, np.nan_to_num(places[pick]), np.nan_to_num(normals[pick]), np.nan_to_num(scales[pick]),
        centres[owner], cell_of, span, unit_of,
    )  # fmt: skip
