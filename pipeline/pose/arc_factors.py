"""Factors of an arc: the trajectory's steps, attitudes with a common bias, and what images measured."""

from dataclasses import dataclass

import gtsam
import numpy as np

from pipeline.pose.arc_landmarks import PointSightings
from pipeline.pose.graph import pose_key
from pipeline.pose.records import MatchError, Pose, PosePrior, check_covariances
from pipeline.pose.se3 import SE3Utils
from pipeline.records import FloatArray, Record

BIAS_KEY = int(gtsam.symbol("b", 0))


@dataclass(frozen=True, eq=False)
class AttitudeFix(Record):
    """Attitude that stars, limbs or rings measured, which says nothing of the position.

    Attributes
    ----------
    camera_from_body
        (3, 3).
    covariance_rad2
        (3, 3) of the rotation r, body-fixed.
    """

    camera_from_body: FloatArray
    covariance_rad2: FloatArray

    def __post_init__(self) -> None:
        self._freeze(camera_from_body=(3, 3), covariance_rad2=(3, 3))
        check_covariances("attitude covariance", self.covariance_rad2[None])


@dataclass(frozen=True, eq=False)
class DirectionFix(Record):
    """Where a limb, a disc or rings were seen: the direction to the body's centre, whatever the attitude.

    An attitude that is made from it is wrong by as much as the position is.

    Attributes
    ----------
    direction
        (3,) unit vector in the camera frame.
    covariance_rad2
        (3, 3) of its error, camera axes; what it says along the direction plays no part.
    """

    direction: FloatArray
    covariance_rad2: FloatArray

    def __post_init__(self) -> None:
        self._freeze(direction=(3,), covariance_rad2=(3, 3))
        if not abs(float(np.linalg.norm(self.direction)) - 1.0) < 1e-6:
            raise MatchError("a direction that is no unit vector")
        check_covariances("direction covariance", self.tangent_covariance[None])

    @property
    def tangent(self) -> FloatArray:
        """(2, 3) unit vectors across the direction."""
        return np.asarray(np.linalg.svd(self.direction[None])[2][1:])

    @property
    def tangent_covariance(self) -> FloatArray:
        """(2, 2) along :attr:`tangent`."""
        across = self.tangent
        return np.asarray(across @ self.covariance_rad2 @ across.T)


@dataclass(frozen=True, eq=False)
class ArcImage(Record):
    """One image of an arc.

    Attributes
    ----------
    image_id
        The image.
    et
        Mid-exposure, TDB seconds past J2000.
    prior
        Trajectory's position and the attitude that was believed.
    fix
        Pose from landmarks, if any, with its covariance.
    offset
        What an offset measured, if any: stars an attitude, a body a direction.
    sightings
        What the fix rests on, if its points are to be solved as well.
    """

    image_id: str
    et: float
    prior: Pose
    fix: PosePrior | None = None
    offset: AttitudeFix | DirectionFix | None = None
    sightings: PointSightings | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.et):
            raise MatchError(f"{self.image_id}: no time")


@dataclass(frozen=True)
class ArcNoise:
    """Uncertainties that all images of an arc share; see ``ArcOptions``."""

    position_sigma_km: float
    walk_km_per_sqrt_s: float
    attitude_sigma_rad: float
    boresight_sigma_rad: float
    twist_sigma_rad: float


def step_factor(before: int, one: ArcImage, other: ArcImage, noise: ArcNoise) -> gtsam.CustomFactor:
    """Trajectory between two images: positions differ as predicted, within a random walk, in body-fixed axes.

    A relative pose would carry the attitude's error into the step; the trajectory knows nothing of attitudes.

    Parameters
    ----------
    before
        Position of the first image in the arc.
    one, other
        Images in the order of time.
    noise
        The walk.

    Returns
    -------
    gtsam.CustomFactor
        Three rows on two poses.
    """
    step = other.prior.position_km - one.prior.position_km
    sigma = noise.walk_km_per_sqrt_s * np.sqrt(other.et - one.et)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        keys = this.keys()
        start, end = values.atPose3(keys[0]), values.atPose3(keys[1])
        if jacobians is not None:
            zero = np.zeros((3, 3))
            jacobians[0] = np.asfortranarray(np.hstack([zero, -start.rotation().matrix()]))
            jacobians[1] = np.asfortranarray(np.hstack([zero, end.rotation().matrix()]))
        return np.asarray(end.translation() - start.translation() - step)

    keys = [pose_key(before), pose_key(before + 1)]
    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, sigma), keys, error)


def attitude_factor(index: int, image: ArcImage, noise: ArcNoise) -> gtsam.CustomFactor:
    """Believed attitude: the true one turned by the bias (boresight about x and y, twist about z) and by noise.

    Parameters
    ----------
    index
        Position of the image in the arc.
    image
        The image.
    noise
        Of a single attitude.

    Returns
    -------
    gtsam.CustomFactor
        Three rows on the pose and the common bias b: ``Log(R_believed' R Exp(b))``.
    """
    believed = image.prior.camera_from_body

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        keys = this.keys()
        bias = values.atVector(keys[1])
        turn = SE3Utils.exp(bias)
        residual = SE3Utils.log(believed @ values.atPose3(keys[0]).rotation().matrix() @ turn)
        if jacobians is not None:
            inverse = _right_jacobian_inverse(residual)
            jacobians[0] = np.asfortranarray(np.hstack([inverse @ turn.T, np.zeros((3, 3))]))
            jacobians[1] = np.asfortranarray(inverse @ _right_jacobian(bias))
        return residual

    model = gtsam.noiseModel.Isotropic.Sigma(3, noise.attitude_sigma_rad)
    return gtsam.CustomFactor(model, [pose_key(index), BIAS_KEY], error)


