"""Rays against a body's surface: a tree of boxes over triangles or bilinear patches.

The tree is split by the surface-area heuristic over bins (Wald 2007); a node holds the boxes of both its children, in
single precision rounded outward, so that a ray opens the nearer one first. Patches are solved as in ``patches.py``.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ContractError
from pipeline.geometry.shape import Shape, icq_cells
from pipeline.records import FloatArray, Record, TriangleMesh, read_only

IntArray = NDArray[np.int64]
# Primitives in a leaf, by their number of corners: patches cost more to solve than boxes to pass by. Measured on
# 200 000 facets.
_LEAF = {3: 4, 4: 2}
_BINS = 16
# A leaf's reference is -(first * 16 + count) - 1.
_LEAF_BASE = 16
# Edges are widened by this share of a primitive, so that no ray slips through between two neighbours.
_EDGE = 1e-12
# Splits by area may be lopsided; below this depth ranges are halved, so that no tree is deeper than the stack.
_LOPSIDED_DEPTH = 32
_STACK = 64


class _Boxes(NamedTuple):
    """Boxes of primitives, (n, 3) lowest and highest corners, and the order in which they are taken."""

    low: FloatArray
    high: FloatArray
    order: IntArray


@dataclass(frozen=True, eq=False)
class RayTree(Record):
    """Surface ready for rays.

    Attributes
    ----------
    corners_km
        (n, 3 or 4, 3) primitives in the order of the leaves: triangles or patches, body frame.
    facet
        (n,) index of each primitive in the shape it came from.
    boxes
        (m, 2, 6) float32: for both children of a node lowest x, y, z and highest x, y, z, km.
    children
        (m, 2) int32: node, or a leaf's first primitive and count in one negative number.
    """

    corners_km: FloatArray
    facet: IntArray
    boxes: NDArray[np.float32]
    children: NDArray[np.int32]

    def __post_init__(self) -> None:
        self._freeze(corners_km=(None, self.corners_km.shape[1], 3), facet=(None,), children=(None, 2))
        object.__setattr__(self, "boxes", read_only(self.boxes, (len(self.children), 2, 6), np.float32))


def tree_of_shape(shape: Shape) -> RayTree:
    """Tree over a shape's own surface: its patches where it has a grid, else its triangles.

    Parameters
    ----------
    shape
        Shape.

    Returns
    -------
    RayTree
        For :func:`cast`.
    """
    return tree_of_mesh(shape.mesh) if shape.icq_km is None else make_tree(icq_cells(shape.icq_km))


def tree_of_mesh(mesh: TriangleMesh) -> RayTree:
    """Tree over triangles.

    Parameters
    ----------
    mesh
        Shape.

    Returns
    -------
    RayTree
        For :func:`cast`.
    """
    return make_tree(mesh.vertices_km[mesh.facets])


def make_tree(corners_km: FloatArray) -> RayTree:
    """Tree over primitives.

    Parameters
    ----------
    corners_km
        (n, 3, 3) triangles or (n, 4, 3) patches; a patch lies within the hull of its corners.

    Returns
    -------
    RayTree
        For :func:`cast`.
    """
    corners_km = np.ascontiguousarray(corners_km, float)
    if corners_km.ndim != 3 or corners_km.shape[1] not in _LEAF:
        raise ContractError("primitives have three or four corners")
    low, high = corners_km.min(axis=1), corners_km.max(axis=1)
    order = np.arange(len(corners_km))
    nodes = max(len(corners_km), 1)
    boxes = np.empty((nodes, 2, 6), np.float32)
    children = np.empty((nodes, 2), np.int32)
    used = _build(_Boxes(low, high, order), boxes, children, _LEAF[corners_km.shape[1]])
    return RayTree(corners_km[order], order, boxes[:used], children[:used])


def cast(tree: RayTree, origins_km: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
    """First point of the surface along each ray.

    Parameters
    ----------
    tree
        Surface.
    origins_km
        (n, 3) starts, or (1, 3) for one start of all; body frame.
    directions
        (n, 3) unit vectors, body frame. Rays that follow each other across an image are fastest.

    Returns
    -------
    tuple
        (n,) distance in km, infinite where nothing is hit; (n,) facet or cell of the shape, -1 likewise.
    """
    directions = np.ascontiguousarray(directions, float)
    distance = np.empty(len(directions))
    hit = np.empty(len(directions), np.int64)
    origins_km = np.ascontiguousarray(origins_km, float)
    _cast(tree.corners_km, tree.boxes, tree.children, origins_km, directions, distance, hit)
    return distance, np.where(hit >= 0, tree.facet[hit], -1)


@numba.njit(cache=True, nogil=True)
def _build(primitives, boxes, children, leaf):  # type: ignore[no-untyped-def]
    """Fill nodes from the root on; returns how many. The primitives' order becomes that of the leaves."""
    stack = np.empty((2 * _STACK, 5), np.int64)
    used = 1
    # Also a lone primitive gets a root; its other child is empty.
    _split_into(primitives, boxes, 0, 0, len(primitives.order), stack, 0, 1)
    top = 2
    while top > 0:
        top -= 1
        first, count, node, side, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3], stack[top, 4]
        if count <= leaf:
            children[node, side] = -(first * _LEAF_BASE + count) - 1
            continue
        children[node, side] = used
        _split_into(primitives, boxes, used, first, count, stack, top, depth + 1)
        used += 1
        top += 2
    return used


