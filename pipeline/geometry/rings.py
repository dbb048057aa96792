"""Rings in their plane: radii of edges, rays through pixels, backplanes, shadows and what stands in front.

The ring frame has its origin in the planet's centre, x toward the reference of longitudes and z toward the pole.
"""

import numpy as np
import xarray as xr

from pipeline.camera import unproject
from pipeline.records import Body, BoolArray, CameraModel, FloatArray, RingFeature, RingKind, RingSystem

TURN = 2.0 * np.pi


def edges_of(feature: RingFeature) -> tuple[bool, ...]:
    """Which edges a feature has.

    Parameters
    ----------
    feature
        Ringlet, gap or single edge.

    Returns
    -------
    tuple of bool
        One per edge, inner first: whether it lies at ``a_km + width_km``.
    """
    return (False, True) if feature.kind in (RingKind.RINGLET, RingKind.GAP) else (False,)


def edge_radius(feature: RingFeature, outer: bool, longitude_rad: FloatArray) -> FloatArray:
    """Radius of an edge: a Keplerian ellipse less its normal modes (French et al. 1993, Icarus 103, 163, eq. 1).

    Parameters
    ----------
    feature
        Elements at the time when the light left.
    outer
        The edge at ``a_km + width_km`` with the same eccentricity.
    longitude_rad
        (n,).

    Returns
    -------
    numpy.ndarray
        (n,) km.
    """
    a = feature.a_km + (feature.width_km if outer else 0.0)
    e = feature.ae_km / feature.a_km
    radius = a * (1.0 - e**2) / (1.0 + e * np.cos(longitude_rad - feature.long_peri_rad))
    for m, amplitude, phase in feature.modes:
        radius = radius - amplitude * np.cos(m * longitude_rad - phase)
    return np.asarray(radius)


def edge_points(feature: RingFeature, outer: bool, longitude_rad: FloatArray) -> FloatArray:
    """Points of an edge, off the plane where it is inclined.

    Parameters
    ----------
    feature, outer, longitude_rad
        As of :func:`edge_radius`.

    Returns
    -------
    numpy.ndarray
        (n, 3) ring frame, km.
    """
    radius = edge_radius(feature, outer, longitude_rad)
    height = feature.a_sin_i_km * np.sin(longitude_rad - feature.long_node_rad)
    return np.stack([radius * np.cos(longitude_rad), radius * np.sin(longitude_rad), height], axis=1)


def seen_curve(feature: RingFeature, outer: bool, observer_km: FloatArray, count: int) -> FloatArray:
    """Curve in the plane z = 0 that an observer sees an edge on.

    Parameters
    ----------
    feature, outer
        Edge.
    observer_km
        (3,) ring frame.
    count
        Samples of longitude, at ``2 pi k / count``.

    Returns
    -------
    numpy.ndarray
        (count,) radius in km; an inclined edge is carried along the lines of sight into the plane.
    """
    longitude = TURN * np.arange(count) / count
    if feature.a_sin_i_km == 0.0:
        return edge_radius(feature, outer, longitude)
    points = edge_points(feature, outer, longitude)
    share = points[:, 2] / (points[:, 2] - observer_km[2])
    flat = points + share[:, None] * (observer_km - points)
    angle = np.unwrap(np.arctan2(flat[:, 1], flat[:, 0]))
    order = np.argsort(angle)
    return np.asarray(np.interp(longitude, angle[order], np.hypot(flat[order, 0], flat[order, 1]), period=TURN))


