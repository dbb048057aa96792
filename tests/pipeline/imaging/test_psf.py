"""Point-source fits against stars rendered by another formula: no bias, and covariances that a Monte Carlo confirms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr

from pipeline.imaging.psf import PointSources, PointSpread, _unit_model, fit_point_sources
from pipeline.records import FloatArray, Image

READ = 5.0
# 18 x 18 stars 26 px apart: 324 fits in one image, none in another's window.
STEP, SIDE = 26, 18
SIZE = STEP * SIDE
GRID = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"), axis=-1).reshape(-1, 2) * STEP + STEP / 2
# Four sigmas of an rms over 324 stars: 4 / sqrt(2 * 324).
RMS_SCATTER = 0.16


def _profile(centre: float, size: int, sigma: float) -> FloatArray:
    edges = np.arange(size + 1) - 0.5
    return np.asarray(np.diff(ndtr((edges - centre) / sigma)))


def _render(
    places: FloatArray, flux: FloatArray, sigma: float, trail: tuple[float, float], size: int = SIZE
) -> FloatArray:
    """Gaussians integrated over pixels, spread over a fine trail."""
    image = np.zeros((size, size))
    steps = [0.0] if trail == (0.0, 0.0) else (np.arange(60) + 0.5) / 60 - 0.5
    for (v, u), f in zip(places, flux, strict=True):
        for s in steps:
            image += (
                f
                / len(steps)
                * np.outer(_profile(v + s * trail[0], size, sigma), _profile(u + s * trail[1], size, sigma))
            )
    return image


def _stamped(places: FloatArray, flux: float, sigma: float, trail: tuple[float, float]) -> FloatArray:
    """The same for stars that fit their own cell of the grid, cell by cell."""
    image = np.zeros((SIZE, SIZE))
    for v, u in places:
        low = (np.array([v, u]) // STEP * STEP).astype(int)
        cell = _render(np.array([[v, u]]) - low, np.array([flux]), sigma, trail, STEP)
        image[low[0] : low[0] + STEP, low[1] : low[1] + STEP] += cell
    return image


def _fit(
    image: FloatArray, starts: FloatArray, spread: PointSpread, gain: float | None, full: float = np.inf
) -> PointSources:
    pixels: Image = image.astype(np.float32)
    saturated = pixels >= full
    noise = np.full(pixels.shape, READ, np.float32)
    return fit_point_sources(pixels, saturated, saturated, noise, gain, spread, starts)


@pytest.mark.parametrize(
    ("sigma", "flux", "gain", "trail"),
    [
        (0.6, 500.0, None, (0.0, 0.0)),
        (1.0, 20000.0, 2.0, (0.0, 0.0)),  # shot noise of the star itself rules
        (1.0, 2000.0, 0.5, (0.0, 0.0)),  # weights taken from the data would pull the flux down by 0.35 sigma here
        (1.5, 2000.0, 5.0, (0.0, 0.0)),
        (0.8, 4000.0, 3.0, (5.0, 3.0)),
    ],
)
def test_fits_are_unbiased_and_their_covariance_is_the_scatter(
    sigma: float, flux: float, gain: float | None, trail: tuple[float, float]
) -> None:
    rng = np.random.default_rng(int(flux + 100 * sigma))
    places = GRID + rng.uniform(-0.5, 0.5, GRID.shape)
    image = _stamped(places, flux, sigma, trail)
    if gain is not None:
        image = rng.poisson(image * gain) / gain
    image += rng.normal(0, READ, image.shape)
    spread = PointSpread(sigma, trail)
    sources = _fit(image, places + rng.uniform(-0.4, 0.4, GRID.shape), spread, gain)
    assert sources.ok.all()
    error = sources.position_vu - places
    pulls = error / np.sqrt(np.diagonal(sources.covariance_vu, axis1=1, axis2=2))
    assert (np.abs((pulls**2).mean(axis=0) ** 0.5 - 1) < RMS_SCATTER).all()
    assert (np.abs(pulls.mean(axis=0)) < 4 / np.sqrt(len(places))).all()
    distance2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(sources.covariance_vu), error)
    assert distance2.mean() == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(places)))
    flux_pull = (sources.flux_dn - flux) / sources.flux_sigma_dn
    assert flux_pull.std() == pytest.approx(1.0, abs=RMS_SCATTER)
    assert abs(flux_pull.mean()) < 4 / np.sqrt(len(places))
    assert (sources.chi2 / sources.dof).mean() == pytest.approx(1.0, abs=0.05)
    if trail != (0.0, 0.0):
        # Along (5, 3) the place is known worse than across, so errors along v and u go together.
        assert (sources.covariance_vu[:, 0, 1] > 0).all()


@pytest.mark.parametrize("trail", [(0.0, 0.0), (4.0, -6.0)])
def test_without_noise_the_planted_star_comes_back(trail: tuple[float, float]) -> None:
    places = np.array([[20.3, 30.7], [45.0, 12.5]])
    image = _render(places, np.array([3000.0, 900.0]), 0.9, trail, 60) + 12.0
    sources = _fit(image, np.rint(places), PointSpread(0.9, trail), None)
    # Float32 pixels, a last step below 1e-3 px, and a trail of steps half a sigma long.
    assert_allclose(sources.position_vu, places, atol=1e-3)
    assert_allclose(sources.flux_dn, [3000.0, 900.0], rtol=5e-3)


def test_the_model_sums_to_one_and_its_derivatives_have_numerical_twins() -> None:
    def model(v: float, u: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        out = (np.empty((31, 31)), np.empty((31, 31)), np.empty((31, 31)))
        _unit_model(v, u, 0, 0, 31, 31, 0.8, 4.0, 2.0, 12, *out)
        return out

    step = 1e-5
    star, by_v, by_u = model(15.2, 14.7)
    assert star.sum() == pytest.approx(1.0, abs=1e-9)
    assert_allclose(by_v, (model(15.2 + step, 14.7)[0] - model(15.2 - step, 14.7)[0]) / (2 * step), atol=1e-9)
    assert_allclose(by_u, (model(15.2, 14.7 + step)[0] - model(15.2, 14.7 - step)[0]) / (2 * step), atol=1e-9)
    fine = _render(np.array([[15.2, 14.7]]), np.ones(1), 0.8, (4.0, 2.0), 31)
    assert_allclose(star, fine, atol=2e-4)  # half-sigma steps against sixty


def test_saturated_stars_are_placed_by_their_wings() -> None:
    rng = np.random.default_rng(4)
    places = GRID + rng.uniform(-0.5, 0.5, GRID.shape)
    image = _stamped(places, 30000.0, 1.2, (0.0, 0.0)) + rng.normal(0, READ, (SIZE, SIZE))
    full = 1500.0
    clipped = np.minimum(image, full)
    sources = _fit(clipped, np.rint(places), PointSpread(1.2), None, full)
    assert sources.ok.all()
    assert (sources.saturated_pixels >= 4).all()
    error = sources.position_vu - places
    distance2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(sources.covariance_vu), error)
    assert distance2.mean() == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(places)))
    assert_allclose(sources.flux_dn, 30000.0, rtol=0.05)
    whole = _fit(image, np.rint(places), PointSpread(1.2), None)
    assert (np.trace(sources.covariance_vu, axis1=1, axis2=2) > np.trace(whole.covariance_vu, axis1=1, axis2=2)).all()


@pytest.mark.parametrize("gap", [4.0, 6.0])
@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_a_neighbours_light_is_taken_away(gap: float, ratio: float) -> None:
    places = np.array([[30.2, 30.4], [30.2, 30.4 + gap]])
    flux = np.array([2000.0, 2000.0 / ratio])
    image = _render(places, flux, 1.0, (0.0, 0.0), 60)
    together = _fit(image, places, PointSpread(1.0), None)
    assert together.ok.all()
    apart = np.abs(together.position_vu - places).max()
    alone = np.abs(_fit(image, places[1:], PointSpread(1.0), None).position_vu[0] - places[1]).max()
    # Two sweeps leave a few hundredths of a pixel of two windows that overlap; a fit that knows of no neighbour is
    # tens of times worse, or walks over to the brighter star.
    assert apart < (0.05 if gap == 4.0 else 1e-3)
    assert alone > 8 * apart
    assert_allclose(together.flux_dn, flux, rtol=0.05)


def test_a_star_at_the_arrays_edge_is_fitted_by_the_half_that_is_there() -> None:
    places = np.array([[0.3, 30.4], [59.1, 58.8]])
    image = _render(places, np.array([5000.0, 5000.0]), 1.0, (0.0, 0.0), 60)
    sources = _fit(image, np.rint(places), PointSpread(1.0), None)
    assert sources.ok.all()
    assert_allclose(sources.position_vu, places, atol=0.01)
    middle = _fit(
        _render(places[:1] + 30.0, np.array([5000.0]), 1.0, (0.0, 0.0), 90), places[:1] + 30.0, PointSpread(1.0), None
    )
    assert sources.covariance_vu[0, 0, 0] > 1.2 * middle.covariance_vu[0, 0, 0]  # half of the light is not there


def test_fits_that_cannot_be_say_so() -> None:
    image = _render(np.array([[30.0, 30.0]]), np.array([5000.0]), 1.0, (0.0, 0.0), 60)
    far = _fit(image, np.array([[80.0, 80.0], [-9.0, 5.0]]), PointSpread(1.0), None)
    assert not far.ok.any()
    assert np.isnan(far.covariance_vu).all()
    assert np.isinf(far.flux_sigma_dn).all()
    pixels, noise = image.astype(np.float32), np.full(image.shape, READ, np.float32)
    start, clear = np.array([[31.5, 30.0]]), np.zeros(image.shape, bool)
    held = fit_point_sources(pixels, clear, clear, noise, None, PointSpread(1.0), start, reach_px=1.0)
    assert not held.ok.any()  # the star is 1.5 px away
    assert fit_point_sources(pixels, clear, clear, noise, None, PointSpread(1.0), start, reach_px=2.0).ok.all()
    hidden = np.ones(image.shape, bool)
    assert not fit_point_sources(pixels, hidden, clear, noise, None, PointSpread(1.0), start).ok.any()
    assert len(fit_point_sources(pixels, clear, clear, noise, None, PointSpread(1.0), np.zeros((0, 2)))) == 0
