"""Light of rings as bands between their edges, each of free brightness, fitted to a lattice of the image's pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.imaging.ring_light import band_equations
from pipeline.predict.rings import RingScene
from pipeline.records import FloatArray
from pipeline.techniques.ring_image import Lattice
from pipeline.techniques.ring_unknowns import PIXEL_VARIANCE

# Level and two slopes, which come before the bands.
_PLANE = 3
# Brightness of bands, over the image's range of light, beyond which they are not believed.
_BRIGHTEST = 10.0


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
    each = _PLANE + len(scene)
    count = each * (1 + scene.before_discs)
    gram, pull = np.zeros((count, count)), np.zeros(count)
    pose = scene.pose(offset_vu, rotation_rad)
    blur = float(np.sqrt(scene.sigma_px**2 + PIXEL_VARIANCE + slack_px**2))
    power, used = band_equations(
        scene.rays.slopes, scene.origin, pose.turn, pose.observer_km, np.zeros(2), float(lattice.step), lattice.data,
        lattice.weight, scene.curves, scene.means, scene.spread, blur, scene.forms, scene.sun,
        scene.before_discs, gram, pull,
    )  # fmt: skip
    # Of pixels that bodies or shadows do not cover under this pointing.
    pixels = max(float(used), 1.0)
    # Bands that no pixel tells apart would be brighter than anything, with either sign.
    plane = np.arange(count) % each < _PLANE
    gram[~plane, ~plane] += 1.0 / (_BRIGHTEST * lattice.amplitude) ** 2
    left, bands = _left(gram, pull, power, np.arange(count))
    bare, _ = _left(gram, pull, power, np.flatnonzero(plane))
    floor = 1e-9 * pixels
    # The contrasts of the region that has more of the image.
    region = each * int(np.argmax(gram.diagonal()[::each]))
    contrasts = np.diff(bands[region + _PLANE : region + each], prepend=0.0)
    return LeftOver(max(left, floor) / pixels, max(bare, floor) / pixels, pixels, contrasts)


def _left(gram: FloatArray, pull: FloatArray, power: float, chosen: NDArray[np.int64]) -> tuple[float, FloatArray]:
    """Weighted squares that some of the unknowns leave, and these."""
    matrix, side = gram[np.ix_(chosen, chosen)], pull[chosen]
    values = _solution(matrix, side)
    return float(power - 2.0 * side @ values + values @ matrix @ values), values


def _solution(gram: FloatArray, pull: FloatArray) -> FloatArray:
    ridge = 1e-9 * np.diag(np.maximum(np.diag(gram), 1e-9 * max(float(np.diag(gram).max()), 1e-300)))
    return np.asarray(np.linalg.solve(gram + ridge, pull))
