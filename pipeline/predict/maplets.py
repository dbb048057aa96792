"""Which maplets a picture shows: one test after the other over all of them, each with its reason.

Source: seed 001 section 3.2 with the project's corrections. Later tests see only what earlier ones kept; the first test
that a maplet fails is its reason.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.camera import unproject
from pipeline.geometry.maplet import MapletIndex, MapletView
from pipeline.geometry.rays import RayTree, cast
from pipeline.options import Options
from pipeline.records import Body, BoolArray, CameraModel, FloatArray, Record, State

# Rays along each side of the array's outline; between them the angle to the boresight has no room to bulge.
_OUTLINE = 33
# Widening of the cones against the outline's sampling and rounding, radians.
_CONE_SLACK_RAD = 1e-6
# Step of the central differences through the camera, in cells.
_STEP_CELLS = 1.0


class MapletReason(IntEnum):
    """Why a maplet is not used in a picture; a column of the table ``landmarks``."""

    USED = 0
    OUTSIDE_CONE = 1
    FACING_AWAY = 2
    NOT_SUNLIT = 3
    LARGER_THAN_FRAME = 4
    OUTSIDE_FRAME = 5
    RESOLUTION = 6
    OCCLUDED = 7
    REMOVED_BY_HAND = 8
    TOO_MUCH_REMOVED = 9
    EMISSION = 10
    ILLUMINATED_FRACTION = 11
    RESOLUTION_TOO_COARSE = 12
    RESOLUTION_TOO_FINE = 13


class CullingOptions(Options):
    """Thresholds of seed 001 section 3.2."""

    least_facing: float = Field(0.05, ge=0, lt=1, description="cosine of emission above which a maplet is seen (3.12)")
    least_sun: float = Field(0.0, ge=0, lt=1, description="cosine of incidence above which a maplet is lit (3.13)")
    numlm: int = Field(200, ge=0, description="maplets in before the resolution is looked at (NUMLM)")
    resolution_min: float = Field(0.3, gt=0, description="cells per pixel from which a maplet is usable then (3.14)")
    resolution_max: float = Field(3.0, gt=0, description="cells per pixel up to which a maplet is usable then (3.14)")
    may_be_lost: float = Field(0.1, ge=0, le=0.5, description="fraction w of the side that may lie outside (3.17)")
    occlusion_tolerance: float = Field(
        0.01, gt=0, le=1, description="share of the body's diameter by which the surface may hide a landmark"
    )


@dataclass(frozen=True, eq=False)
class Visibility(Record):
    """Outcome of the culling, one row per maplet of the catalogue.

    Attributes
    ----------
    reason
        (n,) :class:`MapletReason`.
    predicted_vu
        (n, 2) pixel of the landmark; not-a-number where an earlier test made it needless.
    jacobian
        (n, 2, 2) d(v, u)/d(cells along x, y), likewise.
    ratio
        (n,) cells per pixel (3.56), likewise.
    """

    reason: NDArray[np.int64]
    predicted_vu: FloatArray
    jacobian: FloatArray
    ratio: FloatArray

    def __post_init__(self) -> None:
        n = len(self.reason)
        self._freeze(reason=(n,), predicted_vu=(n, 2), jacobian=(n, 2, 2), ratio=(n,))

    @property
    def used(self) -> NDArray[np.int64]:
        """Rows of the maplets that are seen."""
        return np.flatnonzero(self.reason == MapletReason.USED)


def view_of(state: State, body: Body) -> MapletView:
    """View of a body from a picture's geometry.

    Parameters
    ----------
    state
        Geometry of the image.
    body
        One of its bodies.

    Returns
    -------
    MapletView
        In the body's frame.
    """
    body_from_j2000 = body.body_from_j2000
    return MapletView(
        state.camera_model,
        state.attitude.camera_from_j2000 @ body_from_j2000.T,
        -body_from_j2000 @ body.position_km,
        body_from_j2000 @ body.sun_direction_j2000,
    )


def array_cone(camera: CameraModel) -> tuple[FloatArray, float]:
    """Narrowest cone about the ray through the array's centre that holds the array (eq. 3.1-3.5 as corrected).

    Parameters
    ----------
    camera
        Model; its full inverse is used, distortion included.

    Returns
    -------
    tuple
        (3,) boresight in the camera frame; half-angle in radians, pi where the inverse has no answer.
    """
    rows, cols = camera.shape_vu
    v, u = np.linspace(-0.5, rows - 0.5, _OUTLINE), np.linspace(-0.5, cols - 0.5, _OUTLINE)
    outline = np.concatenate(
        [np.stack(np.broadcast_arrays(v, end), axis=1) for end in (u[0], u[-1])]
        + [np.stack(np.broadcast_arrays(end, u), axis=1) for end in (v[0], v[-1])]
    )
    rays, ok = unproject(camera, outline)
    boresight, known = unproject(camera, camera.centre_vu[None])
    if not (ok.all() and known.all()):
        return np.array([0.0, 0.0, 1.0]), float(np.pi)
    return boresight[0], float(np.arccos(np.clip(rays @ boresight[0], -1, 1)).max()) + _CONE_SLACK_RAD


def cone_test(view: MapletView, maplets: MapletIndex) -> BoolArray:
    """Maplets of which anything can lie in the array (eq. 3.6-3.11 as corrected: conservative at every distance).

    Parameters
    ----------
    view
        Camera and body.
    maplets
        Catalogue.

    Returns
    -------
    numpy.ndarray
        (n,) False where even the ball about the landmark that holds the maplet misses the array's cone.
    """
    boresight, camera_half = array_cone(view.camera)
    sight = maplets.landmark_km - view.position_km
    distance = np.linalg.norm(sight, axis=1)
    # The outermost cells reach half a diagonal beyond their centres.
    ball = maplets.radius_km + maplets.scale_km * np.sqrt(0.5)
    within = ball >= distance
    maplet_half = np.arcsin(np.where(within, 1.0, ball / np.maximum(distance, ball)))
    total = np.minimum(camera_half + maplet_half, np.pi)
    cosine = sight @ (boresight @ view.camera_from_body) / np.maximum(distance, 1e-300)
    return np.asarray(within | (cosine >= np.cos(total)))


def nine_point_test(view: MapletView, maplets: MapletIndex, may_be_lost: float) -> BoolArray:
    """Maplets with the landmark, or one of eight points about it, inside the array (eq. 3.17 as corrected).

    Parameters
    ----------
    view
        Camera and body.
    maplets
        Catalogue.
    may_be_lost
        Fraction w of the side.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    inside = _inside(view, maplets.landmark_km)
    reach = (may_be_lost * maplets.side_km)[:, None]
    x, y = reach * maplets.maplet_from_body[:, 0], reach * maplets.maplet_from_body[:, 1]
    for k, j in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        left = np.flatnonzero(~inside)
        inside[left] = _inside(view, maplets.landmark_km[left] + k * x[left] + j * y[left])
    return inside


