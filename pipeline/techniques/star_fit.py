"""Pointing from matched stars: Procrustes under the full camera model, outliers, and an honest covariance."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.special import chdtri

from pipeline.camera import project
from pipeline.geometry.pointing import corrected_attitude, move_pivot, offset_between
from pipeline.geometry.procrustes import kabsch
from pipeline.geometry.rotations import plane_rotation, plane_rotation_derivative
from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray
from pipeline.techniques.base import NavContext

_MEDIAN_CHI2_2DOF = 2.0 * np.log(2.0)
# Re-prediction with the corrected attitude converges by the square of the field's size: a few rounds settle it, and
# after a step this short what is left is far below the best sigma.
_ROUNDS = 5
_SETTLED_PX = 1e-4
# Halvings of an interval of ten times the largest residual: a millionth of it is far below any sigma.
_BISECTIONS = 24
# With fewer stars a median says nothing of how well the camera model holds.
_MIN_STARS_FOR_SCATTER = 6


class StarFitOptions(Options):
    """Outliers and scatter."""

    outlier_chance: float = Field(
        1e-3, gt=0, lt=0.5, description="chance by which a good star may look like an outlier"
    )
    model_floor_px: float = Field(
        0.1, ge=0, le=5, description="per-axis camera-model error granted before a star counts as an outlier, pixels"
    )
    prior_dof: float = Field(
        4.0, ge=0, le=100, description="weight, in degrees of freedom, of the belief that the stated sigmas are right"
    )


@dataclass(frozen=True, eq=False)
class StarFit:
    """Pointing fitted to matched stars.

    Attributes
    ----------
    offset_vu, rotation_rad
        Similarity about ``pivot_vu``.
    information
        (2, 2) or (3, 3), residual scatter included.
    pivot_vu
        Weighted centroid of the inliers' predictions.
    centre_offset_vu
        Same answer at the array centre.
    residual_vu
        (n, 2) of every star given.
    inlier
        (n,) flags.
    extra_sigma_px
        Per-axis scatter beyond the stated sigmas.
    """

    offset_vu: FloatArray
    rotation_rad: float
    information: FloatArray
    pivot_vu: FloatArray
    centre_offset_vu: FloatArray
    residual_vu: FloatArray
    inlier: BoolArray
    extra_sigma_px: float


def predict_at(context: NavContext, direction: FloatArray, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
    """Pixels of J2000 directions once the pointing is corrected.

    Parameters
    ----------
    context
        Camera and a-priori attitude.
    direction
        (n, 3) unit vectors, J2000.
    offset_vu, rotation_rad
        Correction at the array centre.

    Returns
    -------
    numpy.ndarray
        (n, 2) pixels, NaN behind the camera.
    """
    attitude = corrected_attitude(context.camera_model, context.camera_from_j2000, offset_vu, rotation_rad)
    return project(context.camera_model, direction @ attitude.T)[0]


def _solve(
    context: NavContext, direction: FloatArray, measured_vu: FloatArray, weights: FloatArray, attitude: FloatArray
) -> FloatArray:
    """Attitude that carries the stars onto their measured pixels, predictions renewed under each new attitude."""
    camera, centre = context.camera_model, context.camera_model.centre_vu
    for _ in range(_ROUNDS):
        predicted = project(camera, direction @ attitude.T)[0]
        offset, theta = _similarity(predicted, measured_vu, weights, centre, context.fit_camera_rotation)
        attitude = corrected_attitude(camera, attitude, offset, theta)
        if np.abs(offset).max() + abs(theta) * max(camera.shape_vu) < _SETTLED_PX:
            break
    return attitude


def _similarity(
    predicted_vu: FloatArray, measured_vu: FloatArray, weights: FloatArray, centre_vu: FloatArray, turns: bool
) -> tuple[FloatArray, float]:
    """Weighted offset at the array centre, and rotation where it is a parameter and two stars show it."""
    if not turns or len(weights) < 2:
        return weights @ (measured_vu - predicted_vu) / weights.sum(), 0.0
    offset, theta = kabsch(predicted_vu, measured_vu, weights)
    pivot = weights @ predicted_vu / weights.sum()
    return move_pivot(offset, theta, pivot, centre_vu)[0], theta


def _design(predicted_vu: FloatArray, pivot_vu: FloatArray, rotation_rad: float, size: int) -> FloatArray:
    """(n, 2, size) derivative of the actual pixel with respect to (dv, du[, theta]) about the pivot."""
    design = np.zeros((len(predicted_vu), 2, size))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    if size == 3:
        design[:, :, 2] = (predicted_vu - pivot_vu) @ plane_rotation_derivative(rotation_rad).T
    return design


class _Spread:
    """Residuals in the axes of their own covariances, where adding an isotropic scatter is one sum."""

    def __init__(self, residual_vu: FloatArray, covariance: FloatArray) -> None:
        self._variance, axes = np.linalg.eigh(covariance)
        self._square = np.einsum("nij,ni->nj", axes, residual_vu) ** 2

    def distance2(self, extra_sigma: float) -> FloatArray:
        """(n,) squared Mahalanobis distances with a scatter added."""
        return np.asarray((self._square / (self._variance + extra_sigma**2)).sum(axis=1))

    def scatter(self, target: float, use_median: bool) -> float:
        """Per-axis sigma to add so that the median (or the sum) of the squared distances meets its target."""

        def excess(extra: float) -> float:
            distance2 = self.distance2(extra)
            return float(np.median(distance2) if use_median else distance2.sum()) - target

        if excess(0.0) <= 0:
            return 0.0
        low, high = 0.0, 10.0 * float(np.sqrt(self._square.max())) + 1e-9
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        return high


def _reject(
    context: NavContext,
    predicted_vu: FloatArray,
    measured_vu: FloatArray,
    covariance: FloatArray,
    options: StarFitOptions,
) -> BoolArray:
    """Drop the worst star, one at a time, until none is an outlier or too few would remain to tell.

    ``predicted_vu`` is under an attitude close to the answer, so that a similarity in the image plane is exact enough.
    """
    inlier = np.ones(len(predicted_vu), bool)
    limit = float(chdtri(2, options.outlier_chance))
    turns, centre = context.fit_camera_rotation, context.camera_model.centre_vu
    weights = _weights(covariance + options.model_floor_px**2 * np.eye(2))
    while inlier.sum() > (3 if turns else 2):
        offset, theta = _similarity(predicted_vu[inlier], measured_vu[inlier], weights[inlier], centre, turns)
        fitted = (predicted_vu[inlier] - centre) @ plane_rotation(theta).T + centre + offset
        spread = _Spread(measured_vu[inlier] - fitted, covariance[inlier])
        extra = options.model_floor_px
        if inlier.sum() >= _MIN_STARS_FOR_SCATTER:
            extra = max(extra, spread.scatter(_MEDIAN_CHI2_2DOF, use_median=True))
        # A star's own pull shrinks its residual: what is left of its variance is one minus its share of the weight,
        # and of the rotation's, which makes three parameters out of two.
        share = weights[inlier] / weights[inlier].sum() * (1.5 if turns else 1.0)
        distance2 = spread.distance2(extra) / np.clip(1.0 - share, 0.1, 1.0)
        worst = int(np.argmax(distance2))
        if distance2[worst] <= limit:
            break
        inlier[np.flatnonzero(inlier)[worst]] = False
    return inlier


def _weights(covariance: FloatArray) -> FloatArray:
    return np.asarray(2.0 / np.trace(covariance, axis1=1, axis2=2))


def fit_stars(
    context: NavContext,
    direction: FloatArray,
    predicted_vu: FloatArray,
    measured_vu: FloatArray,
    covariance_vu: FloatArray,
    options: StarFitOptions,
) -> StarFit:
    """Fit offset and rotation to matched stars; stars in a wrong place lose.

    Weights are isotropic, as Procrustes needs; the covariance is that of the weighted estimate under the full
    covariance of every star. Scatter beyond the stated sigmas is added to every star as a further independent
    error, shrunk by a prior worth ``prior_dof`` degrees of freedom.

    Parameters
    ----------
    context
        Camera, attitude, degrees of freedom.
    direction
        (n, 3) J2000 unit vectors, n >= 1.
    predicted_vu
        (n, 2) pixels under the a-priori attitude.
    measured_vu
        (n, 2) pixels.
    covariance_vu
        (n, 2, 2) px^2 of measurement and catalogue place together.
    options
        Limits.

    Returns
    -------
    StarFit
        With one star, or without a rotation parameter, theta is zero; with one star its information is zero.
    """
    camera, prior = context.camera_model, context.camera_from_j2000
    attitude = _solve(
        context, direction, measured_vu, _weights(covariance_vu + options.model_floor_px**2 * np.eye(2)), prior
    )
    near = project(camera, direction @ attitude.T)[0]
    inlier = _reject(context, near, measured_vu, covariance_vu, options)
    size = 3 if context.fit_camera_rotation else 2
    free = size if inlier.sum() > 1 else 2
    extra = 0.0
    for _ in range(2):
        weights = _weights(covariance_vu[inlier] + extra**2 * np.eye(2))
        attitude = _solve(context, direction[inlier], measured_vu[inlier], weights, attitude)
        residual = measured_vu - project(camera, direction @ attitude.T)[0]
        extra = _extra_sigma(residual[inlier], covariance_vu[inlier], 2 * int(inlier.sum()) - free, options)
        if extra == 0.0:
            break
    offset, theta = offset_between(camera, prior, attitude)
    theta = theta if free == 3 else 0.0  # Several smallest rotations in a row leave a tiny twist.
    total = covariance_vu[inlier] + extra**2 * np.eye(2)
    pivot = weights @ predicted_vu[inlier] / weights.sum()
    about_pivot, _ = move_pivot(offset, theta, camera.centre_vu, pivot)
    covariance = _sandwich(_design(predicted_vu[inlier], pivot, theta, free), weights, total)
    information = np.zeros((size, size))
    information[:free, :free] = np.linalg.inv(covariance)
    return StarFit(about_pivot, theta, information, pivot, offset, residual, inlier, extra)


def _extra_sigma(residual_vu: FloatArray, covariance: FloatArray, dof: int, options: StarFitOptions) -> float:
    """Scatter that the residuals ask for beyond the stated sigmas (DerSimonian and Laird's idea, shrunk)."""
    if dof < 1:
        return 0.0
    spread = _Spread(residual_vu, covariance)
    chi2 = float(spread.distance2(0.0).sum())
    factor = (options.prior_dof + chi2) / (options.prior_dof + dof)
    return spread.scatter(chi2 / factor, use_median=False) if factor > 1.0 else 0.0


def _sandwich(design: FloatArray, weights: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance of the weighted least-squares estimate under the true covariance of the data."""
    normal = np.einsum("n,nij,nik->jk", weights, design, design)
    middle = np.einsum("n,nij,nil,nlk->jk", weights**2, design, covariance, design)
    inverse = np.linalg.inv(normal)
    result: FloatArray = inverse @ middle @ inverse
    return (result + result.T) / 2
