"""The tree of boxes against brute force and against the document's algorithm, on a body with a deep hole."""

import pickle

import numpy as np
import pytest

from catalogs.shapes import read_solid
from pipeline.errors import ContractError
from pipeline.geometry.patches import first_patch_hit
from pipeline.geometry.rays import RayTree, cast, make_tree, tree_of_mesh, tree_of_shape
from pipeline.geometry.shape import Shape, icq_cells
from pipeline.records import FloatArray
from tests.pipeline.geometry.test_shape import icq_of, mesh_of
from tests.scenes.data import DATA, needs_data

ICQ = icq_of(10.0, 24, 0.6)
SHAPE = Shape(mesh_of(ICQ), ICQ)


def rays_at(shape: Shape, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Starts around and near the surface, a third in its hollows, toward points in and beside the body."""
    rng = np.random.default_rng(seed)
    size = shape.diameter_km / 2
    start = rng.normal(size=(count, 3))
    start *= (size * rng.uniform(0.3, 3.0, count) / np.linalg.norm(start, axis=1))[:, None]
    target = rng.normal(size=(count, 3)) * size * 0.6
    direction = target - start
    return start, np.asarray(direction / np.linalg.norm(direction, axis=1)[:, None])


def brute(corners: FloatArray, origin: FloatArray, direction: FloatArray) -> float:
    """Distance to the nearest triangle by solving each plane's 3 x 3 system."""
    a, b, c = (corners[:, k] for k in range(3))
    matrix = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=2)
    usable = np.abs(np.linalg.det(matrix)) > 1e-300
    u, v, t = np.linalg.solve(matrix[usable], (origin - a[usable])[..., None])[..., 0].T
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return float(t[inside].min(initial=np.inf))


def test_triangles_agree_with_brute_force() -> None:
    start, direction = rays_at(SHAPE, 400, 1)
    distance, facet = cast(tree_of_mesh(SHAPE.mesh), start, direction)
    corners = SHAPE.mesh.vertices_km[SHAPE.mesh.facets]
    expected = np.array([brute(corners, s, d) for s, d in zip(start, direction, strict=True)])
    assert (np.isfinite(expected)).mean() > 0.5
    assert distance == pytest.approx(expected, abs=1e-6 * SHAPE.diameter_km)
    hit = facet >= 0
    assert np.array_equal(hit, np.isfinite(distance))
    only = np.array([brute(corners[[f]], s, d) for f, s, d in zip(facet[hit], start[hit], direction[hit], strict=True)])
    assert only == pytest.approx(distance[hit], abs=1e-9)


def test_patches_agree_with_the_document() -> None:
    start, direction = rays_at(SHAPE, 1500, 2)
    cells = icq_cells(ICQ)
    distance, cell = cast(tree_of_shape(SHAPE), start, direction)
    expected = [first_patch_hit(cells, s, d) for s, d in zip(start, direction, strict=True)]
    assert distance == pytest.approx(np.array([e[0] for e in expected]), abs=1e-6 * SHAPE.diameter_km)
    # A ray through a common edge belongs to either cell.
    assert (cell == [e[1] for e in expected]).mean() > 0.999


def test_a_hollow_is_seen_twice() -> None:
    """From inside the crater a ray out through its wall meets the body again only where it is concave."""
    tree = tree_of_shape(SHAPE)
    floor = np.array([[0.0, 0.0, 4.5]])
    up, across = np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]])
    assert not np.isfinite(cast(tree, floor, up)[0]).any()
    assert np.isfinite(cast(tree, floor, across)[0]).all()


def test_rays_along_axes_and_through_vertices_do_not_slip_through() -> None:
    tree = tree_of_mesh(SHAPE.mesh)
    toward = SHAPE.mesh.vertices_km
    direction = -toward / np.linalg.norm(toward, axis=1)[:, None]
    assert np.isfinite(cast(tree, 3.0 * toward, direction)[0]).all()
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    assert np.isfinite(cast(tree, -30.0 * axes, axes)[0]).all()


def test_few_primitives_and_many_in_one_place() -> None:
    triangle = np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], float)
    ray = (np.array([[0.0, 0, -3]]), np.array([[0.0, 0, 1]]))
    assert cast(make_tree(triangle), *ray)[0] == pytest.approx([3.0])
    # A geometric row of sizes makes area splits lopsided.
    stacked = np.concatenate([triangle * 0.7**k + np.array([0, 0, 0.7**k]) for k in range(300)])
    assert cast(make_tree(stacked), *ray)[0] == pytest.approx([3.0 + 0.7**299])
    assert cast(make_tree(np.repeat(triangle, 1000, axis=0)), *ray)[0] == pytest.approx([3.0])
    with pytest.raises(ContractError, match="three or four"):
        make_tree(np.zeros((2, 5, 3)))


def test_a_pickled_tree_is_still_read_only() -> None:
    tree: RayTree = pickle.loads(pickle.dumps(tree_of_mesh(SHAPE.mesh)))
    assert not tree.boxes.flags.writeable
    assert tree.boxes.dtype == np.float32


@needs_data
@pytest.mark.parametrize(("reach_km", "grazing"), [(25.0, False), (130.0, True)])
def test_the_two_families_differ_by_the_twist_of_phoebes_cells(reach_km: float, grazing: bool) -> None:
    shape = read_solid((DATA / "phoebe" / "phoebe_ICQ_Q64.TXT").read_bytes(), "phoebe")
    rng = np.random.default_rng(3)
    start = rng.normal(size=(100_000, 3))
    start *= 800.0 / np.linalg.norm(start, axis=1)[:, None]
    direction = rng.uniform(-1.0, 1.0, start.shape) * reach_km / np.sqrt(3.0) - start
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    patches, cell = cast(tree_of_shape(shape), start, direction)
    triangles, facet = cast(tree_of_mesh(shape.mesh), start, direction)
    both = np.isfinite(patches) & np.isfinite(triangles)
    assert both.mean() > 0.98
    share = np.abs(patches[both] - triangles[both]) / shape.diameter_km
    assert 0 < np.median(share) < 8.6e-5
    # Cells of a face are cut along one diagonal each: first all first halves, then all second ones.
    per_face = len(shape.mesh.facets) // 12
    same = (facet // (2 * per_face) * per_face + facet % per_face == cell)[both]
    assert same.mean() > 0.9999
    if not grazing:
        assert share.max() < 1.4e-3
        return
    # A slanting ray stretches what parts the two surfaces; across them it is the twist of a cell.
    corners = shape.mesh.vertices_km[shape.mesh.facets[facet[both]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = share * np.abs((normal * direction[both]).sum(axis=1)) / np.linalg.norm(normal, axis=1)
    cells = icq_cells(np.asarray(shape.icq_km))
    twist = np.linalg.norm(cells[:, 0] - cells[:, 1] + cells[:, 2] - cells[:, 3], axis=1) / 4.0 / shape.diameter_km
    assert across[same].max() < twist.max()
