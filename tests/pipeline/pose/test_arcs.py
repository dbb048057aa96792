"""Arcs with planted drift, bias, gaps and outliers: covariances hold, and cutting an arc changes nothing."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.camera import project
from pipeline.pose.arc_factors import (
    BIAS_KEY,
    ArcImage,
    AttitudeFix,
    DirectionFix,
    attitude_factor,
    direction_factor,
    step_factor,
)
from pipeline.pose.arc_landmarks import PointSightings, common_landmarks
from pipeline.pose.arcs import ArcOptions, ArcResult, GrowingArc, fitted_options, labels_of, smooth_arc
from pipeline.pose.estimator import OpenCVGtsamPoseEstimator
from pipeline.pose.graph import covariances_of, match_graph, point_key, pose_key, resection_factor
from pipeline.pose.records import CameraCalibration, MatchError, MatchResult, Pose, SourceLabel, ThermalState
from pipeline.pose.se3 import SE3Utils
from tests.pipeline.pose.arc_scenes import plant_arc, plant_sightings
from tests.pipeline.pose.scenes import CAMERAS, DATUM

OPTIONS = ArcOptions(segment=40)


def _errors(result: ArcResult, poses: list[Pose]) -> np.ndarray:
    return np.array([SE3Utils.error(result.pose(k), pose) for k, pose in enumerate(poses)])


def _nees(result: ArcResult, poses: list[Pose]) -> np.ndarray:
    error = _errors(result, poses)
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariance), error))


def _wild(image: ArcImage, pose: Pose) -> bool:
    if image.fix is None:
        return False
    error = SE3Utils.error(image.fix.pose, pose)
    return bool(error @ np.linalg.solve(image.fix.covariance, error) > 200)


def _numerical(factor: gtsam.CustomFactor, values: gtsam.Values) -> None:
    """Analytic derivatives against differences along GTSAM's own retraction."""
    linear = factor.linearize(values).jacobian()[0]
    step, column = 1e-6, 0
    for key in list(factor.keys()):
        size = 3 if key == BIAS_KEY else 6
        for k in range(size):
            sides = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * step * np.eye(size)[k])
                sides.append(factor.unwhitenedError(values.retract(delta)))
            slope = factor.noiseModel().whiten((sides[0] - sides[1]) / (2 * step))
            assert_allclose(linear[:, column], slope, rtol=1e-4, atol=1e-5 * np.abs(linear).max())
            column += 1


def test_derivatives_of_the_factors() -> None:
    images, poses, _ = plant_arc(3, 0, OPTIONS)
    values = gtsam.Values()
    values.insert(BIAS_KEY, np.array([1e-3, -2e-3, 3e-3]))
    for k, pose in enumerate(poses):
        values.insert(pose_key(k), SE3Utils.to_gtsam(pose).retract(np.full(6, 1e-3)))
    _numerical(attitude_factor(1, images[1], OPTIONS.noise()), values)
    _numerical(step_factor(1, images[1], images[2], OPTIONS.noise()), values)
    points = np.random.default_rng(0).normal(size=(5, 3)) * 50
    camera = poses[0].to_camera(points)
    factor = resection_factor(pose_key(0), points, camera[:, :2] / camera[:, 2:], np.tile(np.eye(2) * 1e-8, (5, 1, 1)))
    _numerical(factor, values)


def test_covariances_hold_with_and_without_a_fix_of_ones_own() -> None:
    nees, alone, biases = [], [], []
    for seed in range(12):
        images, poses, bias = plant_arc(60, seed, OPTIONS)
        result = smooth_arc(images, OPTIONS)
        each = _nees(result, poses)
        nees.append(each.mean())
        alone.append(each[~result.used].mean())
        away = result.bias_rad - bias
        biases.append(away @ np.linalg.solve(result.bias_covariance_rad2, away))
        bad = [_wild(image, pose) for image, pose in zip(images, poses, strict=True)]
        assert not (result.used & np.array(bad)).any()
        assert result.used.sum() > 0.9 * (sum(im.fix is not None for im in images) - sum(bad))
    # Neighbours share errors, so an arc's mean of 60 scatters by about a half.
    assert 5.3 < np.mean(nees) < 6.7
    assert 5.2 < np.mean(alone) < 6.8
    assert 1.0 < np.mean(biases) < 5.5


