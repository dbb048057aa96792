"""Dawn at Vesta: each given view solved alone with points of the other views, and the poses held back."""

from dataclasses import replace

import numpy as np
import pytest

from catalogs.matches import MatchTable, read_cameras, read_matches
from pipeline.camera import project
from pipeline.pose.bundle import adjust
from pipeline.pose.records import Pose, PoseEstimate, PosePrior
from pipeline.pose.views import Sightings, triangulate_views
from pipeline.records import BoolArray, FloatArray
from tests.scenes.data import DATA, needs_data
from workflows.pose import Budget, CovarianceChoice, Views, compare_given, prepare, solve_views

pytestmark = [needs_data, pytest.mark.slow]
FOLDER = DATA / "vesta_rc3b"


@pytest.fixture(scope="module")
def views() -> Views:
    matches = read_matches((FOLDER / "observations.parquet").read_bytes(), "observations")
    return prepare(matches, read_cameras((FOLDER / "cameras.json").read_bytes(), "cameras"))


def test_the_bundle_fits_no_worse_than_the_given_poses(views: Views) -> None:
    camera, sigma = views.calibration.camera, views.options.assumed_sigma_px
    places = triangulate_views(camera, views.sightings, views.given, len(views.points), sigma)
    spread = np.diag([4.0] * 3 + [2.5e-7] * 3)
    priors = {view: PosePrior(pose, spread) for view, pose in views.given.items()}
    bundle = adjust(camera, views.sightings, views.given, places, priors, sigma)
    before, after = (
        _rms(views, p, x, bundle.used) for p, x in ((views.given, places.places_km), (bundle.poses, bundle.places_km))
    )
    assert (after <= before).all()
    assert bundle.used.sum() > 0.99 * np.isin(views.sightings.view, list(views.given)).sum() * places.ok.mean()


def _rms(views: Views, poses: dict[int, Pose], places_km: FloatArray, used: BoolArray) -> FloatArray:
    """Per axis, over the sightings of a bundle."""
    left = []
    for view, pose in poses.items():
        mine = (views.sightings.view == view) & used
        pixels, _ = project(views.calibration.camera, pose.to_camera(places_km[views.sightings.point[mine]]))
        left.append(views.sightings.pixels_vu[mine] - pixels)
    return np.asarray(np.sqrt((np.concatenate(left) ** 2).mean(axis=0)))


def test_given_views_solved_alone(views: Views) -> None:
    rows = list(solve_views(views, Budget(CovarianceChoice.MARGINALS), every=True))
    assert len(rows) == 65
    assert all(isinstance(row.answer, PoseEstimate) for row in rows)
    away = compare_given(views, rows)
    assert len(away) == 44
    middle = np.median(away, axis=0)
    # Given poses and tracks disagree by 1.6 km and 0.33 mrad themselves.
    assert middle[0] <= 2.0
    assert middle[1] <= 0.5e-3
    assert np.sqrt((away[:, 2:4] ** 2).mean(axis=0)).max() <= 1.2


def test_covariances_hold_on_simulated_observations_of_this_geometry(views: Views) -> None:
    """Given poses and places as truth, with Gaussian errors: places from other views, each view alone."""
    rng = np.random.default_rng(0)
    camera, sigma = views.calibration.camera, 0.6
    truth = triangulate_views(camera, views.sightings, views.given, len(views.points), sigma)
    rows = np.flatnonzero(np.isin(views.sightings.view, list(views.given)) & truth.ok[views.sightings.point])
    view, point = views.sightings.view[rows], views.sightings.point[rows]
    pixels = np.empty((len(rows), 2))
    for key, pose in views.given.items():
        pixels[view == key], _ = project(camera, pose.to_camera(truth.places_km[point[view == key]]))
    noise = np.broadcast_to(np.eye(2) * sigma**2, (len(rows), 2, 2))
    sightings = Sightings(view, point, pixels + rng.normal(size=pixels.shape) * sigma, noise)
    table = MatchTable(views.ids[view], views.points[point], sightings.pixels_vu, sightings.covariance_px2, None, None)
    simulated = replace(views, sightings=sightings, table=table)
    rows_out = list(solve_views(simulated, Budget(CovarianceChoice.MARGINALS), every=True))
    nees = compare_given(simulated, rows_out)[:, 4]
    assert len(nees) == 44
    # Mean of 44 chi2 of six: sigma 0.5; views that share points share a little of their errors.
    assert 4.5 < nees.mean() < 7.5
