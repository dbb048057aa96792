"""Noise of a pixel by its level: planted read noise and gain, with and without texture."""

import numpy as np
import pytest

from pipeline.imaging.noise import PixelNoise, pixel_noise
from pipeline.records import BoolArray, Image

SHAPE = (256, 256)
CLEAN: BoolArray = np.zeros(SHAPE, bool)


def _ramp(seed: int, read: float, gain: float, bias: float = 0.0, top: float = 2000.0) -> Image:
    rng = np.random.default_rng(seed)
    level = np.broadcast_to(np.linspace(0.0, top, SHAPE[1]), SHAPE)
    light = rng.poisson(level * gain) / gain
    return np.asarray(bias + light + rng.normal(0.0, read, SHAPE), np.float32)


def test_variance_is_read_noise_and_photons() -> None:
    noise = PixelNoise(3.0, 0.1, 20.0)
    assert noise.variance(np.array([0.0, 20.0, 120.0])).tolist() == pytest.approx([9.0, 9.0, 19.0])


def test_a_cameras_own_figures_are_taken() -> None:
    noise = pixel_noise(_ramp(1, 9.0, 1.0), CLEAN, 4.0, 10.0, 5.0)
    assert (noise.read_dn, noise.dn2_per_dn, noise.bias_dn) == (4.0, 0.1, 5.0)
    assert pixel_noise(_ramp(1, 9.0, 1.0), CLEAN, 0.0, 10.0, 0.0).read_dn > 0


@pytest.mark.parametrize(("read", "gain", "bias"), [(4.0, 2.0, 0.0), (4.0, 0.5, 100.0), (2.0, 20.0, 30.0)])
def test_the_image_shows_its_noise_where_nobody_tells_it(read: float, gain: float, bias: float) -> None:
    noise = pixel_noise(_ramp(3, read, gain, bias), CLEAN, None, None, bias)
    level = bias + np.array([1000.0, 1800.0])
    truth = read**2 + (level - bias) / gain
    # The quiet third of the tiles stands for all of them: a fifth too little at most.
    ratio = noise.variance(level) / truth
    assert (ratio > 0.7).all()
    assert (ratio < 1.3).all()


def test_the_slope_alone_is_measured_where_read_noise_is_known() -> None:
    noise = pixel_noise(_ramp(4, 5.0, 1.0), CLEAN, 5.0, None, 0.0)
    assert noise.read_dn == 5.0
    assert noise.dn2_per_dn == pytest.approx(1.0, rel=0.25)


def test_bad_pixels_do_not_count() -> None:
    image, bad = _ramp(5, 4.0, 2.0), CLEAN.copy()
    bad[::24, ::24] = True
    spoiled = image.copy()
    spoiled[bad] = 1e6
    clean, masked = (pixel_noise(i, bad, None, None, 0.0) for i in (image, spoiled))
    assert masked.read_dn == pytest.approx(clean.read_dn)
    assert masked.dn2_per_dn == pytest.approx(clean.dn2_per_dn)


def test_an_image_that_tells_nothing_still_has_a_variance() -> None:
    flat = np.full((64, 64), 7.0, np.float32)
    assert pixel_noise(flat, np.zeros(flat.shape, bool), None, None, 0.0).variance(np.array(7.0)) > 0
    assert pixel_noise(flat, np.ones(flat.shape, bool), None, None, 0.0).read_dn == 1.0
    tiny = np.zeros((5, 5), np.float32)
    assert pixel_noise(tiny, np.zeros(tiny.shape, bool), None, 2.0, 0.0).dn2_per_dn == 0.5