def test_cutting_an_arc_changes_nothing() -> None:
    images, _, _ = plant_arc(100, 20, OPTIONS)
    cut, whole = smooth_arc(images, ArcOptions(segment=13)), smooth_arc(images, ArcOptions(segment=1000))
    assert (cut.used == whole.used).all()
    sigma = np.sqrt(np.diagonal(whole.covariance, axis1=1, axis2=2))
    assert (np.abs(cut.position_km - whole.position_km) < 1e-3 * sigma[:, :3]).all()
    assert_allclose(np.sqrt(np.diagonal(cut.covariance, axis1=1, axis2=2)), sigma, rtol=1e-3)
    assert_allclose(cut.bias_rad, whole.bias_rad, atol=1e-9)


def test_a_growing_arc_arrives_where_the_whole_one_does() -> None:
    images, poses, _ = plant_arc(60, 21, OPTIONS, outliers=0.0)
    growing = GrowingArc(OPTIONS)
    for image in images:
        growing.add(image)
    whole = smooth_arc(images, OPTIONS)
    sigma = np.sqrt(np.diag(whole.covariance[-1]))
    assert (np.abs(SE3Utils.error(growing.pose(59), whole.pose(59))) < 0.3 * sigma).all()
    assert_allclose(np.sqrt(np.diag(growing.covariance(59))), sigma, rtol=0.2)
    assert_allclose(growing.bias(), whole.bias_rad, atol=1e-5)
    assert len(list(growing.images())) == 60
    with pytest.raises(MatchError, match="not later"):
        growing.add(replace(images[3], image_id="late"))
    assert poses


def test_an_estimator_adds_its_matches_to_the_arcs_graph() -> None:
    images, poses, _ = plant_arc(6, 25, OPTIONS, gap=1.0)
    growing = GrowingArc(OPTIONS)
    for image in images[:5]:
        growing.add(image)
    before = growing.covariance(4)
    rng = np.random.default_rng(2)
    points = rng.uniform(-60, 60, (80, 3))
    exact, _ = project(CAMERAS[2], poses[4].to_camera(points))
    noise = np.tile(np.eye(2) * 0.09, (80, 1, 1))
    matches = MatchResult("i4", np.arange(80), exact + rng.normal(size=exact.shape) * 0.3, points, noise)
    calibration = CameraCalibration.of(CAMERAS[2], DATUM)
    alone = OpenCVGtsamPoseEstimator().estimate(matches, calibration, ThermalState())
    shared = OpenCVGtsamPoseEstimator(shared=growing).estimate(matches, calibration, ThermalState())
    assert_allclose(growing.pose(4).position_km, shared.pose.position_km)
    for answer in (alone, shared):
        error = SE3Utils.error(answer.pose, poses[4])
        assert error @ np.linalg.solve(answer.covariance_6x6, error) < 25
    # The arc knows more than the image alone, and its neighbours profit.
    assert np.linalg.det(shared.covariance_6x6) < np.linalg.det(alone.covariance_6x6)
    assert np.trace(growing.covariance(3)[:3, :3]) < 0.01 * np.trace(before[:3, :3])
    with pytest.raises(MatchError, match="no image"):
        growing.key_of("none")


def test_an_arc_without_fixes_is_dead_reckoned_within_its_priors() -> None:
    images, poses, _ = plant_arc(30, 22, OPTIONS, gap=1.0)
    result = smooth_arc(images, OPTIONS)
    assert set(result.label) == {SourceLabel.DEAD_RECKONED}
    assert set(result.anchor_age_ms) == {None}
    assert_allclose(np.sqrt(np.diag(result.covariance[0])[:3]), OPTIONS.position_sigma_km, rtol=1e-3)
    assert 0.5 < _nees(result, poses).mean() < 15


def test_attitude_fixes_show_the_bias_without_a_position() -> None:
    images, poses, bias = plant_arc(40, 23, OPTIONS, gap=1.0)
    rng = np.random.default_rng(1)
    measured = []
    for image, pose in zip(images, poses, strict=True):
        r = rng.normal(size=3) * 2e-5
        turn = pose.camera_from_body @ SE3Utils.exp(r)
        measured.append(replace(image, offset=AttitudeFix(turn, np.eye(3) * 4e-10)))
    result = smooth_arc(measured, OPTIONS)
    away = result.bias_rad - bias
    assert np.sqrt(away @ np.linalg.solve(result.bias_covariance_rad2, away)) < 4.5
    assert np.linalg.norm(away) < 0.1 * np.linalg.norm(bias)


