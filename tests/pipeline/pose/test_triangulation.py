"""Lines of sight: exact without noise, with the promised scatter with it, refused where they do not meet."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from pipeline.camera import project
from pipeline.pose.normalise import to_plane
from pipeline.pose.records import MatchError, Pose
from pipeline.pose.triangulation import (
    CameraTriangulation,
    LinesOfSight,
    TriangulationMethod,
    TriangulationOptions,
    intersect_lines,
)
from pipeline.pose.views import Sightings, triangulate_views
from tests.pipeline.pose.scenes import CAMERAS

METHODS = tuple(TriangulationMethod)
TRIALS = 5000
# A sigma from 5000 trials is good to 1 %; five of those.
SIGMA_TOLERANCE = 0.05


def _scene(seed: int, count: int = 12) -> tuple[np.ndarray, Pose]:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    depth = rng.uniform(4.0, 40.0, count)
    camera = np.column_stack([rng.uniform(-0.06, 0.06, (count, 2)) * depth[:, None], depth])
    position = rng.normal(size=3) * 100
    return camera @ turn + position, Pose(turn, position)


def _locate(points: np.ndarray, pixels: np.ndarray, pose: Pose, method: str, sigma: float = 0.0):  # type: ignore[no-untyped-def]
    options = TriangulationOptions(uncertaintyImageMeasurement=sigma, method=TriangulationMethod(method))
    return CameraTriangulation(options).estimate(points, pixels, CAMERAS[0], pose.camera_from_body)


@pytest.mark.parametrize("method", METHODS)
def test_exact_lines_meet_exactly(method: TriangulationMethod) -> None:
    points, pose = _scene(0)
    pixels, _ = project(CAMERAS[0], pose.to_camera(points))
    found = _locate(points, pixels, pose, method)
    assert_allclose(found.position_km, pose.position_km, atol=1e-7)
    assert found.covariance_km2 is None


def test_each_sigma_is_that_of_monte_carlo_and_lost_is_never_worse() -> None:
    points, pose = _scene(1)
    exact, _ = project(CAMERAS[0], pose.to_camera(points))
    rng = np.random.default_rng(2)
    # All trials at once: one place each, through the same function that the class calls.
    noisy = exact + rng.normal(size=(TRIALS, *exact.shape)) * 0.25
    plane = to_plane(CAMERAS[0], noisy.reshape(-1, 2), np.tile(np.eye(2) * 0.0625, (noisy[..., 0].size, 1, 1)))
    index = np.repeat(np.arange(TRIALS, dtype=np.int64), len(points))
    turns = np.broadcast_to(pose.camera_from_body, (len(index), 3, 3))
    lines = LinesOfSight(index, plane.xy, plane.covariance, turns, np.tile(points, (TRIALS, 1)))
    rms = {}
    for method in METHODS:
        found = intersect_lines(lines, TRIALS, method, sign=-1.0)
        error = found.places_km - pose.position_km
        once = _locate(points, exact, pose, method, 0.25)
        assert once.covariance_km2 is not None
        sample = np.cov(error.T)
        assert_allclose(np.sqrt(np.diag(once.covariance_km2) / np.diag(sample)), 1.0, atol=SIGMA_TOLERANCE)
        unit = 1 / np.sqrt(np.diag(sample))
        assert_allclose(once.covariance_km2 * np.outer(unit, unit), sample * np.outer(unit, unit), atol=0.08)
        rms[method] = np.sqrt((error**2).sum(axis=1).mean())
    assert rms[TriangulationMethod.LOST] <= rms[TriangulationMethod.LINEAR]
    assert rms[TriangulationMethod.LOST] < 0.9 * rms[TriangulationMethod.LINEAR]


@pytest.mark.parametrize("seed", range(8))
def test_lost_never_expects_to_be_worse(seed: int) -> None:
    points, pose = _scene(10 + seed, count=5)
    pixels, _ = project(CAMERAS[0], pose.to_camera(points))
    trace = {m: float(np.trace(_locate(points, pixels, pose, m, 1.0).covariance_km2)) for m in METHODS}
    assert trace[TriangulationMethod.LOST] <= min(trace.values()) * (1 + 1e-9)


def test_points_from_many_views() -> None:
    rng = np.random.default_rng(3)
    places = rng.uniform(-1, 1, (40, 3))
    centres = np.array([[0, 0, -30.0], [8, 0, -28], [0, 9, -29], [-6, -5, -31]])
    turns = np.stack([_looking(-c) for c in centres])
    trials = 400
    index = (np.tile(np.repeat(np.arange(40), 4), trials) + np.repeat(np.arange(trials) * 40, 160)).astype(np.int64)
    view = np.tile(np.arange(4), 40 * trials)
    camera = np.einsum("nij,nj->ni", turns[view], places[index % 40] - centres[view])
    pixels, _ = project(CAMERAS[2], camera)
    pixels = pixels + rng.normal(size=pixels.shape) * 0.4
    plane = to_plane(CAMERAS[2], pixels, np.tile(np.eye(2) * 0.16, (len(pixels), 1, 1)))
    lines = LinesOfSight(index, plane.xy, plane.covariance, turns[view], centres[view])
    found = intersect_lines(lines, 40 * trials)
    assert found.ok.all()
    error = found.places_km - places[np.arange(40 * trials) % 40]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_km2), error)
    # Mean of 16000 chi2 of three: sigma 0.02.
    assert nees.mean() == pytest.approx(3.0, abs=0.1)


def _looking(along: np.ndarray) -> np.ndarray:
    z = along / np.linalg.norm(along)
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def test_places_without_two_lines_are_refused_and_the_others_stay() -> None:
    xy = np.array([[0.0, 0], [0.1, 0], [0, 0], [0.1, 0], [0.1, 0], [0, 0], [0, 0]])
    centres = np.array([[0, 0, 0], [-1, 0, 0.0], [5, 5, 5], [0, 0, 0], [1, 0, 0], [0, 0, 0], [1.0, 0, 0]])
    xy[5, 0], xy[6, 0] = 0.1, 0.2
    index = np.array([0, 0, 1, 2, 2, 4, 4])
    lines = LinesOfSight(index, xy, np.tile(np.eye(2), (7, 1, 1)), np.tile(np.eye(3), (7, 1, 1)), centres)
    found = intersect_lines(lines, 5)
    assert found.refusal.tolist() == [0, 1, 2, 1, 3]
    assert_allclose(found.places_km[0], [0, 0, 10], atol=1e-9)
    assert np.isnan(found.places_km[1:]).all()


def test_bad_input_is_one_error_each() -> None:
    points, pose = _scene(4)
    pixels, _ = project(CAMERAS[0], pose.to_camera(points))
    broken = pixels.copy()
    broken[3, 0] = np.nan
    for p, x, message in (
        (points, pixels[:5], "12 points but 5 key points"), (points, broken, "not finite"),
        (points[:1], pixels[:1], "two points"), (np.zeros((0, 3)), np.zeros((0, 2)), "two points"),
        (points[:, :2], pixels, "shape"), (np.tile(points[:1], (4, 1)), np.tile(pixels[:1], (4, 1)), "parallel"),
        (2 * pose.position_km - points, pixels, "behind"),
    ):  # fmt: skip
        with pytest.raises(MatchError, match=message):
            _locate(p, x, pose, "linear")
    with pytest.raises(ValueError, match="greater than or equal"):
        TriangulationOptions(uncertaintyImageMeasurement=-1.0)


def test_a_wrong_view_does_not_bend_a_point() -> None:
    rng = np.random.default_rng(11)
    places = rng.normal(size=(300, 3)) * 20.0
    camera, poses = CAMERAS[2], []
    for k in range(6):
        centre = 400.0 * np.array([np.cos(0.15 * k), np.sin(0.15 * k), 0.1 * (k % 2)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
        poses.append(Pose(np.stack([x, np.cross(z, x), z]), centre))
    pixels = np.stack([project(camera, pose.to_camera(places))[0] for pose in poses], axis=1)
    pixels += rng.normal(size=pixels.shape) * 0.5
    wrong = rng.random((300, 6)) < 0.08
    pixels[wrong] += rng.uniform(20, 200, (int(wrong.sum()), 2)) * rng.choice([-1.0, 1.0], (int(wrong.sum()), 2))
    view, point = np.tile(np.arange(6), 300), np.repeat(np.arange(300), 6)
    sightings = Sightings(view, point, pixels.reshape(-1, 2))
    given = dict(enumerate(poses))
    nees = {}
    for robust in (True, False):
        found = triangulate_views(camera, sightings, given, 300, 0.5, robust)
        away = (found.places_km - places)[found.ok]
        nees[robust] = np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance_km2[found.ok]), away)
        assert found.ok.sum() > (295 if robust else 200)
    assert 2.6 < nees[True].mean() < 3.5
    assert np.percentile(nees[False], 90) > 1000.0
    # Of a point that two views see nobody knows which is wrong: it stays as it is.
    pair = triangulate_views(camera, sightings, {0: poses[0], 1: poses[1]}, 300, 0.5)
    alone = triangulate_views(camera, sightings, {0: poses[0], 1: poses[1]}, 300, 0.5, robust=False)
    assert np.array_equal(pair.places_km, alone.places_km, equal_nan=True)