def _inside(view: MapletView, points_km: FloatArray) -> BoolArray:
    pixels, ahead = view.pixels(points_km)
    rows, cols = view.camera.shape_vu
    # Not-a-number compares as outside.
    high = np.array([rows - 0.5, cols - 0.5])
    return np.asarray(ahead & (pixels >= -0.5).all(axis=1) & (pixels <= high).all(axis=1))


def maplet_jacobian(view: MapletView, maplets: MapletIndex, rows: NDArray[np.int64]) -> FloatArray:
    """Pixels per cell at the landmarks, by central differences through the whole camera (eq. 3.15).

    Parameters
    ----------
    view
        Camera and body.
    maplets
        Catalogue.
    rows
        (k,) maplets asked for.

    Returns
    -------
    numpy.ndarray
        (k, 2, 2), d(v, u)/d(cells along x, y); not-a-number behind the camera.
    """
    place, scale = maplets.landmark_km[rows], maplets.scale_km[rows][:, None]
    columns = []
    for axis in (0, 1):
        step = _STEP_CELLS * scale * maplets.maplet_from_body[rows, axis]
        ahead, behind = view.pixels(place + step)[0], view.pixels(place - step)[0]
        columns.append((ahead - behind) / (2.0 * _STEP_CELLS))
    return np.stack(columns, axis=2)


