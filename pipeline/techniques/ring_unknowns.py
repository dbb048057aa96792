"""Unknowns of a fit of ring edges, what is believed of them, and how they move the pieces of edges."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import plane_rotation_derivative
from pipeline.imaging.ring_light import MOST_EDGES
from pipeline.predict.rings import RingScene
from pipeline.records import BoolArray, FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.ring_units import RingUnits

# A pixel integrates over its square: as much variance, in square pixels, on each axis.
PIXEL_VARIANCE = 1.0 / 12.0
# Wrong wings, widths and geometry move also edges of rings whose light does not depend on the optical depth; and a
# predicted contrast of nearly nothing is not to be believed.
_LEAST_UNEVEN, _MOST_UNEVEN = 0.15, 4.0
# Relative unevenness of rings over the width of a blur, before an image has told its own: Saturn's A and B rings
# scatter by a tenth and more from pixel to pixel in images that resolve them.
USUAL_TEXTURE = 0.1
# A perfect catalogue is one whose errors no pixel shows.
_PERFECT_PX = 1e-4
# Drift of an edge that cannot drift; share of a blur by which an edge's radius has to change for that.
_NO_DRIFT_PX, _LEAST_DRIFT = 1e-4, 0.05
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Layout:
    """Order of the parameters: (dv, du[, theta], blur variance, features' radii in km, edges' shifts and drifts in px).

    Attributes
    ----------
    size
        2 or 3.
    used
        (m,) features of the scene, by their index in the system.
    column
        (edges,) which of them each edge belongs to.
    blur2
        Variance of the blur, px^2.
    km_per_px
        At the planet's distance.
    texture_px
        (edges,) shift of each edge per relative unevenness of its rings, see :mod:`pipeline.techniques.ring_texture`.
    bounds
        (size,) margin in pixels and largest rotation, which keep a step short where edges do not show it.
    """

    size: int
    used: NDArray[np.int64]
    column: NDArray[np.int64]
    blur2: float
    km_per_px: float
    texture_px: FloatArray
    bounds: FloatArray

    @property
    def features(self) -> int:
        """Number of features in use."""
        return len(self.used)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.size + 1 + self.features + 2 * len(self.column)

    @property
    def radii(self) -> slice:
        """Where the errors of features and edges are."""
        return slice(self.size + 1, None)

    @property
    def shifts(self) -> slice:
        """Where edges' shifts are among these errors."""
        return slice(self.features, self.features + len(self.column))

    @property
    def drifts(self) -> slice:
        """Where edges' drifts are among these errors."""
        return slice(self.features + len(self.column), None)


def layout_of(scene: RingScene, context: NavContext) -> Layout:
    """Parameters of a scene.

    Parameters
    ----------
    scene
        Edges.
    context
        Bounds.

    Returns
    -------
    Layout
        For all rounds of a fit.
    """
    camera, rings = scene.state.camera_model, scene.rings
    assert rings is not None
    scale = camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm)))
    used = np.unique(scene.feature)
    bounds = [*context.search_margin_vu, *([context.max_rotation_rad] if context.fit_camera_rotation else [])]
    blur2 = scene.sigma_px**2 + PIXEL_VARIANCE
    return Layout(
        len(bounds), used, np.searchsorted(used, scene.feature).astype(np.int64), blur2,
        float(np.linalg.norm(rings.position_km) / scale), texture_shift(scene.unevenness, blur2), np.array(bounds),
    )  # fmt: skip


def texture_shift(unevenness: FloatArray, blur2: float) -> FloatArray:
    """Shift of edges per relative unevenness of the optical depth beside them.

    Light that is off by a share of the contrast over the width of the blur moves a blurred step by that share of it.

    Parameters
    ----------
    unevenness
        (n,) of :class:`pipeline.predict.rings.RingScene`.
    blur2
        Variance of the blur, px^2.

    Returns
    -------
    numpy.ndarray
        (n,) pixels.
    """
    return np.asarray(np.sqrt(blur2) * np.hypot(np.minimum(unevenness, _MOST_UNEVEN), _LEAST_UNEVEN))


@dataclass(frozen=True, eq=False)
class Radii:
    """Unknown errors: radii of the scene's features in km, then shifts and drifts of its edges alone in pixels.

    An edge alone is off where its blur, or light beside it, is not what a step has; where its radius changes along it,
    it passes through other light and is off by something else at its other end.

    Attributes
    ----------
    values, sigma
        (features + 2 edges,) and what is believed of them.
    free
        (features + 2 edges,) True where nothing is.
    along
        (edges,) variance of single pieces along an edge, px^2.
    wild
        (edges,) factor on the variance of edges that are off by more than usual.
    """

    values: FloatArray
    sigma: FloatArray
    free: BoolArray
    along: FloatArray
    wild: FloatArray