@numba.njit(cache=True, nogil=True)
def _split_into(primitives, boxes, node, first, count, stack, top, depth):  # type: ignore[no-untyped-def]
    """Divide a range of primitives between the two children of a node and push both."""
    left = _partition(primitives, first, count) if depth < _LOPSIDED_DEPTH else count // 2
    for side in range(2):
        start = first if side == 0 else first + left
        size = left if side == 0 else count - left
        _bound(primitives, start, size, boxes, node, side)
        entry = stack[top + side]
        entry[0], entry[1], entry[2], entry[3], entry[4] = start, size, node, side, depth


@numba.njit(cache=True, nogil=True)
def _bound(primitives, start, size, boxes, node, side):  # type: ignore[no-untyped-def]
    low, high, order = primitives
    for k in range(3):
        a, b = np.inf, -np.inf
        for i in range(start, start + size):
            a, b = min(a, low[order[i], k]), max(b, high[order[i], k])
        # Rounded outward by more than single precision loses.
        boxes[node, side, k] = np.float32(a - abs(a) * 2e-7 - 1e-30) if size else np.float32(np.inf)
        boxes[node, side, 3 + k] = np.float32(b + abs(b) * 2e-7 + 1e-30) if size else np.float32(-np.inf)


@numba.njit(cache=True, nogil=True)
def _area(box):  # type: ignore[no-untyped-def]
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x if x >= 0.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _partition(primitives, first, count):  # type: ignore[no-untyped-def]
    """Reorder a range so that its cheapest split by surface area stands in two parts; length of the first."""
    if count < 2:
        return count
    low, high, order = primitives
    middle_low, middle_high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(first, first + count):
        for k in range(3):
            c = low[order[i], k] + high[order[i], k]
            middle_low[k], middle_high[k] = min(middle_low[k], c), max(middle_high[k], c)
    best, best_axis, best_bin = np.inf, -1, 0
    cost = np.empty(_BINS)
    for axis in range(3):
        width = middle_high[axis] - middle_low[axis]
        if width <= 0.0:
            continue
        _bin_costs(primitives, first, count, axis, middle_low[axis], _BINS / width, cost)
        for k in range(_BINS - 1):
            if cost[k] < best:
                best, best_axis, best_bin = cost[k], axis, k
    if best_axis < 0:
        return count // 2
    scale = _BINS / (middle_high[best_axis] - middle_low[best_axis])
    i, j = first, first + count - 1
    while i <= j:
        c = low[order[i], best_axis] + high[order[i], best_axis]
        if min(int((c - middle_low[best_axis]) * scale), _BINS - 1) <= best_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    left = i - first
    return left if 0 < left < count else count // 2


