"""Poses of planted scenes: they are right, their covariances hold, and what cannot be known is refused."""

import json
import logging
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from pipeline.camera import project
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.geometry.wgs84 import Geoid, WgsConverter, wgs84
from pipeline.pose.estimator import OpenCVGtsamPoseEstimator, PoseOptions, place_of
from pipeline.pose.normalise import pinhole_camera, to_plane
from pipeline.pose.pnp import mirrored, scene_shape
from pipeline.pose.records import (
    CameraCalibration,
    CovarianceDegradedWarning,
    CovarianceMode,
    MatchError,
    MatchResult,
    PnpFailure,
    PnpFailureError,
    Pose,
    PoseEstimate,
    PosePrior,
    SourceLabel,
    ThermalState,
)
from pipeline.pose.refine import refine
from pipeline.pose.se3 import SE3Utils
from tests.pipeline.pose.scenes import CAMERAS, DATUM, Planted, Recipe, plant

AHEAD = np.array([0.0, 0.0, 40.0])
COOL, HOT = ThermalState(), ThermalState(thermal_throttle=True, clock_mhz=750.0)


def _solve(scene: Planted, thermal: ThermalState = COOL) -> PoseEstimate:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CovarianceDegradedWarning)
        return OpenCVGtsamPoseEstimator().estimate(scene.matches, scene.calibration, thermal)


def _nees(scene: Planted, estimate: PoseEstimate) -> float:
    error = SE3Utils.error(estimate.pose, scene.pose)
    return float(error @ np.linalg.solve(estimate.covariance_6x6, error))


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("planar", [False, True])
def test_exact_matches_give_the_exact_pose(camera, planar: bool) -> None:  # type: ignore[no-untyped-def]
    scene = plant(Recipe(camera=camera, planar=planar, sigma_px=1e-6), 1)
    estimate = _solve(scene)
    error = SE3Utils.error(estimate.pose, scene.pose)
    assert np.abs(error[:3]).max() < 1e-4
    assert np.abs(error[3:]).max() < 1e-6
    assert estimate.method == ("ippe" if planar else "sqpnp")


