"""Landmarks of a rough plane: pointing and state from pictures that were drawn by its formula."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.maplet import Maplet, MapletView, index_of
from pipeline.geometry.pointing import corrected_attitude, move_pivot, offset_between
from pipeline.geometry.rotations import rotation_about
from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, Body, Detector, FloatArray, Spacecraft, State
from pipeline.status import StatusReason
from pipeline.techniques.base import TechniqueFailure, TechniqueResult
from pipeline.techniques.surface_features import (
    MapletSource,
    SurfaceFeatureOptions,
    surface_feature_nav,
    with_misfit,
    without_trust_in_place,
)
from tests.pipeline.techniques.maplet_scene import maplet_on, picture_of, relief, view_down

SURFACE = relief(9)
VIEW = view_down(0.05, 0.5, 0.4, np.array([0.5, 0.3, 0.7]), 200)
BETA = float(np.exp(-np.degrees(np.arccos(VIEW.sun @ VIEW.position_km / np.linalg.norm(VIEW.position_km))) / 60))
PICTURE = picture_of(SURFACE, VIEW, np.zeros(2), BETA)
HALF = 17


def source() -> MapletSource:
    """Grid of overlapping maplets, cut from the formula."""
    whole = maplet_on(SURFACE, 95, 0.05)
    maplets: list[Maplet] = []
    for i in range(-72, 73, 24):
        for j in range(-72, 73, 24):
            part = (slice(95 + i - HALF, 95 + i + HALF + 1), slice(95 + j - HALF, 95 + j + HALF + 1))
            heights = whole.heights[part] - whole.heights[95 + i, 95 + j]
            place = whole.landmark_km + 0.05 * np.array([i, j, whole.heights[95 + i, 95 + j]])
            name, albedo = f"L{len(maplets)}", whole.albedo[part]
            maplets.append(Maplet(name, place, np.eye(3), 0.05, heights, albedo, np.eye(3) * 0.002**2))
    return MapletSource("PLANE", index_of(maplets), maplets.__getitem__, None)


SOURCE = source()


def state_at(view: MapletView, turns: bool) -> State:
    """State in which the body's axes are those of J2000."""
    body = Body("PLANE", None, -view.position_km, np.ones(3), np.eye(3), view.sun / np.linalg.norm(view.sun))
    settings = InstrumentSettings(fit_camera_rotation=turns, max_rotation_deg=2.0, search_margin_vu=(20.0, 20.0))
    return State(
        "a", "M", "C", 0.0, "2000-01-01T00:00:00", 1.0, view.camera, Detector(), Attitude(view.camera_from_body),
        Spacecraft(), settings, (body,),
    )  # fmt: skip


class _Picture:
    """The two arrays of a frame that landmarks look at."""

    def __init__(self, pixels: FloatArray) -> None:
        self.raw = pixels.astype(np.float32)
        self.bad = np.zeros(pixels.shape, bool)


def found_from(view: MapletView, pixels: FloatArray, turns: bool = False, rounds: int = 3):  # type: ignore[no-untyped-def]
    options = SurfaceFeatureOptions(state_rounds=rounds, position_sigma_share=0.004, attitude_sigma_px=6.0)
    state = state_at(view, turns)
    return surface_feature_nav(state.bodies[0], SOURCE, _Picture(pixels), state, options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("offset", "twist_deg"), [((11.0, -14.0), 0.0), ((-6.0, 9.0), 1.0)])
def test_a_displaced_pointing_comes_back(offset: tuple[float, float], twist_deg: float) -> None:
    turns = twist_deg != 0.0
    away = corrected_attitude(VIEW.camera, VIEW.camera_from_body, -np.array(offset), -float(np.radians(twist_deg)))
    fix = found_from(replace(VIEW, camera_from_body=away), PICTURE, turns, 0)
    answer = fix.answer
    assert isinstance(answer, TechniqueResult)
    centre, _ = move_pivot(answer.offset_vu, answer.rotation_rad, answer.pivot_vu, VIEW.camera.centre_vu)
    after = corrected_attitude(VIEW.camera, away, centre, answer.rotation_rad)
    error, twist = offset_between(VIEW.camera, VIEW.camera_from_body, after)
    assert np.abs(error).max() < 0.05
    assert abs(np.degrees(twist)) < 0.03
    assert fix.table.used.sum() > 30
    assert answer.confidence > 0.999
    assert np.abs(fix.table.observed_vu - VIEW.pixels(fix.table.landmark_km)[0])[fix.table.used].max() < 0.2


