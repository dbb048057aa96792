from dataclasses import replace

import numpy as np
import pytest

from pipeline.predict.rings import RingPredictionOptions, RingScene, bow_px, predict_rings, single_scattering
from pipeline.records import Body, RingFeature, RingKind, State
from tests.scenes.ring_scene import Band, RingView, ring_scene

_OPTIONS = RingPredictionOptions()
_VIEW = RingView(0.5, 0.3, (80.0, 0.4))


def _state(view: RingView = _VIEW, bands: tuple[Band, ...] = (Band(80.0, 6.0, 1.0), Band(100.0, 4.0, 1.0))) -> State:
    return ring_scene(np.random.default_rng(0), bands, view, (0.0, 0.0), over=1).state


def _predicted(state: State) -> RingScene:
    return predict_rings(state, 0.8, _OPTIONS)


def _with(state: State, *features: RingFeature) -> State:
    assert state.rings is not None
    return replace(state, rings=replace(state.rings, features=features))


def test_reflected_light_saturates_and_transmitted_light_fades() -> None:
    tau = np.array([1e-4, 0.5, 50.0])
    lit, unlit = (single_scattering(tau, 0.4, 0.3, side) for side in (True, False))
    # Thin rings scatter tau / mu to either side; thick ones mu0 / (mu + mu0) back and nothing through.
    np.testing.assert_allclose([lit[0], unlit[0]], 1e-4 / 0.4, rtol=1e-3)
    assert lit[2] == pytest.approx(0.3 / 0.7)
    assert unlit[2] < 1e-10
    assert unlit[1] > unlit[0]


def test_transmitted_light_is_continuous_where_sun_and_camera_stand_alike() -> None:
    tau = np.array([0.3, 1.0])
    np.testing.assert_allclose(
        single_scattering(tau, 0.4, 0.4, False), single_scattering(tau, 0.4, 0.4004, False), rtol=2e-3
    )


def test_edges_are_sorted_and_bright_on_the_ringlets_side() -> None:
    scene = _predicted(_state())
    assert scene.names == ("R0", "R0", "R1", "R1")
    assert scene.outer.tolist() == [False, True, False, True]
    assert np.sign(scene.contrasts).tolist() == [1, -1, 1, -1]
    assert (np.diff(scene.means) > 0).all()
    assert all(fate.reason == "" and not fate.straight for fate in scene.fates)


def test_a_gap_in_a_ringlet_is_dark_on_the_lit_side() -> None:
    state = _with(
        _state(), RingFeature("A", RingKind.RINGLET, 70.0, width_km=40.0, tau=0.5),
        RingFeature("G", RingKind.GAP, 85.0, width_km=6.0, tau=0.0),
        RingFeature("E", RingKind.EDGE_OUTER, 112.0, tau=0.5),
    )  # fmt: skip
    scene = _predicted(state)
    edges = zip(scene.names, scene.outer.tolist(), strict=True)
    signs = dict(zip(edges, np.sign(scene.contrasts).tolist(), strict=True))
    assert signs == {("A", False): 1, ("A", True): -1, ("G", False): -1, ("G", True): 1, ("E", False): -1}


def test_features_that_cannot_be_used_say_why() -> None:
    state = _with(
        _state(), RingFeature("far", RingKind.RINGLET, 9000.0, width_km=5.0),
        RingFeature("vague", RingKind.EDGE_OUTER, 90.0, sigma_a_km=100.0),
        RingFeature("good", RingKind.EDGE_OUTER, 80.0),
    )  # fmt: skip
    reasons = {fate.name: fate.reason for fate in _predicted(state).fates}
    assert reasons == {"far": "outside_field", "vague": "radius_unknown", "good": ""}
    flat = _predicted(_state(RingView(1e-4, 0.3, (80.0, 0.4))))
    assert {fate.reason for fate in flat.fates} == {"edge_on"}
    assert len(flat) == 0


def test_a_planet_before_the_rings_hides_them() -> None:
    state = _state(RingView(0.02, 0.0, (60.0, -np.pi / 2)), (Band(60.0, 3.0, 1.0),))
    assert state.rings is not None
    planet = Body("RINGED", None, state.rings.position_km, np.full(3, 50.0), np.eye(3), np.array([0.0, 0.0, -1.0]))
    scene = _predicted(replace(state, bodies=(planet,)))
    pose = scene.pose(np.zeros(2), 0.0)
    longitude = np.radians([90.0, 270.0, 0.0, 180.0])
    points = 60.0 * np.stack([np.cos(longitude), np.sin(longitude), 0 * longitude], axis=1)
    ahead = (points - pose.observer_km) @ pose.turn
    hidden = scene.hidden(pose, 0, longitude)
    # What is farther than the planet's centre lies behind its disc; the near arm lies before it, the ansae beside it.
    assert hidden[np.argmax(ahead[:2, 2])]
    assert not hidden[np.argmin(ahead[:2, 2])]
    assert not hidden[2:].any()


def test_bow_is_the_sagitta() -> None:
    angle = np.linspace(-0.1, 0.1, 41)
    places = 500.0 * np.stack([np.cos(angle + 0.7), np.sin(angle + 0.7)], axis=1)
    assert bow_px(places) == pytest.approx(500.0 * (1 - np.cos(0.1)), rel=1e-6)


def test_drawn_light_is_that_of_the_scene() -> None:
    bands = (Band(80.0, 6.0, 1.0, 3.0, 1.0, (3, 1.0, 0.5)),)
    drawn = ring_scene(np.random.default_rng(0), bands, _VIEW, (2.0, -3.0), snr=1000.0, over=8)
    scene = _predicted(drawn.state)
    blur = float(np.sqrt(0.64 + 1 / 12))
    light = scene.draw(scene.pose(np.array([2.0, -3.0]), 0.0), np.zeros(2), 1.0, drawn.clean.shape, blur)
    truth = (drawn.clean - drawn.clean.min()) / np.ptp(drawn.clean)
    # A pixel's square is drawn as a Gaussian of the same variance, and ansae as straight steps.
    assert np.abs(light / light.max() - truth).max() < 0.05
