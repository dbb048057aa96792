"""Maplets cut from a shape: landmarks spread evenly over its surface, heights by rays along the mean normal."""

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.maplet import Maplet, cell_normals
from pipeline.geometry.rays import RayTree, cast
from pipeline.records import FloatArray, TriangleMesh

# Rays along a side while the mean normal is sought, and how often; the normal settles to some 1e-3.
_COARSE_SIDE = 15
_NORMAL_STEPS = 4
# Bits of each coordinate in the order along the space-filling curve.
_CURVE_BITS = 20
# Fractions of the golden ratio's relatives: a low-discrepancy walk through a facet (Roberts 2018).
_WALK = (0.7548776662466927, 0.5698402909980532)


def spread_landmarks(mesh: TriangleMesh, count: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Points that each stand for the same area of a surface.

    Parameters
    ----------
    mesh
        Shape.
    count
        Number of points.

    Returns
    -------
    tuple
        (count, 3) body-fixed km; (count,) facets that they lie on. Facets are walked along a space-filling curve and
        a point set after each equal share of area, so that neighbours on the curve keep their distance.
    """
    corners = mesh.vertices_km[mesh.facets]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    order = np.argsort(_curve(corners.mean(axis=1)))
    walked = np.cumsum(areas[order])
    steps = (np.arange(count) + 0.5) / count * walked[-1]
    facet = order[np.minimum(np.searchsorted(walked, steps), len(order) - 1)]
    s, t = (np.arange(1, count + 1) * walk % 1.0 for walk in _WALK)
    s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)
    a, b, c = (corners[facet, k] for k in range(3))
    return a + s[:, None] * (b - a) + t[:, None] * (c - a), facet


def _curve(points: FloatArray) -> NDArray[np.int64]:
    """Place of points along a Z-shaped space-filling curve (Morton order)."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    cells = ((points - low) / extent * (2**_CURVE_BITS - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def frame_about(normal: FloatArray) -> FloatArray:
    """Axes of a maplet: z along the normal, y to the east, x to the south, as SPC lays them.

    Parameters
    ----------
    normal
        (3,) unit vector, body frame.

    Returns
    -------
    numpy.ndarray
        (3, 3) rows x, y, z in the body frame; at a pole the body's x axis stands in for the pole.
    """
    pole = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    y = np.cross(pole, normal)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, normal), y, normal])


def cut_maplet(
    tree: RayTree, place: tuple[FloatArray, FloatArray], half: int, scale_km: float, name: str, sigma_km: float
) -> Maplet:
    """Maplet of the surface about a point.

    Parameters
    ----------
    tree
        Surface.
    place
        (3,) point of the surface, body-fixed km; (3,) a first normal, such as its facet's.
    half, scale_km
        Cells on each side of the middle; width of a cell.
    name
        Of the landmark.
    sigma_km
        1 sigma of its position per axis.

    Returns
    -------
    Maplet
        Its z axis is the mean of the normals of its cells; cells whose ray meets no surface within the maplet's own
        radius are not-a-number; the landmark lies on the surface. Albedo is 1.
    """
    point, normal = place
    side_km = 2.0 * half * scale_km
    coarse = side_km / (_COARSE_SIDE - 1)
    for _ in range(_NORMAL_STEPS):
        frame = frame_about(normal)
        heights = _heights(tree, point, frame, _COARSE_SIDE // 2, coarse)
        mean = np.nanmean(cell_normals(heights).reshape(-1, 3), axis=0) if np.isfinite(heights).sum() > 9 else frame[2]
        normal = np.nan_to_num(mean) @ frame if not np.isfinite(mean).all() else mean @ frame
        normal = normal / np.linalg.norm(normal)
    frame = frame_about(normal)
    heights = _heights(tree, point, frame, half, scale_km)
    middle = float(heights[half, half])
    if np.isfinite(middle):
        point, heights = point + middle * scale_km * normal, heights - middle
    albedo = np.where(np.isfinite(heights), 1.0, np.nan)
    return Maplet(name, point, frame, scale_km, heights, albedo, np.eye(3) * sigma_km**2)


def _heights(tree: RayTree, point: FloatArray, frame: FloatArray, half: int, scale_km: float) -> FloatArray:
    """Heights in cells of the outermost surface within the grid's own radius of its plane."""
    steps = np.arange(-half, half + 1.0) * scale_km
    reach = np.sqrt(2.0) * half * scale_km
    plane = point + steps[:, None, None] * frame[0] + steps[None, :, None] * frame[1] + reach * frame[2]
    directions = np.broadcast_to(-frame[2], (steps.size**2, 3))
    down, _ = cast(tree, plane.reshape(-1, 3), directions)
    heights = (reach - np.where(down <= 2.0 * reach, down, np.nan)) / scale_km
    return np.asarray(heights.reshape(steps.size, steps.size))
