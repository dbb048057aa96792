"""Fusion in two and three degrees of freedom: what counts, what does not, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.ensemble import EnsembleOptions, _CombinedEstimate, ensemble
from pipeline.geometry.pointing import move_pivot
from pipeline.records import CameraModel, FloatArray
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueResult, embed_rotation_unobservable, information_of

OPTIONS = EnsembleOptions()
SHAPE = (800, 1000)
CENTRE = np.array([399.5, 499.5])
OFFSET, THETA = np.array([6.0, -4.0]), float(np.radians(3.0))


def _context(turns: bool) -> NavContext:
    camera = CameraModel(SHAPE, 500.0, np.diag([50.0, 50.0]), CENTRE)
    return NavContext(camera, np.eye(3), turns, 5.0, (50.0, 50.0))


def _two(
    name: str, offset: FloatArray, covariance: FloatArray, confidence: float = 0.999, source: str = ""
) -> TechniqueResult:
    sources = (source,) if source else ()
    return TechniqueResult(name, offset, 0.0, information_of(covariance), CENTRE, confidence, error_sources=sources)


def _three(
    name: str, pivot: FloatArray, covariance: FloatArray, error: FloatArray | None = None, centre: FloatArray = OFFSET
) -> TechniqueResult:
    """Answer about a pivot for a similarity that is planted at the array centre."""
    error = np.zeros(3) if error is None else error
    seen = covariance[2, 2] < 1e14
    about, _ = move_pivot(centre, THETA, CENTRE, pivot)
    theta = THETA + error[2] if seen else 0.0
    return TechniqueResult(name, about + error[:2], theta, information_of(covariance), pivot, 0.999)


def _fused(results: list[TechniqueResult], turns: bool, prior: float | None = None) -> _CombinedEstimate:
    estimate = ensemble(results, _context(turns), OPTIONS, prior)
    assert estimate is not None
    return estimate


GOOD = np.diag([0.01, 0.04])
TURNED = np.diag([0.01, 0.04, 1e-6])
BLIND = embed_rotation_unobservable(GOOD)


def test_no_answers_no_estimate() -> None:
    assert ensemble([], _context(False), OPTIONS) is None
    lost = replace(_two("a", OFFSET, GOOD), spurious=True)
    assert ensemble([lost], _context(False), OPTIONS) is None


def test_mixed_degrees_of_freedom_are_a_programmers_error() -> None:
    mixed = [_two("a", OFFSET, GOOD), _three("b", CENTRE, TURNED)]
    with pytest.raises(ValueError, match="DoF"):
        ensemble(mixed, _context(True), OPTIONS)


def test_two_answers_merge_by_their_precision() -> None:
    a, b = (
        _two("a", np.array([1.0, 2.0]), np.diag([0.04, 0.04])),
        _two("b", np.array([1.3, 2.0]), np.diag([0.02, 0.04])),
    )
    estimate = _fused([a, b], False)
    assert_allclose(estimate.offset_vu, [(1.0 * 25 + 1.3 * 50) / 75, 2.0], rtol=1e-12)
    assert_allclose(estimate.covariance, np.diag([1 / 75, 1 / 50]), rtol=1e-12)
    assert (estimate.reason, estimate.rotation_rad, estimate.fitted_rotation) == (StatusReason.NAVIGATED, None, False)
    assert set(estimate.members) == {"a", "b"}


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(deadline=None, max_examples=60)
def test_three_parameters_merge_at_the_centre_whatever_their_pivots(seed: int, count: int) -> None:
    """The planted similarity comes back exactly, and the covariance is the moved informations' inverse sum."""
    rng = np.random.default_rng(seed)
    results, total = [], np.zeros((3, 3))
    for k in range(count):
        root = np.diag([0.1, 0.2, 1e-3]) @ (rng.normal(0, 0.3, (3, 3)) + np.eye(3))
        pivot = rng.uniform(0, 800, 2)
        results.append(_three(f"t{k}", pivot, root @ root.T))
        c, s = np.cos(THETA), np.sin(THETA)
        forward = np.eye(3)
        forward[:2, 2] = -np.array([[-s, c], [-c, -s]]) @ (pivot - CENTRE)  # J of the design, written out
        total += np.linalg.inv(forward @ root @ root.T @ forward.T)
    estimate = _fused(results, True)
    assert_allclose(estimate.offset_vu, OFFSET, atol=1e-6)
    assert estimate.rotation_rad == pytest.approx(THETA, abs=1e-9)
    scale = np.sqrt(np.diag(np.linalg.inv(total)))
    assert_allclose(
        estimate.covariance / np.outer(scale, scale), np.linalg.inv(total) / np.outer(scale, scale), atol=1e-6
    )