def test_the_minimum_is_that_of_an_independent_solver() -> None:
    scene = plant(Recipe(count=25, range_km=20.0), 2)
    estimate = _solve(scene)
    m = scene.matches
    assert m.pixel_covariance_px2 is not None
    white = np.linalg.inv(np.linalg.cholesky(m.pixel_covariance_px2))

    def residual(x: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(x[3:]).as_matrix() @ scene.pose.camera_from_body
        pixels, _ = project(scene.calibration.camera, (m.points_km - scene.pose.position_km - x[:3]) @ turn.T)
        return np.asarray(np.einsum("nij,nj->ni", white, m.pixels_vu - pixels).ravel())

    theirs = least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    # The plane's covariance is carried over to first order, which a half-pixel error through this lens bends by 1e-4.
    sigma = np.sqrt(np.diag(estimate.covariance_6x6))
    away = estimate.pose.position_km - scene.pose.position_km - theirs.x[:3]
    assert (np.abs(away) < 0.01 * sigma[:3]).all()
    assert estimate.chi2 == pytest.approx(2 * theirs.cost, rel=1e-3)


@pytest.mark.parametrize("recipe", [
    Recipe(count=80, outliers=60), Recipe(count=40, outliers=40, planar=True), Recipe(count=12, outliers=15),
    Recipe(count=60, outliers=90, point_sigma_px=0.7),
])  # fmt: skip
def test_wrong_matches_are_found(recipe: Recipe) -> None:
    for seed in range(5):
        scene = plant(recipe, seed)
        estimate = _solve(scene)
        assert _nees(scene, estimate) < chi2.isf(1e-5, 6)
        assert (estimate.inlier == scene.good).mean() > 0.97


@pytest.mark.parametrize("recipe", [
    Recipe(count=40, outliers=20), Recipe(count=60, outliers=20, planar=True, camera=CAMERAS[1]),
    Recipe(count=50, point_sigma_px=0.7, range_km=5000.0, camera=CAMERAS[2]),
])  # fmt: skip
def test_a_covariance_is_that_of_the_errors(recipe: Recipe) -> None:
    scenes = [plant(recipe, 1000 + seed) for seed in range(100)]
    nees = [_nees(scene, _solve(scene)) for scene in scenes]
    # Mean of 100 chi2 of six: sigma 0.35.
    assert 6 - 1.3 < np.mean(nees) < 6 + 1.3
    assert np.mean(np.array(nees) < chi2.ppf(0.95, 6)) >= 0.88


def test_throttled_frames_get_the_jacobian_and_the_next_the_marginals_again() -> None:
    scene = plant(Recipe(point_sigma_px=0.5), 3)
    estimator = OpenCVGtsamPoseEstimator()
    with pytest.warns(CovarianceDegradedWarning, match="JACOBIAN"):
        cheap = estimator.estimate(scene.matches, scene.calibration, HOT)
    assert estimator.current_covariance_mode() is cheap.covariance_mode is CovarianceMode.JACOBIAN
    full = estimator.estimate(scene.matches, scene.calibration, COOL)
    assert estimator.current_covariance_mode() is full.covariance_mode is CovarianceMode.MARGINALS
    ratio = np.sqrt(np.diag(cheap.covariance_6x6) / np.diag(full.covariance_6x6))
    assert_allclose(ratio, 1.0, atol=0.1)
    assert cheap.source_label is full.source_label is SourceLabel.SATELLITE_ANCHORED


def test_unstated_sigmas_come_from_the_residuals() -> None:
    scene = plant(Recipe(count=200, sigma_px=0.25), 4)
    m = scene.matches
    told = _solve(scene)
    bare = MatchResult(m.image_id, m.point_id, m.pixels_vu, m.points_km)
    guessed = OpenCVGtsamPoseEstimator().estimate(bare, scene.calibration, COOL)
    assert guessed.sigma_scale == pytest.approx(float(np.sqrt((guessed.rms_px**2).mean())), rel=0.05)
    assert_allclose(np.diag(guessed.covariance_6x6) / np.diag(told.covariance_6x6), 1.0, atol=0.5)


def _refused(matches: MatchResult, reason: PnpFailure, camera=CAMERAS[2]) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(PnpFailureError) as caught:
        OpenCVGtsamPoseEstimator().estimate(matches, CameraCalibration.of(camera, DATUM), COOL)
    assert caught.value.reason is reason, caught.value.detail


def _seen(points: np.ndarray, sigma: float = 0.3) -> MatchResult:
    pixels, _ = project(CAMERAS[2], points)
    pixels = pixels + np.random.default_rng(0).normal(size=pixels.shape) * sigma
    return MatchResult("x", np.arange(len(points)), pixels, points, np.tile(np.eye(2) * sigma**2, (len(points), 1, 1)))


def test_what_determines_no_pose_is_refused() -> None:
    rng = np.random.default_rng(5)
    _refused(MatchResult("x", np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3))), PnpFailure.TOO_FEW)
    _refused(_seen(rng.uniform(-1, 1, (5, 3)) + AHEAD), PnpFailure.TOO_FEW)
    line = np.linspace(-1, 1, 30)[:, None] * np.array([1.0, 0.5, 0.2]) + [0, 0, 40]
    _refused(_seen(line), PnpFailure.DEGENERATE)
    edge = np.stack([rng.uniform(-1, 1, 40), np.zeros(40), rng.uniform(35, 45, 40)], axis=1)
    _refused(_seen(edge), PnpFailure.DEGENERATE)
    # A small disc far away, tilted: turned over about the line of sight it looks the same.
    disc = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0] @ Rotation.from_rotvec([0.7, 0, 0]).as_matrix() + [0, 0, 300]
    _refused(_seen(disc), PnpFailure.AMBIGUOUS)


