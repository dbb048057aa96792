"""Maplets cut from bodies whose surface is known in closed form."""

import numpy as np
import pytest

from pipeline.geometry.cutting import cut_maplet, frame_about, spread_landmarks
from pipeline.geometry.maplet import Maplet, cell_normals, index_of, maplet_points_km, vertex_radius_km
from pipeline.geometry.rays import tree_of_mesh
from pipeline.records import FloatArray
from tests.pipeline.geometry.test_shape import icq_of, mesh_of

MESH = mesh_of(icq_of(10.0, 64))
TREE = tree_of_mesh(MESH)


def on_ball(direction: FloatArray) -> FloatArray:
    return np.asarray(10.0 * direction / np.linalg.norm(direction))


@pytest.mark.parametrize("direction", [[1.0, 2.0, 3.0], [0.0, 0.0, 1.0], [-1.0, 0.2, 0.0]])
def test_a_maplet_of_a_ball_is_its_cap(direction: list[float]) -> None:
    point = on_ball(np.array(direction))
    tilted = point / 10.0 + np.array([0.3, -0.2, 0.1])
    maplet = cut_maplet(TREE, (point, tilted / np.linalg.norm(tilted)), 20, 0.1, "A", 0.05)
    assert maplet.maplet_from_body[2] @ point / 10.0 > 0.999
    assert maplet.heights[20, 20] == pytest.approx(0.0, abs=1e-12)
    # Facets lie up to (cell / radius)^2 / 8 of the radius below the sphere.
    radii = np.linalg.norm(maplet_points_km(maplet), axis=2)
    assert radii == pytest.approx(np.full_like(radii, 10.0), abs=0.004)
    assert maplet.covariance_km2 == pytest.approx(np.eye(3) * 0.0025)


def test_frames_are_right_handed_with_east_along_y() -> None:
    for normal in ([0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]):
        frame = frame_about(np.array(normal))
        assert frame @ frame.T == pytest.approx(np.eye(3))
        assert np.linalg.det(frame) == pytest.approx(1.0)
    assert frame_about(np.array([0.6, 0.0, 0.8]))[1] == pytest.approx([0.0, 1.0, 0.0])


def test_beyond_the_edge_there_is_no_height() -> None:
    maplet = cut_maplet(TREE, (on_ball(np.array([0.0, 0, 1])), np.array([0.0, 0, 1])), 20, 0.7, "A", 0.0)
    x = np.hypot(*np.meshgrid(np.arange(-20, 21), np.arange(-20, 21))) * 0.7
    # A grid wider than the ball may settle on a slightly tilted normal.
    assert np.isnan(maplet.heights[x > 10.5]).all()
    assert np.isfinite(maplet.heights[x < 9.5]).all()


def test_landmarks_are_spread_by_area() -> None:
    # A body whose facets are eight times finer on one side.
    icq = icq_of(1.0, 40)
    points, facets = spread_landmarks(mesh_of(icq * np.array([1.0, 1.0, 3.0])), 2000)
    assert len(np.unique(facets)) > 1500
    corners = mesh_of(icq * np.array([1.0, 1.0, 3.0]))
    triangles = corners.vertices_km[corners.facets]
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    for low, high in ((-3, -2), (-2, -1), (0, 0.5), (2.5, 3)):
        middle = triangles.mean(axis=1)[:, 2]
        share = areas[(middle >= low) & (middle < high)].sum() / areas.sum()
        assert ((points[:, 2] >= low) & (points[:, 2] < high)).mean() == pytest.approx(share, abs=0.01)
    away = np.linalg.norm(points[:, None] - points[None], axis=2) + 9 * np.eye(2000)
    mean_spacing = np.sqrt(areas.sum() / 2 / 2000)
    assert np.median(away.min(axis=1)) > 0.4 * mean_spacing


def test_eq_3_37_normals_of_a_tilted_plane_and_at_gaps() -> None:
    i, j = np.meshgrid(np.arange(9.0), np.arange(9.0), indexing="ij")
    heights = 0.3 * i - 0.2 * j
    heights[4, 4] = np.nan
    normals = cell_normals(heights)
    expected = np.array([-0.3, 0.2, 1.0]) / np.linalg.norm([-0.3, 0.2, 1.0])
    known = np.isfinite(heights)
    assert normals[known] == pytest.approx(np.broadcast_to(expected, (80, 3)))
    assert np.isnan(normals[4, 4]).all()


def test_eq_3_46_and_3_67_heights_run_along_x_first() -> None:
    heights = np.zeros((5, 5))
    heights[4, 0] = 2.0
    axes = np.array([[0.0, 1, 0], [0.0, 0, 1], [1.0, 0, 0]])
    maplet = Maplet("A", np.array([1.0, 2, 3]), axes, 0.1, heights, np.ones((5, 5)), np.eye(3))
    assert maplet_points_km(maplet)[4, 0] == pytest.approx([1.2, 2.2, 2.8])
    assert vertex_radius_km(maplet) == pytest.approx(0.1 * np.sqrt(12.0))
    assert index_of([maplet]).side_km == pytest.approx([0.5])
