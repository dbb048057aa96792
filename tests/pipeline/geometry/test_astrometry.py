"""Proper motion, parallax and aberration against ERFA and astropy."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from numpy.testing import assert_allclose

from pipeline.geometry.astrometry import (
    ASTRONOMICAL_UNIT_KM,
    RAD_PER_MAS,
    SPEED_OF_LIGHT_KM_S,
    apparent_directions,
    apply_aberration,
    apply_parallax,
    apply_proper_motion,
    julian_year,
    unit_vectors,
)
from pipeline.records import FloatArray, Spacecraft, StarTable

erfa = pytest.importorskip("erfa")  # astropy brings it; it has no types of its own

# Unit vectors in double precision; 1e-14 rad is two nano-arcseconds.
EXACT = 1e-14
COUNT = 60
RNG = np.random.default_rng(8)
RA_DEG = RNG.uniform(0, 360, COUNT)
DEC_DEG = np.degrees(np.arcsin(RNG.uniform(-0.999, 0.999, COUNT)))
PM_RA, PM_DEC = RNG.normal(0, 2000, (2, COUNT))
PARALLAX = RNG.uniform(0.0, 800, COUNT)
POSITION_AU = np.array([-12.0, 31.0, 8.5])
VELOCITY_KM_S = np.array([-14.0, 25.0, 38.0])


def _angle(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(np.cross(a, b), axis=1))


def _pmpx(years: float, parallax_mas: FloatArray, position_au: FloatArray, moving: bool) -> FloatArray:
    """ERFA's proper motion and parallax; its rate in right ascension is without cos(dec)."""
    ra, dec = np.radians(RA_DEG), np.radians(DEC_DEG)
    rate_ra = PM_RA * RAD_PER_MAS / np.cos(dec) * moving
    return np.asarray(erfa.pmpx(ra, dec, rate_ra, PM_DEC * RAD_PER_MAS * moving, parallax_mas / 1e3, 0.0, years,
                                position_au))  # fmt: skip


def test_constants_are_the_defined_ones() -> None:
    assert ASTRONOMICAL_UNIT_KM * 1e3 == erfa.DAU
    assert SPEED_OF_LIGHT_KM_S * 1e3 == erfa.CMPS
    assert_allclose(RAD_PER_MAS, erfa.DAS2R / 1e3, rtol=1e-15)


@pytest.mark.parametrize("et", [-1.2e9, 0.0, 4.7e8])
def test_julian_year(et: float) -> None:
    time = Time(2451545.0, et / 86400.0, format="jd", scale="tdb")
    assert julian_year(et) == pytest.approx(time.jyear, abs=1e-9)  # a thirtieth of a second


def test_unit_vectors() -> None:
    expected = SkyCoord(RA_DEG, DEC_DEG, unit="deg").cartesian.xyz.value.T
    assert_allclose(unit_vectors(RA_DEG, DEC_DEG), expected, atol=EXACT)


def test_proper_motion_is_erfas() -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    moved = apply_proper_motion(start, PM_RA, PM_DEC, np.full(COUNT, 31.0))
    assert _angle(moved, _pmpx(31.0, np.zeros(COUNT), np.zeros(3), True)).max() < EXACT
    assert _angle(moved, start).max() > 1e-4  # 31 years of arcseconds


def test_proper_motion_is_astropys_to_what_light_time_makes() -> None:
    start = SkyCoord(RA_DEG, DEC_DEG, unit="deg")
    there = start.spherical_offsets_by(0 * start.ra, 0 * start.dec)
    moved = apply_proper_motion(unit_vectors(RA_DEG, DEC_DEG), PM_RA, PM_DEC, np.full(COUNT, 1.0))
    away = there.spherical_offsets_to(SkyCoord(*np.degrees([np.arctan2(moved[:, 1], moved[:, 0]),
                                                            np.arcsin(moved[:, 2])]), unit="deg"))  # fmt: skip
    # After one year the tangent offsets are the annual motions; second order is (2 arcsec)^2 = 1e-5 arcsec.
    assert_allclose(away[0].arcsec * 1e3, PM_RA, atol=0.1)
    assert_allclose(away[1].arcsec * 1e3, PM_DEC, atol=0.1)


def test_unknown_motion_and_no_time_move_nothing() -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    nothing = np.full(COUNT, np.nan)
    assert_allclose(apply_proper_motion(start, nothing, nothing, np.full(COUNT, 50.0)), start, atol=EXACT)
    assert_allclose(apply_proper_motion(start, PM_RA, PM_DEC, np.zeros(COUNT)), start, atol=EXACT)


