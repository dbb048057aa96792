"""Ellipsoids in closed form: limb, terminator, sub-observer point, rays.

In coordinates divided by the semi-axes the body is a unit sphere: the limb is a circle in the plane
``x . q = 1`` with q the scaled observer, and the terminator is a great circle (Dermott 1990; the same construction
underlies SPICE's edlimb). Everything here is in the body-fixed frame, kilometres.
"""

import numpy as np

from pipeline.errors import ContractError
from pipeline.records import BoolArray, FloatArray


def _basis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors that complete a unit vector to a right-handed frame."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def limb_points(radii_km: FloatArray, observer_km: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Points of the limb.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    observer_km
        (3,) observer from the body's centre, body-fixed, outside the ellipsoid.
    angle_rad
        (n,) parameter of the limb's circle on the scaled sphere, one turn is the whole limb.

    Returns
    -------
    numpy.ndarray
        (n, 3) body-fixed.

    Raises
    ------
    ContractError
        If the observer is inside the ellipsoid.
    """
    scaled = observer_km / radii_km
    distance = float(np.linalg.norm(scaled))
    if distance <= 1.0:
        raise ContractError("the observer is inside the ellipsoid")
    axis = scaled / distance
    first, second = _basis(axis)
    ring = np.cos(angle_rad)[:, None] * first + np.sin(angle_rad)[:, None] * second
    unit = axis / distance + np.sqrt(1.0 - 1.0 / distance**2) * ring
    return np.asarray(unit * radii_km)


def terminator_points(radii_km: FloatArray, sun: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Points where the Sun's centre stands on the horizon, for a Sun at infinity.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    sun
        (3,) unit vector toward the Sun, body-fixed.
    angle_rad
        (n,) parameter, one turn is the whole terminator.

    Returns
    -------
    numpy.ndarray
        (n, 3) body-fixed.
    """
    # The normal at x (scaled) is x / radii; it is across the Sun where x . (sun / radii) = 0.
    axis = sun / radii_km
    first, second = _basis(axis / np.linalg.norm(axis))
    ring = np.cos(angle_rad)[:, None] * first + np.sin(angle_rad)[:, None] * second
    return np.asarray(ring * radii_km)


def surface_normal(radii_km: FloatArray, points_km: FloatArray) -> FloatArray:
    """Outward unit normals.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    points_km
        (n, 3) on the surface.

    Returns
    -------
    numpy.ndarray
        (n, 3).
    """
    gradient = points_km / radii_km**2
    return np.asarray(gradient / np.linalg.norm(gradient, axis=1)[:, None])


def is_visible(radii_km: FloatArray, observer_km: FloatArray, points_km: FloatArray) -> BoolArray:
    """Which surface points an observer sees past the body itself.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    observer_km
        (3,) observer from the body's centre.
    points_km
        (n, 3) on the surface.

    Returns
    -------
    numpy.ndarray
        (n,) True on the near side of the limb's plane.
    """
    return np.asarray((points_km / radii_km) @ (observer_km / radii_km) > 1.0)


def sub_point(radii_km: FloatArray, direction: FloatArray) -> FloatArray:
    """Where the line from the centre along a direction leaves the body (SPICE's INTERCEPT/ELLIPSOID point).

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    direction
        (3,) any length.

    Returns
    -------
    numpy.ndarray
        (3,) on the surface.
    """
    return np.asarray(direction / np.linalg.norm(direction / radii_km))


def intersect(radii_km: FloatArray, observer_km: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
    """First points at which rays meet the surface.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    observer_km
        (3,) start of the rays, outside.
    rays
        (n, 3) directions of any length, body-fixed.

    Returns
    -------
    tuple
        (n, 3) points, NaN where a ray misses; (n,) True where it hits in front of the observer.
    """
    start, along = observer_km / radii_km, rays / radii_km
    a = (along**2).sum(axis=1)
    b = along @ start
    c = start @ start - 1.0
    # b^2 - a c by Lagrange's identity: far away the two terms agree in all of their digits.
    root2 = a - (np.cross(along, start) ** 2).sum(axis=1)
    hit = (root2 >= 0) & (b < 0)
    # c / (-b + root) is the near root without the difference of two nearly equal numbers.
    near = c / np.where(hit, -b + np.sqrt(np.where(hit, root2, 0.0)), np.nan)
    return observer_km + near[:, None] * rays, np.asarray(hit)


def silhouette_form(radii_km: FloatArray, observer_km: FloatArray) -> FloatArray:
    """Quadratic form that is positive for rays which meet the body: the cone of the limb.

    Parameters
    ----------
    radii_km
        (3,) semi-axes.
    observer_km
        (3,) observer.

    Returns
    -------
    numpy.ndarray
        (3, 3) symmetric M with ``d M d`` the discriminant of the intersection of a ray d.
    """
    inverse = np.diag(1.0 / radii_km**2)
    start = inverse @ observer_km
    return np.asarray(np.outer(start, start) - (observer_km @ start - 1.0) * inverse)
