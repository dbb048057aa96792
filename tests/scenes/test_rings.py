"""Rings drawn by sub-pixels through the whole navigator: errors over their sigmas, and what must not be believed."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.navigate import Navigation, NavigationOptions, navigate
from pipeline.records import Body, FloatArray, RingKind, StarTable
from pipeline.status import Status, StatusReason, status_of
from pipeline.techniques.base import TechniqueResult
from tests.scenes.ring_scene import Band, RingScene, RingView, random_bands, ring_scene

_OPTIONS = NavigationOptions()


def _run(scene: RingScene) -> Navigation:
    return navigate(scene.pixels, None, scene.state, StarTable.empty(), _OPTIONS)


def _random(seed: int, number: int) -> RingScene:
    """Any opening, scale, longitude and noise; catalogue errors as its sigmas say."""
    rng = np.random.default_rng([seed, number])
    low = np.radians(rng.uniform(1.0, 15.0))
    opening = float(np.arcsin(rng.uniform(np.sin(np.radians(1.0)), 1.0))) if number % 4 else float(low)
    radius = float(np.exp(rng.uniform(np.log(80.0), np.log(4000.0))))
    longitude = float(rng.uniform(0.0, 2.0 * np.pi))
    view = RingView(opening * float(rng.choice([-1, 1])), float(rng.uniform(0.0, 2.0 * np.pi)), (radius, longitude))
    squeeze = float(1.0 / np.sqrt(np.cos(longitude) ** 2 + np.sin(longitude) ** 2 / np.sin(opening) ** 2))
    count = min(int(rng.integers(1, 21)), max(1, int(radius / (30.0 / squeeze))))
    sigma = float(rng.choice([0.0, 0.02, 0.1, 0.3])) / squeeze
    bands = random_bands(rng, radius, squeeze, count, sigma)
    snr = float(np.exp(rng.uniform(np.log(3.0), np.log(100.0))))
    offset = (float(rng.uniform(-15.0, 15.0)), float(rng.uniform(-15.0, 15.0)))
    return ring_scene(rng, bands, view, offset, snr=snr, sigma_px=float(rng.uniform(0.5, 1.2)))


def _pulls(scene: RingScene, navigation: Navigation) -> FloatArray:
    """Errors in sigmas along independent directions."""
    estimate = navigation.estimate
    assert estimate is not None
    if estimate.observable_vu is not None:
        assert estimate.along_px is not None
        assert estimate.sigma_along_px is not None
        return np.array([(estimate.along_px - estimate.observable_vu @ scene.offset_vu) / estimate.sigma_along_px])
    error = estimate.offset_vu - scene.offset_vu
    return np.asarray(np.linalg.solve(np.linalg.cholesky(estimate.covariance), error))


def _check(seed: int, count: int) -> None:
    pulls: list[FloatArray] = []
    for number in range(count):
        scene = _random(seed, number)
        navigation = _run(scene)
        if status_of(navigation.reason) is Status.SUCCESS:
            pulls.append(_pulls(scene, navigation))
    assert len(pulls) >= 0.95 * count
    every = np.concatenate(pulls)
    # Of n squares the mean scatters by sqrt(2 / n).
    spread = 2.5 * np.sqrt(2.0 / len(every))
    assert 0.64 - spread < float((every**2).mean()) < 1.0 + max(spread, 0.5)
    # A neighbour taken for the right edge would be hundreds of sigmas off.
    assert np.abs(every).max() < 8.0


def test_errors_are_as_large_as_their_sigmas() -> None:
    _check(seed=11, count=12)


@pytest.mark.slow
def test_errors_are_as_large_as_their_sigmas_in_hundreds_of_frames() -> None:
    _check(seed=7, count=200)


def _ellipse(error: float = 0.0) -> tuple[Band, ...]:
    return tuple(
        Band(radius, 5.0, 1.0, sigma=0.05, error=error if k == 2 else 0.0) for k, radius in enumerate((60, 75, 92, 110))
    )


def test_a_feature_three_pixels_off_is_named_and_does_not_move_the_answer() -> None:
    rng = np.random.default_rng(3)
    scene = ring_scene(rng, _ellipse(3.0), RingView(0.6, 0.4, (70.0, 0.5)), (4.3, -6.1))
    navigation = _run(scene)
    assert navigation.reason is StatusReason.NAVIGATED
    assert np.abs(_pulls(scene, navigation)).max() < 2.5
    table = next(r for r in navigation.results if r.technique == "RingEdgeNav").features
    assert table is not None
    assert dict(zip(table.name.tolist(), table.reason.tolist(), strict=True))["R2"] == "radius_off"
    assert table.used.sum() == 3


def test_a_coherent_radius_error_within_its_sigma_is_in_the_covariance() -> None:
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(10):
        error = float(rng.normal(0.0, 3.0))
        # A quarter of one ringlet: a larger radius looks like a shift.
        band = Band(300.0, 6.0, 1.0, sigma=3.0, error=error)
        scene = ring_scene(rng, (band,), RingView(1.2, 0.0, (300.0, 0.9)), (2.0, -3.0))
        navigation = _run(scene)
        assert status_of(navigation.reason) is Status.SUCCESS
        squares.append(_pulls(scene, navigation) ** 2)
    assert 0.3 < float(np.concatenate(squares).mean()) < 2.0


def test_straight_edges_tell_one_direction_and_nothing_else() -> None:
    rng = np.random.default_rng(5)
    bands = (Band(60000.0, 12.0, 1.0), Band(60040.0, 5.0, 0.6))
    scene = ring_scene(rng, bands, RingView(np.pi / 2 - 0.01, 0.7, (60020.0, 1.0)), (3.0, -2.0))
    navigation = _run(scene)
    assert navigation.reason is StatusReason.NAVIGATED_ONE_DIRECTION
    assert abs(_pulls(scene, navigation)[0]) < 3.0
    for result in navigation.results:
        assert isinstance(result, TechniqueResult)
        assert result.error_sources == ("rings:RINGED",)
        assert np.linalg.matrix_rank(result.information, tol=1e-12 * result.information.max()) == 1


@pytest.mark.parametrize("degrees", [-3.0, 1.1, 3.0])
def test_rotation(degrees: float) -> None:
    rng = np.random.default_rng(6)
    scene = ring_scene(
        rng, _ellipse(), RingView(0.5, 0.3, (80.0, 0.3)), (5.0, -7.0), np.radians(degrees), snr=20.0, fit_rotation=True
    )
    estimate = _run(scene).estimate
    assert estimate is not None
    assert estimate.rotation_rad is not None
    sigma = float(np.sqrt(estimate.covariance[2, 2]))
    assert np.degrees(sigma) < 0.05
    assert abs(estimate.rotation_rad - scene.rotation_rad) < 3.0 * sigma
    assert np.abs(estimate.offset_vu - scene.offset_vu).max() < 0.1


def test_a_round_ring_tells_no_rotation() -> None:
    rng = np.random.default_rng(7)
    view = RingView(np.pi / 2 - 1e-9, 0.0, (20.0, 0.3))
    scene = ring_scene(rng, _ellipse(), view, (5.0, -7.0), 0.02, fit_rotation=True)
    estimate = _run(scene).estimate
    assert estimate is not None
    assert estimate.rotation_rad is None


def test_a_grating_of_like_ringlets_is_ambiguous() -> None:
    rng = np.random.default_rng(8)
    # Ten pixels apart, far beyond the frame on both sides: each may be its neighbour.
    bands = tuple(Band(30000.0 + 10.0 * k, 4.0, 1.0) for k in range(-40, 41))
    scene = ring_scene(rng, bands, RingView(np.pi / 2 - 0.01, 0.2, (30000.0, 1.0)), (6.0, 4.0), margin_vu=(30.0, 30.0))
    navigation = _run(scene)
    assert status_of(navigation.reason) is not Status.SUCCESS
    assert navigation.reason is StatusReason.AMBIGUOUS_MATCH


def test_rings_are_found_whose_brightness_is_the_opposite_of_the_predicted_one() -> None:
    rng = np.random.default_rng(12)
    bands = random_bands(rng, 300.0, 1.0, 9, 0.02)
    scene = ring_scene(rng, bands, RingView(0.7, 0.4, (300.0, 0.5)), (11.3, -9.1))
    rings = scene.state.rings
    assert rings is not None
    other = {RingKind.RINGLET: RingKind.GAP, RingKind.GAP: RingKind.RINGLET}
    features = tuple(replace(f, kind=other[f.kind], tau=1.0 - (f.tau or 0.0)) for f in rings.features)
    scene = replace(scene, state=replace(scene.state, rings=replace(rings, features=features)))
    navigation = _run(scene)
    assert status_of(navigation.reason) is Status.SUCCESS
    assert np.abs(_pulls(scene, navigation)).max() < 3.5


def test_an_edge_that_drifts_moves_the_answer_within_its_sigma() -> None:
    squares = []
    for seed in range(8):
        rng = np.random.default_rng([13, seed])
        bands = [Band(radius, 6.0, 1.0, sigma=0.02) for radius in (260.0, 280.0, 300.0, 320.0, 340.0)]
        # A wave of one and a half pixels, of which the catalogue knows nothing.
        bands[2] = replace(bands[2], mode=(2, 1.5, float(rng.uniform(0.0, 6.0))))
        view = RingView(0.9, 0.4, (300.0, float(rng.uniform(0.0, 6.0))))
        scene = ring_scene(rng, tuple(bands), view, (4.0, -3.0))
        rings = scene.state.rings
        assert rings is not None
        features = tuple(replace(feature, modes=np.zeros((0, 3))) for feature in rings.features)
        scene = replace(scene, state=replace(scene.state, rings=replace(rings, features=features)))
        navigation = _run(scene)
        assert status_of(navigation.reason) is Status.SUCCESS
        squares.append(_pulls(scene, navigation) ** 2)
    assert float(np.concatenate(squares).mean()) < 2.5


@pytest.mark.parametrize("radius", [290.0, 190.0])
def test_rings_before_a_disc_are_navigated(radius: float) -> None:
    """Dark against it, where the catalogue has ringlets; of the smaller disc a part of the outline is in the frame."""
    rng = np.random.default_rng(14)
    bands = tuple(Band(r, 5.0, -0.5, sigma=0.02) for r in (300.0, 318.0, 333.0, 352.0))
    view = RingView(0.35, 0.2, (330.0, np.pi / 2))
    scene = ring_scene(rng, bands, view, (6.2, -4.4), margin_vu=(15.0, 15.0))
    rings = scene.state.rings
    assert rings is not None
    pixels = np.indices(scene.pixels.shape).reshape(2, -1).T.astype(float)
    middle = (np.array(scene.pixels.shape) - 1) / 2 + rings.position_km[[1, 0]] + scene.offset_vu
    beyond = np.hypot(*(pixels - middle).T).reshape(scene.pixels.shape) > radius
    # Sky beside the disc, at the level of the dark bands.
    dark = rng.normal(float(np.quantile(scene.pixels, 0.02)), 4.0, scene.pixels.shape)
    frame = np.where(beyond, dark, scene.pixels).astype(np.float32)
    planet = Body("RINGED", None, rings.position_km, np.full(3, radius), np.eye(3), np.array([0.0, 0.0, -1.0]))
    features = tuple(replace(f, kind=RingKind.RINGLET, tau=1.0) for f in rings.features)
    state = replace(scene.state, bodies=(planet,), rings=replace(rings, features=features))
    navigation = navigate(frame, None, state, StarTable.empty(), _OPTIONS)
    edges = next(r for r in navigation.results if r.technique == "RingEdgeNav")
    assert isinstance(edges, TechniqueResult)
    assert edges.diagnostics["rank"] == 2.0
    error = edges.offset_vu - scene.offset_vu
    assert float(error @ edges.information @ error) < 12.0


def test_an_empty_sky_has_no_rings() -> None:
    rng = np.random.default_rng(9)
    dark = tuple(Band(radius, 5.0, 1e-9) for radius in (60.0, 80.0))
    scene = ring_scene(rng, dark, RingView(0.6, 0.4, (70.0, 0.5)), (4.3, -6.1))
    assert status_of(_run(scene).reason) is Status.FAILED


def test_measured_radii_are_the_true_ones() -> None:
    rng = np.random.default_rng(10)
    bands = (Band(80.0, 6.0, 1.0, 2.0, 0.7, (3, 1.0, 0.2)), Band(100.0, 6.0, 1.0))
    scene = ring_scene(rng, bands, RingView(0.7, 0.4, (70.0, 0.5)), (1.3, -2.1), snr=60.0)
    edges = _run(scene).ring_edges
    assert edges is not None
    believed = edges.weight > 0.1
    pull = ((edges.radius_km - edges.predicted_km) / edges.sigma_km)[believed]
    # The pointing is common to all samples and hardly counts beside each one's noise.
    assert believed.sum() > 50
    assert 0.5 < float(np.sqrt((pull**2).mean())) < 1.4
    assert set(edges.feature.tolist()) == {"R0", "R1"}
