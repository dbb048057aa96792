"""State update from landmarks: partials against differences, pulls against planted errors, outliers with their name."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from pipeline.geometry.maplet import MapletView
from pipeline.geometry.rotations import rotation_about
from pipeline.records import CameraModel, FloatArray
from pipeline.techniques.landmark_state import (
    LandmarkState,
    LandmarkStateOptions,
    state_partials,
    turned,
    update_state,
)

CAMERA = CameraModel(
    (1000, 1000), 100.0, np.array([[70.0, 0.3], [-0.2, -71.0]]), np.array([480.0, 520.0]),
    np.array([1e-4, 1e-7, 2e-5, -3e-5, 1e-5, 1e-7]), np.array([0.01, -0.02]),
)  # fmt: skip
TURN = rotation_about(np.array([0.6, 0.0, 0.8]), 0.7)
VIEW = MapletView(CAMERA, TURN, -TURN.T @ np.array([1.0, -2.0, 100.0]), np.array([0.0, 0.0, 1.0]))
PRIOR = np.diag([0.3**2] * 3 + [3e-3**2] * 3)


def exp(vector: FloatArray) -> FloatArray:
    angle = float(np.linalg.norm(vector))
    return rotation_about(vector / angle, angle)


def landmarks(rng: np.random.Generator, count: int) -> FloatArray:
    """On the near side of a ball of 6 km."""
    points = rng.normal(size=(count, 3))
    points[:, 2] = -np.abs(points[:, 2])
    return np.asarray(6.0 * points / np.linalg.norm(points, axis=1)[:, None] @ TURN)


def test_eq_2_23_2_24_and_2_26_to_2_32_partials_are_the_derivatives() -> None:
    points = landmarks(np.random.default_rng(1), 30)
    partials, by_place = state_partials(VIEW, points)
    step = 1e-5
    for axis in range(3):
        unit = np.eye(3)[axis] * step
        moved = [replace(VIEW, position_km=VIEW.position_km + s * unit).pixels(points)[0] for s in (1, -1)]
        assert partials[:, :, axis] == pytest.approx((moved[0] - moved[1]) / (2 * step), rel=1e-6, abs=1e-4)
        twisted = [replace(VIEW, camera_from_body=turned(TURN, s * unit)).pixels(points)[0] for s in (1, -1)]
        assert partials[:, :, 3 + axis] == pytest.approx((twisted[0] - twisted[1]) / (2 * step), rel=1e-6, abs=1e-4)
        shifted = [VIEW.pixels(points + s * unit)[0] for s in (1, -1)]
        assert by_place[:, :, axis] == pytest.approx((shifted[0] - shifted[1]) / (2 * step), rel=1e-6, abs=1e-4)


def test_eq_2_27_updates_are_exact_rotations() -> None:
    dtheta = np.array([0.2, -0.3, 0.1])
    after = turned(TURN, dtheta)
    assert after @ after.T == pytest.approx(np.eye(3), abs=1e-14)
    assert after == pytest.approx(exp(-dtheta) @ TURN)
    skew = np.cross(np.eye(3), dtheta)
    small = turned(TURN, 1e-6 * dtheta)
    assert small == pytest.approx((np.eye(3) - 1e-6 * skew) @ TURN, abs=1e-12)


def trial(
    rng: np.random.Generator, count: int, mode: Literal["solve", "consider"], landmark_km: float, outliers: int = 0,
    prior: FloatArray = PRIOR,
) -> tuple[LandmarkState, FloatArray]:  # fmt: skip
    """One update with planted errors of everything; the state and its error in the project's order."""
    true_place = landmarks(rng, count)
    believed = true_place + rng.normal(size=true_place.shape) * landmark_km
    root = np.linalg.cholesky(prior if np.isfinite(prior).all() else PRIOR)
    error = root @ rng.normal(size=6)
    # body_from_camera_true = Exp(r) body_from_camera_est, p_est = p_true + dp.
    start = replace(VIEW, position_km=VIEW.position_km + error[:3], camera_from_body=TURN @ exp(error[3:]))
    observed = VIEW.pixels(true_place)[0] + rng.normal(size=(count, 2)) * [0.1, 0.2]
    observed += rng.normal(size=2) * LandmarkStateOptions().common_sigma_px
    observed[:outliers] += rng.choice([-1, 1], (outliers, 2)) * rng.uniform(5, 30, (outliers, 2))
    noise = np.broadcast_to(np.diag([0.01, 0.04]), (count, 2, 2))
    place_noise = np.broadcast_to(np.eye(3) * landmark_km**2, (count, 3, 3))
    options = LandmarkStateOptions(landmark_errors=mode)
    found = update_state(start, (believed, place_noise, observed, noise), prior, options)
    assert isinstance(found, LandmarkState)
    change = TURN.T @ found.view.camera_from_body
    r = 0.5 * np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])
    return found, np.concatenate([found.view.position_km - VIEW.position_km, r])


