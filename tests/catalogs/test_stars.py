"""The star index against brute force, and the built-in catalogues against Hipparcos."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catalogs.stars import (
    StarIndex,
    added_index,
    build_index,
    built_in_index,
    cache_folder,
    is_catalog_name,
    open_index,
    seen_from,
)
from pipeline.errors import ConfigurationError
from pipeline.geometry.astrometry import apparent_directions, unit_vectors
from pipeline.records import FloatArray, Spacecraft, StarTable

NOBODY = Spacecraft()
# Rounding of unit vectors and of the window's bounds; a hundred-thousandth of the finest pixel.
ROUNDING_RAD = 1e-10


def _table(ra_deg: FloatArray, dec_deg: FloatArray, **columns: FloatArray) -> StarTable:
    n = len(ra_deg)
    blank = {name: np.full(n, np.nan) for name in ("pm_ra_masyr", "pm_dec_masyr", "parallax_mas", "epoch")}
    return StarTable(
        star_id=np.array([f"s{k}" for k in range(n)], dtype=str) if n else np.zeros(0, "U1"),
        ra_deg=ra_deg, dec_deg=dec_deg, mag=np.zeros(n), apparent=np.zeros(n, bool), **{**blank, **columns},
    )  # fmt: skip


@pytest.fixture(scope="module")
def sky() -> StarTable:
    """Stars everywhere, more of them at the poles and along 0 h, and some at every special place."""
    rng = np.random.default_rng(1)
    dec = np.degrees(np.arcsin(rng.uniform(-1, 1, 6000)))
    ra = rng.uniform(0, 360, 6000)
    polar = np.concatenate([90 - rng.exponential(0.05, 500), -90 + rng.exponential(0.05, 500)])
    seam = np.concatenate([rng.normal(0, 0.01, 500), [0.0, 360.0, -360.0, -1e-17, 1e-300, 180.0, -180.0, 359.9999999]])
    special = np.repeat([-90.0, -89.5, -0.5, 0.0, 0.5, 89.5, 90.0], 3)
    return _table(
        np.concatenate([ra, rng.uniform(0, 360, 1000), seam, np.tile([0.0, 180.0, 90.0], 7)]),
        np.concatenate([dec, np.clip(polar, -90, 90), rng.normal(0, 0.01, len(seam)), special]),
    )


@pytest.fixture(scope="module")
def index(sky: StarTable, tmp_path_factory: pytest.TempPathFactory) -> StarIndex:
    return build_index(sky, "sky", "0" * 64, tmp_path_factory.mktemp("index"))


DECLINATIONS = st.one_of(
    st.floats(-90, 90), st.sampled_from([-90.0, 90.0, 0.0, 89.5, -89.5]), st.floats(89.9, 90), st.floats(-90, -89.9)
)
ASCENSIONS = st.one_of(st.floats(0, 360), st.sampled_from([0.0, 360.0, 180.0]), st.floats(-0.1, 0.1))
HALF_ANGLES = st.one_of(st.floats(-7.0, np.log10(np.pi)).map(lambda power: 10.0**power), st.just(np.pi))


@settings(max_examples=400, deadline=None)
@given(ra=ASCENSIONS, dec=DECLINATIONS, half=HALF_ANGLES)
def test_cone_equals_brute_force(index: StarIndex, sky: StarTable, ra: float, dec: float, half: float) -> None:
    axis = unit_vectors(np.array([ra]), np.array([dec]))[0]
    stars = unit_vectors(sky.ra_deg, sky.dec_deg)
    angle = np.arctan2(np.linalg.norm(np.cross(stars, axis), axis=1), stars @ axis)
    found = index.around(axis, half).star_id.tolist()
    assert len(found) == len(set(found))
    assert set(sky.star_id[angle < half - ROUNDING_RAD]) <= set(found)
    assert set(found) <= set(sky.star_id[angle < half + ROUNDING_RAD])


def test_every_star_is_in_a_cone_around_itself(index: StarIndex, sky: StarTable) -> None:
    for row, axis in enumerate(unit_vectors(sky.ra_deg, sky.dec_deg)[6000:], start=6000):
        assert sky.star_id[row] in index.around(axis, 1e-9).star_id


def test_columns_survive_the_index(tmp_path: Path) -> None:
    stars = _table(np.array([10.0, 5.0]), np.array([1.0, 1.1]), epoch=np.array([1991.25, 2016.0]))
    found = build_index(stars, "pair", "1" * 64, tmp_path).around(
        unit_vectors(np.array([7.5]), np.array([1.0]))[0], 0.1
    )
    assert found.star_id.tolist() == ["s1", "s0"]
    assert found.epoch.tolist() == [2016.0, 1991.25]
    assert np.isnan(found.pm_ra_masyr).all()
    assert not found.apparent.any()


def test_empty_table_gives_an_empty_index(tmp_path: Path) -> None:
    index = build_index(_table(np.zeros(0), np.zeros(0)), "none", "2" * 64, tmp_path)
    assert len(index.around(np.array([0.0, 0.0, 1.0]), np.pi)) == 0
    assert len(seen_from([index], np.array([1.0, 0.0, 0.0]), 0.1, 0.0, NOBODY)) == 0


def test_no_catalogue_gives_no_star() -> None:
    assert len(seen_from([], np.array([1.0, 0.0, 0.0]), 0.1, 0.0, NOBODY)) == 0


def test_damaged_index_says_so(tmp_path: Path) -> None:
    index = build_index(_table(np.array([1.0]), np.array([1.0])), "one", "3" * 64, tmp_path)
    index.path.write_bytes(index.path.read_bytes()[:-8])
    with pytest.raises(ConfigurationError, match="damaged"):
        open_index(index.path)


@pytest.mark.parametrize("name", ["../x", "a/b", "gaia", "", "\0", "a" * 300])
def test_names_that_could_point_anywhere_are_refused(name: str, tmp_path: Path) -> None:
    assert not is_catalog_name(name)
    assert added_index(name, tmp_path) is None


def test_small_field_costs_less_than_ten_milliseconds() -> None:
    index = built_in_index("gaia", cache_folder())
    axes = unit_vectors(np.array([10.0, 95.0, 266.0, 359.99, 0.0]), np.array([0.0, -20.0, -29.0, 60.0, 90.0]))
    seen_from([index], axes[0], np.radians(0.1), 0.0, NOBODY)
    seconds = []
    for axis in np.repeat(axes, 5, axis=0):
        start = time.perf_counter()
        seen_from([index], axis, np.radians(0.1), 0.0, NOBODY)
        seconds.append(time.perf_counter() - start)
    # The median: what else runs on the machine is not the index's cost.
    assert np.median(seconds) < 0.010


PROXIMA = unit_vectors(np.array([217.42894]), np.array([-62.67949]))[0]


def _proxima(name: str) -> StarTable:
    stars = built_in_index(name, cache_folder()).around(PROXIMA, np.radians(120 / 3600))
    return stars.take(np.argsort(-np.nan_to_num(stars.parallax_mas))[:1])


@pytest.mark.parametrize("name", ["gaia", "hipparcos"])
def test_proxima_moves_as_hipparcos_says(name: str) -> None:
    star = _proxima(name)
    assert star.pm_ra_masyr[0] == pytest.approx(-3775.75, abs=0.01)
    assert star.pm_dec_masyr[0] == pytest.approx(765.54, abs=0.01)
    assert star.parallax_mas[0] == pytest.approx(771.64, abs=0.01)


def test_proxima_is_one_place_in_both_catalogues() -> None:
    # 2016 to 2020.3: hipparcos is moved by 29 years, gaia by four.
    et = (2020.3 - 2000.0) * 365.25 * 86400
    gaia, hipparcos = (apparent_directions(_proxima(name), et, NOBODY)[0] for name in ("gaia", "hipparcos"))
    # 25 years of the 7 mas/yr by which the two missions differ; with one motion left out it would be 16 arcsec.
    assert np.linalg.norm(gaia - hipparcos) < 0.25 / 206265


def test_no_star_takes_magnitudes_for_motion() -> None:
    every = built_in_index("gaia", cache_folder()).around(np.array([0.0, 0.0, 1.0]), np.pi)
    hipparcos = built_in_index("hipparcos", cache_folder()).around(np.array([0.0, 0.0, 1.0]), np.pi)
    known = ~np.isnan(every.pm_ra_masyr)
    assert 100_000 < known.sum() < len(hipparcos)
    assert np.array_equal(known, ~np.isnan(every.pm_dec_masyr))
    assert np.array_equal(known, ~np.isnan(every.parallax_mas))
    # Each motion is one that Hipparcos gives, and as many are negative as positive.
    motions = set(zip(hipparcos.pm_ra_masyr, hipparcos.pm_dec_masyr, hipparcos.parallax_mas, strict=True))
    mine = zip(every.pm_ra_masyr[known], every.pm_dec_masyr[known], every.parallax_mas[known], strict=True)
    assert set(mine) <= motions
    assert 0.4 < (every.pm_dec_masyr[known] < 0).mean() < 0.7


def test_old_places_widen_the_search(tmp_path: Path) -> None:
    # A star as fast as Barnard's, catalogued in 1800: by 2015 it is 37 arcmin away from its place.
    epoch = np.array([1800.0])
    stars = _table(
        np.array([0.0]), np.array([0.0]), pm_ra_masyr=np.zeros(1), pm_dec_masyr=np.array([10_300.0]), epoch=epoch
    )
    index = build_index(stars, "old", "4" * 64, tmp_path)
    et = 15 * 365.25 * 86400.0
    place = apparent_directions(stars, et, NOBODY)[0]
    assert len(seen_from([index], place, np.radians(0.01), et, NOBODY)) == 1


def test_aberration_and_parallax_widen_the_search() -> None:
    index = built_in_index("hipparcos", cache_folder())
    far = Spacecraft(np.array([0.0, 7e9, 0.0]), np.array([100.0, 0.0, 0.0]))
    for star in range(0, 50):
        one = (
            _proxima("hipparcos")
            if star == 0
            else index.around(unit_vectors(np.array([star * 7.0]), np.array([star - 25.0]))[0], 0.02)
        )
        if len(one):
            seen = apparent_directions(one, 0.0, far)[0]
            assert one.star_id[0] in seen_from([index], seen, 1e-5, 0.0, far).star_id
