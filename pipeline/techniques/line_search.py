"""Whole-pixel search for an outline: how well edges of the right polarity lie under it at every offset."""

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from pipeline.imaging.edges import EdgeField
from pipeline.imaging.ncc import reduce
from pipeline.records import FloatArray
from pipeline.techniques.body_search import ROTATION_SAMPLES

# Share of the outline's weight that must be inside the array for a placement to be scored by its own weight alone.
_LEAST_INSIDE = 0.5
_FACTORS = (4, 2, 1)
_CANDIDATES = 6


@dataclass(frozen=True)
class LinePlace:
    """A placement of the outline: offset about the pivot, rotation, mean agreement in [0, 1]."""

    offset_vu: tuple[float, float]
    rotation_rad: float
    score: float


@numba.njit(cache=True, nogil=True)
def _scores(along_v, along_u, places, normals, weights, low_v, low_u, step, out):  # type: ignore[no-untyped-def]
    """Mean of minus normal times gradient at shifted vertices; the gradient points to the light, the normal away."""
    rows, cols = along_v.shape
    total = weights.sum()
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            dv, du = low_v + i * step, low_u + j * step
            found = inside = 0.0
            for k in range(places.shape[0]):
                v = int(np.floor(places[k, 0] + dv + 0.5))
                u = int(np.floor(places[k, 1] + du + 0.5))
                if v < 0 or u < 0 or v >= rows or u >= cols:
                    continue
                inside += weights[k]
                found -= weights[k] * (normals[k, 0] * along_v[v, u] + normals[k, 1] * along_u[v, u])
            floor = _LEAST_INSIDE * total
            out[i, j] = found / max(inside, floor) if total > 0 else 0.0


def search_line(
    field: EdgeField,
    vertices_vu: FloatArray,
    normal_vu: FloatArray,
    weights: FloatArray,
    reach_vu: tuple[float, float],
    bound_rad: float,
    pivot_vu: FloatArray,
) -> list[LinePlace]:
    """Best placements of an outline, best first.

    Parameters
    ----------
    field
        Edges of the image.
    vertices_vu, normal_vu
        (n, 2) predicted places, and unit normals toward the dark.
    weights
        (n,) expected contrast.
    reach_vu
        Largest offset about the pivot.
    bound_rad
        Largest rotation, zero for none.
    pivot_vu
        (2,) centre of the rotation.

    Returns
    -------
    list of LinePlace
        One per separate peak; offsets to a pixel.
    """
    radius = float(np.hypot(*(vertices_vu - pivot_vu).T).max())
    places: list[LinePlace] = []
    for depth, factor in enumerate(_FACTORS):
        planes = reduce(field.along_v, factor), reduce(field.along_u, factor)
        if depth == 0:
            places = _everywhere(planes, vertices_vu, normal_vu, weights, reach_vu, bound_rad, pivot_vu, factor)
            continue
        samples = ROTATION_SAMPLES[min(depth, len(ROTATION_SAMPLES) - 1)] if bound_rad else 1
        # From the second level on a rotation must be as fine as the pixels it moves the farthest vertex by.
        step = min(2.0 * bound_rad / (ROTATION_SAMPLES[0] - 1) / 2.0**depth, 2.0 * factor / max(radius, 1.0))
        places = [
            _nearby(planes, vertices_vu, normal_vu, weights, place, samples, step, bound_rad, pivot_vu, factor)
            for place in places
        ]
    return sorted(places, key=lambda place: -place.score)


def _turned(points: FloatArray, theta: float) -> FloatArray:
    """Rows (v, u) turned by theta: +u toward +v."""
    c, s = np.cos(theta), np.sin(theta)
    return np.ascontiguousarray(points @ np.array([[c, s], [-s, c]]).T)


def _everywhere(
    planes: tuple[np.ndarray, np.ndarray],
    vertices: FloatArray,
    normals: FloatArray,
    weights: FloatArray,
    reach_vu: tuple[float, float],
    bound: float,
    pivot: FloatArray,
    factor: int,
) -> list[LinePlace]:
    half_v, half_u = (int(np.ceil(n / factor)) for n in reach_vu)
    thin = max(1, len(vertices) // 400)
    thetas = np.linspace(-bound, bound, ROTATION_SAMPLES[0]) if bound else np.zeros(1)
    maps = np.zeros((len(thetas), 2 * half_v + 1, 2 * half_u + 1))
    for k, theta in enumerate(thetas):
        places = (pivot + _turned(vertices[::thin] - pivot, theta) + 0.5) / factor - 0.5
        turned = _turned(normals[::thin], theta)
        _scores(*planes, places, turned, weights[::thin], float(-half_v), float(-half_u), 1.0, maps[k])
    best, which = maps.max(axis=0), maps.argmax(axis=0)
    peaks = (best >= cv2.dilate(best, np.ones((5, 5)))) & (best > 0)
    rows, cols = np.nonzero(peaks)
    order = np.argsort(best[rows, cols])[::-1][:_CANDIDATES]
    return [
        LinePlace(
            (float((rows[k] - half_v) * factor), float((cols[k] - half_u) * factor)),
            float(thetas[which[rows[k], cols[k]]]), float(best[rows[k], cols[k]]),
        )
        for k in order
    ]  # fmt: skip


def _nearby(
    planes: tuple[np.ndarray, np.ndarray],
    vertices: FloatArray,
    normals: FloatArray,
    weights: FloatArray,
    place: LinePlace,
    samples: int,
    step: float,
    bound: float,
    pivot: FloatArray,
    factor: int,
) -> LinePlace:
    best = LinePlace(place.offset_vu, place.rotation_rad, -1.0)
    half = 3
    low = [np.rint(n / factor) - half for n in place.offset_vu]
    out = np.zeros((2 * half + 1, 2 * half + 1))
    for k in range(samples):
        theta = float(np.clip(place.rotation_rad + step * (k - samples // 2), -bound, bound))
        places = (pivot + _turned(vertices - pivot, theta) + 0.5) / factor - 0.5
        _scores(*planes, places, _turned(normals, theta), weights, float(low[0]), float(low[1]), 1.0, out)
        i, j = np.unravel_index(int(np.argmax(out)), out.shape)
        if out[i, j] > best.score:
            best = LinePlace(
                (float((low[0] + i) * factor), float((low[1] + j) * factor)), theta, float(out[i, j])
            )
    return best