@pytest.mark.parametrize(("mode", "landmark_km"), [("solve", 0.02), ("consider", 0.02), ("solve", 1e-6)])
def test_eq_2_19_errors_are_as_large_as_the_covariance_says(
    mode: Literal["solve", "consider"], landmark_km: float
) -> None:
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(250):
        found, error = trial(rng, 60, mode, landmark_km)
        nees.append(error @ np.linalg.solve(found.covariance, error))
        assert found.converged
        assert found.observable == 6
    # The mean of 250 six-dimensional squares has a sigma of 0.22; good landmarks rejected by chance add a little.
    assert np.mean(nees) == pytest.approx(6.0, abs=0.9)


def test_outliers_are_rejected_and_do_no_harm() -> None:
    rng = np.random.default_rng(6)
    nees = []
    for _ in range(60):
        found, error = trial(rng, 60, "solve", 0.005, outliers=9)
        assert not found.used[:9].any()
        assert found.used[9:].sum() >= 47
        nees.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(nees) == pytest.approx(6.0, abs=2.0)


def test_solving_landmarks_along_is_the_full_least_squares() -> None:
    """Marginal of the explicit problem with 6 + 3 n unknowns."""
    rng = np.random.default_rng(7)
    found, _ = trial(rng, 8, "solve", 0.03)
    n = 8
    points = landmarks(np.random.default_rng(7), n)
    partials, by_place = state_partials(found.view, points)
    full = np.zeros((6 + 3 * n, 6 + 3 * n))
    weight = np.diag([100.0, 25.0])
    for k in range(n):
        row = np.zeros((2, 6 + 3 * n))
        row[:, :6], row[:, 6 + 3 * k : 9 + 3 * k] = partials[k], by_place[k]
        full += row.T @ weight @ row
        full[6 + 3 * k : 9 + 3 * k, 6 + 3 * k : 9 + 3 * k] += np.eye(3) / 0.03**2
    # dp is the estimate less the truth, the other way round than what is to be added.
    into_body = -np.eye(6)
    into_body[3:, 3:] = found.view.camera_from_body.T
    full[:6, :6] += into_body.T @ np.linalg.inv(PRIOR) @ into_body
    expected = into_body @ np.linalg.inv(full)[:6, :6] @ into_body.T
    # The places differ by the planted errors, so the partials do by a few thousandths.
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.02)


def test_an_unknown_prior_carries_no_weight_and_too_few_landmarks_are_told() -> None:
    rng = np.random.default_rng(8)
    unknown = np.diag([np.inf] * 6)
    found, error = trial(rng, 60, "solve", 1e-6, prior=np.where(np.eye(6) > 0, np.inf, 0.0))
    assert found.observable == 6
    assert error @ np.linalg.solve(found.covariance, error) < 25.0
    few = landmarks(rng, 3)
    noise = np.broadcast_to(np.eye(2), (3, 2, 2))
    matches = (few, np.zeros((3, 3, 3)), VIEW.pixels(few)[0], noise)
    assert update_state(VIEW, matches, unknown, LandmarkStateOptions()) == "3 landmarks"
    two = LandmarkStateOptions(least_landmarks=2)
    pair = tuple(part[:2] for part in matches)
    answer = update_state(VIEW, (pair[0], pair[1], pair[2], pair[3]), PRIOR, two)
    assert isinstance(answer, LandmarkState)
    # Two landmarks give four equations for six unknowns; the a-priori state fills in.
    assert answer.observable == 4
    assert (np.diag(answer.covariance) < np.diag(PRIOR) * 1.0001).all()
