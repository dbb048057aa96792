"""Least squares for one pose on the ideal plane: Levenberg-Marquardt on whitened residuals, compiled.

Parameters are the correction (dp, r) of ``pipeline.pose.se3``; with a = X - p, ``x_camera = C (a - dp - r x a)``,
so its derivatives are -C and C [a x] (seed 001 eq. 2.25-2.32, written in one line).
"""

from dataclasses import dataclass

import numba
import numpy as np

from pipeline.pose.records import Pose
from pipeline.pose.se3 import SE3Utils
from pipeline.records import FloatArray, Record

_MAX_STEPS = 60
# Of the cost, which is a sum of squared sigmas: far below what any test can see.
_SETTLED = 1e-9
_FIRST_DAMPING = 1e-6
_MOST_DAMPING = 1e12
_BEHIND = 1e100


@dataclass(frozen=True, eq=False)
class Fit(Record):
    """Where the least squares settled.

    Attributes
    ----------
    pose
        The pose.
    chi2
        Sum of squared whitened residuals.
    information
        (6, 6) of the correction (dp, r).
    """

    pose: Pose
    chi2: float
    information: FloatArray

    def __post_init__(self) -> None:
        self._freeze(information=(6, 6))


@numba.njit(cache=True, nogil=True)
def _cost(points, xy, white, c, p):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(len(points)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(3):
            a = points[i, k] - p[k]
            x += c[0, k] * a
            y += c[1, k] * a
            z += c[2, k] * a
        if z <= 0.0:
            return _BEHIND
        dx, dy = xy[i, 0] - x / z, xy[i, 1] - y / z
        e0 = white[i, 0, 0] * dx + white[i, 0, 1] * dy
        e1 = white[i, 1, 0] * dx + white[i, 1, 1] * dy
        total += e0 * e0 + e1 * e1
    return total


@numba.njit(cache=True, nogil=True)
def _normal_equations(points, xy, white, c, p):  # type: ignore[no-untyped-def]
    """Information (6, 6) and gradient (6,) of the correction."""
    information = np.zeros((6, 6))
    gradient = np.zeros(6)
    row = np.zeros((2, 6))
    plane = np.zeros((2, 6))
    camera = np.zeros((3, 6))
    for i in range(len(points)):
        a0, a1, a2 = points[i, 0] - p[0], points[i, 1] - p[1], points[i, 2] - p[2]
        for k in range(3):
            camera[k, 0], camera[k, 1], camera[k, 2] = -c[k, 0], -c[k, 1], -c[k, 2]
            camera[k, 3] = c[k, 1] * a2 - c[k, 2] * a1
            camera[k, 4] = c[k, 2] * a0 - c[k, 0] * a2
            camera[k, 5] = c[k, 0] * a1 - c[k, 1] * a0
        z = c[2, 0] * a0 + c[2, 1] * a1 + c[2, 2] * a2
        x = (c[0, 0] * a0 + c[0, 1] * a1 + c[0, 2] * a2) / z
        y = (c[1, 0] * a0 + c[1, 1] * a1 + c[1, 2] * a2) / z
        dx, dy = xy[i, 0] - x, xy[i, 1] - y
        for m in range(6):
            plane[0, m] = (camera[0, m] - x * camera[2, m]) / z
            plane[1, m] = (camera[1, m] - y * camera[2, m]) / z
        for e in range(2):
            w0, w1 = white[i, e, 0], white[i, e, 1]
            residual = w0 * dx + w1 * dy
            for m in range(6):
                row[e, m] = w0 * plane[0, m] + w1 * plane[1, m]
            for m in range(6):
                gradient[m] += row[e, m] * residual
                for n in range(m + 1):
                    information[m, n] += row[e, m] * row[e, n]
    for m in range(6):
        for n in range(m):
            information[n, m] = information[m, n]
    return information, gradient


@numba.njit(cache=True, nogil=True)
def _turn(r):  # type: ignore[no-untyped-def]
    """Exp(-r)."""
    angle = np.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    s = 1.0 - angle * angle / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    h = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / (angle * angle)
    k = np.array([[0.0, r[2], -r[1]], [-r[2], 0.0, r[0]], [r[1], -r[0], 0.0]])
    return np.eye(3) + s * k + h * (k @ k)


@numba.njit(cache=True, nogil=True)
def _levenberg(points, xy, white, c, p):  # type: ignore[no-untyped-def]
    cost = _cost(points, xy, white, c, p)
    damping = _FIRST_DAMPING
    information, gradient = _normal_equations(points, xy, white, c, p)
    for _ in range(_MAX_STEPS):
        damped = information.copy()
        for k in range(6):
            damped[k, k] += damping * information[k, k] + 1e-300
        step = np.linalg.solve(damped, gradient)
        c_new, p_new = c @ _turn(step[3:]), p + step[:3]
        new = _cost(points, xy, white, c_new, p_new)
        if new < cost:
            settled = cost - new <= _SETTLED * (1.0 + new)
            c, p, cost = c_new, p_new, new
            information, gradient = _normal_equations(points, xy, white, c, p)
            damping = max(damping * 0.1, 1e-12)
            if settled:
                break
        else:
            predicted = step @ gradient
            damping = damping * 10.0
            if damping > _MOST_DAMPING or predicted <= _SETTLED * (1.0 + cost):
                break
    return c, p, cost, information


@numba.njit(cache=True, nogil=True)
def _whitening_2x2(covariance):  # type: ignore[no-untyped-def]
    """Inverse of the lower Cholesky factor of each matrix."""
    white = np.zeros(covariance.shape)
    for i in range(len(covariance)):
        a, b, c = covariance[i, 0, 0], covariance[i, 1, 0], covariance[i, 1, 1]
        first = np.sqrt(a)
        second = np.sqrt(c - b * b / a)
        white[i, 0, 0] = 1.0 / first
        white[i, 1, 0] = -b / (a * second)
        white[i, 1, 1] = 1.0 / second
    return white


@numba.njit(cache=True, nogil=True)
def _squared_distances(points, xy, white, c, p):  # type: ignore[no-untyped-def]
    """Squared whitened residual of each point, infinite behind the camera."""
    squared = np.empty(len(points))
    for i in range(len(points)):
        squared[i] = _cost(points[i : i + 1], xy[i : i + 1], white[i : i + 1], c, p)
        if squared[i] >= _BEHIND:
            squared[i] = np.inf
    return squared


@numba.njit(cache=True, nogil=True)
def _spread(points, covariance, point_covariance, c, p):  # type: ignore[no-untyped-def]
    """Covariance on the plane with that of each point projected onto it."""
    out = covariance.copy()
    slope = np.zeros((2, 3))
    for i in range(len(points)):
        x, y, z = c @ (points[i] - p)
        if z <= 0.0:
            continue
        for k in range(3):
            slope[0, k] = (c[0, k] - x / z * c[2, k]) / z
            slope[1, k] = (c[1, k] - y / z * c[2, k]) / z
        for e in range(2):
            for f in range(2):
                for k in range(3):
                    for m in range(3):
                        out[i, e, f] += slope[e, k] * point_covariance[i, k, m] * slope[f, m]
    return out


def squared_distances(pose: Pose, points_km: FloatArray, xy: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared residuals of :func:`plane_residuals` over their covariances.

    Parameters
    ----------
    pose, points_km, xy
        As there.
    covariance
        (n, 2, 2) of the residuals.

    Returns
    -------
    numpy.ndarray
        (n,), infinite for a point behind the camera.
    """
    found: FloatArray = _squared_distances(
        points_km, xy, _whitening_2x2(covariance), pose.camera_from_body, pose.position_km
    )
    return found


def whitening(covariance: FloatArray) -> FloatArray:
    """Matrices W with ``W S W' = 1``.

    Parameters
    ----------
    covariance
        (n, k, k) positive definite.

    Returns
    -------
    numpy.ndarray
        (n, k, k) lower triangular.
    """
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def plane_residuals(pose: Pose, points_km: FloatArray, xy: FloatArray) -> FloatArray:
    """Measured minus predicted on the ideal plane.

    Parameters
    ----------
    pose
        The pose.
    points_km
        (n, 3) body-fixed.
    xy
        (n, 2) measured.

    Returns
    -------
    numpy.ndarray
        (n, 2), infinite for a point behind the camera.
    """
    camera = pose.to_camera(points_km)
    ahead = camera[:, 2:] > 0
    return np.asarray(np.where(ahead, xy - camera[:, :2] / np.where(ahead, camera[:, 2:], 1.0), np.inf))


def with_point_errors(
    pose: Pose, points_km: FloatArray, covariance: FloatArray, point_covariance_km2: FloatArray | None
) -> FloatArray:
    """Covariance on the ideal plane with that of the points projected onto it.

    Parameters
    ----------
    pose
        Where the projection is linearised.
    points_km
        (n, 3) body-fixed.
    covariance
        (n, 2, 2) of the measurements.
    point_covariance_km2
        (n, 3, 3), or None for exact points.

    Returns
    -------
    numpy.ndarray
        (n, 2, 2); points behind the camera keep that of the measurement alone.
    """
    if point_covariance_km2 is None:
        return covariance
    spread: FloatArray = _spread(points_km, covariance, point_covariance_km2, pose.camera_from_body, pose.position_km)
    return spread


def refine(pose: Pose, points_km: FloatArray, xy: FloatArray, covariance: FloatArray) -> Fit:
    """Least-squares pose near a start.

    Parameters
    ----------
    pose
        Start, with every point before the camera.
    points_km
        (n, 3) body-fixed.
    xy
        (n, 2) measured on the ideal plane.
    covariance
        (n, 2, 2) of the residuals there.

    Returns
    -------
    Fit
        The minimum; ``chi2`` is infinite where the start has points behind the camera.
    """
    # Positions in units of the scene, so that one damping suits both blocks.
    centre, scale = scene_scale(points_km)
    c, p, cost, information = _levenberg(
        np.ascontiguousarray((points_km - centre) / scale), np.ascontiguousarray(xy), _whitening_2x2(covariance),
        np.ascontiguousarray(pose.camera_from_body), (pose.position_km - centre) / scale,
    )  # fmt: skip
    unit = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
    u, _, vt = np.linalg.svd(c)
    found = Pose(u @ vt, p * scale + centre)
    return Fit(found, float(cost) if cost < _BEHIND else np.inf, information / np.outer(unit, unit))


def scene_scale(points_km: FloatArray) -> tuple[FloatArray, float]:
    """Centre and root mean square radius of points.

    Parameters
    ----------
    points_km
        (n, 3).

    Returns
    -------
    tuple
        (3,) centre and a positive length.
    """
    centre = points_km.mean(axis=0)
    scale = float(np.sqrt(((points_km - centre) ** 2).sum(axis=1).mean()))
    return centre, scale if scale > 0 else 1.0


def covariance_of(information: FloatArray) -> FloatArray:
    """Covariance of errors from the information about corrections.

    Parameters
    ----------
    information
        (6, 6) positive definite, of (dp, r).

    Returns
    -------
    numpy.ndarray
        (6, 6) of errors (x, y, z, rx, ry, rz).
    """
    unit = 1.0 / np.sqrt(np.diag(information))
    scaled = np.linalg.inv(information * np.outer(unit, unit))
    return SE3Utils.error_from_correction((scaled + scaled.T) / 2 * np.outer(unit, unit))
