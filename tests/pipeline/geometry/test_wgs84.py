"""Planetodetic coordinates against astropy (ERFA), and by their definition on triaxial bodies."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import EarthLocation
from numpy.testing import assert_allclose

from pipeline.errors import ContractError
from pipeline.geometry.wgs84 import Datum, Geoid, WgsConverter


def _places(seed: int, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lat = np.degrees(np.arcsin(rng.uniform(-1, 1, count)))
    return np.stack([lat, rng.uniform(-180, 180, count), rng.uniform(-1e4, 5e6, count)], axis=1)


def test_body_fixed_agrees_with_erfa() -> None:
    poles = np.array([[90.0, 0, 10], [-90, 0, 10], [0, 180, 0], [0, -90, 1e3]])
    places = np.vstack([_places(0), poles])
    theirs = EarthLocation.from_geodetic(places[:, 1] * u.deg, places[:, 0] * u.deg, places[:, 2] * u.m)
    ours = WgsConverter().body_fixed(places)
    assert_allclose(ours, np.stack([x.to_value(u.km) for x in theirs.geocentric], axis=1), atol=1e-8)


def test_geodetic_agrees_with_erfa() -> None:
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(500, 3))
    points = direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(6300, 60000, (500, 1))
    points = np.vstack([points, [[0, 0, 6400], [0, 0, -6400], [7000, 0, 0], [-7000, 1e-9, 0]]])
    theirs = EarthLocation.from_geocentric(*points.T, unit=u.km).to_geodetic("WGS84")
    ours = WgsConverter().geodetic(points)
    assert_allclose(ours[:, 0], theirs.lat.to_value(u.deg), atol=1e-11)
    turn = (ours[:-4, 1] - theirs.lon.to_value(u.deg)[:-4] + 180) % 360 - 180
    assert_allclose(turn, 0, atol=1e-11)
    # A micrometre: ERFA's own closed form keeps no more.
    assert_allclose(ours[:, 2], theirs.height.to_value(u.m), atol=1e-5)


@pytest.mark.parametrize("radii", [(6378.137, 6378.137, 6356.752), (17.0, 5.5, 5.0), (3.0, 8.0, 5.0), (5.0, 5.0, 5.0)])
def test_there_and_back_on_any_ellipsoid(radii: tuple[float, float, float]) -> None:
    converter = WgsConverter(Datum("body", np.array(radii)))
    places = _places(2)
    places[:, 2] = np.random.default_rng(3).uniform(-0.05, 3, len(places)) * min(radii) * 1e3
    places[:, 2] = np.where(places[:, 2] < 0, places[:, 2] * min(radii) / max(radii) ** 2 * min(radii), places[:, 2])
    back = converter.geodetic(converter.body_fixed(places))
    assert_allclose(back, places, rtol=1e-9, atol=1e-8)


def test_the_foot_is_the_nearest_point() -> None:
    radii = np.array([17.0, 8.0, 5.0])
    converter = WgsConverter(Datum("body", radii))
    point = np.array([[12.0, 9.0, -6.0]])
    height = converter.geodetic(point)[0, 2] / 1e3
    direction = np.random.default_rng(4).normal(size=(200000, 3))
    surface = direction / np.linalg.norm(direction, axis=1)[:, None] * radii
    nearest = np.linalg.norm(surface - point, axis=1).min()
    assert height <= nearest < height + 0.01


def test_local_tangent_plane() -> None:
    converter = WgsConverter()
    origin = np.array([48.5, 35.0, 120.0])
    start = converter.body_fixed(origin[None])
    up = converter.body_fixed(np.array([[48.5, 35.0, 620.0]])) - start
    north = converter.body_fixed(np.array([[48.5 + 1e-5, 35.0, 120.0]])) - start
    assert_allclose(converter.to_local(start + up, origin), [[0, 0, 500]], atol=1e-6)
    east_north_up = converter.to_local(start + north, origin)[0]
    # The meridian's radius of curvature at 48.5 degrees is 6371.3 km.
    assert_allclose(east_north_up, [0, 1.1122, 0], atol=2e-4)
    local = np.random.default_rng(5).normal(size=(20, 3)) * 1e4
    assert_allclose(converter.to_local(converter.from_local(local, origin), origin), local, atol=1e-6)


def test_centre_has_no_place() -> None:
    assert np.isnan(WgsConverter().geodetic(np.zeros((1, 3)))).all()


def test_geoid_is_bilinear_and_ends_at_its_grid() -> None:
    lat, lon = np.arange(-10.0, 11.0, 5.0), np.arange(170.0, 191.0, 5.0)
    geoid = Geoid(lat, lon, 3.0 + 0.5 * lat[:, None] - 0.25 * lon[None, :])
    assert geoid.height_at(1.5, -178.0) == pytest.approx(3.0 + 0.75 - 0.25 * 182.0)
    assert geoid.height_at(10.0, 190.0) == pytest.approx(3.0 + 5.0 - 47.5)
    assert geoid.height_at(11.0, 180.0) is None
    assert geoid.height_at(0.0, 10.0) is None


def test_nonsense_is_refused() -> None:
    with pytest.raises(ContractError, match="positive"):
        Datum("x", np.array([1.0, 0.0, 1.0]))
    with pytest.raises(ContractError, match="ascending"):
        Geoid(np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.zeros((2, 2)))
