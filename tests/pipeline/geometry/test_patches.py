"""The document's ray casting, equation by equation, with the corrections that it needs."""

from itertools import combinations

import numpy as np
import pytest

from pipeline.geometry.patches import (
    first_patch_hit,
    is_convex,
    is_pierced,
    longest_span,
    near_cells,
    patch_roots,
    tilde_frame,
)
from pipeline.records import FloatArray


def at(x: float, y: float, z: float) -> FloatArray:
    return np.array([x, y, z])


def unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def point_of(corners: FloatArray, iota: float, gamma: float) -> FloatArray:
    one, two, three, four = corners
    low, high = one + gamma * (two - one), four + gamma * (three - four)
    return np.asarray(low + iota * (high - low))


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [-1.0, 0, 0], [0.0, 0, 1], [0.3, -0.5, 0.8]])
def test_eq_3_21_tilde_frame_is_right_handed_about_the_ray(direction: list[float]) -> None:
    axes = tilde_frame(unit(np.array(direction)))
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes @ unit(np.array(direction)) == pytest.approx([0, 0, 1], abs=1e-15)


def test_eq_3_24_longest_span_can_be_a_side() -> None:
    # Three corners at one end: the long sides are longer than both diagonals.
    cell = np.array([[[0, 0, 0], [10, 0, 0], [9, 0.5, 0], [1, 0.5, 0]]], float)
    diagonals = [float(np.linalg.norm(cell[0, i] - cell[0, j])) for i, j in ((0, 2), (1, 3))]
    assert longest_span(cell) == 10.0 > max(diagonals)


def test_eq_3_25_no_pierced_cell_is_thrown_away() -> None:
    rng = np.random.default_rng(11)
    cells = rng.normal(size=(4000, 4, 3)) + at(0, 0, 9)
    inside = np.array([bool(patch_roots(cell)) for cell in cells])
    assert inside.sum() > 300
    assert near_cells(cells, longest_span(cells))[inside].all()
    far = cells + at(2.0 * longest_span(cells), 0, 0)
    assert not near_cells(far, longest_span(cells)).any()


def test_eq_3_26_both_windings_are_pierced() -> None:
    cell = np.array([[[-1, -1, 5], [1, -1, 5], [1, 1, 5], [-1, 1, 5]]], float)
    assert is_pierced(cell).all()
    assert is_pierced(cell[:, ::-1]).all()
    assert not is_pierced(cell + at(1.5, 0, 0)).any()


def test_eq_3_26_a_non_convex_cell_fails_the_cross_products_though_it_is_hit() -> None:
    # An arrow head: the ray passes between its barbs and the third corner.
    cell = np.array([[-1, -1, 5], [0, -0.2, 5], [1, -1, 5.5], [0, 2, 5]], float) - at(0.25, 0.5, 0)
    assert not is_convex(cell[None]).any()
    found, index = first_patch_hit(cell[None], np.zeros(3), np.array([0.0, 0, 1]))
    assert index == 0
    assert 5.0 <= found <= 5.5


def test_eq_3_29_to_3_35_every_planted_point_is_found() -> None:
    rng = np.random.default_rng(11)
    for _ in range(2000):
        corners = rng.normal(size=(4, 3)) + at(0, 0, 20)
        iota, gamma = rng.uniform(0.001, 0.999, 2)
        target = point_of(corners, iota, gamma)
        roots = patch_roots(corners - at(target[0], target[1], 0.0))
        assert any(np.allclose(root, [iota, gamma, target[2]], atol=1e-6) for root in roots)
        assert all(first[2] <= second[2] for first, second in combinations(roots, 2))


def test_eq_3_31_a_parallelogram_has_no_square_term() -> None:
    corners = np.array([[-1, -1, 3], [-1, 2, 3], [2, 2, 6], [2, -1, 6]], float)
    ((iota, gamma, depth),) = patch_roots(corners)
    assert [iota, gamma, depth] == pytest.approx([1 / 3, 1 / 3, 4.0])


def test_eq_3_32_the_other_denominator_is_taken_where_one_vanishes() -> None:
    # X2 = X3 = 0: gamma runs along y alone.
    corners = np.array([[-1, -1, 3], [-1, 3, 3], [2, 3, 3], [2, -1, 3]], float)
    ((iota, gamma, _),) = patch_roots(corners)
    assert [iota, gamma] == pytest.approx([1 / 3, 0.25])
    turned = corners[:, [1, 0, 2]]
    assert len(patch_roots(turned)) == 1


def test_what_lies_behind_is_not_hit_and_the_nearest_is() -> None:
    cell = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    cells = np.stack([cell + at(0, 0, z) for z in (-2.0, 7.0, 4.0)])
    distance, index = first_patch_hit(cells, np.zeros(3), np.array([0.0, 0, 1]))
    assert (distance, index) == (4.0, 2)
    assert first_patch_hit(cells, np.array([5.0, 0, 0]), np.array([0.0, 0, 1])) == (np.inf, -1)
