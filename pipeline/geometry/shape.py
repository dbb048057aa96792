"""Shape of a body: triangles, Gaskell's six-faced grid of quadrilaterals, and what follows from their vertices.

A grid cell is the bilinear patch over its four corners; the triangles of the same shape cut it along one diagonal.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from pipeline.errors import ContractError
from pipeline.records import FloatArray, Record, TriangleMesh

IntArray = NDArray[np.int64]
ICQ_FACES = 6
_CORNERS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Shape(Record):
    """Surface of a body in its own frame.

    Attributes
    ----------
    mesh
        Triangles, outward.
    icq_km
        (6, Q + 1, Q + 1, 3) vertices of Gaskell's implicitly connected quadrilaterals, where the shape came as such; J
        before I, as in the file.
    """

    mesh: TriangleMesh
    icq_km: FloatArray | None = None

    def __post_init__(self) -> None:
        self._freeze(icq_km=(ICQ_FACES, None, None, 3))
        if self.icq_km is not None and self.icq_km.shape[1] != self.icq_km.shape[2]:
            raise ContractError(f"faces of {self.icq_km.shape[1]} x {self.icq_km.shape[2]} vertices are not square")

    @cached_property
    def volume_km3(self) -> float:
        """Enclosed volume, positive for outward facets."""
        return volume_km3(self.mesh)

    @cached_property
    def extent_km(self) -> FloatArray:
        """(2, 3) lowest and highest coordinates."""
        return np.stack([self.mesh.vertices_km.min(axis=0), self.mesh.vertices_km.max(axis=0)])

    @cached_property
    def diameter_km(self) -> float:
        """Largest distance between two points of the surface: two corners of its convex hull."""
        corners = self.mesh.vertices_km[ConvexHull(self.mesh.vertices_km).vertices]
        from_middle = np.linalg.norm(corners - corners.mean(axis=0), axis=1)
        start = corners[np.argmax(from_middle)]
        least = float(np.linalg.norm(corners - start, axis=1).max())
        # Smooth bodies have tens of thousands of corners, of which few can be an end of the diameter.
        ends = corners[from_middle >= least - from_middle.max()]
        parts = np.array_split(ends, max(1, len(ends) // _CORNERS_AT_ONCE))
        return max(least, *(float(cdist(part, ends).max()) for part in parts))


def volume_km3(mesh: TriangleMesh) -> float:
    """Volume that a closed mesh encloses, by the divergence theorem.

    Parameters
    ----------
    mesh
        Shape.

    Returns
    -------
    float
        km^3, negative where the facets face inward.
    """
    return signed_volume(mesh.vertices_km, mesh.facets)


def signed_volume(vertices_km: FloatArray, facets: IntArray) -> float:
    """Sum of the signed tetrahedra over facets and the origin.

    Parameters
    ----------
    vertices_km
        (n, 3).
    facets
        (m, 3) vertex indices.

    Returns
    -------
    float
        km^3.
    """
    a, b, c = (vertices_km[facets[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def facet_adjacency(mesh: TriangleMesh) -> IntArray:
    """Neighbours of each facet across its edges.

    Parameters
    ----------
    mesh
        Shape whose edges belong to two facets at most.

    Returns
    -------
    numpy.ndarray
        (m, 3) facet across the edge from corner k to corner k + 1; -1 where the surface ends.

    Raises
    ------
    ContractError
        If an edge is walked twice in the same sense, as where three facets meet or two face opposite ways.
    """
    count = np.int64(len(mesh.vertices_km))
    start, end = mesh.facets, np.roll(mesh.facets, -1, axis=1)
    there, back = (start * count + end).ravel(), (end * count + start).ravel()
    order = np.argsort(there)
    keys = there[order]
    if (keys[1:] == keys[:-1]).any():
        raise ContractError("an edge belongs to more than two facets, or its two facets face opposite ways")
    place = np.minimum(np.searchsorted(keys, back), len(keys) - 1)
    neighbour = np.where(keys[place] == back, order[place] // 3, -1)
    return np.asarray(neighbour.reshape(-1, 3), np.int64)


def icq_cells(icq_km: FloatArray) -> FloatArray:
    """Corners of the grid's cells, each face turned so that its cells wind counter-clockwise seen from outside.

    Parameters
    ----------
    icq_km
        (6, Q + 1, Q + 1, 3) vertices.

    Returns
    -------
    numpy.ndarray
        (6 Q^2, 4, 3) corners in order around the cell. Files wind either way: the face's signed volume decides.
    """
    a, b, c, d = icq_km[:, :-1, :-1], icq_km[:, :-1, 1:], icq_km[:, 1:, 1:], icq_km[:, 1:, :-1]
    cells = np.stack([a, b, c, d], axis=3).reshape(ICQ_FACES, -1, 4, 3)
    return np.concatenate([face if _volume_under(face) >= 0 else face[:, ::-1] for face in cells])


def _volume_under(cells: FloatArray) -> float:
    """Signed volume between the origin and cells cut along one diagonal."""
    a, b, c, d = (cells[:, corner] for corner in range(4))
    return float(np.einsum("ij,ij->", np.cross(a, b) + np.cross(d, a), c) / 6.0)


def icq_adjacency(icq_km: FloatArray) -> IntArray:
    """How the six faces of a grid join.

    Parameters
    ----------
    icq_km
        (6, Q + 1, Q + 1, 3) vertices.

    Returns
    -------
    numpy.ndarray
        (6, 4, 3): for face and edge (J = 0, J = Q, I = 0, I = Q) the neighbouring face, its edge, and 1 where it is
        walked the other way.

    Raises
    ------
    ContractError
        If an edge has no other edge with the same vertices.
    """
    edges = [(face, edge, line) for face in range(ICQ_FACES) for edge, line in enumerate(_edges_of(icq_km[face]))]
    joined = np.full((ICQ_FACES, 4, 3), -1, np.int64)
    for face, edge, line in edges:
        for other, its, candidate in edges:
            if other == face:
                continue
            if np.array_equal(line, candidate):
                joined[face, edge] = other, its, 0
            elif np.array_equal(line, candidate[::-1]):
                joined[face, edge] = other, its, 1
        if joined[face, edge, 0] < 0:
            raise ContractError(f"edge {edge} of face {face + 1} belongs to no other face: the grid is not closed")
    return joined


def _edges_of(face: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return face[0], face[-1], face[:, 0], face[:, -1]
