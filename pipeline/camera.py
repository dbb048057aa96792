"""Owen camera model: project, unproject and their Jacobians (a pinhole is the case of zero distortion).

Source: seed 001 eq. 1.6, 1.12-1.16 and 2.23-2.24, read with the project's corrections: the photo frame is positive,
``x = f/z (X, Y)``, and every entry of K applies.
"""

import numba
import numpy as np

from pipeline.records import BoolArray, CameraModel, FloatArray

UNPROJECT_TOLERANCE_PX = 1e-8
_MAX_NEWTON_STEPS = 30
# A step that would leave this multiple of the array's own extent means that the model folds over there.
_MAX_PHOTO_RADIUS_FACTOR = 4.0
# Points between the optical axis and a solution at which the model must not be turned inside out.
_FOLD_SAMPLES = 32


def distort(camera: CameraModel, photo_mm: FloatArray) -> FloatArray:
    """Apply radial, tip/tilt and pinwheel terms.

    Parameters
    ----------
    camera
        The model.
    photo_mm
        (n, 2) ideal photo-plane points (x, y), mm.

    Returns
    -------
    numpy.ndarray
        (n, 2) distorted points, mm.
    """
    e1, e2, e3, e4, e5, e6 = camera.distortion_eps
    x, y = photo_mm[:, 0], photo_mm[:, 1]
    r2 = x * x + y * y
    r = np.sqrt(r2)
    scale = 1.0 + e1 * r2 + e2 * r2 * r2 + e3 * y + e4 * x
    swirl = e5 * r + e6 * r2 * r
    return np.stack([scale * x - swirl * y, scale * y + swirl * x], axis=1)


def distort_jacobian(camera: CameraModel, photo_mm: FloatArray) -> FloatArray:
    """Derivative of :func:`distort` (seed 001 eq. 2.23 as corrected; the limit at r = 0 is the identity).

    Parameters
    ----------
    camera
        The model.
    photo_mm
        (n, 2) ideal points, mm.

    Returns
    -------
    numpy.ndarray
        (n, 2, 2), d(distorted)/d(ideal).
    """
    e1, e2, e3, e4, e5, e6 = camera.distortion_eps
    x, y = photo_mm[:, 0], photo_mm[:, 1]
    r2 = x * x + y * y
    r = np.sqrt(r2)
    unit = np.divide(photo_mm, r[:, None], out=np.zeros_like(photo_mm), where=r[:, None] > 0)
    scale = 1.0 + e1 * r2 + e2 * r2 * r2 + e3 * y + e4 * x
    swirl = e5 * r + e6 * r2 * r
    scale_gradient = (2 * e1 * r + 4 * e2 * r2 * r)[:, None] * unit + np.array([e4, e3])
    swirl_gradient = (e5 + 3 * e6 * r2)[:, None] * unit
    jacobian = photo_mm[:, :, None] * scale_gradient[:, None, :]
    jacobian += np.stack([-y, x], axis=1)[:, :, None] * swirl_gradient[:, None, :]
    jacobian[:, 0, 0] += scale
    jacobian[:, 1, 1] += scale
    jacobian[:, 0, 1] -= swirl
    jacobian[:, 1, 0] += swirl
    return np.asarray(jacobian)


def _pixel_from_photo(camera: CameraModel, distorted_mm: FloatArray) -> FloatArray:
    uv = distorted_mm @ camera.k_px_per_mm.T
    if camera.k_xy_px_per_mm2.any():
        uv = uv + np.prod(distorted_mm, axis=1)[:, None] * camera.k_xy_px_per_mm2
    return uv[:, ::-1] + camera.principal_point_vu


def _pixel_jacobian(camera: CameraModel, distorted_mm: FloatArray) -> FloatArray:
    jacobian = np.broadcast_to(camera.k_px_per_mm, (len(distorted_mm), 2, 2))
    if camera.k_xy_px_per_mm2.any():
        jacobian = jacobian + camera.k_xy_px_per_mm2[None, :, None] * distorted_mm[:, None, ::-1]
    return jacobian[:, ::-1, :]


