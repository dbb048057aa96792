"""Rays against a grid of quadrilaterals, step by step as SPC does it: the readable reference for the fast caster.

Source: seed 001 section 3.2.1, eq. 3.21-3.35, with the project's corrections. Written for reading and for tests; a
ray costs one pass over all cells.
"""

from itertools import combinations

import numpy as np

from pipeline.records import BoolArray, FloatArray


def first_patch_hit(cells_km: FloatArray, origin_km: FloatArray, direction: FloatArray) -> tuple[float, int]:
    """Nearest point at which a ray meets a surface of bilinear patches.

    Parameters
    ----------
    cells_km
        (n, 4, 3) corners in order around each cell, either sense.
    origin_km
        (3,) start of the ray, same frame.
    direction
        (3,) unit vector.

    Returns
    -------
    tuple
        Distance along the ray in km, infinite where nothing is hit; index of the cell, -1 likewise.
    """
    tilde = (cells_km - origin_km) @ tilde_frame(direction).T
    near = np.flatnonzero(near_cells(tilde, longest_span(cells_km)))
    asked = near[~is_convex(tilde[near]) | is_pierced(tilde[near])]
    best, cell = np.inf, -1
    for index in asked:
        for _, _, depth in patch_roots(tilde[index]):
            if 0.0 < depth < best:
                best, cell = depth, int(index)
    return best, cell


def tilde_frame(direction: FloatArray) -> FloatArray:
    """Axes whose third lies along a ray (eq. 3.21, 3.23).

    Parameters
    ----------
    direction
        (3,) unit vector.

    Returns
    -------
    numpy.ndarray
        (3, 3) rotation into the tilde frame. The helping axis is the body's x, or y where the ray lies along x.
    """
    helper = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(direction, helper)
    y /= np.linalg.norm(y)
    x = np.cross(y, direction)
    return np.stack([x / np.linalg.norm(x), y, direction])


def longest_span(cells_km: FloatArray) -> float:
    """Longest distance between two corners of one cell (eq. 3.24, over all six pairs and not the diagonals alone).

    Parameters
    ----------
    cells_km
        (n, 4, 3).

    Returns
    -------
    float
        km.
    """
    pairs = [np.linalg.norm(cells_km[:, i] - cells_km[:, j], axis=1).max() for i, j in combinations(range(4), 2)]
    return float(max(pairs))


def near_cells(tilde_km: FloatArray, span_km: float) -> BoolArray:
    """Cells that the ray can pass through: no corner farther from it than the longest span (eq. 3.25).

    Parameters
    ----------
    tilde_km
        (n, 4, 3) corners in the tilde frame.
    span_km
        See :func:`longest_span`.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    return np.asarray(((tilde_km[..., :2] ** 2).sum(axis=2) <= span_km**2).all(axis=1))


def _turns(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(first[..., 0] * second[..., 1] - second[..., 0] * first[..., 1])


def is_pierced(tilde_km: FloatArray) -> BoolArray:
    """Whether the four cross products of successive corners agree in sign, either sign (eq. 3.26).

    Parameters
    ----------
    tilde_km
        (n, 4, 3) corners in the tilde frame.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    products = _turns(tilde_km, np.roll(tilde_km, -1, axis=1))
    return np.asarray((products >= 0).all(axis=1) | (products <= 0).all(axis=1))


def is_convex(tilde_km: FloatArray) -> BoolArray:
    """Whether cells project to convex outlines; only those can be told by :func:`is_pierced`.

    Parameters
    ----------
    tilde_km
        (n, 4, 3) corners in the tilde frame.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    sides = np.roll(tilde_km, -1, axis=1) - tilde_km
    return is_pierced(sides)


def patch_roots(corners_km: FloatArray) -> list[tuple[float, float, float]]:
    """Where the tilde frame's z axis meets the bilinear patch of one cell (eq. 3.27-3.35).

    Parameters
    ----------
    corners_km
        (4, 3) corners in the tilde frame; iota runs from corner 1 to 4, gamma from 1 to 2.

    Returns
    -------
    list
        Up to two triples (iota, gamma, z in km) with iota and gamma in 0..1, nearest first.
    """
    one, two, three, four = corners_km
    p0, p1, p2, p3 = one, four - one, two - one, one - two - four + three
    a = p1[0] * p3[1] - p3[0] * p1[1]
    b = p1[0] * p2[1] - p2[0] * p1[1] - p3[0] * p0[1] + p0[0] * p3[1]
    c = p0[0] * p2[1] - p2[0] * p0[1]
    found = []
    for iota in _stable_roots(a, b, c):
        over = p2[:2] + p3[:2] * iota
        axis = int(np.argmax(np.abs(over)))
        if over[axis] == 0.0:
            continue
        gamma = -(p0[axis] + p1[axis] * iota) / over[axis]
        if 0.0 <= iota <= 1.0 and 0.0 <= gamma <= 1.0:
            found.append((iota, gamma, float(p0[2] + p1[2] * iota + p2[2] * gamma + p3[2] * iota * gamma)))
    return sorted(found, key=lambda root: root[2])


def _stable_roots(a: float, b: float, c: float) -> list[float]:
    """Real roots of a x^2 + b x + c without cancellation, also where a is zero."""
    under = b * b - 4.0 * a * c
    if under < 0.0:
        return []
    s = -0.5 * (b + np.copysign(np.sqrt(under), b))
    return [float(top / bottom) for top, bottom in ((s, a), (c, s)) if bottom != 0.0]