def cells_per_pixel(jacobian: FloatArray) -> FloatArray:
    """Resolution ratio: width of a pixel on the maplet, in cells (eq. 3.14 and 3.56 as corrected).

    Parameters
    ----------
    jacobian
        (n, 2, 2) pixels per cell.

    Returns
    -------
    numpy.ndarray
        (n,) 1/sqrt(abs(det J)); det J is an area. Times the scale it is kilometres per pixel.
    """
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(np.abs(determinant)))


def occlusion_test(view: MapletView, landmarks_km: FloatArray, tree: RayTree, allowance_km: float) -> BoolArray:
    """Landmarks before which the surface stands (seed 001 section 3.2.1).

    Parameters
    ----------
    view
        Camera and body.
    landmarks_km
        (n, 3) body-fixed.
    tree
        The body's surface.
    allowance_km
        Distance by which the surface may stand before a landmark, since shape and maplet are not the same model.

    Returns
    -------
    numpy.ndarray
        (n,) True where it is hidden.
    """
    sight = landmarks_km - view.position_km
    distance = np.linalg.norm(sight, axis=1)
    hit, _ = cast(tree, view.position_km[None], sight / distance[:, None])
    return np.asarray(hit < distance - allowance_km)


def cull(
    view: MapletView, maplets: MapletIndex, surface: tuple[RayTree, float] | None, options: CullingOptions
) -> Visibility:
    """All tests of seed 001 section 3.2 in their order.

    Parameters
    ----------
    view
        Camera and body.
    maplets
        Catalogue.
    surface
        The body's surface and its largest diameter in km; None skips the test for occlusion.
    options
        Thresholds.

    Returns
    -------
    Visibility
        One reason for every maplet. The resolution counts only for maplets that come, in the order of the catalogue,
        after ``numlm`` others that passed all tests before it.
    """
    n = len(maplets)
    reason = np.full(n, int(MapletReason.USED))
    predicted, jacobian, ratio = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.full(n, np.nan)

    def drop(rows: NDArray[np.int64], keep: BoolArray, why: MapletReason) -> NDArray[np.int64]:
        reason[rows[~keep]] = int(why)
        return rows[keep]

    rows = drop(np.arange(n), cone_test(view, maplets), MapletReason.OUTSIDE_CONE)
    sight = maplets.landmark_km[rows] - view.position_km
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    normal = maplets.maplet_from_body[rows, 2]
    facing = -np.einsum("ij,ij->i", sight, normal) > options.least_facing
    lit = normal[facing] @ view.sun > options.least_sun
    rows = drop(drop(rows, facing, MapletReason.FACING_AWAY), lit, MapletReason.NOT_SUNLIT)
    jacobian[rows] = maplet_jacobian(view, maplets, rows)
    ratio[rows] = cells_per_pixel(jacobian[rows])
    # Behind the camera, though within the cone of a very near maplet, there is no ratio.
    frame_cells = ratio[rows] * np.sqrt(np.prod(view.camera.shape_vu))
    rows = drop(rows, 2 * maplets.half[rows] + 1 < frame_cells, MapletReason.LARGER_THAN_FRAME)
    rows = drop(rows, nine_point_test(view, _take(maplets, rows), options.may_be_lost), MapletReason.OUTSIDE_FRAME)
    usable = (ratio[rows] >= options.resolution_min) & (ratio[rows] <= options.resolution_max)
    rows = drop(rows, usable | (np.arange(len(rows)) < options.numlm), MapletReason.RESOLUTION)
    if surface is not None:
        tree, diameter_km = surface
        hidden = occlusion_test(view, maplets.landmark_km[rows], tree, options.occlusion_tolerance * diameter_km)
        rows = drop(rows, ~hidden, MapletReason.OCCLUDED)
    predicted[rows] = view.pixels(maplets.landmark_km[rows])[0]
    return Visibility(reason, predicted, jacobian, ratio)


def _take(maplets: MapletIndex, rows: NDArray[np.int64]) -> MapletIndex:
    return MapletIndex(
        maplets.name[rows], maplets.landmark_km[rows], maplets.maplet_from_body[rows], maplets.scale_km[rows],
        maplets.half[rows], maplets.radius_km[rows], maplets.covariance_km2[rows],
    )  # fmt: skip
