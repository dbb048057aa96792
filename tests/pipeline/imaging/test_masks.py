"""Missing and saturated pixels: planted gaps against clipped noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from pipeline.imaging.masks import _long_runs, missing_pixels, saturated_pixels
from pipeline.records import BoolArray, Image

SHAPE = (256, 256)


def _clipped(level: float, sigma: float = 3.0, seed: int = 0) -> Image:
    noisy = np.random.default_rng(seed).normal(level, sigma, SHAPE)
    return np.round(np.clip(noisy, 0, None)).astype(np.float32)


def test_without_a_fill_value_nothing_is_missing() -> None:
    zeros = np.zeros(SHAPE, np.float32)
    assert not missing_pixels(zeros, None, 0.0, 1.0).any()
    assert not missing_pixels(zeros, float("nan"), 0.0, 1.0).any()


def test_far_from_the_fill_every_such_pixel_is_missing() -> None:
    image = _clipped(100.0)
    image[7, 9] = image[200, 100:120] = 0.0
    assert_array_equal(missing_pixels(image, 0.0, 100.0, 3.0), image == 0.0)


@pytest.mark.parametrize("level", [0.0, 2.0, 5.0])
def test_clipped_zeros_are_not_missing(level: float) -> None:
    image = _clipped(level)
    assert (image == 0).mean() > 0.04  # there are many
    assert not missing_pixels(image, 0.0, level, 3.0).any()


@pytest.mark.parametrize("level", [0.0, 2.0, 5.0])
@pytest.mark.parametrize("first", [0, 1, 37, 156])
@pytest.mark.parametrize("length", [99, 100])
def test_long_gaps_among_clipped_zeros_are_found_to_the_pixel(level: float, first: int, length: int) -> None:
    image = _clipped(level)
    planted = np.zeros(SHAPE, bool)
    planted[50, first : first + length] = True
    planted[120:130] = True
    image[planted] = 0.0
    found = missing_pixels(image, 0.0, level, 3.0)
    assert found[planted].all()
    # A gap's ends may by chance be lengthened by clipped neighbours: runs of them, six at most in these rows.
    extra = found & ~planted
    assert extra.sum() <= 12
    assert not extra[np.r_[0:50, 51:120, 130:256]].any()


def _runs(flags: BoolArray, length: int) -> BoolArray:
    """The same by counting, row by row."""
    kept = np.zeros_like(flags)
    for row, line in enumerate(flags):
        edges = np.flatnonzero(np.diff(np.r_[0, line.astype(int), 0]))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            kept[row, start:stop] = stop - start >= length
    return kept


@given(st.integers(0, 10_000), st.integers(1, 45), st.floats(0.3, 0.97))
@settings(deadline=None)
def test_runs_are_those_that_counting_finds(seed: int, length: int, share: float) -> None:
    flags = np.random.default_rng(seed).random((6, 40)) < share
    assert_array_equal(_long_runs(flags, length), _runs(flags, length))


def test_a_fill_value_other_than_zero() -> None:
    image = _clipped(100.0)
    image[3, 4] = -32768.0
    assert missing_pixels(image, -32768.0, 100.0, 3.0).sum() == 1


def test_saturation() -> None:
    image = np.array([[0.0, 254.0, 255.0, 300.0]], np.float32)
    assert saturated_pixels(image, None, 3.0).sum() == 0
    assert_array_equal(saturated_pixels(image, 255.0, None), [[False, False, True, True]])
    # Noise added after the converter's clip may leave a full pixel four sigmas below.
    assert_array_equal(saturated_pixels(image, 256.0, 0.5), [[False, True, True, True]])
    # But a noisy camera keeps nine tenths of its range.
    assert_array_equal(saturated_pixels(image, 270.0, 100.0), [[False, True, True, True]])
