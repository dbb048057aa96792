"""Owen camera model: project, unproject and their Jacobians (a pinhole is the case of zero distortion).

Source: seed 001 eq. 1.6, 1.12-1.16 and 2.23-2.24, read with the project's corrections: the photo frame is positive,
``x = f/z (X, Y)``, and every entry of K applies.
"""

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
    residual = np.full_like(photo, np.inf)
    for _ in range(_MAX_NEWTON_STEPS):
        distorted = distort(camera, photo)
        residual = pixels_vu - _pixel_from_photo(camera, distorted)
        worst = np.abs(residual).max(axis=1)
        if not (worst > UNPROJECT_TOLERANCE_PX / 10).any():
            break
        step = _solve_2x2(_pixel_jacobian(camera, distorted) @ distort_jacobian(camera, photo), residual, scale)
        photo = np.clip(photo + step, -limit, limit)
    converged = (np.abs(residual) <= UNPROJECT_TOLERANCE_PX).all(axis=1)
    return photo, np.asarray(converged & _before_fold(camera, photo))


def _before_fold(camera: CameraModel, photo_mm: FloatArray) -> BoolArray:
    """True where the model is nowhere turned inside out between the optical axis and a point.

    Beyond a fold the residual can vanish at a wrong root, also on a branch that a second fold has turned upright again.
    """
    share = np.linspace(1.0 / _FOLD_SAMPLES, 1.0, _FOLD_SAMPLES)
    on_the_way = (share[:, None, None] * photo_mm).reshape(-1, 2)
    jacobian = _pixel_jacobian(camera, distort(camera, on_the_way)) @ distort_jacobian(camera, on_the_way)
    (a, b), (c, d) = np.moveaxis(jacobian, 0, 2)
    # Rows are (v, u), columns (x, y): the order alone turns the sign.
    upright = camera.handedness * (b * c - a * d) > 0
    return np.asarray(upright.reshape(_FOLD_SAMPLES, -1).all(axis=0))


def _solve_2x2(matrix: FloatArray, right: FloatArray, scale: float) -> FloatArray:
    """Solutions of (n, 2, 2) systems by Cramer's rule; zero where a system is singular or not finite."""
    (a, b), (c, d) = np.moveaxis(matrix, 0, 2)
    determinant = a * d - b * c
    solvable = np.isfinite(right).all(axis=1) & (np.abs(determinant) > 1e-12 / scale**2)
    divisor = np.where(solvable, determinant, 1.0)
    step = np.stack([d * right[:, 0] - b * right[:, 1], a * right[:, 1] - c * right[:, 0]], axis=1) / divisor[:, None]
    return np.asarray(np.where(solvable[:, None], step, 0.0))


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
