"""Scattering laws against their printed formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.imaging.illumination import LUNAR_LAMBERT, MINNAERT, brightness, law_of
from pipeline.records import Photometry

MU0, MU = (grid.ravel() for grid in np.meshgrid(np.linspace(0.02, 1.0, 25), np.linspace(0.02, 1.0, 25)))
cosine = st.floats(1e-3, 1.0)


def test_lambert_is_the_cosine_of_incidence() -> None:
    assert_allclose(brightness(Photometry.LAMBERT, None, 0.3, MU0, MU), MU0, rtol=1e-14)


def test_lommel_seeliger() -> None:
    assert_allclose(brightness(Photometry.LOMMEL_SEELIGER, None, 0.3, MU0, MU), 2.0 / (1.0 + MU / MU0), rtol=1e-13)


@pytest.mark.parametrize("weight", [0.0, 0.35, 1.0])
def test_lunar_lambert_mixes_the_two(weight: float) -> None:
    mixed = brightness(Photometry.LUNAR_LAMBERT, weight, 1.0, MU0, MU)
    seeliger = brightness(Photometry.LOMMEL_SEELIGER, None, 1.0, MU0, MU)
    assert_allclose(mixed, weight * seeliger + (1.0 - weight) * MU0, rtol=1e-13)


@pytest.mark.parametrize("k", [0.5, 0.7, 1.0])
def test_minnaert(k: float) -> None:
    assert_allclose(brightness(Photometry.MINNAERT, k, 1.0, MU0, MU), (MU0 * MU) ** k / MU, rtol=1e-12)
    assert law_of(Photometry.MINNAERT, None, 1.0) == (MINNAERT, 0.7)


@given(st.floats(0.0, np.pi))
def test_mcewens_weight_is_his_cubic_held_between_0_and_1(phase: float) -> None:
    kind, weight = law_of(Photometry.MCEWEN, None, phase)
    g = float(np.degrees(phase))
    assert kind == LUNAR_LAMBERT
    assert 0.0 <= weight <= 1.0
    cubic = 1.0 + g * (-0.019 + g * (2.42e-4 + g * -1.46e-6))
    assert weight == pytest.approx(min(max(cubic, 0.0), 1.0), abs=1e-12)


def test_mcewens_weight_at_full_phase_and_at_night() -> None:
    assert law_of(Photometry.MCEWEN, None, 0.0)[1] == 1.0
    assert law_of(Photometry.MCEWEN, None, np.radians(150.0))[1] == 0.0
    assert law_of(Photometry.MCEWEN, 0.4, np.radians(150.0))[1] == 0.4


@pytest.mark.parametrize("photometry", list(Photometry))
def test_every_law_is_one_from_straight_above_and_dark_at_night(photometry: Photometry) -> None:
    one = np.ones(1)
    assert brightness(photometry, None, 0.0, one, one)[0] == pytest.approx(1.0)
    night = brightness(photometry, None, 0.5, np.array([0.0, -0.3, -1.0]), np.array([0.5, 0.0, 1.0]))
    assert (night == 0.0).all()


@pytest.mark.parametrize("photometry", list(Photometry))
@given(mu0=cosine, mu=cosine)
def test_every_law_is_finite_and_rises_with_the_sun(photometry: Photometry, mu0: float, mu: float) -> None:
    low, high = brightness(photometry, None, 0.5, np.array([mu0 * 0.9, mu0]), np.array([mu, mu]))
    assert 0.0 < low < high < np.inf


def test_at_the_very_limb_no_law_is_infinite() -> None:
    edge = brightness(Photometry.MINNAERT, 0.7, 1.0, np.array([0.5, 0.5]), np.array([0.0, -1e-12]))
    assert np.isfinite(edge).all()