def plane_points(observer_km: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where rays meet the ring plane.

    Parameters
    ----------
    observer_km
        (3,) ring frame, off the plane.
    rays
        (n, 3) directions of any length, ring frame.

    Returns
    -------
    tuple
        (n, 3) points, not-a-number where a ray runs away from the plane; (n,) lengths of rays to there.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -observer_km[2] / rays[:, 2]
    share = np.where(np.isfinite(share) & (share > 0), share, np.nan)
    points = observer_km + share[:, None] * rays
    points[:, 2] = 0.0 * share
    return points, share


def ring_backplanes(
    rings: RingSystem, camera: CameraModel, camera_from_j2000: FloatArray, v: FloatArray, u: FloatArray
) -> xr.Dataset:
    """Ring radius, longitude and distance behind every pixel of a grid.

    Parameters
    ----------
    rings
        System.
    camera, camera_from_j2000
        Model and (3, 3) attitude.
    v, u
        Rows and columns of the grid, pixels.

    Returns
    -------
    xarray.Dataset
        ``radius`` (km), ``longitude`` (deg, 0 to 360) and ``distance`` (km from the camera) over (v, u);
        not-a-number where the line of sight misses the plane or the camera model has no inverse.
    """
    places = np.stack(np.meshgrid(v, u, indexing="ij"), axis=2).reshape(-1, 2)
    rays = unproject(camera, places)[0] @ (rings.plane_from_j2000 @ camera_from_j2000.T).T
    points, distance = plane_points(rings.observer_km, rays)
    planes = {
        "radius": (np.hypot(points[:, 0], points[:, 1]), "km"),
        "longitude": (np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360.0, "deg"),
        "distance": (distance, "km"),
    }
    shape = (len(v), len(u))
    return xr.Dataset(
        {name: (("v", "u"), values.reshape(shape), {"units": unit}) for name, (values, unit) in planes.items()},
        coords={"v": ("v", v, {"units": "px"}), "u": ("u", u, {"units": "px"})}, attrs={"planet": rings.planet},
    )  # fmt: skip


def ring_forms(rings: RingSystem, bodies: tuple[Body, ...], pad_km: float) -> FloatArray:
    """Bodies as quadratic forms in the ring frame, blown up by a pad.

    Parameters
    ----------
    rings
        System.
    bodies
        Planet and moons; of a mesh the bounding ellipsoid counts.
    pad_km
        Added to each semi-axis, beside ten scale heights of a haze.

    Returns
    -------
    numpy.ndarray
        (n, 13): centre, rows of B with ``(x - c) B (x - c) = 1`` on the surface, and the factor on B that shrinks the
        body as far below its true surface; huge where nothing is left of it.
    """
    forms = np.zeros((len(bodies), 13))
    for row, body in zip(forms, bodies, strict=True):
        turn = rings.plane_from_j2000 @ body.body_from_j2000.T
        extra = pad_km + 10.0 * body.haze_km
        radii = body.radii_km + extra
        row[:3] = rings.plane_from_j2000 @ (body.position_km - rings.position_km)
        row[3:12] = (turn @ np.diag(1.0 / radii**2) @ turn.T).ravel()
        row[12] = float((radii / np.maximum(body.radii_km - extra, 1e-6 * radii)).max()) ** 2
    return forms


def meets(forms: FloatArray, start_km: FloatArray, rays: FloatArray, within: FloatArray | None = None) -> BoolArray:
    """Whether rays meet any of the bodies.

    Parameters
    ----------
    forms
        (m, 13) of :func:`ring_forms`.
    start_km
        (3,) or (n, 3) starts.
    rays
        (n, 3) directions.
    within
        (n,) multiples of the rays up to which a body counts; None for any distance.

    Returns
    -------
    numpy.ndarray
        (n,) True where one is ahead.
    """
    struck = np.zeros(len(rays), bool)
    for form in forms:
        matrix = form[3:12].reshape(3, 3)
        gap = start_km - form[:3]
        a = ((rays @ matrix) * rays).sum(axis=1)
        b = ((rays @ matrix) * gap).sum(axis=1)
        c = ((gap @ matrix) * gap).sum(axis=-1) - 1.0
        root2 = b * b - a * c
        with np.errstate(invalid="ignore"):
            near = (-b - np.sqrt(np.where(root2 >= 0, root2, np.nan))) / a
        limit = np.inf if within is None else within
        struck |= (near > 0) & (near < limit)
    return struck