def test_forgetting_the_pivot_would_be_off_by_pixels() -> None:
    result = _three("a", np.array([100.0, 900.0]), TURNED)
    assert np.linalg.norm(result.offset_vu - OFFSET) > 20.0
    assert_allclose(_fused([result], True).offset_vu, OFFSET, atol=1e-9)


@pytest.mark.parametrize("pivot", [CENTRE, np.array([100.0, 900.0])])
def test_an_unseen_rotation_is_null_and_its_prior_widens_the_offset(pivot: FloatArray) -> None:
    result = TechniqueResult("one star", OFFSET, 0.0, information_of(BLIND), pivot, 0.999)
    assert not result.information[2].any()  # exact zeros, not 1e-15
    for prior in (None, 1e-3):
        estimate = _fused([result], True, prior)
        sigma = prior or np.radians(5.0) / np.sqrt(3.0)
        arm = pivot - CENTRE
        sideways = np.array([arm[1], -arm[0]])  # R'(0) on the arm, [[0, 1], [-1, 0]]
        assert estimate.rotation_rad is None
        assert estimate.fitted_rotation
        assert_allclose(estimate.offset_vu, OFFSET, atol=1e-9)  # the prior's mean is no rotation
        assert_allclose(estimate.covariance, GOOD + sigma**2 * np.outer(sideways, sideways), rtol=1e-6, atol=1e-9)
        assert estimate.reason is StatusReason.NAVIGATED
        assert estimate.observable_vu is None


def test_one_answer_with_rotation_serves_one_without() -> None:
    blind, full = _three("blind", np.array([100.0, 900.0]), BLIND), _three("full", np.array([300.0, 300.0]), TURNED)
    estimate = _fused([blind, full], True)
    assert set(estimate.members) == {"blind", "full"}
    # At three degrees and 500 px of arm a move that is linear about no rotation would be off by 0.7 px.
    assert_allclose(estimate.offset_vu, OFFSET, atol=1e-6)
    assert estimate.rotation_rad == pytest.approx(THETA, abs=1e-9)
    alone = _fused([full], True)
    assert (np.diag(estimate.covariance) < np.diag(alone.covariance)).all()  # the blind one does help