def test_position_and_attitude_come_back_within_their_covariance() -> None:
    rng = np.random.default_rng(3)
    nees = []
    for _ in range(4):
        noisy = PICTURE + rng.normal(size=PICTURE.shape) * 0.1 * PICTURE.std()
        place = rng.normal(size=3) * 0.3
        turn = rng.normal(size=3) * 1e-3
        attitude = VIEW.camera_from_body @ rotation_about(turn, float(np.linalg.norm(turn)))
        away = replace(VIEW, position_km=VIEW.position_km + place, camera_from_body=attitude)
        state = found_from(away, noisy).state
        assert state is not None
        assert state.converged
        change = VIEW.camera_from_body.T @ state.view.camera_from_body
        r = 0.5 * np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])
        error = np.concatenate([state.view.position_km - VIEW.position_km, r])
        nees.append(error @ np.linalg.solve(state.covariance, error))
        assert (np.sqrt(np.diag(state.covariance))[:3] < 0.4).all()
    # Four six-dimensional squares: mean 6, sigma 1.7.
    assert np.mean(nees) < 13.0


def test_a_picture_of_something_else_is_no_match() -> None:
    other = np.random.default_rng(1).normal(100.0, 10.0, PICTURE.shape)
    fix = found_from(VIEW, other)
    assert isinstance(fix.answer, TechniqueFailure)
    assert fix.state is None
    empty = found_from(VIEW, np.full(PICTURE.shape, 5.0))
    assert isinstance(empty.answer, TechniqueFailure)
    behind = replace(VIEW, camera_from_body=np.diag([1.0, -1.0, -1.0]) @ VIEW.camera_from_body)
    unseen = found_from(behind, PICTURE)
    assert isinstance(unseen.answer, TechniqueFailure)
    assert unseen.answer.reason is StatusReason.NO_FEATURES_PREDICTED
    assert "49 outside_cone" in unseen.answer.detail


def test_scatter_that_landmarks_share_is_added_to_the_covariance() -> None:
    covariance = np.diag([1e-4, 4e-4, 1e-9])
    added = np.diag([0.06, 0.06, 0.06 / 150.0**2])
    found = np.linalg.inv(with_misfit(np.linalg.inv(covariance), 0.6, 150.0))
    assert found == pytest.approx(covariance + added, rel=1e-6, abs=1e-15)
    assert with_misfit(np.eye(2), 0.0, 150.0) == pytest.approx(np.eye(2))
    # What is not observed stays so.
    assert np.linalg.matrix_rank(with_misfit(np.diag([50.0, 50.0, 0.0]), 0.6, 150.0)) == 2


def test_a_wrong_place_makes_outlines_of_the_same_body_less_sure() -> None:
    state = state_at(VIEW, False)
    body, options = state.bodies[0], SurfaceFeatureOptions()
    limb = TechniqueResult(
        "BodyLimbNav", np.zeros(2), 0.0, np.diag([100.0, 0.0, 0.0]), np.zeros(2), 1.0, error_sources=("body:PLANE",)
    )
    # One kilometre seen from 100 km through pixels of 0.0005 rad.
    error = options.position_sigma_share * (1.0 / np.linalg.norm(body.position_km)) / 0.0005
    found = without_trust_in_place(limb, body, state, options)
    assert 1.0 / found.information[0, 0] == pytest.approx(0.01 + error**2, rel=0.02)
    assert np.linalg.matrix_rank(found.information) == 1
    other = replace(limb, error_sources=("body:MOON",))
    assert without_trust_in_place(other, body, state, options) is other
    own = replace(limb, technique="SurfaceFeatureNav")
    assert without_trust_in_place(own, body, state, options) is own
