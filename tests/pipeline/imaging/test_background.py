"""Level, noise and gain from tiles, on images whose level, noise and gain are planted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.imaging.background import BackgroundOptions, estimate_background, estimate_gain
from pipeline.records import Image

OPTIONS = BackgroundOptions()
SHAPE = (512, 512)
CLEAR = np.zeros(SHAPE, bool)
NOISE = 4.0
# A tile has 256 samples: its median scatters by 1.25 sigma / 16, its lower 16 % quantile's distance by about 1.7 / 16.
MEDIAN_SCATTER, QUANTILE_SCATTER = 1.25 / 16, 1.7 / 16


def _noise(seed: int, level: float = 0.0, sigma: float = NOISE) -> Image:
    return np.random.default_rng(seed).normal(level, sigma, SHAPE).astype(np.float32)


def test_flat_level_and_noise() -> None:
    background = estimate_background(_noise(0, 100.0), CLEAR, 0.0, None, OPTIONS)
    assert background.tile_level.shape == (8, 8)
    assert background.level.shape == background.sigma.shape == SHAPE
    # 64 tiles: four sigmas each, and the mean of all eight times closer (with the quantile's small bias).
    assert np.abs(background.tile_level - 100.0).max() < 4 * MEDIAN_SCATTER * NOISE
    assert background.tile_level.mean() == pytest.approx(100.0, abs=4 * MEDIAN_SCATTER * NOISE / 8)
    assert background.tile_sigma.mean() == pytest.approx(NOISE, rel=4 * QUANTILE_SCATTER / 8)


def test_a_slope_is_followed() -> None:
    v, u = np.indices(SHAPE)
    planted = (0.2 * v - 0.1 * u + 100.0).astype(np.float32)
    background = estimate_background(_noise(1) + planted, CLEAR, 0.0, None, OPTIONS)
    inner = (slice(32, -32), slice(32, -32))  # beyond the outermost tiles' centres the level is held
    assert np.abs(background.level - planted)[inner].max() < 5 * MEDIAN_SCATTER * np.hypot(NOISE, 12.0 / np.sqrt(3))


def test_stars_touch_neither_level_nor_noise() -> None:
    image = _noise(2, 50.0)
    rng = np.random.default_rng(3)
    at = rng.integers(0, 512, (2, 5000))  # two percent of the pixels shine
    image[at[0], at[1]] += rng.uniform(100, 5000, 5000).astype(np.float32)
    background = estimate_background(image, CLEAR, 0.0, None, OPTIONS)
    # Two percent more above moves the median by 0.025 sigma and the lower quantile by about as much.
    assert np.median(background.tile_level) == pytest.approx(50.0, abs=0.1 * NOISE)
    assert np.median(background.tile_sigma) == pytest.approx(NOISE, rel=0.06)


def test_a_clipped_side_is_measured_on_the_other() -> None:
    """Level 1 DN, noise 4 DN, stored without negatives: the lower quantile is the clip itself."""
    background = estimate_background(np.maximum(_noise(4, 1.0), 0.0), CLEAR, 0.0, None, OPTIONS)
    assert np.median(background.tile_sigma) == pytest.approx(NOISE, rel=0.06)
    assert np.median(background.tile_level) == pytest.approx(1.0, abs=0.3)


def test_bad_pixels_are_not_looked_at() -> None:
    image, bad = _noise(5, 30.0), CLEAR.copy()
    image[:, :256] = -9999.0
    bad[:, :256] = True
    background = estimate_background(image, bad, 0.0, None, OPTIONS)
    assert background.tile_level.min() > 25.0  # tiles without a pixel take the others' median
    assert np.isfinite(background.level).all()
    empty = estimate_background(image, np.ones(SHAPE, bool), 2.0, None, OPTIONS)
    assert_allclose(empty.level, 0.0)
    assert_allclose(empty.sigma, 2.0)


def test_the_noise_is_never_below_what_the_camera_promises() -> None:
    flat = np.full(SHAPE, 100.0, np.float32)
    assert_allclose(estimate_background(flat, CLEAR, 3.0, None, OPTIONS).sigma, 3.0)
    # Shot noise of 100 DN at 4 e-/DN is 25 DN^2.
    assert_allclose(estimate_background(flat, CLEAR, 3.0, 4.0, OPTIONS).sigma, np.sqrt(9.0 + 25.0), rtol=1e-6)


def test_an_image_smaller_than_a_tile_works() -> None:
    small = np.random.default_rng(6).normal(7.0, 1.0, (40, 50)).astype(np.float32)
    background = estimate_background(small, np.zeros(small.shape, bool), 0.0, None, OPTIONS)
    assert background.tile_level.shape == (1, 1)
    assert background.level.mean() == pytest.approx(7.0, abs=0.5)  # 130 samples


def _stairs(gain: float, read: float, low: float, high: float, seed: int) -> Image:
    """Sixteen levels, each as wide as a tile of 32 pixels."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(gain * np.broadcast_to(np.repeat(np.linspace(low, high, 16), 32), SHAPE))
    return (electrons / gain + rng.normal(0, read, SHAPE)).astype(np.float32)


@pytest.mark.parametrize("gain", [0.5, 2.0, 10.0])
def test_gain_of_an_image_that_spans_levels(gain: float) -> None:
    options, estimates = BackgroundOptions(tile_px=32, samples_per_side=32), []
    for seed in range(4):
        background = estimate_background(_stairs(gain, 1.0, 10.0, 600.0, seed), CLEAR, 1.0, None, options)
        estimate = estimate_gain(background, 1.0)
        assert estimate is not None
        estimates.append(estimate)
    # 256 tiles of 1024 samples know their variance to 11 % each, steadied over 3 x 3: the slope to about one percent;
    # the median of neighbours and the quantiles' discreteness may pull it by a few.
    assert np.mean(estimates) == pytest.approx(gain, rel=0.08)


def test_no_gain_from_a_flat_image() -> None:
    found = [
        estimate_gain(estimate_background(_stairs(2.0, 3.0, 50.0, 50.0, seed), CLEAR, 3.0, None, OPTIONS), 3.0)
        for seed in range(10)
    ]
    assert found.count(None) >= 9  # a slope of three sigmas by chance: one in 700


def test_no_gain_from_a_handful_of_tiles_or_none_that_differ() -> None:
    background = estimate_background(_noise(7)[:100, :100].copy(), np.zeros((100, 100), bool), 0.0, None, OPTIONS)
    assert estimate_gain(background, 0.0) is None
    flat = estimate_background(np.full(SHAPE, 9.0, np.float32), CLEAR, 1.0, None, OPTIONS)
    assert estimate_gain(flat, 1.0) is None
