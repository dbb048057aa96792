"""Edges of images: their direction, their strength against noise, and distances to them."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.imaging.edges import distance_to_edges, edge_field
from pipeline.records import BoolArray, Image

SHAPE = (90, 100)
NONE: BoolArray = np.zeros(SHAPE, bool)


def _step(angle_deg: float, distance: float, height: float = 100.0) -> Image:
    """Blurred half-plane, bright behind a line; the normal points out of it."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    normal = np.array([np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))])
    beyond = (v - 45.0) * normal[0] + (u - 50.0) * normal[1] - distance
    return np.asarray(gaussian_filter(height * np.clip(0.5 - beyond, 0.0, 1.0), 0.7), np.float32)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 45.0, 110.0, 200.0, 315.0])
def test_gradients_point_to_the_light_and_edges_lie_on_the_line(angle_deg: float) -> None:
    distance = 3.3
    field = edge_field(_step(angle_deg, distance), NONE, np.full(SHAPE, 1.0, np.float32))
    normal = np.array([np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))])
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    beyond = (v - 45.0) * normal[0] + (u - 50.0) * normal[1] - distance
    middle = np.zeros(SHAPE, bool)
    middle[25:65, 30:70] = True
    on_line = middle & (np.abs(beyond) < 0.5)
    along = field.along_v[on_line] * normal[0] + field.along_u[on_line] * normal[1]
    assert (along < -0.8).all()
    assert np.hypot(field.along_v, field.along_u).max() <= 1.0
    away = distance_to_edges(field, 5.0)
    # Edges are whole pixels, of a slanting line up to two side by side: as much nearer on both sides.
    assert np.abs(away - np.abs(beyond))[middle].max() < 1.0
    sides = [float((away - np.abs(beyond))[middle & side].mean()) for side in (beyond > 2.0, beyond < -2.0)]
    assert abs(sides[0] - sides[1]) / 2.0 <= 0.35


def test_noise_alone_has_the_strength_that_is_claimed_for_it() -> None:
    rng = np.random.default_rng(1)
    image = rng.normal(0.0, 5.0, (400, 400)).astype(np.float32)
    field = edge_field(image, np.zeros(image.shape, bool), np.full(image.shape, 5.0, np.float32))
    inner = field.strength[10:-10, 10:-10]
    # Two components of unit variance each: differences of neighbours lose a tenth of a continuous filter's.
    assert float(np.sqrt((inner**2).mean() / 2.0)) == pytest.approx(0.85, abs=0.1)
    assert (distance_to_edges(field, 6.0) == 400.0).all()


def test_a_strong_edge_in_noise_is_found_and_a_weak_one_is_not() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 5.0, SHAPE)
    sigma = np.full(SHAPE, 5.0, np.float32)
    strong = edge_field((_step(0.0, 0.0) + noise).astype(np.float32), NONE, sigma)
    weak = edge_field((_step(0.0, 0.0, 3.0) + noise).astype(np.float32), NONE, sigma)
    assert float(np.median(distance_to_edges(strong, 6.0)[20:70, 50])) <= 1.0
    assert (distance_to_edges(weak, 6.0) == max(SHAPE)).all()


def test_no_edge_is_seen_around_missing_pixels() -> None:
    image = np.full(SHAPE, 50.0, np.float32)
    bad = NONE.copy()
    bad[40:50, 40:50] = True
    image[bad] = 0.0
    field = edge_field(image, bad, np.full(SHAPE, 1.0, np.float32))
    assert float(field.strength.max()) < 1e-3
    assert (distance_to_edges(field, 3.0) == max(SHAPE)).all()


def test_an_edge_goes_on_beside_a_gap() -> None:
    image, bad = _step(0.0, 0.0), NONE.copy()
    bad[44:47] = True
    image[bad] = -5.0
    field = edge_field(image, bad, np.full(SHAPE, 1.0, np.float32))
    away = distance_to_edges(field, 8.0)
    assert float(away[51, 20:80].min()) <= 1.0
    assert not field.strength[43:48].any()
    # Far from the step the gap draws no edge of its own.
    assert float(away[40:50, 10:20].min()) > 20.0