def test_random_matches_agree_on_nothing() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(8, 200))
        matches = MatchResult(
            "x", np.arange(n), rng.uniform(0, 1023, (n, 2)), rng.uniform(-1, 1, (n, 3)) + AHEAD,
            np.tile(np.eye(2), (n, 1, 1)),
        )  # fmt: skip
        _refused(matches, PnpFailure.NO_CONSENSUS)


def test_a_prior_chooses_between_two_answers_and_does_not_pull() -> None:
    rng = np.random.default_rng(5)
    disc = rng.uniform(-1, 1, (40, 3)) * [1, 1, 0] @ Rotation.from_rotvec([0.7, 0, 0]).as_matrix() + [0, 0, 300]
    matches = _seen(disc, 0.1)
    # Where two answers are as good, one sigma is a long way, and the bound on it is not the subject here.
    estimator = OpenCVGtsamPoseEstimator(PoseOptions(max_curvature=2.0))
    true = Pose(np.eye(3), np.zeros(3))
    answers = []
    for start in (true, mirrored(true, scene_shape(disc))):
        prior = PosePrior(start, np.diag([100.0] * 3 + [1e-2] * 3))
        asked = MatchResult("x", matches.point_id, matches.pixels_vu, disc, matches.pixel_covariance_px2, None, prior)
        answers.append(estimator.estimate(asked, CameraCalibration.of(CAMERAS[2], DATUM), COOL).pose)
    turned = np.linalg.norm(SE3Utils.error(answers[0], answers[1])[3:])
    assert turned == pytest.approx(2 * 0.7, abs=0.1)
    assert np.linalg.norm(SE3Utils.error(answers[0], true)[3:]) < 0.1


def test_points_behind_the_camera_are_no_inliers() -> None:
    scene = plant(Recipe(count=40), 6)
    m = scene.matches
    behind = 2 * scene.pose.position_km - m.points_km[:5]
    matches = MatchResult(
        "x", np.arange(45), np.vstack([m.pixels_vu, m.pixels_vu[:5]]), np.vstack([m.points_km, behind]),
        np.concatenate([m.pixel_covariance_px2, m.pixel_covariance_px2[:5]]),  # type: ignore[index]
    )  # fmt: skip
    estimate = OpenCVGtsamPoseEstimator().estimate(matches, scene.calibration, COOL)
    assert not estimate.inlier[40:].any()
    assert estimate.inlier[:40].mean() > 0.95


def test_logs_are_json(caplog: pytest.LogCaptureFixture) -> None:
    scene = plant(Recipe(), 7)
    with caplog.at_level(logging.DEBUG, logger="pilotage.pose"):
        _solve(scene, HOT)
        _refused(MatchResult("none", np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3))), PnpFailure.TOO_FEW)
    lines = [(record.levelname, json.loads(record.message)) for record in caplog.records]
    levels = [level for level, _ in lines]
    assert levels == ["INFO", "WARNING", "DEBUG", "INFO", "ERROR"]
    assert lines[1][1]["thermal_throttle"] is True
    assert lines[1][1]["clock_mhz"] == 750.0
    assert lines[2][1]["inliers"] == 60
    assert lines[4][1]["frame"] == "none"


