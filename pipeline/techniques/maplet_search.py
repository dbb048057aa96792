"""A landmark far from where it is believed to be: one wide search, and whether its peak stands alone."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pipeline.imaging.ncc import Level, ncc_map
from pipeline.records import BoolArray, FloatArray

# Binned cells along a side of a maplet below which its pattern is no longer its own.
_LEAST_SIDE = 24


def widest_bin(side: int) -> int:
    """Largest bin at which a maplet can be told from others.

    Parameters
    ----------
    side
        Its cells along a side.

    Returns
    -------
    int
        At least 1.
    """
    return max(1, side // _LEAST_SIDE)


def wide_surface(predicted: tuple[FloatArray, BoolArray], extracted: tuple[FloatArray, BoolArray]) -> FloatArray:
    """Normalised correlation at every shift for which a maplet stays within a wider image.

    Parameters
    ----------
    predicted
        (n, n) light and flags.
    extracted
        (n + 2 w, n + 2 w) light and flags. Cells that do not count take the mean of those that do.

    Returns
    -------
    numpy.ndarray
        (2 w + 1, 2 w + 1), entry (a, b) for the shift (a - w, b - w); -1 where nothing varies.
    """
    (p, mp), (e, me) = predicted, extracted
    level = Level(1, p.astype(np.float32), mp.astype(np.float32))
    window = np.where(me, e, e[me].mean() if me.any() else 0.0).astype(np.float32)
    # The map's offsets say where the window lies from the maplet, which is the other way round.
    return ncc_map(level, window)[::-1, ::-1]


def stands_alone(surface: FloatArray, place: tuple[int, int] | NDArray[np.int64], share: float) -> bool:
    """Tell whether no other peak comes near the highest one.

    Parameters
    ----------
    surface
        Correlations, not-a-number where there is none.
    place
        Highest sample.
    share
        What the highest peak may lack to a correlation of 1, over what the next one lacks.

    Returns
    -------
    bool
        True also where there is no other peak. Samples beside the highest one are no peaks of their own.
    """
    known = np.where(np.isfinite(surface), surface, -1.0)
    peaks = (known == maximum_filter(known, 3)) & (known > -1.0)
    i, j = (int(k) for k in place)
    peaks[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = False
    if not peaks.any():
        return True
    return bool(1.0 - known[i, j] < share * (1.0 - known[peaks].max()))
