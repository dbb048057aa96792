"""The techniques' interface: embedding, information and covariance, edges, contracts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.errors import ContractError
from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, CameraModel, Detector, FloatArray, Spacecraft, State
from pipeline.techniques.base import (
    ROTATION_AT_EDGE_FRACTION,
    ROTATION_UNOBSERVABLE_VARIANCE,
    FeatureTable,
    NavContext,
    TechniqueOptions,
    TechniqueResult,
    covariance_of,
    edge_flags,
    embed_rotation_unobservable,
    information_of,
)

TRANSLATION = np.array([[0.04, 0.01], [0.01, 0.09]])
CAMERA = CameraModel((100, 100), 50.0, np.diag([80.0, 80.0]), np.array([49.5, 49.5]))


def _context(turns: bool, max_deg: float = 5.0) -> NavContext:
    return NavContext(CAMERA, np.eye(3), turns, max_deg, (40.0, 60.0))


def test_the_seeds_numbers() -> None:
    assert ROTATION_UNOBSERVABLE_VARIANCE == 1.0e15
    assert ROTATION_AT_EDGE_FRACTION == 0.95
    assert TechniqueOptions().rotation_at_edge_fraction == 0.95


def test_embedding_keeps_the_translation_and_says_nothing_of_the_rotation() -> None:
    promoted = embed_rotation_unobservable(TRANSLATION)
    assert_array_equal(promoted[:2, :2], TRANSLATION)
    assert_array_equal(promoted[2], [0.0, 0.0, ROTATION_UNOBSERVABLE_VARIANCE])
    assert_array_equal(promoted, promoted.T)


def test_information_has_exact_zeros_where_the_covariance_has_its_sentinel() -> None:
    information = information_of(embed_rotation_unobservable(TRANSLATION))
    assert_array_equal(information[2], 0.0)
    assert_array_equal(information[:, 2], 0.0)
    assert_allclose(information[:2, :2] @ TRANSLATION, np.eye(2), atol=1e-13)


def test_an_unobservable_translation_is_zero_too() -> None:
    information = information_of(np.diag([0.04, ROTATION_UNOBSERVABLE_VARIANCE]))
    assert_allclose(information, np.diag([25.0, 0.0]))
    assert information[1, 1] == 0.0


@pytest.mark.parametrize("covariance", [np.diag([1.0, -1.0]), np.diag([1.0, 0.0]), np.diag([1.0, np.nan])])
def test_what_is_no_covariance_is_a_bug(covariance: FloatArray) -> None:
    with pytest.raises(ContractError):
        information_of(covariance)


@given(st.integers(0, 10_000), st.sampled_from([2, 3]))
@settings(deadline=None)
def test_information_and_covariance_invert_each_other(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size)) + 3 * np.eye(size)
    scale = np.diag([0.05, 0.2, 1e-4][:size])  # pixels and radians side by side
    covariance = scale @ root @ root.T @ scale
    back = covariance_of(information_of(covariance))
    assert_allclose(back, covariance, rtol=1e-8, atol=1e-9 * float(np.abs(covariance).min()) + 1e-18)


def test_the_sentinel_comes_back_on_the_rotation_alone() -> None:
    back = covariance_of(information_of(embed_rotation_unobservable(TRANSLATION)))
    assert_allclose(back, embed_rotation_unobservable(TRANSLATION), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("sense", [(1.0, 0.0), (1.0, 100.0), (0.6, 0.8), (3.0, -1e-3)])
def test_one_known_direction_keeps_its_variance_whatever_the_units(sense: tuple[float, float]) -> None:
    """g.x is known to variance 1; across it the sentinel stands, and none of it leaks into what is known."""
    g = np.array(sense)
    covariance = covariance_of(np.outer(g, g))
    across = np.array([-g[1], g[0]]) / np.linalg.norm(g)
    # The sentinel's rounding is 1e15 * 1e-16 for unit g, times |g|^2.
    assert g @ covariance @ g == pytest.approx(1.0, abs=0.5 * max(1.0, float(g @ g)))
    assert across @ covariance @ across == pytest.approx(ROTATION_UNOBSERVABLE_VARIANCE, rel=1e-6)


def test_a_known_combination_of_offset_and_rotation_keeps_its_variance() -> None:
    arm = np.array([1.0, 0.0, 300.0])  # what one edge sees of (dv, du, theta), 300 px off its pivot
    across = np.array([0.0, 1.0, 0.0])
    covariance = covariance_of(100.0 * np.outer(arm, arm) + np.outer(across, across))
    blind = np.array([300.0, 0.0, -1.0]) / np.hypot(300.0, 1.0)
    assert blind @ covariance @ blind == pytest.approx(ROTATION_UNOBSERVABLE_VARIANCE, rel=1e-6)
    assert across @ covariance @ across == pytest.approx(1.0, abs=0.3)


def test_degrees_of_freedom_and_the_seeds_covariance() -> None:
    result = TechniqueResult("t", np.zeros(2), 0.0, information_of(TRANSLATION), np.zeros(2), 0.9)
    assert result.degrees_of_freedom == 2
    assert_allclose(result.covariance, TRANSLATION, rtol=1e-10)
    with pytest.raises(ContractError):
        TechniqueResult("t", np.zeros(2), 0.0, np.eye(4), np.zeros(2), 0.9)
    with pytest.raises(ContractError):
        TechniqueResult("t", np.zeros(3), 0.0, np.eye(2), np.zeros(2), 0.9)


@pytest.mark.parametrize(
    ("offset", "theta_deg", "turns", "expected"),
    [
        ((0.0, 0.0), 0.0, True, (False, False)),
        ((39.0, 59.0), 4.7, True, (False, False)),  # 99 % of 40 is 39.6, 95 % of 5 deg is 4.75
        ((39.7, 0.0), 0.0, True, (True, False)),
        ((0.0, -59.5), 0.0, True, (True, False)),
        ((0.0, 0.0), 4.76, True, (True, True)),
        ((0.0, 0.0), -4.76, True, (True, True)),
        ((0.0, 0.0), 4.76, False, (False, False)),  # no rotation is fitted, none is at its edge
    ],
)
def test_edges(offset: tuple[float, float], theta_deg: float, turns: bool, expected: tuple[bool, bool]) -> None:
    flags = edge_flags(np.array(offset), float(np.radians(theta_deg)), _context(turns), TechniqueOptions())
    assert flags == expected


def test_the_rotations_edge_is_the_techniques_own_fraction() -> None:
    options = TechniqueOptions(rotation_at_edge_fraction=0.5)
    assert edge_flags(np.zeros(2), float(np.radians(2.6)), _context(True), options) == (True, True)
    assert edge_flags(np.zeros(2), float(np.radians(2.4)), _context(True), options) == (False, False)


def test_the_context_is_the_states() -> None:
    settings_ = InstrumentSettings(fit_camera_rotation=True, max_rotation_deg=3.0, search_margin_vu=(7.0, 8.0))
    state = State("i", "m", "c", 0.0, "", 1.0, CAMERA, Detector(), Attitude(np.eye(3)), Spacecraft(), settings_)
    context = NavContext.of(state)
    assert context.max_rotation_rad == pytest.approx(np.radians(3.0))
    assert context.search_margin_vu == (7.0, 8.0)
    assert _context(False).max_rotation_rad == 0.0
    with pytest.raises(ValueError, match="max_rotation_deg"):
        InstrumentSettings(fit_camera_rotation=True, max_rotation_deg=0.0)


def test_an_inventory_has_one_length() -> None:
    text, pair, one = np.array(["a", "b"]), np.zeros((2, 2)), np.zeros(2)
    table = FeatureTable(text, text, pair, pair, pair, one, one, one, one > 0, text)
    assert len(table) == 2
    with pytest.raises(ContractError):
        replace(table, snr=np.zeros(3))
