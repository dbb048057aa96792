"""Directions of edges: blind to which side is the brighter, and their correlation finds planted shifts."""

import numpy as np

from pipeline.imaging.directions import direction_around, direction_map, directions_of, drawn_directions
from pipeline.imaging.ncc import Level

_ROWS, _COLS, _SURPLUS = 60, 70, 9


def _circles(shape: tuple[int, int], centre: tuple[float, float], steps: tuple[float, ...]) -> np.ndarray:
    """Blurred steps at radii of 12, 20, 28 ... pixels."""
    v, u = np.indices(shape)
    radius = np.hypot(v - centre[0], u - centre[1])
    return sum((np.tanh((radius - 12.0 - 8.0 * k) / 1.2) * step for k, step in enumerate(steps)), np.zeros(shape))


def _level(image: np.ndarray, hole: bool = False) -> Level:
    weight = np.ones(image.shape, np.float32)
    if hole:
        weight[20:32, 25:40] = 0.0
    return Level(1, (image * weight).astype(np.float32), weight)


def test_opposite_steps_have_one_direction() -> None:
    image = _circles((_ROWS, _COLS), (30.0, 33.0), (1.0, 0.4, -0.7)).astype(np.float32)
    seen, other = directions_of(_level(image)), directions_of(_level(-3.0 * image))
    np.testing.assert_allclose(other.field, 3.0 * seen.field, rtol=1e-4, atol=1e-5)


def test_the_map_peaks_at_the_planted_shift_whatever_the_contrasts() -> None:
    rng = np.random.default_rng(1)
    rising = _circles((_ROWS + 2 * _SURPLUS, _COLS + 2 * _SURPLUS), (30.0 + _SURPLUS, 33.0 + _SURPLUS), (1.0, 1.0, 1.0))
    drawn = drawn_directions(rising.astype(np.float32))
    for steps in ((1.0, 0.5, 0.8), (-1.0, 0.5, -0.3), (0.2, -0.9, 0.4)):
        shift = rng.integers(-6, 7, 2)
        image = _circles((_ROWS, _COLS), (30.0 + shift[0], 33.0 + shift[1]), steps)
        image += rng.normal(0, 0.05, image.shape)
        found = direction_map(directions_of(_level(image, hole=True)), drawn)
        assert found.shape == (2 * _SURPLUS + 1, 2 * _SURPLUS + 1)
        assert np.abs(found).max() <= 1.0 + 1e-6
        np.testing.assert_array_equal(np.unravel_index(int(found.argmax()), found.shape), shift + _SURPLUS)


def test_shifts_around_none_are_those_of_the_map() -> None:
    rng = np.random.default_rng(2)
    rising = _circles((_ROWS + 4, _COLS + 4), (33.0, 35.0), (1.0, 1.0, 1.0)).astype(np.float32)
    seen = directions_of(_level(rng.normal(size=(_ROWS, _COLS)), hole=True))
    drawn = drawn_directions(rising)
    np.testing.assert_allclose(direction_around(seen, drawn, 2), direction_map(seen, drawn), atol=1e-5)


def test_nothing_seen_or_drawn_is_no_peak() -> None:
    flat = np.zeros((_ROWS, _COLS), np.float32)
    drawn = np.zeros((2, _ROWS + 4, _COLS + 4), np.float32)
    assert (direction_map(directions_of(_level(flat)), drawn) == -1.0).all()
    assert (direction_around(directions_of(_level(flat)), drawn, 2) == -1.0).all()