@numba.njit(cache=True, nogil=True)
def _bin_costs(primitives, first, count, axis, start, scale, cost):  # type: ignore[no-untyped-def]
    """Cost of a split behind each bin: area times number of primitives on both sides."""
    low, high, order = primitives
    boxes = np.empty((_BINS, 6))
    numbers = np.zeros(_BINS, np.int64)
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    for i in range(first, first + count):
        p = order[i]
        b = min(int((low[p, axis] + high[p, axis] - start) * scale), _BINS - 1)
        numbers[b] += 1
        for k in range(3):
            boxes[b, k], boxes[b, 3 + k] = min(boxes[b, k], low[p, k]), max(boxes[b, 3 + k], high[p, k])
    run = np.empty(6)
    for way in range(2):
        run[:3], run[3:] = np.inf, -np.inf
        number = 0
        for step in range(_BINS - 1):
            b = step if way == 0 else _BINS - 1 - step
            number += numbers[b]
            for k in range(3):
                run[k], run[3 + k] = min(run[k], boxes[b, k]), max(run[3 + k], boxes[b, 3 + k])
            part = _area(run) * number
            if way == 0:
                cost[b] = part
                if number == 0 or number == count:
                    cost[b] = np.inf
            else:
                cost[b - 1] += part


@numba.njit(cache=True, nogil=True, inline="always")
def _triangle(t, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Distance to a triangle from either side (Moeller and Trumbore 1997), infinite if missed."""
    ax, ay, az = t[0, 0], t[0, 1], t[0, 2]
    ux, uy, uz = t[1, 0] - ax, t[1, 1] - ay, t[1, 2] - az
    vx, vy, vz = t[2, 0] - ax, t[2, 1] - ay, t[2, 2] - az
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    det = ux * px + uy * py + uz * pz
    if det == 0.0:
        return np.inf
    inverse = 1.0 / det
    sx, sy, sz = ox - ax, oy - ay, oz - az
    u = (sx * px + sy * py + sz * pz) * inverse
    if u < -_EDGE or u > 1.0 + _EDGE:
        return np.inf
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) * inverse
    if v < -_EDGE or u + v > 1.0 + _EDGE:
        return np.inf
    return (vx * qx + vy * qy + vz * qz) * inverse


@numba.njit(cache=True, nogil=True)
def _patch(t, origin, x, y, z):  # type: ignore[no-untyped-def]
    """Distance to a bilinear patch along z, infinite if missed or behind; x and y are the ray's tilde axes."""
    p = np.empty((4, 3))
    for corner in range(4):
        a, b, c = t[corner, 0] - origin[0], t[corner, 1] - origin[1], t[corner, 2] - origin[2]
        p[corner, 0] = a * x[0] + b * x[1] + c * x[2]
        p[corner, 1] = a * y[0] + b * y[1] + c * y[2]
        p[corner, 2] = a * z[0] + b * z[1] + c * z[2]
    for k in range(3):
        one, two, three, four = p[0, k], p[1, k], p[2, k], p[3, k]
        p[1, k], p[2, k], p[3, k] = four - one, two - one, one - two - four + three
    a = p[1, 0] * p[3, 1] - p[3, 0] * p[1, 1]
    b = p[1, 0] * p[2, 1] - p[2, 0] * p[1, 1] - p[3, 0] * p[0, 1] + p[0, 0] * p[3, 1]
    c = p[0, 0] * p[2, 1] - p[2, 0] * p[0, 1]
    under = b * b - 4.0 * a * c
    best = np.inf
    if under < 0.0:
        return best
    s = -0.5 * (b + np.copysign(np.sqrt(under), b))
    for root in range(2):
        top, bottom = (s, a) if root == 0 else (c, s)
        if bottom == 0.0:
            continue
        i = top / bottom
        if i < -_EDGE or i > 1.0 + _EDGE:
            continue
        over_x, over_y = p[2, 0] + p[3, 0] * i, p[2, 1] + p[3, 1] * i
        k = 0 if abs(over_x) >= abs(over_y) else 1
        over = over_x if k == 0 else over_y
        if over == 0.0:
            continue
        g = -(p[0, k] + p[1, k] * i) / over
        if g < -_EDGE or g > 1.0 + _EDGE:
            continue
        depth = p[0, 2] + p[1, 2] * i + p[2, 2] * g + p[3, 2] * i * g
        if 0.0 < depth < best:
            best = depth
    return best


@numba.njit(cache=True, nogil=True)
def _tilde(z, x, y):  # type: ignore[no-untyped-def]
    """Two axes across a ray, written into x and y."""
    helper = 0 if abs(z[0]) < 0.9 else 1
    if helper == 0:
        y[0], y[1], y[2] = 0.0, z[2], -z[1]
    else:
        y[0], y[1], y[2] = -z[2], 0.0, z[0]
    norm = np.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    y[0], y[1], y[2] = y[0] / norm, y[1] / norm, y[2] / norm
    x[0], x[1], x[2] = y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0]


