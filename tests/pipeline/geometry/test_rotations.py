"""Rotations against scipy, which wrote them independently."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from pipeline.geometry.rotations import (
    matrix_from_quaternion,
    plane_rotation,
    plane_rotation_derivative,
    quaternion_from_matrix,
    rotation_about,
    smallest_rotation,
)
from pipeline.records import FloatArray

# Products of a few numbers below one in double precision.
TIGHT = 1e-14


def _random(count: int, seed: int) -> Rotation:
    return Rotation.random(count, rng=np.random.default_rng(seed))


def _unit(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def test_matrix_of_a_quaternion() -> None:
    for rotation in _random(50, 0):
        x, y, z, w = rotation.as_quat()
        assert_allclose(matrix_from_quaternion(3.0 * np.array([w, x, y, z])), rotation.as_matrix(), atol=TIGHT)


def test_a_quaternion_turns_as_q_v_q_star() -> None:
    half = np.radians(45.0)
    quarter_turn_about_z = matrix_from_quaternion(np.array([np.cos(half), 0.0, 0.0, np.sin(half)]))
    assert_allclose(quarter_turn_about_z @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=TIGHT)


def test_quaternion_of_a_matrix_near_half_turns_too() -> None:
    axes = [*np.eye(3), np.array([1.0, 1.0, 0.0]), np.array([1.0, -2.0, 3.0])]
    cases = [rotation_about(axis, np.pi - small) for axis in axes for small in (0.0, 1e-9, -1e-9, 1e-3)]
    for matrix in [*cases, *_random(50, 1).as_matrix()]:
        quaternion = quaternion_from_matrix(matrix)
        assert quaternion[0] >= 0.0
        assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=TIGHT)
        assert_allclose(matrix_from_quaternion(quaternion), matrix, atol=4 * TIGHT)


def test_rotation_about_an_axis() -> None:
    rng = np.random.default_rng(2)
    for _ in range(30):
        axis, angle = _unit(rng), rng.uniform(-4, 4)
        expected = Rotation.from_rotvec(angle * axis).as_matrix()
        assert_allclose(rotation_about(7.0 * axis, angle), expected, atol=TIGHT)


def test_smallest_rotation_carries_and_does_not_twist() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        start, end = _unit(rng), _unit(rng)
        matrix = smallest_rotation(start, end)
        assert_allclose(matrix @ start, end, atol=1e-12)
        assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        turn = Rotation.from_matrix(matrix).magnitude()
        assert turn == pytest.approx(np.arccos(start @ end), abs=1e-7)  # arccos loses half its digits at 0 and pi


def test_smallest_rotation_of_equal_vectors_is_none() -> None:
    start = np.array([0.6, 0.0, 0.8])
    assert_allclose(smallest_rotation(start, start), np.eye(3), atol=TIGHT)


def test_a_positive_angle_turns_columns_toward_rows() -> None:
    plus_u = np.array([0.0, 1.0])
    turned = plane_rotation(np.radians(10.0)) @ plus_u
    assert turned[0] == pytest.approx(np.sin(np.radians(10.0)))  # toward +v
    assert turned[1] == pytest.approx(np.cos(np.radians(10.0)))


@given(st.floats(-3, 3), st.floats(-3, 3))
@settings(deadline=None)
def test_plane_rotations_add_up(a: float, b: float) -> None:
    assert_allclose(plane_rotation(a) @ plane_rotation(b), plane_rotation(a + b), atol=TIGHT)
    assert_allclose(plane_rotation(a).T, plane_rotation(-a), atol=TIGHT)


@pytest.mark.parametrize("angle", [-1.0, 0.0, 0.3, 2.0])
def test_derivative_of_the_plane_rotation(angle: float) -> None:
    step = 1e-5
    twin = (plane_rotation(angle + step) - plane_rotation(angle - step)) / (2 * step)
    assert_allclose(plane_rotation_derivative(angle), twin, atol=1e-10)  # step^2/6 and rounding 1e-16/1e-5
