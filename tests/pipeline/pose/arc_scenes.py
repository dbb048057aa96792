"""Planted arcs: a trajectory that drifts, attitudes with a common bias, landmark fixes with gaps and outliers."""

import numpy as np

from pipeline.pose.arc_factors import ArcImage
from pipeline.pose.arcs import ArcOptions
from pipeline.pose.records import Pose, PosePrior
from pipeline.pose.se3 import SE3Utils
from pipeline.records import FloatArray


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
