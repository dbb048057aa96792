"""Planted arcs: a trajectory that drifts, attitudes with a common bias, landmark fixes with gaps and outliers."""

from dataclasses import replace

import numpy as np

from pipeline.camera import project
from pipeline.pose.arc_factors import ArcImage
from pipeline.pose.arc_landmarks import sightings_of
from pipeline.pose.arcs import ArcOptions
from pipeline.pose.estimator import OpenCVGtsamPoseEstimator
from pipeline.pose.records import CameraCalibration, MatchResult, Pose, PosePrior, ThermalState
from pipeline.pose.se3 import SE3Utils
from pipeline.records import CameraModel, FloatArray
from tests.pipeline.pose.scenes import DATUM

CAMERA = CameraModel((1024, 1024), 150.0, np.array([[60.0, 0.0], [0.0, 60.0]]), np.array([511.5, 511.5]))


def plant_arc(
    count: int, seed: int, options: ArcOptions, gap: float = 0.4, outliers: float = 0.05
) -> tuple[list[ArcImage], list[Pose], FloatArray]:
    """Images, true poses and the true bias (boresight x, y, twist), drawn as the options say."""
    rng = np.random.default_rng(seed)
    et = np.cumsum(rng.uniform(5.0, 20.0, count))
    b = rng.normal(size=3) * [options.boresight_sigma_rad, options.boresight_sigma_rad, options.twist_sigma_rad]
    steps = rng.normal(size=(count - 1, 3)) * options.walk_km_per_sqrt_s * np.sqrt(np.diff(et))[:, None]
    drift = np.vstack([rng.normal(size=(1, 3)) * options.position_sigma_km, steps]).cumsum(axis=0)
    images, poses = [], []
    for k in range(count):
        angle = et[k] * 1e-4
        true = _looking(500.0 * np.array([np.cos(angle), np.sin(angle), 0.2 * np.sin(3 * angle)]))
        turn = true.camera_from_body.T
        believed = turn @ SE3Utils.exp(b) @ SE3Utils.exp(rng.normal(size=3) * options.attitude_sigma_rad)
        fix = _fix(rng, true, outliers) if rng.random() > gap else None
        images.append(ArcImage(f"i{k}", float(et[k]), Pose(believed.T, true.position_km + drift[k]), fix))
        poses.append(true)
    return images, poses, np.asarray(b)


def _looking(place: FloatArray) -> Pose:
    z = -place / np.linalg.norm(place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z]), place)


def _fix(rng: np.random.Generator, true: Pose, outliers: float) -> PosePrior:
    factor = rng.normal(size=(6, 6))
    unit = np.array([0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-4])
    covariance = (factor @ factor.T / 6 + 0.2 * np.eye(6)) * np.outer(unit, unit)
    error = rng.multivariate_normal(np.zeros(6), covariance) * (200.0 if rng.random() < outliers else 1.0)
    turn = SE3Utils.exp(-error[3:]) @ true.camera_from_body.T
    return PosePrior(Pose(turn.T, true.position_km + error[:3]), covariance)


def plant_sightings(
    images: list[ArcImage], poses: list[Pose], seed: int, sigma_px: float = 0.3, place_sigma_km: float = 0.1
) -> tuple[list[ArcImage], FloatArray]:
    """Images of one set of wrongly known points, each with the pose that its own sightings give; true places."""
    rng = np.random.default_rng(seed)
    calibration, estimator = CameraCalibration.of(CAMERA, DATUM), OpenCVGtsamPoseEstimator()
    true = rng.normal(size=(150, 3))
    true *= rng.uniform(18.0, 25.0, (150, 1)) / np.linalg.norm(true, axis=1)[:, None]
    factor = rng.normal(size=(150, 3, 3))
    spread = (factor @ factor.transpose(0, 2, 1) / 6 + 0.5 * np.eye(3)) * place_sigma_km**2
    places = true + np.einsum("nij,nj->ni", np.linalg.cholesky(spread), rng.normal(size=(150, 3)))
    out = []
    for image, pose in zip(images, poses, strict=True):
        pixels, _ = project(CAMERA, pose.to_camera(true))
        pixels = pixels + rng.normal(size=pixels.shape) * sigma_px
        rows = np.flatnonzero((true @ pose.position_km > 0) & (rng.random(150) < 0.4))
        noise = np.tile(np.eye(2) * sigma_px**2, (len(rows), 1, 1))
        matches = MatchResult(image.image_id, rows + 10, pixels[rows], places[rows], noise, spread[rows])
        if image.fix is None:
            out.append(image)
            continue
        answer = estimator.estimate(matches, calibration, ThermalState())
        fix = PosePrior(answer.pose, answer.covariance_6x6)
        out.append(replace(image, fix=fix, sightings=sightings_of(matches, answer, calibration, 1.0)))
    return out, true
