"""Ellipsoids against rays traced by brute force, cones, planes and closed forms of spheres."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import brentq

from pipeline.errors import ContractError
from pipeline.geometry.ellipsoid import (
    intersect,
    is_visible,
    limb_points,
    silhouette_form,
    sub_point,
    surface_normal,
    terminator_points,
)
from pipeline.records import FloatArray

RADII = np.array([120.0, 90.0, 70.0])
TURN = np.linspace(0.0, 2.0 * np.pi, 73)[:-1]
DIRECTIONS = [np.array([0.3, -0.8, 0.5]), np.array([0.0, 0.0, 1.0]), np.array([-1.0, 1e-9, 0.0])]
positive = st.floats(0.2, 5.0)
component = st.floats(-1.0, 1.0)


def _level(radii: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(((points / radii) ** 2).sum(axis=-1))


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("distance", [150.0, 1e3, 1e6, 1e9])
def test_limb_points_lie_on_the_surface_and_see_the_observer_on_their_horizon(
    direction: FloatArray, distance: float
) -> None:
    observer = distance * direction / np.linalg.norm(direction)
    points = limb_points(RADII, observer, TURN)
    assert_allclose(_level(RADII, points), 1.0, rtol=1e-13)
    toward = observer - points
    cosine = (surface_normal(RADII, points) * toward).sum(axis=1) / np.linalg.norm(toward, axis=1)
    # A rounding of the observer's place, 1e-16 of the distance, against the body's own size.
    assert np.abs(cosine).max() < 1e-12
    assert np.ptp(points, axis=0).max() > 100.0  # a whole turn, not one point


def test_a_spheres_limb_is_the_circle_of_its_tangent_cone() -> None:
    points = limb_points(np.full(3, 50.0), np.array([0.0, 0.0, 130.0]), TURN)
    assert_allclose(points[:, 2], 50.0**2 / 130.0, rtol=1e-13)
    assert_allclose(np.hypot(points[:, 0], points[:, 1]), 50.0 * np.sqrt(1 - (50 / 130) ** 2), rtol=1e-13)


def test_far_bodies_keep_their_precision() -> None:
    """At 1e9 km the apparent limb of a 50-km sphere is right to 1e-12 of its radius."""
    distance = 1e9
    observer = np.array([distance, 0.0, 0.0])
    points = limb_points(np.full(3, 50.0), observer, TURN)
    assert_allclose(np.hypot(points[:, 1], points[:, 2]), 50.0, rtol=1e-12)
    offsets = np.linspace(-0.999, 0.999, 41) * 50.0
    rays = np.column_stack([np.full(41, -distance), offsets, np.zeros(41)])
    hit_points, hit = intersect(np.full(3, 50.0), observer, rays)
    assert hit.all()
    # The observer's own coordinate is rounded to 1e-7 km.
    assert_allclose(np.linalg.norm(hit_points, axis=1), 50.0, atol=1e-6)
    beyond = np.array([[-distance, 50.0 * (1 + 1e-6), 0.0], [-distance, 50.0 * (1 - 1e-6), 0.0]])
    assert intersect(np.full(3, 50.0), observer, beyond)[1].tolist() == [False, True]


def test_an_observer_inside_has_no_limb() -> None:
    with pytest.raises(ContractError, match="inside"):
        limb_points(RADII, np.array([100.0, 0.0, 10.0]), TURN)


@pytest.mark.parametrize("sun", DIRECTIONS)
def test_terminator_points_have_the_sun_on_their_horizon(sun: FloatArray) -> None:
    sun = sun / np.linalg.norm(sun)
    points = terminator_points(RADII, sun, TURN)
    assert_allclose(_level(RADII, points), 1.0, rtol=1e-13)
    assert np.abs(surface_normal(RADII, points) @ sun).max() < 1e-14
    # Opposite parameters are opposite points: one great circle of the scaled sphere.
    assert_allclose(points, -np.roll(points, len(TURN) // 2, axis=0), atol=1e-10)


def test_normals_are_gradients() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 3))
    points = RADII * points / np.linalg.norm(points, axis=1)[:, None]
    step = 1e-4
    gradient = np.stack(
        [(_level(RADII, points + step * e) - _level(RADII, points - step * e)) / (2 * step) for e in np.eye(3)], axis=1
    )
    gradient /= np.linalg.norm(gradient, axis=1)[:, None]
    assert_allclose(surface_normal(RADII, points), gradient, atol=1e-9)


def _marched(radii: FloatArray, observer: FloatArray, ray: FloatArray) -> FloatArray | None:
    """First crossing by sampling along the ray and bisecting."""
    unit = ray / np.linalg.norm(ray)
    t = np.linspace(0.0, 2.0 * np.linalg.norm(observer), 4001)
    inside = _level(radii, observer + t[:, None] * unit) < 1.0
    if not inside.any():
        return None
    k = int(np.argmax(inside))
    root = brentq(lambda s: float(_level(radii, observer + s * unit)) - 1.0, t[k - 1], t[k], xtol=1e-12)
    return np.asarray(observer + root * unit)


def test_rays_meet_the_surface_where_marching_along_them_does() -> None:
    rng = np.random.default_rng(2)
    observer = np.array([250.0, -180.0, 90.0])
    rays = -observer + rng.normal(size=(150, 3)) * 80.0
    rays[:20] *= -1.0  # away from the body
    rays *= rng.uniform(0.1, 10.0, (150, 1))
    points, hit = intersect(RADII, observer, rays)
    found = [_marched(RADII, observer, ray) for ray in rays]
    assert 30 < hit.sum() < 120
    assert hit.tolist() == [point is not None for point in found]
    assert_allclose(points[hit], [point for point in found if point is not None], atol=1e-8)
    assert np.isnan(points[~hit]).all()


def test_the_silhouette_is_positive_where_rays_hit_and_zero_along_the_limb() -> None:
    rng = np.random.default_rng(3)
    observer = np.array([250.0, -180.0, 90.0])
    form = silhouette_form(RADII, observer)
    rays = -observer + rng.normal(size=(500, 3)) * 80.0
    value = np.einsum("ni,ij,nj->n", rays, form, rays)
    _, hit = intersect(RADII, observer, rays)
    assert ((value > 0) == hit).all()
    tangent = limb_points(RADII, observer, TURN) - observer
    along = np.einsum("ni,ij,nj->n", tangent, form, tangent)
    assert np.abs(along).max() < 1e-11 * np.abs(value).max()
    assert_allclose(form, form.T)


def test_visible_points_are_those_whose_line_of_sight_is_free() -> None:
    rng = np.random.default_rng(4)
    observer = np.array([0.0, 300.0, 120.0])
    points = rng.normal(size=(300, 3))
    points = RADII * points / np.linalg.norm(points, axis=1)[:, None]
    first, hit = intersect(RADII, observer, points - observer)
    free = hit & (np.linalg.norm(first - points, axis=1) < 1e-6)
    assert (is_visible(RADII, observer, points) == free).all()
    assert 60 < free.sum() < 150  # less than half of the surface


def test_the_sub_point_is_on_the_line_to_the_centre() -> None:
    direction = np.array([0.3, -0.8, 0.5])
    point = sub_point(RADII, 17.0 * direction)
    assert _level(RADII, point) == pytest.approx(1.0)
    assert_allclose(np.cross(point, direction), 0.0, atol=1e-12)
    assert point @ direction > 0


@given(positive, positive, positive, component, component, component, st.floats(1.01, 1e6))
@settings(deadline=None, max_examples=80)
def test_any_limb_is_seen_edge_on(
    a: float, b: float, c: float, x: float, y: float, z: float, times: float
) -> None:
    direction = np.array([x, y, z])
    if np.linalg.norm(direction) < 0.1:
        direction = np.array([0.0, 0.0, 1.0])
    radii = np.array([a, b, c])
    observer = times * sub_point(radii, direction)
    points = limb_points(radii, observer, TURN[::6])
    cosine = (points / radii) @ (observer / radii)
    assert_allclose(cosine, 1.0, atol=1e-9)
    assert_allclose(_level(radii, points), 1.0, rtol=1e-12)
