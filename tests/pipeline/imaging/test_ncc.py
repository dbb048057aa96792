"""Peaks of correlation maps."""

import numpy as np

from pipeline.imaging.ncc import highest_peaks


def test_peaks_are_local_maxima_of_the_highest_map() -> None:
    maps = np.zeros((2, 9, 11))
    maps[0, 2, 3] = 0.5
    # Beside a higher one: no peak.
    maps[0, 2, 4] = 0.4
    maps[1, 7, 9] = 0.8
    first, second = highest_peaks(list(maps), 5, 0.1)
    assert (first.shift, first.layer, first.height) == ((3, 4), 1, 0.8)
    assert (second.shift, second.layer, second.height) == ((-2, -2), 0, 0.5)


def test_no_more_than_asked_and_none_below_the_least() -> None:
    rng = np.random.default_rng(2)
    maps = [rng.random((20, 20)) for _ in range(3)]
    peaks = highest_peaks(maps, 4, 0.0)
    assert [peak.height for peak in peaks] == sorted((peak.height for peak in peaks), reverse=True)
    assert len(peaks) == 4
    assert highest_peaks(maps, 4, 1.0) == []
