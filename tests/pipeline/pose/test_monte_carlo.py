"""Two thousand scenes of every kind: an answer whose covariance holds, or an honest failure."""

import warnings
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.pose.estimator import OpenCVGtsamPoseEstimator
from pipeline.pose.records import CovarianceDegradedWarning, PnpFailureError, ThermalState
from pipeline.pose.se3 import SE3Utils
from tests.pipeline.pose.scenes import CAMERAS, Planted, Recipe, plant

TRIALS = 2000
MANY = 30


def draw_recipe(rng: np.random.Generator) -> Recipe:
    """6 to 500 true inliers, up to 60 % outliers beside them, planar or not, near and far, three lenses."""
    count = int(np.exp(rng.uniform(np.log(6), np.log(500))))
    share = rng.uniform(0.0, 0.6)
    return Recipe(
        count=count, outliers=round(count * share / (1 - share)), planar=bool(rng.random() < 0.4),
        range_km=float(np.exp(rng.uniform(0.0, np.log(5000)))), sigma_px=float(np.exp(rng.uniform(-1.6, 0.4))),
        point_sigma_px=float(rng.choice([0.0, 0.5])), tilt_deg=float(rng.uniform(0, 50)),
        depth=float(np.exp(rng.uniform(np.log(0.1), np.log(1.5)))), camera=CAMERAS[int(rng.integers(3))],
    )  # fmt: skip


@dataclass
class Tally:
    """What came out."""

    nees: list[float] = field(default_factory=list)
    inliers: list[int] = field(default_factory=list)
    ratios: list[np.ndarray] = field(default_factory=list)
    failures: list[tuple[Recipe, str]] = field(default_factory=list)

    def solve(self, recipe: Recipe, scene: Planted) -> None:
        """One scene, with both covariances."""
        estimator = OpenCVGtsamPoseEstimator()
        try:
            full = estimator.estimate(scene.matches, scene.calibration, ThermalState())
        except PnpFailureError as failure:
            self.failures.append((recipe, failure.reason.value))
            return
        cheap = estimator.estimate(scene.matches, scene.calibration, ThermalState(thermal_throttle=True))
        error = SE3Utils.error(full.pose, scene.pose)
        self.nees.append(float(error @ np.linalg.solve(full.covariance_6x6, error)))
        self.inliers.append(int((full.inlier & scene.good).sum()))
        if recipe.count >= MANY:
            self.ratios.append(np.sqrt(np.diag(cheap.covariance_6x6) / np.diag(full.covariance_6x6)))


@pytest.mark.slow
def test_covariances_hold_or_the_failure_is_honest() -> None:
    tally = Tally()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CovarianceDegradedWarning)
        for trial in range(TRIALS):
            recipe = draw_recipe(np.random.default_rng([3, trial]))
            tally.solve(recipe, plant(recipe, trial))
    nees, inliers = np.array(tally.nees), np.array(tally.inliers)
    many = inliers >= MANY
    assert nees[many].mean() == pytest.approx(6.0, rel=0.05)
    assert (nees[~many] < chi2.ppf(0.95, 6)).mean() >= 0.90
    assert np.abs(np.array(tally.ratios) - 1.0).max() <= 0.10
    # Failures are scenes that do not determine a pose: planes, mostly with few points.
    assert len(tally.failures) <= 0.08 * TRIALS
    assert np.mean([recipe.planar for recipe, _ in tally.failures]) > 0.8
