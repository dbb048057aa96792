"""Whole-pixel searches for an outline among edges: offset, rotation, polarity."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.imaging.edges import EdgeField, edge_field
from pipeline.records import FloatArray
from pipeline.techniques.line_search import search_line

SHAPE = (180, 200)
V, U = (grid.astype(float) for grid in np.mgrid[: SHAPE[0], : SHAPE[1]])
PIVOT = np.array([85.0, 95.0])
AXES = np.array([28.0, 44.0])


def _turn(theta: float) -> FloatArray:
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def _outline(turn_share: float = 0.5, count: int = 220) -> tuple[FloatArray, FloatArray]:
    """Part of an ellipse (half of it, as a lit limb is), and its outward normals."""
    angle = turn_share * np.linspace(-np.pi, np.pi, count)
    unit = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    normal = unit / AXES
    return PIVOT + AXES * unit, normal / np.linalg.norm(normal, axis=1)[:, None]


def _field(offset: tuple[float, float], theta: float, height: float, seed: int = 1) -> EdgeField:
    """Noisy image of the turned and moved ellipse."""
    places = (np.stack([V.ravel(), U.ravel()], axis=1) - PIVOT - offset) @ _turn(theta)
    inside = ((places / AXES) ** 2).sum(axis=1) < 1.0
    image = gaussian_filter(height * inside.reshape(SHAPE), 0.8)
    image = image + np.random.default_rng(seed).normal(0.0, 4.0, SHAPE)
    return edge_field(image.astype(np.float32), np.zeros(SHAPE, bool), np.full(SHAPE, 4.0, np.float32))


@pytest.mark.parametrize("offset", [(0.0, 0.0), (11.0, -17.0), (-19.0, 24.0)])
def test_the_offset_is_found_to_a_pixel(offset: tuple[float, float]) -> None:
    vertices, normals = _outline()
    found = search_line(_field(offset, 0.0, 100.0), vertices, normals, np.ones(len(vertices)), (25.0, 30.0), 0.0, PIVOT)
    assert found[0].offset_vu == pytest.approx(offset, abs=1.0)
    assert found[0].rotation_rad == 0.0
    assert 0.5 < found[0].score <= 1.0
    assert [place.score for place in found] == sorted((place.score for place in found), reverse=True)


@pytest.mark.parametrize("degrees", [-6.0, 2.5, 7.0])
@pytest.mark.parametrize("turn_share", [0.5, 0.99])
def test_so_is_the_rotation(degrees: float, turn_share: float) -> None:
    vertices, normals = _outline(turn_share)
    theta = float(np.radians(degrees))
    field = _field((6.0, -9.0), theta, 100.0)
    bound = float(np.radians(8.0))
    best = search_line(field, vertices, normals, np.ones(len(vertices)), (15.0, 15.0), bound, PIVOT)[0]
    # Half an ellipse trades some offset for rotation: what counts is where its vertices land.
    landed = PIVOT + (vertices - PIVOT) @ _turn(best.rotation_rad).T + best.offset_vu
    truth = PIVOT + (vertices - PIVOT) @ _turn(theta).T + [6.0, -9.0]
    across = ((landed - truth) * (normals @ _turn(theta).T)).sum(axis=1)
    assert float(np.sqrt((across**2).mean())) < 1.0
    if turn_share > 0.9:
        assert best.rotation_rad == pytest.approx(theta, abs=np.radians(2.0))


def test_edges_of_the_wrong_polarity_do_not_count() -> None:
    vertices, normals = _outline()
    ones = np.ones(len(vertices))
    dark, right = (
        search_line(_field((4.0, 3.0), 0.0, height), vertices, normals, ones, (15.0, 15.0), 0.0, PIVOT)
        for height in (-100.0, 100.0)
    )
    assert max((place.score for place in dark), default=0.0) < 0.3 < 0.6 < right[0].score


def test_noise_alone_scores_low() -> None:
    vertices, normals = _outline()
    found = search_line(
        _field((0.0, 0.0), 0.0, 0.0), vertices, normals, np.ones(len(vertices)), (25.0, 30.0), 0.0, PIVOT
    )
    assert not found or found[0].score < 0.15


def test_a_line_that_is_predicted_outside_is_found_inside() -> None:
    vertices, normals = _outline()
    away = np.array([0.0, 150.0])
    found = search_line(
        _field((0.0, 0.0), 0.0, 100.0),
        vertices + away,
        normals,
        np.ones(len(vertices)),
        (10.0, 160.0),
        0.0,
        PIVOT + away,
    )
    assert found[0].offset_vu == pytest.approx((0.0, -150.0), abs=1.0)
