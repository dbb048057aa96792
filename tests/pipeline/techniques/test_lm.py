"""Lines on distance fields that are known in closed form: what is seen of them, and what is not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from pipeline.records import FloatArray, Image
from pipeline.techniques.lm import TUKEY_C, lm_subpixel_refine, sample, tukey_weight

SHAPE = (160, 180)
V, U = (grid.astype(float) for grid in np.mgrid[: SHAPE[0], : SHAPE[1]])
PIVOT = np.array([80.0, 90.0])


def _turn(theta: float) -> FloatArray:
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def _box(half_v: float, half_u: float, count: int = 80) -> FloatArray:
    """(n, 2) outline of a rectangle about the pivot."""
    t = np.linspace(-1.0, 1.0, count)
    one = np.ones(count)
    sides = [(one * s, t) for s in (-1, 1)] + [(t, one * s) for s in (-1, 1)]
    return np.asarray(PIVOT + np.concatenate([np.stack(side, axis=1) for side in sides]) * [half_v, half_u])


def _box_distance(half_v: float, half_u: float, offset: FloatArray, theta: float) -> Image:
    """Distance to the outline of a turned and moved rectangle."""
    places = (np.stack([V.ravel(), U.ravel()], axis=1) - PIVOT - offset) @ _turn(theta)
    q = np.abs(places) - [half_v, half_u]
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    inside = np.minimum(q.max(axis=1), 0.0)
    return np.asarray(np.abs(outside + inside).reshape(SHAPE), np.float32)


def _circle_distance(centre: FloatArray, radius: float) -> Image:
    return np.asarray(np.abs(np.hypot(V - centre[0], U - centre[1]) - radius), np.float32)


def test_samples_are_bilinear() -> None:
    rng = np.random.default_rng(1)
    image = rng.normal(size=(20, 30)).astype(np.float32)
    places = rng.uniform([0, 0], [19, 29], (100, 2))
    places[0] = [19.0, 29.0]
    assert_allclose(sample(image, places, np.nan), map_coordinates(image, places.T, order=1), atol=1e-5)
    assert np.isnan(sample(image, np.array([[-0.01, 5.0], [5.0, 29.01]]), np.nan)).all()


def test_weights_fall_to_zero_at_tukeys_bound() -> None:
    residual = np.array([0.0, 0.5, 1.0, 2.0]) * TUKEY_C * 0.7
    assert_allclose(tukey_weight(residual, 0.7), [1.0, 0.75**2, 0.0, 0.0], atol=1e-12)
    assert TUKEY_C == 4.685


@pytest.mark.parametrize(("offset", "theta"), [((-1.4, 3.2), 0.03), ((0.6, 0.4), -0.05)])
def test_a_rectangle_shows_offset_and_rotation(offset: tuple[float, float], theta: float) -> None:
    distance = _box_distance(35.0, 50.0, np.array(offset), theta)
    vertices = _box(35.0, 50.0)
    fit = lm_subpixel_refine(distance, vertices, np.ones(len(vertices)), (0.0, 0.0, 0.0), True, PIVOT, 45.0)
    # Between pixels a bilinear valley has a floor; along slanting sides its steps average out.
    assert_allclose(fit.offset_vu, offset, atol=0.06)
    assert fit.rotation_rad == pytest.approx(theta, abs=1.5e-3)
    assert (np.linalg.eigvalsh(fit.covariance) > 0).all()


@pytest.mark.parametrize("offset", [(2.3, -1.7), (-3.45, 0.2)])
def test_along_rows_and_columns_edges_are_whole_pixels(offset: tuple[float, float]) -> None:
    distance = _box_distance(35.0, 50.0, np.array(offset), 0.0)
    vertices = _box(35.0, 50.0)
    fit = lm_subpixel_refine(distance, vertices, np.ones(len(vertices)), (0.0, 0.0, 0.0), False, PIVOT, 45.0)
    assert_allclose(fit.offset_vu, offset, atol=0.5)


def test_outliers_do_not_pull() -> None:
    offset, theta = np.array([1.6, -2.2]), 0.02
    distance = _box_distance(35.0, 50.0, offset, theta)
    vertices = _box(35.0, 50.0)
    wrong = np.arange(len(vertices)) % 5 == 0
    vertices[wrong] += [0.0, 14.0]
    fit = lm_subpixel_refine(distance, vertices, np.ones(len(vertices)), (0.0, 0.0, theta), False, PIVOT, 45.0)
    assert_allclose(fit.offset_vu, offset, atol=0.15)
    # Moved along the upper and lower side a vertex is still on the line.
    lost = wrong & (np.abs(vertices[:, 0] - PIVOT[0]) < 30.0)
    assert fit.weight[lost].max() < 0.1 < 0.9 < fit.weight[~wrong].mean()


def test_a_circle_is_found_and_its_rotation_stays_where_it_began() -> None:
    offset, radius, start = np.array([1.3, -0.8]), 40.0, 0.02
    angle = np.linspace(0.0, 2.0 * np.pi, 240, endpoint=False)
    vertices = PIVOT + radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    distance = _circle_distance(PIVOT + offset, radius)
    fit = lm_subpixel_refine(distance, vertices, np.ones(240), (0.0, 0.0, start), True, PIVOT, radius)
    assert_allclose(fit.offset_vu, offset, atol=0.06)
    # Only the grid's own roughness can turn it, by a fraction of a pixel.
    assert abs(fit.rotation_rad - start) * radius < 0.5


def test_a_straight_line_shows_one_direction() -> None:
    normal, along = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    distance = np.abs((V - PIVOT[0]) * normal[0] + (U - PIVOT[1]) * normal[1] - 1.5).astype(np.float32)
    vertices = PIVOT + np.linspace(-50.0, 50.0, 301)[:, None] * along
    fit = lm_subpixel_refine(distance, vertices, np.ones(301), (0.0, 0.0, 0.0), False, PIVOT, 40.0)
    assert fit.offset_vu @ normal == pytest.approx(1.5, abs=0.05)
    assert abs(fit.offset_vu @ along) < 0.5
    assert normal @ fit.covariance @ normal > 0


def test_a_covariance_is_the_scatter_of_the_answers() -> None:
    """Vertices whose distances to the line scatter: the sigma that is claimed is that of the answers."""
    rng = np.random.default_rng(5)
    radius, scatter, count = 40.0, 0.6, 100
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    normal = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    distance = _circle_distance(PIVOT, radius)
    pulls = []
    for _ in range(60):
        vertices = PIVOT + (radius + rng.normal(0.0, scatter, (count, 1))) * normal
        fit = lm_subpixel_refine(distance, vertices, np.ones(count), (0.5, -0.5, 0.0), False, PIVOT, radius)
        pulls.append(fit.offset_vu / np.sqrt(np.diag(fit.covariance)))
    # Near the line an unsigned distance has little slope: the sigma is on the safe side.
    assert 0.5 < float(np.sqrt(np.mean(np.square(pulls)))) < 1.1


def test_vertices_outside_the_array_do_not_count() -> None:
    offset = np.array([1.0, 2.0])
    distance = _box_distance(35.0, 50.0, offset, 0.0)
    vertices = np.concatenate([_box(35.0, 50.0), np.full((50, 2), -40.0)])
    fit = lm_subpixel_refine(distance, vertices, np.ones(len(vertices)), (0.0, 0.0, 0.0), False, PIVOT, 45.0)
    assert_allclose(fit.offset_vu, offset, atol=0.02)
    assert not fit.weight[-50:].any()