def _right_jacobian(vector: FloatArray) -> FloatArray:
    """Right Jacobian of the exponential to second order (Sola et al. 2018, eq. 143); angles here are small."""
    skew = SE3Utils.skew(vector)
    return np.asarray(np.eye(3) - skew / 2.0 + skew @ skew / 6.0)


def _right_jacobian_inverse(vector: FloatArray) -> FloatArray:
    """Its inverse to second order (eq. 144)."""
    skew = SE3Utils.skew(vector)
    return np.asarray(np.eye(3) + skew / 2.0 + skew @ skew / 12.0)


def first_factors(image: ArcImage, noise: ArcNoise) -> gtsam.NonlinearFactorGraph:
    """Priors of an arc's first position and of the common bias.

    Parameters
    ----------
    image
        First image.
    noise
        Their sigmas.

    Returns
    -------
    gtsam.NonlinearFactorGraph
        Two factors.
    """
    graph = gtsam.NonlinearFactorGraph()
    position = gtsam.noiseModel.Isotropic.Sigma(3, noise.position_sigma_km)
    graph.add(gtsam.PoseTranslationPrior3D(pose_key(0), SE3Utils.to_gtsam(image.prior), position))
    sigmas = np.array([noise.boresight_sigma_rad, noise.boresight_sigma_rad, noise.twist_sigma_rad])
    graph.add(gtsam.PriorFactorVector(BIAS_KEY, np.zeros(3), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    return graph


def fix_noise(fix: PosePrior) -> gtsam.noiseModel.Gaussian:
    """Noise of a landmark fix in GTSAM's tangent.

    Parameters
    ----------
    fix
        Pose with the covariance of its errors.

    Returns
    -------
    gtsam.noiseModel.Gaussian
        Six rows.
    """
    return gtsam.noiseModel.Gaussian.Covariance(SE3Utils.gtsam_from_error(fix.covariance, fix.pose.camera_from_body))


def image_factors(
    index: int, image: ArcImage, noise: ArcNoise, robust: gtsam.noiseModel.mEstimator.Base | None
) -> gtsam.NonlinearFactorGraph:
    """What one image contributes: its believed attitude and what was measured in it.

    Parameters
    ----------
    index
        Position of the image in the arc.
    image
        The image.
    noise
        Of attitudes.
    robust
        Weight function of measurements; None leaves them as they are.

    Returns
    -------
    gtsam.NonlinearFactorGraph
        One to three factors.
    """
    graph = gtsam.NonlinearFactorGraph()
    graph.add(attitude_factor(index, image, noise))
    key = pose_key(index)

    def weighted(model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        return model if robust is None else gtsam.noiseModel.Robust.Create(robust, model)

    if image.fix is not None:
        measured = SE3Utils.to_gtsam(image.fix.pose)
        graph.add(gtsam.PriorFactorPose3(key, measured, weighted(fix_noise(image.fix))))
    if image.offset is not None:
        model = weighted(gtsam.noiseModel.Gaussian.Covariance(offset_covariance(image.offset)))
        if isinstance(image.offset, AttitudeFix):
            graph.add(gtsam.PoseRotationPrior3D(key, gtsam.Rot3(image.offset.camera_from_body.T), model))
        else:
            graph.add(direction_factor(key, image.offset, model))
    return graph


def direction_factor(key: int, fix: DirectionFix, model: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """Direction of the body's centre, in the camera frame.

    Parameters
    ----------
    key
        Of the pose.
    fix
        What was measured.
    model
        Noise of two rows.

    Returns
    -------
    gtsam.CustomFactor
        Two rows across the measured direction.
    """

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        residual, slope = offset_residual(fix, SE3Utils.from_gtsam(values.atPose3(this.keys()[0])))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(slope)
        return residual

    return gtsam.CustomFactor(model, [key], error)


def offset_covariance(offset: AttitudeFix | DirectionFix) -> FloatArray:
    """Covariance of an offset's rows in the graph.

    Parameters
    ----------
    offset
        What was measured.

    Returns
    -------
    numpy.ndarray
        (3, 3) of a rotation in camera axes, or (2, 2) across a direction.
    """
    if isinstance(offset, DirectionFix):
        return offset.tangent_covariance
    turn = offset.camera_from_body
    return np.asarray(turn @ offset.covariance_rad2 @ turn.T)


def offset_residual(offset: AttitudeFix | DirectionFix, pose: Pose) -> tuple[FloatArray, FloatArray]:
    """How far a pose is from what an offset measured.

    Parameters
    ----------
    offset
        What was measured.
    pose
        The pose.

    Returns
    -------
    tuple
        (k,) rows, as in the graph; (k, 6) their derivative along GTSAM's tangent (rotation, translation).
    """
    if isinstance(offset, AttitudeFix):
        return SE3Utils.log(offset.camera_from_body @ pose.camera_from_body.T), np.eye(3, 6)
    centre = -pose.camera_from_body @ pose.position_km
    distance = float(np.linalg.norm(centre))
    unit = centre / distance
    slope = offset.tangent @ (np.eye(3) - np.outer(unit, unit)) / distance
    return offset.tangent @ unit, slope @ np.hstack([SE3Utils.skew(centre), -np.eye(3)])