def with_drifts(radii: Radii, layout: Layout, drift: FloatArray) -> Radii:
    """Errors whose drifts are believed to be as large as the edges' shifts, by how much of other light edges pass.

    Parameters
    ----------
    radii, layout
        Errors.
    drift
        (edges,) share of the shift's sigma.

    Returns
    -------
    Radii
        With other sigmas of drifts.
    """
    sigma = radii.sigma.copy()
    sigma[layout.drifts] = np.maximum(drift * sigma[layout.shifts], _NO_DRIFT_PX)
    return replace(radii, sigma=sigma)


def first_radii(scene: RingScene, layout: Layout) -> Radii:
    """No errors yet, catalogue's sigmas."""
    first = np.unique(scene.feature, return_index=True)[1]
    known = np.maximum(scene.sigma_km[first], _PERFECT_PX * layout.km_per_px)
    sigma = np.concatenate([known, USUAL_TEXTURE * layout.texture_px, np.full(len(scene), _NO_DRIFT_PX)])
    return Radii(np.zeros(len(sigma)), sigma, np.zeros(len(sigma), bool), np.zeros(len(scene)), np.ones(len(scene)))


@dataclass(frozen=True, eq=False)
class Levers:
    """How the parameters move the units' edges.

    Attributes
    ----------
    normal, lever, scale, way
        (n, 10, 2), (n, 10), (n, 10), (n, 10): pixels per pixel, per radian, per kilometre, and per drift: from -1 to 1
        along each edge; zero where a unit has no such edge.
    edges
        (n, 2) as of the units.
    drift
        (edges,) how far edges pass through other light along them, as a share of a blur, one at most.
    """

    normal: FloatArray
    lever: FloatArray
    scale: FloatArray
    way: FloatArray
    edges: NDArray[np.int64]
    drift: FloatArray


def levers_of(scene: RingScene, units: RingUnits, pivot_vu: FloatArray, blur_px: float) -> Levers:
    """Derivatives of the units' shifts.

    Parameters
    ----------
    scene, units
        Edges, and pieces of them.
    pivot_vu
        (2,) centre of the rotation.
    blur_px
        Of the steps.

    Returns
    -------
    Levers
        At the units' middles.
    """
    arm = (units.places_vu - pivot_vu) @ plane_rotation_derivative(0.0).T
    lever = (arm * units.normal_vu).sum(axis=2) * units.present
    way, drift = _drifts(scene, units, blur_px)
    return Levers(
        units.normal_vu * units.present[:, :, None], lever, units.px_per_km * units.present, way, units.edges.copy(),
        drift,
    )  # fmt: skip


def _drifts(scene: RingScene, units: RingUnits, blur_px: float) -> tuple[FloatArray, FloatArray]:
    """(n, 10) way along the edges, and (edges,) half the change of their radii in blurs, one at most."""
    row, slot = np.nonzero(units.present)
    edge, count = units.edges[row, 0] + slot, len(scene)
    longitude = units.longitude_rad[row]
    radius = scene.radii_km(edge, longitude)
    lowest, highest, first, last = (np.full(count, np.inf) * sign for sign in (1.0, -1.0, 1.0, -1.0))
    for low, high, values in ((lowest, highest, radius), (first, last, longitude)):
        np.minimum.at(low, edge, values)
        np.maximum.at(high, edge, values)
    here = highest >= lowest
    total: FloatArray = np.bincount(edge, weights=units.px_per_km[row, slot], minlength=count).astype(float)
    scale = total / np.maximum(np.bincount(edge, minlength=count), 1)
    drift = np.zeros(count)
    drift[here] = np.minimum(0.5 * (highest - lowest)[here] * scale[here] / blur_px, 1.0)
    drift[drift < _LEAST_DRIFT] = 0.0
    middle, half = (first[edge] + last[edge]) / 2.0, np.maximum((last[edge] - first[edge]) / 2.0, _TINY)
    way = np.zeros(units.present.shape)
    way[row, slot] = np.where(drift[edge] > 0, (longitude - middle) / half, 0.0)
    return way, drift


def shifts_of(levers: Levers, layout: Layout, values: FloatArray) -> FloatArray:
    """(n, 10) shifts of the units' edges by parameters, pixels."""
    shifts = levers.normal @ values[:2]
    if layout.size == 3:
        shifts += levers.lever * values[2]
    edge = np.minimum(levers.edges[:, :1] + np.arange(MOST_EDGES), len(layout.column) - 1)
    errors = values[layout.radii]
    own = errors[layout.shifts][edge] * (levers.scale > 0) + errors[layout.drifts][edge] * levers.way
    return np.asarray(shifts + levers.scale * errors[layout.column[edge]] + own)
