"""Scenes with planted poses, projected with the camera model alone."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.camera import project
from pipeline.geometry.wgs84 import Datum
from pipeline.pose.records import CameraCalibration, MatchResult, Pose
from pipeline.records import BoolArray, CameraModel, FloatArray

CAMERAS = (
    CameraModel(
        (1024, 1024), 100.0, np.array([[60.0, 0.1], [0.0, 61.0]]), np.array([510.0, 515.0]),
        np.array([3e-5, -2e-8, 1e-5, -2e-5, 1e-5, 1e-8]),
    ),
    CameraModel(
        (1024, 1024), 20.0, np.array([[60.0, 0.0], [0.0, -61.0]]), np.array([510.0, 515.0]),
        np.array([-3e-4, 1e-7, 0.0, 0.0, 0.0, 0.0]),
    ),
    CameraModel((1024, 1024), 150.0, np.array([[71.0, 0.0], [0.0, 71.0]]), np.array([511.5, 511.5])),
)  # fmt: skip
DATUM = Datum("ball", np.ones(3))


@dataclass(frozen=True)
class Planted:
    """What is asked and what is true."""

    matches: MatchResult
    calibration: CameraCalibration
    pose: Pose
    good: BoolArray


@dataclass(frozen=True)
class Recipe:
    """How a scene is made."""

    count: int = 60
    outliers: int = 0
    planar: bool = False
    range_km: float = 100.0
    sigma_px: float = 0.5
    point_sigma_px: float = 0.0
    tilt_deg: float = 30.0
    depth: float = 0.5
    camera: CameraModel = CAMERAS[0]


def plant(recipe: Recipe, seed: int) -> Planted:
    """A scene whose points fill three quarters of the field, matched with Gaussian errors and with wrong partners."""
    rng = np.random.default_rng(seed)
    camera = recipe.camera
    half = 0.37 * 1024 / abs(camera.k_px_per_mm[0, 0]) / camera.focal_length_mm * recipe.range_km
    flat = rng.uniform(-1, 1, (recipe.count, 3)) * half * np.array([1, 1, 0 if recipe.planar else recipe.depth])
    tilt = Rotation.from_rotvec(np.radians(recipe.tilt_deg) * np.array([0.6, -0.8, 0.0]))
    pose = Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 300.0)
    points = (tilt.apply(flat) + np.array([0, 0, recipe.range_km])) @ pose.camera_from_body + pose.position_km
    pixels, _ = project(camera, pose.to_camera(points))
    covariance = _covariances(rng, recipe.count, 2) * recipe.sigma_px**2
    pixels = pixels + _draw(rng, covariance)
    spread = None
    if recipe.point_sigma_px:
        scale = recipe.point_sigma_px * recipe.range_km / camera.focal_length_mm / 60.0
        spread = _covariances(rng, recipe.count, 3) * scale**2
        points = points + _draw(rng, spread)
    partner = rng.integers(0, recipe.count, recipe.outliers)
    pixels = np.vstack([pixels, rng.uniform(0, 1023, (recipe.outliers, 2))])
    order = rng.permutation(len(pixels))
    every = np.concatenate([np.arange(recipe.count), partner])[order]
    matches = MatchResult(
        f"scene-{seed}", np.arange(len(pixels)), pixels[order], points[every], covariance[every],
        None if spread is None else spread[every],
    )  # fmt: skip
    return Planted(matches, CameraCalibration.of(camera, DATUM), pose, order < recipe.count)


def _covariances(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    factor = rng.normal(size=(count, size, size))
    return np.asarray(factor @ factor.transpose(0, 2, 1) / (2 * size) + 0.5 * np.eye(size))


def _draw(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    unit = rng.normal(size=covariance.shape[:2])
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), unit))