def test_the_mounting_and_the_datum_reach_the_report() -> None:
    converter, earth = WgsConverter(), wgs84()
    origin = np.array([48.0, 35.0, 300.0])
    down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]) @ converter.local_from_body(48.0, 35.0)
    pose = Pose(down, converter.body_fixed(origin[None])[0])
    mounting = Rotation.from_euler("zyx", [20, 5, -3], degrees=True).as_matrix()
    arm = np.array([0.5, -1.0, 2.0])
    geoid = Geoid(np.array([40.0, 50.0]), np.array([30.0, 40.0]), np.full((2, 2), 21.0))
    calibration = CameraCalibration(CAMERAS[0], earth, mounting, arm, geoid)
    place = place_of(pose, calibration)
    local = down.T @ mounting @ arm * 1e-3
    assert place.ellipsoidal_m == pytest.approx(converter.geodetic((pose.position_km - local)[None])[0, 2])
    assert place.alt_m == pytest.approx(place.ellipsoidal_m - 21.0)
    assert place.datum == "WGS84"
    assert place_of(pose, CameraCalibration.of(CAMERAS[0], earth)).alt_m is None
    scene = plant(Recipe(), 8)
    tilted = CameraCalibration(scene.calibration.camera, DATUM, mounting, np.zeros(3))
    estimate = OpenCVGtsamPoseEstimator().estimate(scene.matches, tilted, COOL)
    vehicle = matrix_from_quaternion(estimate.orientation_world_T_body)
    assert_allclose(mounting @ vehicle.T, estimate.pose.camera_from_body, atol=1e-12)


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_plane_carries_covariances(camera) -> None:  # type: ignore[no-untyped-def]
    pixels = np.random.default_rng(9).uniform(50, 950, (20, 2))
    covariance = np.tile(np.array([[0.3, 0.1], [0.1, 0.2]]), (20, 1, 1))
    plane = to_plane(camera, pixels, covariance)
    back, _ = project(camera, np.column_stack([plane.xy, np.ones(20)]))
    assert_allclose(back, pixels, atol=1e-7)
    step = 1e-3
    for k in range(2):
        moved = to_plane(camera, pixels + step * np.eye(2)[k], covariance).xy
        lower = to_plane(camera, pixels - step * np.eye(2)[k], covariance).xy
        slope = (moved - lower) / (2 * step)
        assert_allclose(np.linalg.inv(plane.px_from_xy)[:, :, k], slope, rtol=1e-5, atol=1e-11)


def test_a_calibration_matrix_is_a_camera() -> None:
    k = np.array([[900.0, 2.0, 511.0], [0.0, 910.0, 380.0], [0.0, 0.0, 1.0]])
    pixels, _ = project(pinhole_camera(k, (768, 1024)), np.array([[0.1, -0.2, 2.0]]))
    assert_allclose(pixels[0, ::-1], (k @ [0.05, -0.1, 1.0])[:2])
    for wrong in (np.eye(2), np.diag([1.0, 0.0, 1.0]), np.full((3, 3), np.nan), k.T):
        with pytest.raises(MatchError, match="K is"):
            pinhole_camera(wrong, (768, 1024))


def test_the_fit_descends_from_afar() -> None:
    scene = plant(Recipe(count=30, range_km=50.0), 10)
    plane = to_plane(scene.calibration.camera, scene.matches.pixels_vu, np.tile(np.eye(2) * 0.25, (30, 1, 1)))
    near = refine(scene.pose, scene.matches.points_km, plane.xy, plane.covariance)
    off = SE3Utils.corrected(scene.pose, np.array([2.0, -3.0, 4.0, 0.05, -0.03, 0.08]))
    far = refine(off, scene.matches.points_km, plane.xy, plane.covariance)
    assert far.chi2 == pytest.approx(near.chi2, rel=1e-6)
    away = SE3Utils.error(far.pose, near.pose)
    assert away @ SE3Utils.error_from_correction(near.information) @ away < 1e-6


def test_degenerate_grids_end_in_a_pose_or_in_a_reason() -> None:
    rng = np.random.default_rng(11)
    calibration, outcomes = CameraCalibration.of(CAMERAS[2], DATUM), {"pose": 0, "reason": 0}
    for _ in range(80):
        n = int(rng.integers(6, 14))
        points = np.round(rng.uniform(-2, 2, (n, 3))) + AHEAD
        pixels = np.round(_seen(points, float(rng.choice([0.01, 1.0, 30.0]))).pixels_vu)
        stated = None if rng.random() < 0.5 else np.tile(np.eye(2), (n, 1, 1))
        matches = MatchResult("x", np.arange(n), pixels, points, stated)
        try:
            estimate = OpenCVGtsamPoseEstimator().estimate(matches, calibration, COOL)
            assert np.linalg.eigvalsh(estimate.covariance_6x6)[0] > 0
            outcomes["pose"] += 1
        except PnpFailureError:
            outcomes["reason"] += 1
    assert min(outcomes.values()) >= 5
