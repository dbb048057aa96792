"""Rendering of triangle meshes: a depth buffer from the camera, and one from the Sun for cast shadows."""

from dataclasses import dataclass
from math import ceil, floor, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.imaging.illumination import reflectance
from pipeline.imaging.render import Cells, Window
from pipeline.records import FloatArray, Record

# Shadow map: cells along the body's extent, and the depth (in its cells) by which a facet never shadows itself.
_SHADOW_CELLS = 700
_SHADOW_BIAS_CELLS = 2.0


@dataclass(frozen=True, eq=False)
class MeshSolid(Record):
    """A mesh in the camera frame.

    Attributes
    ----------
    points_km
        (n, 3) vertices from the camera.
    pixels_vu
        (n, 2) where they are imaged, not-a-number behind the camera.
    facets
        (m, 3) vertex indices, counter-clockwise from outside.
    sun
        (3,) unit vector toward the Sun, camera frame.
    law, parameter
        Scattering law, see ``illumination.law_of``.
    """

    points_km: FloatArray
    pixels_vu: FloatArray
    facets: NDArray[np.int64]
    sun: FloatArray
    law: int
    parameter: float

    def __post_init__(self) -> None:
        self._freeze(points_km=(None, 3), pixels_vu=(None, 2), facets=(None, 3), sun=(3,))


def render_meshes(cells: Cells, meshes: list[MeshSolid], window: Window) -> None:
    """Draw meshes over what the cells of a window hold.

    Parameters
    ----------
    cells
        Changed in place.
    meshes
        Farthest first.
    window
        Pixels of the cells.
    """
    over = cells.over
    for mesh in meshes:
        # Cell (i, j) has its centre at v0 - 0.5 + (i + 0.5) / over.
        rows = (mesh.pixels_vu[:, 0] - window.v0 + 0.5) * over - 0.5
        cols = (mesh.pixels_vu[:, 1] - window.u0 + 0.5) * over - 0.5
        places = np.stack([rows, cols, 1.0 / mesh.points_km[:, 2]], axis=1)
        shadow, axes, start, step = _shadow_map(mesh)
        light = _facet_light(mesh.points_km, mesh.facets, mesh.sun, mesh.law, mesh.parameter)
        depth = np.zeros(cells.light.shape, np.float64)
        bias = _SHADOW_BIAS_CELLS * step
        _fill(
            cells.light, cells.cover, depth, places, mesh.points_km, mesh.facets, light, shadow, axes, start, step, bias
        )


def _shadow_map(mesh: MeshSolid) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Height above a plane across the Sun's direction of the surface that the Sun sees, on a square grid."""
    helper = np.eye(3)[int(np.argmin(np.abs(mesh.sun)))]
    first = np.cross(mesh.sun, helper)
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(mesh.sun, first), mesh.sun])
    places = mesh.points_km @ axes.T
    low, high = places.min(axis=0), places.max(axis=0)
    step = float(max(high[0] - low[0], high[1] - low[1]) / _SHADOW_CELLS)
    heights = np.full((_SHADOW_CELLS + 2, _SHADOW_CELLS + 2), -np.inf)
    _heights(heights, (places[:, :2] - low[:2]) / step, places[:, 2], mesh.facets)
    return heights, axes, low[:2], step


@numba.njit(cache=True, nogil=True)
def _heights(heights, places, height, facets):  # type: ignore[no-untyped-def]
    for f in range(facets.shape[0]):
        i, j, k = facets[f, 0], facets[f, 1], facets[f, 2]
        ax, ay, bx, by, cx, cy = places[i, 0], places[i, 1], places[j, 0], places[j, 1], places[k, 0], places[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area <= 0.0:
            continue
        for x in range(max(0, ceil(min(ax, bx, cx))), min(heights.shape[0] - 1, int(max(ax, bx, cx))) + 1):
            for y in range(max(0, ceil(min(ay, by, cy))), min(heights.shape[1] - 1, int(max(ay, by, cy))) + 1):
                p = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                q = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                r = 1.0 - p - q
                if p >= 0.0 and q >= 0.0 and r >= 0.0:
                    heights[x, y] = max(heights[x, y], p * height[i] + q * height[j] + r * height[k])


@numba.njit(cache=True, nogil=True)
def _facet_light(points, facets, sun, law, parameter):  # type: ignore[no-untyped-def]
    """Radiance of each facet toward the camera; -1 where it faces away."""
    light = np.empty(facets.shape[0])
    for f in range(facets.shape[0]):
        a, b, c = points[facets[f, 0]], points[facets[f, 1]], points[facets[f, 2]]
        n = np.cross(b - a, c - a)
        m = (a + b + c) / 3.0
        norm = sqrt(n @ n)
        facing = -(n @ m)
        if norm == 0.0 or facing <= 0.0:
            light[f] = -1.0
            continue
        light[f] = reflectance(law, parameter, (n @ sun) / norm, facing / norm / sqrt(m @ m))
    return light


@numba.njit(cache=True, nogil=True)
def _fill(cells, cover, depth, places, points, facets, light, shadow, axes, start, step, bias):  # type: ignore[no-untyped-def]
    for f in range(facets.shape[0]):
        if light[f] < 0.0:
            continue
        i, j, k = facets[f, 0], facets[f, 1], facets[f, 2]
        ay, ax, by, bx, cy, cx = places[i, 0], places[i, 1], places[j, 0], places[j, 1], places[k, 0], places[k, 1]
        if not (ay == ay and by == by and cy == cy):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        for y in range(max(0, ceil(min(ay, by, cy))), min(cells.shape[0] - 1, floor(max(ay, by, cy))) + 1):
            for x in range(
                max(0, ceil(min(ax, bx, cx))), min(cells.shape[1] - 1, floor(max(ax, bx, cx))) + 1
            ):
                p = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                q = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                r = 1.0 - p - q
                if p < 0.0 or q < 0.0 or r < 0.0:
                    continue
                # 1/z is linear over the image of a plane.
                nearness = p * places[i, 2] + q * places[j, 2] + r * places[k, 2]
                if nearness <= depth[y, x]:
                    continue
                depth[y, x] = nearness
                value = light[f]
                if value > 0.0:
                    here = (p * places[i, 2] * points[i] + q * places[j, 2] * points[j] + r * places[k, 2] * points[k])
                    here = here / nearness
                    s = floor((axes[0] @ here - start[0]) / step)
                    t = floor((axes[1] @ here - start[1]) / step)
                    inside = 0 <= s < shadow.shape[0] - 1 and 0 <= t < shadow.shape[1] - 1
                    # In grazing light a surface rises by many cells from one to the next; of the four around a point
                    # one is always below it, unless something else stands there.
                    level = axes[2] @ here + bias
                    if (
                        inside
                        and shadow[s, t] > level
                        and shadow[s + 1, t] > level
                        and shadow[s, t + 1] > level
                        and shadow[s + 1, t + 1] > level
                    ):
                        value = 0.0
                cells[y, x] = value
                cover[y, x] = 1.0