def test_two_blind_answers_far_apart_see_the_rotation_together() -> None:
    small = 1e-4
    results = []
    for name, pivot in (("left", np.array([400.0, 100.0])), ("right", np.array([400.0, 900.0]))):
        about, _ = move_pivot(OFFSET, small, CENTRE, pivot)
        results.append(TechniqueResult(name, about, 0.0, information_of(BLIND), pivot, 0.999))
    estimate = _fused(results, True)
    # Linear about no rotation: 1e-8 of curvature over 400 px.
    assert estimate.rotation_rad == pytest.approx(small, abs=1e-7)
    assert_allclose(estimate.offset_vu, OFFSET, atol=1e-4)
    # Two rows of sigma 0.1 px, 800 px apart.
    assert np.sqrt(estimate.covariance[2, 2]) == pytest.approx(0.1 * np.sqrt(2) / 800, rel=1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
@pytest.mark.parametrize("turns", [False, True])
def test_one_observable_direction(angle_deg: float, turns: bool) -> None:
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    information = np.zeros((3, 3))
    information[:2, :2] = np.outer(along, along) / 0.09
    size = 3 if turns else 2
    result = TechniqueResult("edge", OFFSET, 0.0, information[:size, :size], CENTRE, 0.999)
    estimate = _fused([result], turns)
    assert estimate.reason is StatusReason.NAVIGATED_ONE_DIRECTION
    assert estimate.observable_vu is not None
    assert abs(estimate.observable_vu @ along) == pytest.approx(1.0, abs=1e-9)
    sign = float(np.sign(estimate.observable_vu @ along))
    assert estimate.along_px == pytest.approx(sign * (along @ OFFSET), abs=1e-9)
    assert estimate.sigma_along_px == pytest.approx(0.3, rel=1e-9)
    assert np.isnan(estimate.covariance).all()
    assert estimate.rotation_rad is None
    assert_allclose(estimate.offset_vu, along * (along @ OFFSET), atol=1e-9)


def test_two_directions_make_a_plane() -> None:
    rows, cols = np.diag([1 / 0.04, 0.0]), np.diag([0.0, 1 / 0.01])
    results = [
        TechniqueResult("rows", np.array([6.0, 99.0]), 0.0, rows, CENTRE, 0.999),
        TechniqueResult("cols", np.array([-77.0, -4.0]), 0.0, cols, CENTRE, 0.999),
    ]
    estimate = _fused(results, False)
    # What each says along its blind direction is no disagreement.
    assert_allclose(estimate.offset_vu, OFFSET, atol=1e-9)
    assert_allclose(estimate.covariance, np.diag([0.04, 0.01]), rtol=1e-9)
    assert estimate.reason is StatusReason.NAVIGATED


def test_an_answer_that_knows_nothing_is_none() -> None:
    nothing = TechniqueResult("nothing", OFFSET, 0.0, np.zeros((2, 2)), CENTRE, 0.999)
    assert ensemble([nothing], _context(False), OPTIONS) is None
    estimate = _fused([nothing, _two("a", OFFSET, GOOD)], False)
    assert estimate.members == ("a",)
    assert estimate.excluded == (("nothing", "uninformative"),)


def test_answers_at_the_edge_count_only_alone() -> None:
    edge = replace(_two("edge", np.array([49.9, 0.0]), GOOD), at_edge=True)
    estimate = _fused([edge, _two("inside", OFFSET, GOOD, 0.95)], False)
    assert estimate.members == ("inside",)
    assert estimate.excluded == (("edge", "at_edge"),)
    assert estimate.reason is StatusReason.NAVIGATED
    alone = _fused([edge], False)
    assert alone.reason is StatusReason.NAVIGATED_AT_EDGE
    assert_allclose(alone.offset_vu, [49.9, 0.0])


def test_spurious_answers_never_count() -> None:
    ghost = replace(_two("ghost", np.array([30.0, 30.0]), GOOD), spurious=True)
    estimate = _fused([ghost, _two("real", OFFSET, GOOD)], False)
    assert estimate.members == ("real",)
    assert ("ghost", "spurious") in estimate.excluded


def test_the_link_length_is_the_stated_chance() -> None:
    """Two answers of sigma s each differ by s sqrt(2); chi-square of 2 at 1e-3 is 13.816."""
    at_link = np.sqrt(2 * 0.01 * 13.8155)
    wide = np.diag([0.01, 0.01])
    for factor, members in ((0.99, 2), (1.01, 1)):
        pair = [_two("a", np.zeros(2), wide), _two("b", np.array([factor * at_link, 0.0]), wide)]
        assert len(_fused(pair, False).members) == members


def test_clusters_are_single_link() -> None:
    """The ends disagree with each other, but the middle links them."""
    wide = np.diag([0.01, 0.01])
    results = [_two(name, np.array([0.0, x]), wide) for name, x in (("a", 0.0), ("b", 0.45), ("c", 0.9))]
    assert set(_fused(results, False).members) == {"a", "b", "c"}
    assert len(_fused([results[0], results[2]], False).members) == 1


def test_a_majority_of_sure_answers_wins_and_the_odd_one_is_named() -> None:
    results = [_two(name, OFFSET, GOOD, 0.9999) for name in ("a", "b", "c")]
    odd = _two("odd", OFFSET + 5.0, GOOD, 0.92)
    estimate = _fused([odd, *results], False)
    assert set(estimate.members) == {"a", "b", "c"}
    assert ("odd", "disagrees") in estimate.excluded
    assert estimate.reason is StatusReason.NAVIGATED
    assert estimate.confidence == 0.9999


@pytest.mark.parametrize("turns", [False, True])
def test_two_answers_that_both_stand_are_a_conflict(turns: bool) -> None:
    if turns:
        pair = [_three("a", CENTRE, TURNED), _three("b", np.array([50.0, 50.0]), TURNED, centre=OFFSET + 9.0)]
    else:
        pair = [_two("a", OFFSET, GOOD), _two("b", OFFSET + 9.0, GOOD)]
    assert _fused(pair, turns).reason is StatusReason.TECHNIQUES_DISAGREE


def test_answers_that_differ_in_rotation_alone_do_not_agree() -> None:
    pair = [_three("a", CENTRE, TURNED), _three("b", CENTRE, TURNED, np.array([0.0, 0.0, 0.02]))]
    assert _fused(pair, True).reason is StatusReason.TECHNIQUES_DISAGREE


def test_doubtful_answers_are_not_given() -> None:
    assert _fused([_two("a", OFFSET, GOOD, 0.5)], False).reason is StatusReason.LOW_CONFIDENCE
    assert _fused([_two("a", OFFSET, GOOD, 0.91)], False).reason is StatusReason.NAVIGATED


def test_dependent_answers_do_not_count_twice() -> None:
    seed = replace(_two("seed", OFFSET, GOOD, source="stars"), measurements=5)
    refined = replace(_two("refined", OFFSET + 0.01, 0.9 * GOOD, source="stars"), measurements=9)
    estimate = _fused([seed, refined], False)
    assert estimate.members == ("refined",)
    assert estimate.excluded == (("seed", "dependent"),)
    assert_allclose(estimate.covariance, 0.9 * GOOD, rtol=1e-9)
    other = _two("limb", OFFSET, GOOD, source="limb")
    assert_allclose(
        _fused([seed, refined, other], False).covariance, np.linalg.inv(np.linalg.inv(GOOD) * (1 + 1 / 0.9))
    )


def test_more_evidence_beats_a_smaller_stated_sigma() -> None:
    lucky = replace(_two("lucky", OFFSET, 0.01 * GOOD, source="stars"), measurements=3)
    solid = replace(_two("solid", OFFSET, GOOD, source="stars"), measurements=20)
    assert _fused([lucky, solid], False).members == ("solid",)
    both = TechniqueResult("edge", OFFSET, 0.0, np.diag([1e6, 0.0]), CENTRE, 0.999, 99, error_sources=("stars",))
    assert _fused([both, solid], False).members == ("solid",)  # two directions before one


def test_dependent_answers_do_not_outvote_a_sure_one() -> None:
    echo = [_two(f"echo {k}", OFFSET + 9.0, GOOD, 0.95, "stars") for k in range(5)]
    assert _fused([*echo, _two("sure", OFFSET, GOOD, 0.999999)], False).members == ("sure",)


@pytest.mark.parametrize("turns", [False, True])
def test_sigmas_of_fused_answers_hold(turns: bool) -> None:
    """Pulls of two independent answers fused over a Monte Carlo, about pivots of their own."""
    rng, size = np.random.default_rng(9), 3 if turns else 2
    sigma = np.array([0.1, 0.2, 1e-3])[:size]
    distance2 = []
    for _ in range(400):
        errors = rng.normal(0, 1, (2, size)) * sigma
        if turns:
            pivots = rng.uniform(0, 800, (2, 2))
            results = [_three(f"t{k}", pivots[k], TURNED, errors[k]) for k in range(2)]
        else:
            results = [_two(f"t{k}", OFFSET + errors[k], GOOD) for k in range(2)]
        estimate = _fused(results, turns)
        if len(estimate.members) < 2:
            continue  # one in a thousand is not linked
        error = estimate.offset_vu - OFFSET
        error = np.append(error, (estimate.rotation_rad or 0.0) - THETA) if turns else error
        distance2.append(error @ np.linalg.inv(estimate.covariance) @ error)
    assert len(distance2) > 390
    # Chi-square of 2 or 3: the mean of 400 scatters by sqrt(2 size / 400), four of which are allowed.
    assert np.mean(distance2) == pytest.approx(size, abs=4 * np.sqrt(2 * size / 400))


def test_the_order_of_answers_does_not_matter() -> None:
    results = [_three(f"t{k}", np.array([100.0 * k, 700.0]), TURNED, np.full(3, 1e-4 * k)) for k in range(3)]
    forward, backward = _fused(results, True), _fused(results[::-1], True)
    assert_allclose(forward.offset_vu, backward.offset_vu, atol=1e-9)
    assert_allclose(forward.covariance, backward.covariance, rtol=1e-9, atol=1e-15)


def test_a_limb_about_a_far_centre_tells_one_direction_whatever_the_rotation() -> None:
    rng = np.random.default_rng(5)
    pulls = []
    for _ in range(300):
        arm, angle = float(rng.uniform(900.0, 9000.0)), float(rng.uniform(0.0, 2.0 * np.pi))
        pivot = CENTRE + arm * np.array([np.cos(angle), np.sin(angle)])
        offset = rng.uniform(-50.0, 50.0, 2)
        # Rotations as large as the margin of the offset allows about that centre.
        turn = float(np.clip(rng.uniform(-50.0, 50.0) / arm, -np.radians(5.0), np.radians(5.0)))
        about, _ = move_pivot(offset, turn, CENTRE, pivot)
        seen = TechniqueResult(
            "limb", about + rng.normal(0.0, 0.1, 2), 0.0, information_of(BLIND), pivot, 0.999
        )  # fmt: skip
        estimate = _fused([seen], True)
        assert estimate.reason is StatusReason.NAVIGATED_ONE_DIRECTION
        assert estimate.observable_vu is not None
        assert estimate.along_px is not None
        assert estimate.sigma_along_px is not None
        pulls.append((estimate.along_px - estimate.observable_vu @ offset) / estimate.sigma_along_px)
    assert 0.2 < float(np.sqrt(np.mean(np.square(pulls)))) < 1.3
    assert float((np.abs(pulls) < 2.5).mean()) > 0.95


def test_a_near_pivot_tells_both_directions_without_a_rotation() -> None:
    estimate = _fused([_three("disc", CENTRE + np.array([100.0, 50.0]), BLIND)], True)
    assert estimate.reason is StatusReason.NAVIGATED
    assert estimate.observable_vu is None
    assert np.sqrt(np.linalg.eigvalsh(estimate.covariance)).max() < 10.0
