"""The whole search volume is searched: offsets near the margin and rotations near the bound are recovered."""

from itertools import product

import numpy as np
import pytest

from pipeline.navigate import NavigationOptions, navigate
from pipeline.status import Status, status_of
from tests.scenes.star_scene import star_scene

MARGIN = np.array([50.0, 140.0])


@pytest.mark.parametrize(("v", "u", "degrees"), list(product((-0.95, 0.95), (-0.95, 0.95), (-4.75, 4.75))))
def test_corners_of_the_search_volume(v: float, u: float, degrees: float) -> None:
    rng = np.random.default_rng(int(1000 * (v + 2 * u) + 10 * degrees) % 997)
    scene = star_scene(rng, MARGIN * (v, u), np.radians(degrees))
    navigation = navigate(scene.pixels, None, scene.state, scene.stars, NavigationOptions())
    estimate = navigation.estimate
    assert status_of(navigation.reason) is Status.SUCCESS, navigation.detail
    assert estimate is not None
    assert estimate.rotation_rad is not None
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.abs(estimate.offset_vu - scene.offset_vu).max() < 5 * sigma[:2].max()
    assert abs(estimate.rotation_rad - scene.rotation_rad) < 5 * sigma[2]
    # At the bound of the rotation, noise decides which techniques count as at the edge; two stars alone may be left.
    assert np.abs(estimate.offset_vu - scene.offset_vu).max() < 0.5


def test_offsets_inside_without_rotation() -> None:
    rng = np.random.default_rng(5)
    for _ in range(6):
        planted = MARGIN * rng.uniform(-0.95, 0.95, 2)
        scene = star_scene(rng, planted, 0.0, fit_rotation=False, stars=12, false=40)
        navigation = navigate(scene.pixels, None, scene.state, scene.stars, NavigationOptions())
        assert navigation.estimate is not None, navigation.detail
        assert navigation.estimate.rotation_rad is None
        assert navigation.estimate.covariance.shape == (2, 2)
        assert np.abs(navigation.estimate.offset_vu - planted).max() < 0.1


def test_a_wrong_catalogue_is_never_answered() -> None:
    """Stars of another field against 300 detections: chance patterns must not pass for an answer."""
    rng = np.random.default_rng(6)
    for _ in range(8):
        scene = star_scene(rng, np.zeros(2), 0.0, stars=40, false=260)
        other = star_scene(rng, np.zeros(2), 0.0, stars=40, false=0)
        navigation = navigate(scene.pixels, None, scene.state, other.stars, NavigationOptions())
        assert status_of(navigation.reason) is Status.FAILED