def _with_directions(images: list[ArcImage], poses: list[Pose], seed: int) -> tuple[list[ArcImage], np.ndarray]:
    """Offsets from the body's place in every image, a twentieth of them wrong."""
    rng, seen = np.random.default_rng(seed), []
    wild = rng.random(len(images)) < 0.05
    for k, (image, pose) in enumerate(zip(images, poses, strict=True)):
        turn = SE3Utils.exp(rng.normal(size=3) * 2e-5 * (300.0 if wild[k] else 1.0))
        centre = turn @ pose.camera_from_body @ -pose.position_km
        fix = DirectionFix(centre / np.linalg.norm(centre), np.eye(3) * 4e-10)
        seen.append(replace(image, offset=fix))
    return seen, wild


def test_directions_of_the_body_hold_an_arc_and_their_covariances_too() -> None:
    nees, sizes = [], []
    for seed in range(4):
        images, poses, _ = plant_arc(60, 30 + seed, OPTIONS, gap=0.8, outliers=0.0)
        seen, wild = _with_directions(images, poses, seed)
        with_them, without = smooth_arc(seen, OPTIONS), smooth_arc(images, OPTIONS)
        assert not (with_them.offset_used & wild).any()
        assert with_them.offset_used.sum() > 0.95 * (~wild).sum()
        assert not without.offset_used.any()
        nees.append(_nees(with_them, poses).mean())
        sizes.append(np.linalg.det(with_them.covariance) / np.linalg.det(without.covariance))
    assert 5.2 < np.mean(nees) < 6.8
    assert np.mean(np.array(sizes) < 0.5) > 0.9


def test_a_direction_leaves_position_and_attitude_along_it_open() -> None:
    images, poses, _ = plant_arc(3, 41, OPTIONS, gap=1.0)
    seen, _ = _with_directions(images, poses, 1)
    values = gtsam.Values()
    values.insert(pose_key(1), SE3Utils.to_gtsam(poses[1]).retract(np.full(6, 1e-3)))
    offset = seen[1].offset
    assert isinstance(offset, DirectionFix)
    factor = direction_factor(pose_key(1), offset, gtsam.noiseModel.Unit.Create(2))
    _numerical(factor, values)
    for wrong, message in (([0, 0, 2.0], "unit vector"), ([0, 0, 1.0], "zero or negative")):
        with pytest.raises(MatchError, match=message):
            DirectionFix(np.array(wrong), np.diag([0.0, 1.0, 1.0]))


def test_labels_and_ages() -> None:
    labels, ages = labels_of([0.0, 1.5, 2.0, 4.25], np.array([False, True, False, False]))
    assert [label.value for label in labels] == ["visual_propagated", "satellite_anchored", *["visual_propagated"] * 2]
    assert ages == (None, 0, 500, 2750)


def test_what_is_no_arc_is_refused() -> None:
    images, _, _ = plant_arc(3, 24, OPTIONS)
    for wrong, message in (
        ([], "without images"), ([images[0], images[0]], "twice"), ([images[1], images[0]], "not later"),
    ):  # fmt: skip
        with pytest.raises(MatchError, match=message):
            smooth_arc(wrong)
    with pytest.raises(MatchError, match="no time"):
        replace(images[0], et=np.nan)


def test_uncertainties_that_nobody_told_come_from_the_fixes() -> None:
    told = ArcOptions(position_sigma_km=4.0, walk_km_per_sqrt_s=0.2, attitude_sigma_rad=8e-4)
    found = []
    for seed in range(12):
        images, _, _ = plant_arc(80, 50 + seed, told, gap=0.2, outliers=0.05)
        fitted = fitted_options(images, ArcOptions(twist_sigma_rad=2e-3))
        found.append([fitted.walk_km_per_sqrt_s, fitted.attitude_sigma_rad, fitted.position_sigma_km])
        assert fitted.twist_sigma_rad == 2e-3
    walk, attitude, position = np.median(found, axis=0)
    # Steps span gaps between fixes too; each fix's own error of 0.05 km is a fifth of a step.
    assert 0.19 < walk < 0.25
    assert 7e-4 < attitude < 9.5e-4
    assert 2.0 < position < 20.0
    few, _, _ = plant_arc(80, 1, told, gap=0.99)
    assert fitted_options(few, told) is told


def _with_points(count: int, seed: int) -> tuple[list[ArcImage], list[Pose], np.ndarray]:
    images, poses, _ = plant_arc(count, seed, OPTIONS, outliers=0.0)
    sighted, places = plant_sightings(images, poses, seed)
    return sighted, poses, places


