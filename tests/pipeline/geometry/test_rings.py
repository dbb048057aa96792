import numpy as np
import pytest
import spiceypy

from pipeline.camera import project
from pipeline.errors import ContractError
from pipeline.geometry.rings import (
    edge_points,
    edge_radius,
    meets,
    plane_points,
    ring_backplanes,
    ring_forms,
    seen_curve,
)
from pipeline.geometry.rotations import rotation_about
from pipeline.records import Body, CameraModel, FloatArray, RingFeature, RingKind, RingSystem


def _rings(opening_rad: float = 0.4) -> RingSystem:
    plane = rotation_about(np.array([1.0, 0.3, 0.2]), 2.0 + opening_rad)
    return RingSystem("P", np.array([3.0e5, -2.0e5, 1.1e6]), plane, 0.2)


def _camera() -> CameraModel:
    return CameraModel(
        (256, 300), 500.0, np.array([[80.0, 0.4], [-0.2, 79.0]]), np.array([120.0, 155.0]),
        np.array([2e-4, 0.0, 1e-5, 0.0, 1e-5, 0.0]),
    )  # fmt: skip


def _toward(direction: FloatArray) -> FloatArray:
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def test_backplanes_are_those_of_spice() -> None:
    rings, camera = _rings(), _camera()
    attitude = _toward(rings.position_km + np.array([9.0e4, 2.0e4, 3.0e4]))
    v, u = np.linspace(0.0, 255.0, 12), np.linspace(0.0, 299.0, 13)
    planes = ring_backplanes(rings, camera, attitude, v, u)
    assert planes["radius"].dims == ("v", "u")
    assert planes["radius"].attrs["units"] == "km"
    pole, node, place = (np.array(x) for x in (*rings.plane_from_j2000[[2, 0]], rings.position_km))
    plane = spiceypy.nvp2pl(pole, place)
    worst = 0.0
    for place_v in v:
        for place_u in u:
            here = planes.sel(v=place_v, u=place_u)
            # The ray of the pixel from the projection alone.
            ray = _ray(camera, np.array([place_v, place_u]))
            found, point = spiceypy.inrypl(np.zeros(3), attitude.T @ ray, plane)
            assert found == 1
            gap = np.array(point) - rings.position_km
            radius = float(spiceypy.vnorm(gap))
            longitude = np.degrees(np.arctan2(gap @ np.cross(pole, node), gap @ node)) % 360.0
            along = float(np.radians(here["longitude"] - longitude)) * radius
            worst = max(worst, abs(float(here["radius"]) - radius), abs(along))
    # An error of 1e-12 of a pixel at this range is 1e-8 km.
    assert worst < 1e-6


def _ray(camera: CameraModel, place_vu: FloatArray) -> FloatArray:
    slopes = np.zeros(2)
    for _ in range(20):
        here = project(camera, np.array([[*slopes, 1.0]]))[0][0]
        steps = [project(camera, np.array([[*(slopes + step), 1.0]]))[0][0] - here for step in 1e-7 * np.eye(2)]
        slopes = slopes + 1e-7 * np.linalg.solve(np.array(steps).T, place_vu - here)
    return np.array([*slopes, 1.0])


def test_rays_away_from_the_plane_meet_nothing() -> None:
    rays = np.array([[0.0, 1.0, 1.0], [0.0, 1.0, 0.0], [0.0, 2.0, -1.0]])
    points, share = plane_points(np.array([0.0, 0.0, 10.0]), rays)
    assert np.isnan(points[:2]).all()
    assert np.isnan(share[:2]).all()
    assert points[2].tolist() == [0.0, 20.0, 0.0]


def test_edges_are_ellipses_less_their_modes() -> None:
    longitude = np.linspace(0.0, 6.0, 40)
    modes = np.array([[3.0, 2.0, 0.4], [0.0, 1.5, 1.0]])
    feature = RingFeature("R", RingKind.RINGLET, 1000.0, 20.0, 0.7, 50.0, modes=modes)
    # The focus-centred ellipse from its centre: x^2 / a^2 + y^2 / b^2 = 1.
    for outer, a in ((False, 1000.0), (True, 1050.0)):
        bare = edge_radius(feature, outer, longitude) + 2.0 * np.cos(3.0 * longitude - 0.4) + 1.5 * np.cos(-1.0)
        e = 0.02
        x, y = bare * np.cos(longitude - 0.7) + a * e, bare * np.sin(longitude - 0.7)
        np.testing.assert_allclose(x**2 / a**2 + y**2 / (a**2 * (1 - e**2)), 1.0, rtol=1e-12)


def test_an_inclined_edge_is_seen_where_its_points_are() -> None:
    feature = RingFeature("R", RingKind.EDGE_OUTER, 1000.0, 10.0, 1.0, a_sin_i_km=4.0, long_node_rad=0.5)
    observer = np.array([4.0e4, -3.0e4, 2.0e4])
    curve = seen_curve(feature, False, observer, 4096)
    points = edge_points(feature, False, np.linspace(0.1, 6.1, 50))
    flat, _ = plane_points(observer, points - observer)
    angle = np.arctan2(flat[:, 1], flat[:, 0]) % (2 * np.pi)
    found = np.interp(angle, 2 * np.pi * np.arange(4097) / 4096, np.append(curve, curve[0]))
    # Linear interpolation of a radius that swings by ten kilometres.
    np.testing.assert_allclose(found, np.hypot(flat[:, 0], flat[:, 1]), atol=1e-4)
    assert np.abs(curve - edge_radius(feature, False, 2 * np.pi * np.arange(4096) / 4096)).max() > 3.0


def test_planets_hide_what_is_behind_and_shade_what_is_beyond() -> None:
    rings = _rings()
    radii, sun = np.array([600.0, 600.0, 540.0]), np.array([0.0, 0.0, 1.0])
    body = Body("P", None, rings.position_km, radii, rings.plane_from_j2000, sun)
    forms = ring_forms(rings, (body,), 0.0)
    start = np.array([5000.0, 0.0, 100.0])
    targets = np.array([[-2000.0, 0.0, 0.0], [0.0, 3000.0, 0.0], [900.0, 0.0, 0.0]])
    assert meets(forms, start, targets - start, np.ones(3)).tolist() == [True, False, False]
    shaded = meets(forms, targets, np.broadcast_to([1.0, 0.0, 0.0], (3, 3)))
    assert shaded.tolist() == [True, False, False]


def test_impossible_features_are_refused() -> None:
    with pytest.raises(ContractError, match="ae"):
        RingFeature("R", RingKind.GAP, 100.0, 200.0)
    with pytest.raises(ContractError, match="not a rotation"):
        RingSystem("P", np.ones(3), 2.0 * np.eye(3), 0.1)
