"""Maplets: square height fields about a landmark, in a frame of their own.

A maplet's grid is ``heights[i, j]``, i along its x and j along its y axis, both from -half to +half, in cells; heights
are in cells too, so one scale turns all three into kilometres (seed 001 eq. 3.46).
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import project
from pipeline.errors import ContractError
from pipeline.records import BoolArray, CameraModel, FloatArray, Record


@dataclass(frozen=True, eq=False)
class Maplet(Record):
    """Height and albedo of a patch of surface.

    Attributes
    ----------
    name
        Landmark's name.
    landmark_km
        (3,) origin of the maplet's frame, body-fixed.
    maplet_from_body
        (3, 3) rows are the maplet's x, y and z axes in the body frame; z is the mean normal.
    scale_km
        Width of a cell.
    heights
        (n, n) cells above the plane of the frame, n odd; not-a-number where unknown.
    albedo
        (n, n) relative, 1 on average; not-a-number where unknown.
    covariance_km2
        (3, 3) of the landmark's position, body axes.
    """

    name: str
    landmark_km: FloatArray
    maplet_from_body: FloatArray
    scale_km: float
    heights: FloatArray
    albedo: FloatArray
    covariance_km2: FloatArray

    def __post_init__(self) -> None:
        n = len(self.heights)
        self._freeze(landmark_km=(3,), maplet_from_body=(3, 3), heights=(n, n), albedo=(n, n), covariance_km2=(3, 3))
        if n < 3 or n % 2 == 0:
            raise ContractError(f"{self.name}: {n} x {n} cells have no middle")
        if not self.scale_km > 0:
            raise ContractError(f"{self.name}: scale {self.scale_km} km must be positive")
        # Frames come from single precision.
        if not np.allclose(self.maplet_from_body @ self.maplet_from_body.T, np.eye(3), atol=1e-5):
            raise ContractError(f"{self.name}: the axes of its frame are not orthonormal")

    @property
    def half(self) -> int:
        """Cells on each side of the middle one."""
        return len(self.heights) // 2


@dataclass(frozen=True, eq=False)
class MapletIndex(Record):
    """What culling asks of every maplet of a catalogue, as arrays.

    Attributes
    ----------
    name
        (n,) text.
    landmark_km, maplet_from_body, scale_km, covariance_km2
        (n, 3), (n, 3, 3), (n,), (n, 3, 3): see :class:`Maplet`.
    half
        (n,) cells on each side of the middle.
    radius_km
        (n,) largest distance of a vertex from the landmark, heights included.
    """

    name: NDArray[np.str_]
    landmark_km: FloatArray
    maplet_from_body: FloatArray
    scale_km: FloatArray
    half: NDArray[np.int64]
    radius_km: FloatArray
    covariance_km2: FloatArray

    def __post_init__(self) -> None:
        n = len(self.name)
        self._freeze(
            name=(n,), landmark_km=(n, 3), maplet_from_body=(n, 3, 3), scale_km=(n,), half=(n,), radius_km=(n,),
            covariance_km2=(n, 3, 3),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.name)

    @property
    def side_km(self) -> FloatArray:
        """(n,) length of a maplet's side."""
        return np.asarray((2 * self.half + 1) * self.scale_km)

    @staticmethod
    def concatenate(parts: "list[MapletIndex]") -> "MapletIndex":
        """All rows, in the order given."""
        return MapletIndex(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(MapletIndex)))


@dataclass(frozen=True, eq=False)
class MapletView(Record):
    """A camera beside a body, in the body's own frame.

    Attributes
    ----------
    camera
        Model.
    camera_from_body
        (3, 3) rotation.
    position_km
        (3,) of the camera, body-fixed.
    sun
        (3,) unit vector from the body to the Sun, body-fixed.
    """

    camera: CameraModel
    camera_from_body: FloatArray
    position_km: FloatArray
    sun: FloatArray

    def __post_init__(self) -> None:
        self._freeze(camera_from_body=(3, 3), position_km=(3,), sun=(3,))

    def pixels(self, points_km: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels of body-fixed points.

        Parameters
        ----------
        points_km
            (n, 3).

        Returns
        -------
        tuple
            (n, 2) pixels, not-a-number behind the camera; (n,) flags of what lies ahead.
        """
        return project(self.camera, (points_km - self.position_km) @ self.camera_from_body.T)


def maplet_points_km(maplet: Maplet) -> FloatArray:
    """Body-fixed places of a maplet's cells (seed 001 eq. 3.46).

    Parameters
    ----------
    maplet
        Maplet.

    Returns
    -------
    numpy.ndarray
        (n, n, 3), km; not-a-number where the height is.
    """
    steps = np.arange(-maplet.half, maplet.half + 1.0)
    x, y, z = maplet.maplet_from_body * maplet.scale_km
    plane = maplet.landmark_km + steps[:, None, None] * x + steps[None, :, None] * y
    return np.asarray(plane + maplet.heights[..., None] * z)


def vertex_radius_km(maplet: Maplet) -> float:
    """Largest distance of a vertex from the landmark; cells without height count as level.

    Parameters
    ----------
    maplet
        Maplet.

    Returns
    -------
    float
        km.
    """
    steps = np.arange(-maplet.half, maplet.half + 1.0) ** 2
    squares = steps[:, None] + steps[None, :] + np.nan_to_num(maplet.heights) ** 2
    return float(maplet.scale_km * np.sqrt(squares.max()))


def index_of(maplets: list[Maplet]) -> MapletIndex:
    """Index of maplets.

    Parameters
    ----------
    maplets
        Any number but none.

    Returns
    -------
    MapletIndex
        In the same order.
    """
    return MapletIndex(
        np.array([m.name for m in maplets]),
        np.array([m.landmark_km for m in maplets]),
        np.array([m.maplet_from_body for m in maplets]),
        np.array([m.scale_km for m in maplets]),
        np.array([m.half for m in maplets]),
        np.array([vertex_radius_km(m) for m in maplets]),
        np.array([m.covariance_km2 for m in maplets]),
    )


def cell_normals(heights: FloatArray) -> FloatArray:
    """Unit normals of cells by differences of heights (seed 001 eq. 3.36-3.37).

    Parameters
    ----------
    heights
        (n, n) cells, i along x, j along y.

    Returns
    -------
    numpy.ndarray
        (n, n, 3) in the maplet's frame: central differences where both neighbours are known, else the one; not-a-number
        where the cell or all its neighbours along an axis are unknown.
    """
    slopes = [_slope(heights, axis) for axis in (0, 1)]
    normals = np.stack([-slopes[0], -slopes[1], np.where(np.isfinite(heights), 1.0, np.nan)], axis=2)
    return np.asarray(normals / np.linalg.norm(normals, axis=2)[..., None])


def _slope(heights: FloatArray, axis: int) -> FloatArray:
    step = np.diff(heights, axis=axis)
    edge = np.full_like(np.take(heights, [0], axis=axis), np.nan)
    before, after = np.concatenate([edge, step], axis=axis), np.concatenate([step, edge], axis=axis)
    return np.where(np.isnan(before), after, np.where(np.isnan(after), before, 0.5 * (before + after)))
