"""All views together: covariances hold, wrong tracks take no part, and something has to hold the frame."""

import numpy as np
import pytest

from pipeline.camera import project
from pipeline.pose.bundle import adjust
from pipeline.pose.records import MatchError, Pose, PosePrior
from pipeline.pose.se3 import SE3Utils
from pipeline.pose.views import Sightings, looks_away, sigma_of, triangulate_views, turned
from pipeline.records import BoolArray, FloatArray
from tests.pipeline.pose.scenes import CAMERAS

CAMERA = CAMERAS[2]
POINTS = 150


def _pose(angle: float) -> Pose:
    place = 60.0 * np.array([np.cos(angle), np.sin(angle), 0.2 * np.sin(4 * angle)])
    z = -place / np.linalg.norm(place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z]), place)


def _views(seed: int, wrong: float = 0.02) -> tuple[Sightings, list[Pose], FloatArray, BoolArray]:
    rng = np.random.default_rng(seed)
    poses = [_pose(angle) for angle in np.linspace(0, 0.6, 6)]
    points = rng.uniform(-2, 2, (POINTS, 3))
    view, point = (a.ravel() for a in np.meshgrid(np.arange(6), np.arange(POINTS), indexing="ij"))
    pixels = np.vstack([project(CAMERA, pose.to_camera(points))[0] for pose in poses])
    pixels = pixels + rng.normal(size=pixels.shape) * 0.3
    bad = rng.random(len(pixels)) < wrong
    pixels[bad] += rng.choice([-1, 1], (bad.sum(), 2)) * 60.0
    noise = np.tile(np.eye(2) * 0.09, (len(pixels), 1, 1))
    return Sightings(view, point, pixels, noise), poses, points, bad


def test_covariances_hold_and_wrong_tracks_take_no_part() -> None:
    nees = []
    unit = np.array([0.2, 0.2, 0.2, 2e-3, 2e-3, 2e-3])
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        sightings, poses, points, bad = _views(seed)
        priors, starts = {}, {}
        for k, pose in enumerate(poses):
            error = rng.normal(size=6) * unit
            start = SE3Utils.corrected(pose, np.concatenate([error[:3], -error[3:]]))
            priors[k], starts[k] = PosePrior(start, np.diag(unit**2)), start
        places = triangulate_views(CAMERA, sightings, starts, POINTS, 0.3)
        bundle = adjust(CAMERA, sightings, starts, places, priors, 0.3)
        assert not bundle.used[bad].any()
        assert bundle.used[~bad].mean() > 0.95
        for k, pose in enumerate(poses):
            error = SE3Utils.error(bundle.poses[k], pose)
            nees.append(error @ np.linalg.solve(bundle.covariances[k], error))
        # The scale, which positions hold by the length of the baseline, moves all points along the sight together.
        away = bundle.places_km - points
        assert np.nanmedian(np.linalg.norm(away - np.nanmean(away, axis=0), axis=1)) < 0.1
    # All views of a bundle share its frame's error, so there are eight independent draws of more than six.
    assert 3.0 < np.mean(nees) < 10.0


def test_nothing_holds_the_frame() -> None:
    sightings, poses, _, _ = _views(1)
    places = triangulate_views(CAMERA, sightings, dict(enumerate(poses)), POINTS, 0.3)
    with pytest.raises(MatchError, match="frame and scale"):
        adjust(CAMERA, sightings, dict(enumerate(poses)), places, {}, 0.3)


def test_the_sigma_of_sightings_is_found() -> None:
    sightings, poses, _, _ = _views(2, wrong=0.0)
    bare = Sightings(sightings.view, sightings.point, sightings.pixels_vu)
    places = triangulate_views(CAMERA, bare, dict(enumerate(poses)), POINTS, 1.0)
    assert sigma_of(CAMERA, bare, dict(enumerate(poses)), places.places_km) == pytest.approx(0.3, rel=0.1)


def test_positions_written_toward_the_body_are_noticed() -> None:
    sightings, poses, _, _ = _views(3)
    seen = triangulate_views(CAMERA, sightings, dict(enumerate(poses)), POINTS, 0.3)
    away = triangulate_views(CAMERA, sightings, {k: turned(pose) for k, pose in enumerate(poses)}, POINTS, 0.3)
    assert not looks_away(seen)
    assert looks_away(away)
    np.testing.assert_allclose(turned(turned(poses[0])).position_km, poses[0].position_km)