def test_points_that_are_solved_make_covariances_hold_which_common_errors_spoil() -> None:
    apart, together, points = [], [], []
    for seed in range(12):
        images, poses, places = _with_points(16, seed)
        apart.append(_nees(smooth_arc(images, OPTIONS), poses).mean())
        result = smooth_arc(images, ArcOptions(segment=40, solve_landmarks=True))
        together.append(_nees(result, poses).mean())
        solved = result.landmarks
        assert solved is not None
        assert len(solved.point_id) > 40
        assert solved.sightings.min() >= 2
        error = solved.places_km - places[solved.point_id - 10]
        points.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(solved.covariance_km2), error).mean())
        # The places were 0.1 km wrong.
        assert np.sqrt((error**2).mean()) < 0.07
    # Images of an arc share errors, so each arc is about one draw of chi2 with six degrees of freedom: mean of twelve.
    assert np.mean(apart) > 12.0
    assert 3.5 < np.mean(together) < 9.0
    assert 2.3 < np.mean(points) < 3.7


def test_cutting_an_arc_with_points_changes_nothing() -> None:
    images, _, _ = _with_points(30, 3)
    whole = smooth_arc(images, ArcOptions(segment=100, solve_landmarks=True))
    cut = smooth_arc(images, ArcOptions(segment=8, solve_landmarks=True))
    sigma = np.sqrt(np.diagonal(whole.covariance, axis1=1, axis2=2))
    assert (np.abs(cut.position_km - whole.position_km) < 0.05 * sigma[:, :3]).all()
    assert_allclose(np.diagonal(cut.covariance, axis1=1, axis2=2), sigma**2, rtol=0.01)
    assert whole.landmarks is not None
    assert cut.landmarks is not None
    assert cut.landmarks.point_id.tolist() == whole.landmarks.point_id.tolist()
    assert_allclose(cut.landmarks.places_km, whole.landmarks.places_km, atol=5e-3)
    assert_allclose(cut.landmarks.covariance_km2, whole.landmarks.covariance_km2, atol=2e-5)


def test_points_between_segments_are_bounded_and_those_with_most_sightings_stay() -> None:
    images, _, _ = _with_points(30, 3)
    used = np.array([image.fix is not None for image in images])
    every, few = (common_landmarks(images, used, 8, most) for most in (1000, 5))
    for boundary in (8, 16, 24):
        assert len(every.crossing(boundary)) > 5 >= len(few.crossing(boundary))
    best = every.point_id[np.argmax(every.sightings)]
    assert best in few.point_id
    result = smooth_arc(images, ArcOptions(segment=8, solve_landmarks=True, most_common_landmarks=5))
    assert result.landmarks is not None
    assert result.landmarks.point_id.tolist() == few.point_id.tolist()


def test_places_that_images_state_apart_are_different_points() -> None:
    def seen(place: float) -> PointSightings:
        return PointSightings(
            np.array([4]), np.zeros((1, 2)), np.eye(2)[None] * 1e-6, np.full((1, 3), place), np.eye(3)[None]
        )

    image = ArcImage("a", 0.0, Pose(np.eye(3), np.zeros(3)))
    images = [replace(image, sightings=seen(place)) for place in (0.0, 0.0, 3.0)]
    points = common_landmarks(images, np.ones(3, dtype=bool), 10, 10)
    sizes = [points.image_factors(k, seen(place), Pose(np.eye(3), np.array([0, 0, -9.0]))) for k, place in
             enumerate((0.0, 3.0))]  # fmt: skip
    assert [list(graph.at(0).keys()) for graph in sizes] == [[pose_key(0), point_key(0)], [pose_key(1)]]


def test_covariances_at_once_are_those_of_the_tree() -> None:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(20, 3)) + np.array([0.0, 0.0, 9.0])
    spread = np.tile(np.eye(3) * 1e-3, (20, 1, 1))
    noise = np.tile(np.eye(2) * 1e-6, (20, 1, 1))
    graph, values = match_graph(pose_key(0), places, places[:, :2] / places[:, 2:], noise, spread)
    values.insert(pose_key(0), gtsam.Pose3())
    tree = gtsam.Marginals(graph, values)
    found = covariances_of(graph, values, [point_key(k) for k in range(15)],
                           [pose_key(0), *(point_key(k) for k in range(15, 20))])  # fmt: skip
    assert len(found) == 21
    for key, covariance in found.items():
        expected = tree.marginalCovariance(key)
        assert_allclose(covariance, expected, atol=1e-6 * np.abs(expected).max())
