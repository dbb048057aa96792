"""The blind search: its threshold means sigmas, its positions are good starts, and what is no star is dropped."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr

from pipeline.imaging.detect import (
    DetectionOptions,
    detect_point_sources,
    kernel_of,
    local_maxima,
    matched_filter_snr,
    star_like,
)
from pipeline.imaging.psf import PointSources, PointSpread
from pipeline.records import BoolArray, FloatArray, Image

NOISE = 6.0
SIZE = 300
SPREAD = PointSpread(1.1)
CLEAR = np.zeros((SIZE, SIZE), bool)
SIGMA = np.full((SIZE, SIZE), NOISE, np.float32)
OPTIONS = DetectionOptions()


def _profile(centre: float) -> FloatArray:
    return np.asarray(np.diff(ndtr((np.arange(SIZE + 1) - 0.5 - centre) / SPREAD.sigma_px)))


def _sky(places: FloatArray, flux: FloatArray, seed: int | None) -> FloatArray:
    image = np.zeros((SIZE, SIZE)) if seed is None else np.random.default_rng(seed).normal(0, NOISE, (SIZE, SIZE))
    for (v, u), f in zip(places, flux, strict=True):
        image += f * np.outer(_profile(v), _profile(u))
    return image


def _flux_at(snr: float) -> float:
    """Flux at which an optimal measurement reaches a signal to noise: sigma over the root of the summed squares."""
    star = np.outer(_profile(150.0), _profile(150.0))
    return float(snr * NOISE / np.sqrt((star**2).sum()))


def _detect(image: FloatArray, bad: BoolArray = CLEAR, full: float = np.inf) -> PointSources:
    pixels: Image = image.astype(np.float32)
    saturated = pixels >= full
    return detect_point_sources(pixels, bad | saturated, saturated, SIGMA, None, SPREAD, OPTIONS)


@pytest.mark.parametrize("spread", [SPREAD, PointSpread(0.6), PointSpread(1.0, (6.0, -4.0))])
def test_the_filters_noise_has_unit_sigma(spread: PointSpread) -> None:
    noise = np.random.default_rng(0).normal(0, NOISE, (SIZE, SIZE)).astype(np.float32)
    snr = matched_filter_snr(noise, CLEAR, SIGMA, spread)[20:-20, 20:-20]
    # 67,600 pixels over some 4 pi sigma^2 (and a trail) correlated ones: an rms good to about two percent.
    assert snr.std() == pytest.approx(1.0, abs=0.06)
    assert snr.mean() == pytest.approx(0.0, abs=0.06)
    kernel = kernel_of(spread)
    assert kernel.sum() == pytest.approx(1.0)
    assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)


def test_a_stars_peak_is_its_signal_to_noise() -> None:
    image = _sky(np.array([[150.0, 150.0]]), np.array([_flux_at(50.0)]), None)
    snr = matched_filter_snr(image.astype(np.float32), CLEAR, SIGMA, SPREAD)
    assert divmod(int(snr.argmax()), SIZE) == (150, 150)
    assert snr.max() == pytest.approx(50.0, rel=0.01)  # the kernel's Gaussian against the integrated one


def test_the_threshold_is_in_sigmas() -> None:
    """Stars well above are found, stars well below are not, and noise alone is not taken for stars."""
    places = np.mgrid[30:290:40, 30:290:40].reshape(2, -1).T + np.float64(0.3)
    found = {}
    for snr in (0.0, 2.0, 5.0, 9.0):
        sources = _detect(_sky(places, _flux_at(snr) * np.ones(len(places)), 1))
        gap = np.linalg.norm(sources.position_vu[:, None] - places, axis=2)
        found[snr] = float((gap < 2.0).any(axis=0).mean())
        # 90,000 pixels, some 10,000 of them independent, at 5 sigmas of one-sided chance 3e-7.
        assert (gap > 2.0).all(axis=1).sum() == 0
    assert found[0.0] == 0.0
    assert found[2.0] < 0.1  # a chance of 1e-3 each
    assert 0.25 < found[5.0] < 0.85  # at the threshold about half, the maximum of a few pixels
    assert found[9.0] > 0.95


def test_maxima_are_starts_to_a_fraction_of_a_pixel_brightest_first() -> None:
    places = np.array([[40.3, 60.8], [120.4, 200.2], [250.0, 33.4]])
    image = _sky(places, np.array([2000.0, 5000.0, 3000.0]), None)
    snr = matched_filter_snr(image.astype(np.float32), CLEAR, SIGMA, SPREAD)
    starts = local_maxima(snr, 5.0, 3, 10)
    assert_allclose(starts, places[[1, 2, 0]], atol=0.1)  # a parabola through three pixels of a Gaussian
    assert len(local_maxima(snr, 5.0, 3, 2)) == 2
    assert len(local_maxima(snr, 1e6, 3, 2)) == 0


def test_detected_sources_are_the_planted_stars() -> None:
    rng = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(np.arange(20, 290, 30), np.arange(20, 290, 30)), axis=-1).reshape(-1, 2)
    flux = np.exp(np.linspace(np.log(_flux_at(12.0)), np.log(_flux_at(900.0)), len(grid)))
    places: FloatArray = grid + rng.uniform(-4, 4, grid.shape)
    sources = _detect(_sky(places, flux, 3))
    assert len(sources) == len(places)
    assert (np.diff(sources.flux_dn) <= 0).all()
    nearest = np.linalg.norm(sources.position_vu[:, None] - places, axis=2).argmin(axis=1)
    error = sources.position_vu - places[nearest]
    pulls = np.einsum("ni,nij,nj->n", error, np.linalg.inv(sources.covariance_vu), error)
    assert pulls.mean() == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(places)))


def test_cosmic_rays_are_not_stars() -> None:
    image = _sky(np.array([[100.0, 100.0]]), np.array([4000.0]), 4)
    image[200, 200] += 4000.0  # one pixel
    image[50, 150:170] += 900.0  # a track
    sources = _detect(image)
    assert len(sources) == 1
    assert_allclose(sources.position_vu[0], [100.0, 100.0], atol=0.1)


def test_a_misfit_is_forgiven_by_its_share_of_the_light_only() -> None:
    def fit(chi2: float, snr: float) -> PointSources:
        one = np.ones(1)
        dof = np.array([77])
        return PointSources(np.zeros((1, 2)), np.eye(2)[None], snr * one, one, chi2 * one, dof, 0 * dof, one > 0)

    assert star_like(fit(80.0, 10.0), SPREAD, OPTIONS).all()
    assert not star_like(fit(250.0, 10.0), SPREAD, OPTIONS).any()
    assert star_like(fit(250.0 + (0.15 * 1000) ** 2 - 200, 1000.0), SPREAD, OPTIONS).all()
    assert not star_like(fit(80.0, -3.0), SPREAD, OPTIONS).any()


def test_a_saturated_star_is_found_once_where_it_is() -> None:
    place = np.array([[140.4, 90.7]])
    image = np.minimum(_sky(place, np.array([60000.0]), 5), 800.0)
    sources = _detect(image, full=800.0)
    assert len(sources) == 1
    assert sources.saturated_pixels[0] > 5
    assert_allclose(sources.position_vu, place, atol=0.1)


def test_bad_pixels_make_no_sources() -> None:
    image, bad = _sky(np.zeros((0, 2)), np.zeros(0), 6), CLEAR.copy()
    image[77, 80:90] = 5000.0
    bad[77, 80:90] = True
    assert len(_detect(image, bad)) == 0
    assert len(_detect(np.zeros((SIZE, SIZE)))) == 0


def test_the_search_leaves_its_input_alone() -> None:
    pixels: Image = _sky(np.array([[100.0, 100.0]]), np.array([4000.0]), 7).astype(np.float32)
    bad = CLEAR.copy()
    bad[100, 100] = True
    before = pixels.copy()
    detect_point_sources(pixels, bad, CLEAR, SIGMA, None, SPREAD, OPTIONS)
    assert (pixels == before).all()
