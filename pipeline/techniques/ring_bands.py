"""Light of rings as bands between their edges, each of free brightness, fitted to a lattice of the image's pixels."""

from dataclasses import dataclass

import numpy as np

from pipeline.frame import Frame
from pipeline.imaging.ring_light import band_equations
from pipeline.predict.rings import RingScene
from pipeline.records import BoolArray, FloatArray, Image
from pipeline.techniques.ring_solve import PIXEL_VARIANCE

_LATTICE = 16_000
# Level and two slopes, which come before the bands.
_PLANE = 3
# Brightness of bands, over the image's range of light, beyond which they are not believed.
_BRIGHTEST = 10.0


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


@dataclass(frozen=True)
class LeftOver:
    """What a fit of bands leaves.

    Attributes
    ----------
    mean
        Mean weighted square.
    bare
        Of a plane alone.
    pixels
        Their number.
    contrasts
        Light outside less inside of every edge.
    """

    mean: float
    bare: float
    pixels: float
    contrasts: FloatArray


def lattice_of(frame: Frame, variance: Image) -> Lattice:
    """Pixels of an image for :func:`left_over`.

    Parameters
    ----------
    frame
        Image.
    variance
        (rows, cols) DN^2.

    Returns
    -------
    Lattice
        Of some 16 000 pixels.
    """
    step = max(1, int(np.sqrt(frame.raw.size / _LATTICE)))
    good: BoolArray = ~frame.bad[::step, ::step]
    data = frame.raw[::step, ::step].astype(float)
    weight = np.where(good, 1.0 / variance[::step, ::step].astype(float), 0.0)
    low, level, high = np.quantile(data[good], (0.002, 0.5, 0.998)).tolist() if good.any() else (0.0, 0.0, 0.0)
    return Lattice(data - level, weight, step, max(high - low, 1e-9))


def left_over(
    scene: RingScene, lattice: Lattice, offset_vu: FloatArray, rotation_rad: float, slack_px: float = 0.0
) -> LeftOver:
    """Fit bands under a pointing.

    Parameters
    ----------
    scene
        Edges.
    lattice
        Pixels.
    offset_vu, rotation_rad
        (2,) correction at the array centre, pixels; radians.
    slack_px
        Error of the place that is forgiven, as a wider blur.

    Returns
    -------
    LeftOver
        Smallest at the right place, whatever the rings' brightness.
    """
    assert scene.rays is not None
    count = _PLANE + len(scene)
    gram, pull = np.zeros((count, count)), np.zeros(count)
    pose = scene.pose(offset_vu, rotation_rad)
    blur = float(np.sqrt(scene.sigma_px**2 + PIXEL_VARIANCE + slack_px**2))
    power = band_equations(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, np.zeros(2), float(lattice.step), lattice.data,
        lattice.weight, scene.curves, scene.means, scene.spread, blur, scene.forms, scene.sun, gram, pull,
    )  # fmt: skip
    pixels = float((lattice.weight > 0).sum())
    # Bands that no pixel tells apart would be brighter than anything, with either sign.
    usual = np.full(count, 1.0 / (_BRIGHTEST * lattice.amplitude) ** 2)
    usual[:_PLANE] = 0.0
    plane, bands = (_solution(gram[:n, :n] + np.diag(usual[:n]), pull[:n]) for n in (_PLANE, count))
    floor = 1e-9 * pixels
    left = [
        max(float(power - 2.0 * pull[: len(x)] @ x + x @ gram[: len(x), : len(x)] @ x), floor) / pixels
        for x in (bands, plane)
    ]
    return LeftOver(left[0], left[1], pixels, np.diff(bands[_PLANE:], prepend=0.0))


def _solution(gram: FloatArray, pull: FloatArray) -> FloatArray:
    ridge = 1e-9 * np.diag(np.maximum(np.diag(gram), 1e-9 * max(float(np.diag(gram).max()), 1e-300)))
    return np.asarray(np.linalg.solve(gram + ridge, pull))
