"""Shapes: volume, extent and adjacency of bodies whose figures are known."""

import numpy as np
import pytest

from pipeline.errors import ContractError
from pipeline.geometry.shape import Shape, facet_adjacency, icq_adjacency, icq_cells, volume_km3
from pipeline.records import FloatArray, TriangleMesh

# Faces of a cube by fixed axis, its sign, and the axes of J and I; they wind both ways.
_FACES = ((2, 1.0, 0, 1), (0, 1.0, 1, 2), (1, 1.0, 2, 0), (0, -1.0, 1, 2), (1, -1.0, 2, 0), (2, -1.0, 0, 1))


def icq_of(radius: float, side: int, dent: float = 0.0) -> FloatArray:
    """(6, side + 1, side + 1, 3) cube blown up to a ball, with a deep crater at the end of the z axis."""
    grid = np.linspace(-1.0, 1.0, side + 1)
    j, i = np.meshgrid(grid, grid, indexing="ij")
    faces = np.empty((6, side + 1, side + 1, 3))
    for face, (axis, sign, first, second) in enumerate(_FACES):
        faces[face, ..., axis], faces[face, ..., first], faces[face, ..., second] = sign, j, i
    unit = faces / np.linalg.norm(faces, axis=3)[..., None]
    height = radius * (1.0 - dent * np.exp(-(np.arccos(np.clip(unit[..., 2], -1, 1)) ** 2) / 0.08))
    return np.asarray(unit * height[..., None])


def mesh_of(icq: FloatArray) -> TriangleMesh:
    """Triangles along one diagonal of each cell, sharing vertices."""
    cells = icq_cells(icq)
    vertices, place = np.unique(cells.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    corners = place.reshape(-1, 4)
    return TriangleMesh(vertices, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]))


def test_volume_and_extent_of_a_ball() -> None:
    shape = Shape(mesh_of(icq_of(2.0, 40)), icq_of(2.0, 40))
    # The facets of a fine grid lie below the sphere by a share of (cell / radius)^2 / 4.
    assert shape.volume_km3 == pytest.approx(4.0 / 3.0 * np.pi * 8.0, rel=2e-3)
    assert shape.extent_km == pytest.approx(np.array([[-2.0] * 3, [2.0] * 3]))
    assert shape.diameter_km == pytest.approx(4.0)


def test_turned_facets_have_a_negative_volume() -> None:
    mesh = mesh_of(icq_of(1.0, 6))
    turned = TriangleMesh(mesh.vertices_km, mesh.facets[:, ::-1])
    assert volume_km3(turned) == pytest.approx(-volume_km3(mesh), rel=1e-12)
    assert volume_km3(turned) < 0


def test_cells_wind_outward_whatever_the_file_says() -> None:
    cells = icq_cells(icq_of(1.0, 8))
    normal = np.cross(cells[:, 2] - cells[:, 0], cells[:, 3] - cells[:, 1])
    assert (np.einsum("ij,ij->i", normal, cells.mean(axis=1)) > 0).all()


def test_neighbours_share_an_edge_and_know_each_other() -> None:
    mesh = mesh_of(icq_of(1.0, 5, 0.4))
    neighbour = facet_adjacency(mesh)
    assert (neighbour >= 0).all()
    for k in range(3):
        edge = np.sort(mesh.facets[:, [k, (k + 1) % 3]], axis=1)
        others = np.sort(mesh.facets[neighbour[:, k]], axis=1)
        assert all(set(pair) <= set(corners) for pair, corners in zip(edge, others, strict=True))
        assert (neighbour[neighbour[:, k]] == np.arange(len(mesh.facets))[:, None]).any(axis=1).all()


def test_an_open_edge_has_no_neighbour_and_a_crowded_one_is_refused() -> None:
    sheet = TriangleMesh(np.eye(4)[:, :3], np.array([[0, 1, 2], [2, 1, 3]]))
    assert facet_adjacency(sheet).tolist() == [[-1, 1, -1], [0, -1, -1]]
    with pytest.raises(ContractError, match="two facets"):
        facet_adjacency(TriangleMesh(np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 1, 3]])))


def test_faces_of_a_grid_join_or_are_refused() -> None:
    icq = icq_of(1.0, 4)
    joined = icq_adjacency(icq)
    for face in range(6):
        for edge in range(4):
            other, its, _ = joined[face, edge]
            assert joined[other, its, :2].tolist() == [face, edge]
    icq[2, 0, 1] += 1e-9
    with pytest.raises(ContractError, match="no other face"):
        icq_adjacency(icq)
    with pytest.raises(ContractError, match="not square"):
        Shape(mesh_of(icq_of(1.0, 4)), np.zeros((6, 3, 4, 3)))