def test_a_star_at_the_pole_moves_by_its_motion() -> None:
    pole = np.array([[0.0, 0.0, 1.0]])
    moved = apply_proper_motion(pole, np.array([3000.0]), np.array([4000.0]), np.array([10.0]))
    assert float(_angle(moved, pole)[0]) == pytest.approx(50000.0 * RAD_PER_MAS, rel=1e-6)  # tangent for angle


def test_parallax_is_erfas_as_far_out_as_a_spacecraft_goes() -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    seen = apply_parallax(start, PARALLAX, POSITION_AU * ASTRONOMICAL_UNIT_KM)
    assert _angle(seen, _pmpx(0.0, PARALLAX, POSITION_AU, False)).max() < EXACT
    # Proxima from 47 au is seen tens of arcseconds away: more than a pixel of many cameras.
    assert _angle(seen, start).max() > 20e3 * RAD_PER_MAS


def test_a_star_moves_away_from_where_the_observer_went() -> None:
    star = np.array([[1.0, 0.0, 0.0]])
    seen = apply_parallax(star, np.array([500.0]), np.array([0.0, 10.0, 0.0]) * ASTRONOMICAL_UNIT_KM)
    assert seen[0, 1] == pytest.approx(-5000.0 * RAD_PER_MAS, rel=1e-6)


def test_parallaxes_that_are_no_distances_do_nothing() -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    for value in (np.nan, -3.0, 0.0):
        seen = apply_parallax(start, np.full(COUNT, value), POSITION_AU * ASTRONOMICAL_UNIT_KM)
        assert_allclose(seen, start, atol=EXACT)


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_aberration_is_erfas_also_where_relativity_shows(factor: float) -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    beta = factor * VELOCITY_KM_S / SPEED_OF_LIGHT_KM_S
    # ERFA adds the Sun's potential at a distance in au: infinitely far away it is zero.
    expected = np.array([erfa.ab(p, beta, 1e12, np.sqrt(1 - beta @ beta)) for p in start])
    seen = apply_aberration(start, factor * VELOCITY_KM_S)
    assert _angle(seen, expected).max() < 4 * EXACT
    assert_allclose(np.linalg.norm(seen, axis=1), 1.0, atol=EXACT)


def test_stars_lean_toward_where_the_observer_goes() -> None:
    seen = apply_aberration(np.array([[1.0, 0.0, 0.0]]), np.array([0.0, 30.0, 0.0]))
    assert seen[0, 1] == pytest.approx(30.0 / SPEED_OF_LIGHT_KM_S, rel=1e-6)


def test_aberration_is_undone_by_the_opposite_boost() -> None:
    start = unit_vectors(RA_DEG, DEC_DEG)
    boosted = apply_aberration(start, 3e3 * VELOCITY_KM_S)
    assert_allclose(apply_aberration(boosted, -3e3 * VELOCITY_KM_S), start, atol=4 * EXACT)


def _table(apparent: bool, epoch: float) -> StarTable:
    return StarTable(
        np.array([str(k) for k in range(COUNT)]), RA_DEG, DEC_DEG, np.full(COUNT, 5.0), PM_RA, PM_DEC, PARALLAX,
        np.full(COUNT, epoch), np.full(COUNT, apparent),
    )  # fmt: skip


ET = 15.0 * 365.25 * 86400.0
FLYING = Spacecraft(POSITION_AU * ASTRONOMICAL_UNIT_KM, VELOCITY_KM_S)


def test_apparent_places_chain_motion_parallax_and_aberration() -> None:
    place = _pmpx(15.0 - 16.0, PARALLAX, POSITION_AU, True)
    beta = VELOCITY_KM_S / SPEED_OF_LIGHT_KM_S
    expected = np.array([erfa.ab(p, beta, 1e12, np.sqrt(1 - beta @ beta)) for p in place])
    apart = _angle(apparent_directions(_table(False, 2016.0), ET, FLYING), expected)
    # ERFA moves the epoch by the light's way to the observer: 33 au are 4.5 hours of 6 arcsec a year at most.
    assert apart.max() < 4.0 * RAD_PER_MAS
    assert apart.max() < 0.02 * _angle(expected, unit_vectors(RA_DEG, DEC_DEG)).min()


def test_places_as_seen_stay_as_they_are() -> None:
    assert_allclose(apparent_directions(_table(True, 2016.0), ET, FLYING), unit_vectors(RA_DEG, DEC_DEG), atol=EXACT)


def test_what_is_unknown_is_left_out() -> None:
    still = apparent_directions(_table(False, np.nan), ET, Spacecraft())
    assert_allclose(still, unit_vectors(RA_DEG, DEC_DEG), atol=EXACT)
    moving = apparent_directions(_table(False, 2015.0), ET, Spacecraft(velocity_km_s=VELOCITY_KM_S))
    assert_allclose(moving, apply_aberration(unit_vectors(RA_DEG, DEC_DEG), VELOCITY_KM_S), atol=EXACT)