def project(camera: CameraModel, points: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Pixels of points or directions in the camera frame.

    Parameters
    ----------
    camera
        The model.
    points
        (n, 3) camera frame, any length unit.

    Returns
    -------
    tuple
        (n, 2) pixels, NaN behind the camera; (n,) True in front of it.
    """
    points = np.asarray(points, dtype=float)
    ahead = points[:, 2] > 0
    depth = np.where(ahead, points[:, 2], np.nan)
    photo = camera.focal_length_mm * points[:, :2] / depth[:, None]
    return _pixel_from_photo(camera, distort(camera, photo)), ahead


def project_jacobian(camera: CameraModel, points: FloatArray) -> FloatArray:
    """Derivative of :func:`project` with respect to the point (seed 001 eq. 2.24 as corrected).

    Parameters
    ----------
    camera
        The model.
    points
        (n, 3) camera frame, z > 0.

    Returns
    -------
    numpy.ndarray
        (n, 2, 3), d(v, u)/d(X, Y, Z), pixels per unit of ``points``.
    """
    points = np.asarray(points, dtype=float)
    x, y, z = points.T
    zero = np.zeros_like(x)
    pinhole = np.stack([np.stack([z, zero, -x], axis=1), np.stack([zero, z, -y], axis=1)], axis=1)
    pinhole = pinhole * (camera.focal_length_mm / z**2)[:, None, None]
    photo = camera.focal_length_mm * points[:, :2] / z[:, None]
    result: FloatArray = _pixel_jacobian(camera, distort(camera, photo)) @ distort_jacobian(camera, photo) @ pinhole
    return result


def unproject(camera: CameraModel, pixels_vu: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Directions through pixels: the exact inverse of :func:`project` by Newton's method.

    Parameters
    ----------
    camera
        The model.
    pixels_vu
        (n, 2) pixels.

    Returns
    -------
    tuple
        (n, 3) unit vectors in the camera frame, NaN where the inverse was not found to 1e-8 px; (n,) True where it
        was.
    """
    pixels_vu = np.asarray(pixels_vu, dtype=float)
    centred = (pixels_vu - camera.principal_point_vu)[:, ::-1]
    photo: FloatArray = centred @ np.linalg.inv(camera.k_px_per_mm).T
    ok: BoolArray = np.asarray(np.isfinite(photo).all(axis=1))
    if camera.distortion_eps.any() or camera.k_xy_px_per_mm2.any():
        photo, ok = _newton(camera, pixels_vu, photo)
    rays = np.concatenate([photo, np.full((len(photo), 1), camera.focal_length_mm)], axis=1)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays[~ok] = np.nan
    return rays, ok


def _newton(camera: CameraModel, pixels_vu: FloatArray, start_mm: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Photo-plane points that project to ``pixels_vu``; flags where the residual is within tolerance."""
    scale = np.abs(np.linalg.inv(camera.k_px_per_mm)).max()
    photo = np.where(np.isfinite(start_mm), start_mm, 0.0)
    limit = _MAX_PHOTO_RADIUS_FACTOR * scale * max(camera.shape_vu) + np.abs(photo).max(initial=0.0)
    constants = np.concatenate([camera.distortion_eps, camera.k_px_per_mm.ravel(), camera.k_xy_px_per_mm2])
    target_uv = np.ascontiguousarray((pixels_vu - camera.principal_point_vu)[:, ::-1])
    ok = _invert(photo, target_uv, constants, limit, 1e-12 / scale**2)
    return photo, np.asarray(ok & _before_fold(photo, constants, camera.handedness))


@numba.njit(cache=True, nogil=True)
def _forward(x, y, c):  # type: ignore[no-untyped-def]
    """(u, v) from the principal point and d(u, v)/d(x, y), row by row, of one photo-plane point.

    The formulae of :func:`distort` and :func:`distort_jacobian`; constants are epsilon 1-6, K by rows, (Kxxy, Kyxy).
    """
    r2 = x * x + y * y
    r = np.sqrt(r2)
    scale = 1.0 + c[0] * r2 + c[1] * r2 * r2 + c[2] * y + c[3] * x
    swirl = c[4] * r + c[5] * r2 * r
    radial = 2.0 * c[0] + 4.0 * c[1] * r2
    turning = (c[4] / r if r > 0.0 else 0.0) + 3.0 * c[5] * r
    scale_x, scale_y = radial * x + c[3], radial * y + c[2]
    swirl_x, swirl_y = turning * x, turning * y
    dx, dy = scale * x - swirl * y, scale * y + swirl * x
    dxx, dxy = scale + x * scale_x - y * swirl_x, x * scale_y - y * swirl_y - swirl
    dyx, dyy = y * scale_x + x * swirl_x + swirl, scale + y * scale_y + x * swirl_y
    kxx, kxy = c[6] + c[10] * dy, c[7] + c[10] * dx
    kyx, kyy = c[8] + c[11] * dy, c[9] + c[11] * dx
    u, v = c[6] * dx + c[7] * dy + c[10] * dx * dy, c[8] * dx + c[9] * dy + c[11] * dx * dy
    return u, v, kxx * dxx + kxy * dyx, kxx * dxy + kxy * dyy, kyx * dxx + kyy * dyx, kyx * dxy + kyy * dyy


@numba.njit(cache=True, nogil=True)
def _invert(photo, target, constants, limit, singular):  # type: ignore[no-untyped-def]
    """Newton's method from the start in ``photo``, which is overwritten; flags where it has settled."""
    ok = np.zeros(len(photo), dtype=np.bool_)
    for i in range(len(photo)):
        x, y = photo[i, 0], photo[i, 1]
        worst = np.inf
        for _ in range(_MAX_NEWTON_STEPS):
            u, v, a, b, c, d = _forward(x, y, constants)
            du, dv = target[i, 0] - u, target[i, 1] - v
            if not np.isfinite(du + dv):
                worst = np.inf
                break
            worst = max(abs(du), abs(dv))
            determinant = a * d - b * c
            if worst <= UNPROJECT_TOLERANCE_PX / 10 or not abs(determinant) > singular:
                break
            x = min(max(x + (d * du - b * dv) / determinant, -limit), limit)
            y = min(max(y + (a * dv - c * du) / determinant, -limit), limit)
        photo[i, 0], photo[i, 1] = x, y
        ok[i] = worst <= UNPROJECT_TOLERANCE_PX
    return ok


@numba.njit(cache=True, nogil=True)
def _before_fold(photo, constants, handedness):  # type: ignore[no-untyped-def]
    """True where the model is nowhere turned inside out between the optical axis and a point.

    Beyond a fold the residual can vanish at a wrong root, also on a branch that a second fold has turned upright again.
    """
    upright = np.ones(len(photo), dtype=np.bool_)
    for i in range(len(photo)):
        for k in range(1, _FOLD_SAMPLES + 1):
            share = k / _FOLD_SAMPLES
            _, _, a, b, c, d = _forward(share * photo[i, 0], share * photo[i, 1], constants)
            if not handedness * (a * d - b * c) > 0.0:
                upright[i] = False
                break
    return upright


def unproject_jacobian(camera: CameraModel, pixels_vu: FloatArray) -> FloatArray:
    """Derivative of the unit ray of :func:`unproject` with respect to the pixel.

    Parameters
    ----------
    camera
        The model.
    pixels_vu
        (n, 2) pixels inside the model's domain.

    Returns
    -------
    numpy.ndarray
        (n, 3, 2), d(unit ray)/d(v, u), per pixel.
    """
    rays, _ = unproject(camera, pixels_vu)
    photo = camera.focal_length_mm * rays[:, :2] / rays[:, 2:]
    forward = _pixel_jacobian(camera, distort(camera, photo)) @ distort_jacobian(camera, photo)
    length = camera.focal_length_mm / rays[:, 2]
    plane = np.zeros((len(rays), 3, 2))
    plane[:, 0, 0] = plane[:, 1, 1] = 1.0
    tangent = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) @ plane / length[:, None, None]
    result: FloatArray = tangent @ np.linalg.inv(forward)
    return result


def pixel_scale_rad(camera: CameraModel) -> FloatArray:
    """Angle that one pixel covers along v and u at the array centre.

    Parameters
    ----------
    camera
        The model.

    Returns
    -------
    numpy.ndarray
        (2,) radians per pixel.
    """
    jacobian = unproject_jacobian(camera, camera.centre_vu[None])[0]
    result: FloatArray = np.linalg.norm(jacobian, axis=0)
    return result


def field_of_view(camera: CameraModel, margin_vu: tuple[float, float] = (0.0, 0.0)) -> tuple[FloatArray, float]:
    """Cone that holds the array widened by a margin.

    Parameters
    ----------
    camera
        The model.
    margin_vu
        Widening on every side, pixels.

    Returns
    -------
    tuple
        (3,) axis in the camera frame; half-angle in radians.
    """
    rows, cols = camera.shape_vu
    low_v, low_u = -0.5 - margin_vu[0], -0.5 - margin_vu[1]
    high_v, high_u = rows - 0.5 + margin_vu[0], cols - 0.5 + margin_vu[1]
    middle_v, middle_u = (low_v + high_v) / 2, (low_u + high_u) / 2
    outline = [(v, u) for v in (low_v, middle_v, high_v) for u in (low_u, middle_u, high_u)]
    rays, ok = unproject(camera, np.array(outline))
    axis = unproject(camera, camera.centre_vu[None])[0][0]
    if not np.isfinite(axis).all():
        return np.array([0.0, 0.0, 1.0]), float(np.pi)
    if ok.sum() <= 1:  # The middle alone is no cone.
        return axis, float(np.pi)
    half = float(np.arccos(np.clip(rays[ok] @ axis, -1, 1)).max())
    return axis, half if ok.all() else min(2.0 * half, float(np.pi))