@numba.njit(cache=True, nogil=True, inline="always")
def _enters(b, ox, oy, oz, ix, iy, iz, best):  # type: ignore[no-untyped-def]
    """Distance at which a ray enters a box, infinite where it passes by, behind or beyond ``best``."""
    ax, bx = (b[0] - ox) * ix, (b[3] - ox) * ix
    ay, by = (b[1] - oy) * iy, (b[4] - oy) * iy
    az, bz = (b[2] - oz) * iz, (b[5] - oz) * iz
    near = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), 0.0))
    far = min(min(max(ax, bx), max(ay, by)), min(max(az, bz), best))
    return near if near <= far * (1.0 + 1e-12) else np.inf


@numba.njit(cache=True, nogil=True)
def _cast(corners, boxes, children, origins, directions, distance, hit):  # type: ignore[no-untyped-def]
    triangles = corners.shape[1] == 3
    stack = np.empty(_STACK, np.int32)
    entry = np.empty(_STACK)
    x, y = np.empty(3), np.empty(3)
    last = -1
    for r in range(len(directions)):
        origin, z = origins[r if len(origins) > 1 else 0], directions[r]
        ox, oy, oz, dx, dy, dz = origin[0], origin[1], origin[2], z[0], z[1], z[2]
        # A component of zero would make 0 * infinity in the boxes' planes.
        ix = 1.0 / (dx if abs(dx) > 1e-300 else 1e-300)
        iy = 1.0 / (dy if abs(dy) > 1e-300 else 1e-300)
        iz = 1.0 / (dz if abs(dz) > 1e-300 else 1e-300)
        if not triangles:
            _tilde(z, x, y)
        best, found = np.inf, -1
        if last >= 0:
            # Neighbouring rays mostly hit one facet: knowing its distance closes most of the tree.
            c = corners[last]
            t = _triangle(c, ox, oy, oz, dx, dy, dz) if triangles else _patch(c, origin, x, y, z)
            if 0.0 < t < best:
                best, found = t, last
        stack[0], entry[0], top = 0, 0.0, 1
        while top > 0:
            top -= 1
            if entry[top] > best:
                continue
            node = stack[top]
            while node >= 0:
                one = _enters(boxes[node, 0], ox, oy, oz, ix, iy, iz, best)
                two = _enters(boxes[node, 1], ox, oy, oz, ix, iy, iz, best)
                first = 0 if one <= two else 1
                near, far = (one, two) if one <= two else (two, one)
                if near == np.inf:
                    break
                if far < np.inf:
                    stack[top], entry[top] = children[node, 1 - first], far
                    top += 1
                node = children[node, first]
            if node >= 0:
                continue
            code = -(node + 1)
            start, count = code // _LEAF_BASE, code % _LEAF_BASE
            for p in range(start, start + count):
                t = _triangle(corners[p], ox, oy, oz, dx, dy, dz) if triangles else _patch(corners[p], origin, x, y, z)
                if 0.0 < t < best:
                    best, found = t, p
        distance[r], hit[r] = best, found
        last = found
