"""An image as ring techniques use it: its pixels, their noise, and a lattice of them for questions to the whole."""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.frame import Frame
from pipeline.records import BoolArray, FloatArray, Image

_LATTICE = 16_000
# Pixels that tell edges as well as all would, where their light is so many sigmas of a pixel's noise; with more noise
# more are needed, in proportion to its square, up to the most.
_ENOUGH_PIXELS, _ENOUGH_SNR, _MOST_PIXELS = 100_000, 20.0, 400_000


@dataclass(frozen=True, eq=False)
class Lattice:
    """Single pixels of an image, far enough apart to be few.

    Attributes
    ----------
    data, weight
        (rows, cols) light less its median, and inverse variance, zero where bad.
    step
        Between them, pixels.
    amplitude
        Range of the light.
    """

    data: FloatArray
    weight: FloatArray
    step: int
    amplitude: float

    def halved(self) -> "Lattice":
        """Every second pixel of every second row."""
        data, weight = (np.ascontiguousarray(values[::2, ::2]) for values in (self.data, self.weight))
        return Lattice(data, weight, 2 * self.step, self.amplitude)


@dataclass(frozen=True, eq=False)
class RingImage:
    """Image and noise.

    Attributes
    ----------
    frame
        Image.
    variance
        (rows, cols) DN^2, of each pixel by its neighbourhood's level, which its own noise hardly moves.
    lattice
        Some 16 000 pixels.
    enough_pixels
        Pixels from which on texture, not noise, limits a fit of many edges; few for clean images.
    """

    frame: Frame
    variance: Image
    lattice: Lattice
    enough_pixels: int


def ring_image(frame: Frame) -> RingImage:
    """Prepare an image.

    Parameters
    ----------
    frame
        Image.

    Returns
    -------
    RingImage
        For all ring techniques.
    """
    smooth = np.asarray(cv2.blur(frame.raw, (3, 3)), np.float32)
    variance = np.asarray(frame.noise.variance(smooth), np.float32)
    lattice = _lattice(frame, variance)
    return RingImage(frame, variance, lattice, _enough_pixels(lattice))


def _enough_pixels(lattice: Lattice) -> int:
    good = lattice.weight > 0
    if not good.any():
        return _MOST_PIXELS
    # Of the middle of the light: a planet in a corner says nothing of the rings.
    low, high = np.quantile(lattice.data[good], (0.1, 0.9))
    snr = float(high - low) * float(np.sqrt(np.median(lattice.weight[good])))
    return int(np.clip(_ENOUGH_PIXELS * (_ENOUGH_SNR / max(snr, 1e-3)) ** 2, _ENOUGH_PIXELS, _MOST_PIXELS))


def _lattice(frame: Frame, variance: Image) -> Lattice:
    step = max(1, round(float(np.sqrt(frame.raw.size / _LATTICE))))
    good: BoolArray = ~frame.bad[::step, ::step]
    data = frame.raw[::step, ::step].astype(float)
    weight = np.where(good, 1.0 / variance[::step, ::step].astype(float), 0.0)
    low, level, high = np.quantile(data[good], (0.002, 0.5, 0.998)).tolist() if good.any() else (0.0, 0.0, 0.0)
    return Lattice(data - level, weight, step, max(high - low, 1e-9))
