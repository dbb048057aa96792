"""Kabsch and the two-star rotation against planted truth and brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import minimize_scalar

from pipeline.geometry.procrustes import kabsch, pair_rotation
from pipeline.geometry.rotations import plane_rotation
from pipeline.records import FloatArray


def _moved(points: FloatArray, pivot: FloatArray, theta: float, offset: FloatArray) -> FloatArray:
    return np.asarray((points - pivot) @ plane_rotation(theta).T + pivot + offset)


@given(st.integers(0, 10_000), st.integers(2, 30), st.floats(-3.1, 3.1))
@settings(deadline=None)
def test_exact_points_give_back_what_moved_them(seed: int, count: int, theta: float) -> None:
    rng = np.random.default_rng(seed)
    points, weights = rng.uniform(0, 1000, (count, 2)), rng.uniform(0.1, 10, count)
    centroid = weights @ points / weights.sum()
    truth = np.array([12.5, -7.25])
    offset, angle = kabsch(points, _moved(points, centroid, theta, truth), weights)
    assert_allclose(offset, truth, atol=1e-9)  # thousand pixels in double precision
    spread = np.linalg.norm(points - centroid, axis=1).max()
    assert angle == pytest.approx(theta, abs=1e-9 / min(spread, 1.0))


def test_a_column_moves_down_under_a_positive_rotation() -> None:
    points = np.array([[0.0, -10.0], [0.0, 10.0]])
    lower_right = np.array([[-1.0, -10.0], [1.0, 10.0]])  # +u end moved toward +v
    assert kabsch(points, lower_right, np.ones(2))[1] == pytest.approx(np.arctan(0.1))
    assert pair_rotation(points, lower_right) == pytest.approx(np.arctan(0.1))


@pytest.mark.parametrize("seed", range(5))
def test_the_answer_minimises_the_weighted_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, weights = rng.uniform(0, 100, (8, 2)), rng.uniform(0.1, 5, 8)
    centroid = weights @ points / weights.sum()
    measured = _moved(points, centroid, 0.2, np.ones(2)) + rng.normal(0, 5, (8, 2))
    offset, theta = kabsch(points, measured, weights)
    assert_allclose(offset, weights @ (measured - points) / weights.sum(), atol=1e-12)

    def cost(angle: float) -> float:
        return float(weights @ ((measured - _moved(points, centroid, angle, offset)) ** 2).sum(axis=1))

    best = minimize_scalar(cost, bracket=(theta - 0.4, theta + 0.3), options={"xtol": 1e-10})
    assert theta == pytest.approx(best.x, abs=1e-7)  # a minimum is flat: half of the digits


def test_a_mirror_image_is_never_answered_by_a_reflection() -> None:
    """The best orthogonal matrix here is the mirror itself; the best rotation leaves a residual."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        points = rng.normal(0, 100, (6, 2))
        points -= points.mean(axis=0)
        mirrored = points * [1.0, -1.0]
        offset, theta = kabsch(points, mirrored, np.ones(6))
        assert_allclose(offset, 0.0, atol=1e-12)
        angles = np.linspace(-np.pi, np.pi, 1801)
        costs = [((mirrored - points @ plane_rotation(a).T) ** 2).sum() for a in angles]
        mine = ((mirrored - points @ plane_rotation(theta).T) ** 2).sum()
        assert mine <= min(costs) * (1 + 1e-9)
        assert mine > 1.0


def test_two_nearly_mirrored_points_give_a_rotation_of_half_a_turn_or_less() -> None:
    points = np.array([[0.0, 0.0], [0.0, 10.0]])
    offset, theta = kabsch(points, points[::-1], np.ones(2))
    assert_allclose(offset, 0.0)
    assert abs(theta) == pytest.approx(np.pi)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=50)
def test_two_stars_turn_as_kabsch_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 500, (2, 2))
    measured = points + rng.normal(0, 20, (2, 2))
    # Both are exact formulas; 1e-9 leaves room for points that fall close together.
    assert pair_rotation(points, measured) == pytest.approx(kabsch(points, measured, np.ones(2))[1], abs=1e-9)


def test_pairs_come_in_stacks() -> None:
    rng = np.random.default_rng(2)
    points, measured = rng.normal(0, 9, (2, 4, 2, 2))
    stacked = np.asarray(pair_rotation(points, measured))
    assert_allclose(stacked, [pair_rotation(p, m) for p, m in zip(points, measured, strict=True)])
