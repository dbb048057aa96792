"""Which pixels carry no measurement: never received, saturated."""

import cv2
import numba
import numpy as np

from pipeline.records import BoolArray, Image

# The chance that noise alone makes one run of clipped pixels somewhere in the image is kept below this.
_CHANCE_RUN = 1e-3
# A level this many sigmas from the fill value leaves no room for noise to reach it.
_CLEAR_OF_FILL_SIGMA = 5.0
_SATURATION_NOISE_SIGMA = 4.0


def missing_pixels(image: Image, missing_value: float | None, level_dn: float, sigma_dn: float) -> BoolArray:
    """Pixels that were never received, told from pixels that noise has clipped to the same value.

    Where the background is far from the fill value every pixel with that value is missing. Where noise can reach
    it, only rows' runs too long for chance are.

    Parameters
    ----------
    image
        (rows, cols) DN, finite.
    missing_value
        Fill value, None when there is none.
    level_dn, sigma_dn
        Background and its noise.

    Returns
    -------
    numpy.ndarray
        (rows, cols) True where missing.
    """
    if missing_value is None or not np.isfinite(missing_value):
        return np.zeros(image.shape, bool)
    equal: BoolArray = np.asarray(image == np.float32(missing_value))
    if not equal.any() or abs(level_dn - missing_value) > _CLEAR_OF_FILL_SIGMA * max(sigma_dn, 1e-6):
        return equal
    return _long_runs(equal, _run_length(equal))


def _run_length(equal: BoolArray) -> int:
    """Shortest run along a row that chance would not make, from the share of clipped pixels in a typical row."""
    share = float(np.clip(np.median(equal.mean(axis=1)), 0.01, 0.9))
    return int(np.ceil(np.log(_CHANCE_RUN / equal.size) / np.log(share)))


def _long_runs(flags: BoolArray, length: int) -> BoolArray:
    """Runs of at least ``length`` along rows: a morphological opening with a horizontal bar."""
    if length > flags.shape[1]:
        return np.zeros_like(flags)
    bar = np.ones((1, length), np.uint8)
    # Erosion and dilation by a bar of even length must be anchored at opposite ends, or every run moves by one pixel.
    starts = cv2.erode(flags.astype(np.uint8), bar, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    whole = cv2.dilate(starts, bar, anchor=(length - 1, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(whole, bool)


def saturated_pixels(image: Image, saturation_dn: float | None, read_noise_dn: float | None) -> BoolArray:
    """Pixels whose well or converter is full.

    Parameters
    ----------
    image
        (rows, cols) DN.
    saturation_dn
        Level at which the response ends, None when unknown.
    read_noise_dn
        Noise that may have been added after clipping.

    Returns
    -------
    numpy.ndarray
        (rows, cols) True where saturated.
    """
    if saturation_dn is None:
        return np.zeros(image.shape, bool)
    slack = _SATURATION_NOISE_SIGMA * (read_noise_dn or 0.0)
    # At most a tenth of the range: a noisy camera must not lose its upper half.
    result: BoolArray = image >= saturation_dn - min(slack, 0.1 * abs(saturation_dn))
    return result


@numba.njit(cache=True, nogil=True)
def _mark_spikes(image, bad, sigma, least_sigma, result):  # type: ignore[no-untyped-def]
    rows, cols = image.shape
    for i in range(1, rows - 1):
        for j in range(1, cols - 1):
            here = image[i, j]
            if bad[i, j] or here <= image[i, j - 1] or here < image[i - 1, j] or here <= image[i + 1, j]:
                continue
            lowest = here
            for a in range(-1, 2):
                for b in range(-1, 2):
                    lowest = min(lowest, image[i + a, j + b])
            rise = here - lowest
            if rise < least_sigma * sigma[i, j]:
                continue
            alike, v, u = 0, i, j
            for a in range(-1, 2):
                for b in range(-1, 2):
                    if (a or b) and image[i + a, j + b] - lowest > 0.4 * rise:
                        alike, v, u = alike + 1, i + a, j + b
            if alike <= 1:
                result[i, j] = result[v, u] = True


def spikes(image: Image, bad: BoolArray, sigma_dn: Image, least_sigma: float) -> BoolArray:
    """Single bright pixels, or pairs: cosmic rays and hot pixels, which no optics make.

    A sharp star can be among them; a crescent one pixel wide is not, for it goes on on both sides.

    Parameters
    ----------
    image
        (rows, cols) DN.
    bad
        (rows, cols) pixels known to be bad.
    sigma_dn
        (rows, cols) noise.
    least_sigma
        Rise over the surroundings from which a pixel may be one.

    Returns
    -------
    numpy.ndarray
        (rows, cols) True where struck.
    """
    result = np.zeros(image.shape, np.bool_)
    _mark_spikes(image, bad, sigma_dn, least_sigma, result)
    return result
