"""Common alignment of maplets with a picture that was drawn by a formula."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from pipeline.geometry.maplet import Maplet
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.maplet_images import MapletImageOptions
from pipeline.records import FloatArray
from pipeline.techniques.maplet_alignment import align, light_of
from tests.pipeline.techniques.maplet_scene import maplet_on, picture_of, relief, view_down

SURFACE = relief(5)
SUN = np.array([0.5, 0.3, 0.7])
VIEW = view_down(0.065, 0.2, 0.4, SUN, 130)


def maplets() -> list[Maplet]:
    """Five pieces of the plane."""
    whole = maplet_on(SURFACE, 60, 0.05)
    pieces = []
    for i, j in ((-35, -35), (-35, 35), (0, 0), (35, -35), (35, 35)):
        part = (slice(60 + i - 20, 60 + i + 21), slice(60 + j - 20, 60 + j + 21))
        place = whole.landmark_km + 0.05 * np.array([i, j, 0.0])
        pieces.append(Maplet("A", place, np.eye(3), 0.05, whole.heights[part], whole.albedo[part], np.zeros((3, 3))))
    return pieces


def turned_about(image: FloatArray, pivot: FloatArray, angle: float) -> FloatArray:
    """Picture whose content is turned by an angle, +u toward +v, by nearest pixels of a fine copy."""
    v, u = np.indices(image.shape)
    places = (np.stack([v, u], axis=2) - pivot) @ plane_rotation(-angle).T + pivot
    return np.asarray(map_coordinates(image, places.transpose(2, 0, 1), order=1, mode="nearest"))


@pytest.mark.parametrize("offset", [(0.0, 0.0), (17.0, -23.0)])
def test_offsets_far_beyond_a_single_search_are_found(offset: tuple[float, float]) -> None:
    beta = float(np.exp(-np.degrees(np.arccos(VIEW.sun @ VIEW.position_km / 100.0)) / 60))
    image = picture_of(SURFACE, VIEW, np.array(offset), beta).astype(np.float32)
    found = align(light_of(VIEW, maplets(), MapletImageOptions()), (image, np.ones(image.shape, bool)), (30, 30), 0.0)
    assert found is not None
    assert found.offset_vu == pytest.approx(offset, abs=0.6)
    assert found.correlation > 0.85


def test_a_twist_is_found_with_its_sign() -> None:
    angle_deg = -2.5
    beta = float(np.exp(-np.degrees(np.arccos(VIEW.sun @ VIEW.position_km / 100.0)) / 60))
    cells = light_of(VIEW, maplets(), MapletImageOptions())
    image = picture_of(SURFACE, VIEW, np.zeros(2), beta)
    pivot = (cells.pixels_vu.min(axis=0) + cells.pixels_vu.max(axis=0)) / 2
    turned = turned_about(image, pivot, np.radians(angle_deg)).astype(np.float32)
    found = align(cells, (turned, np.ones(turned.shape, bool)), (10, 10), np.radians(4.0))
    assert found is not None
    assert np.degrees(found.rotation_rad) == pytest.approx(angle_deg, abs=1.3)
    assert found.offset_vu == pytest.approx([0.0, 0.0], abs=1.0)


def test_nothing_to_align_is_told() -> None:
    image = np.full((50, 50), 3.0, np.float32)
    good = np.ones((50, 50), bool)
    assert align(light_of(VIEW, [], MapletImageOptions()), (image, good), (5, 5), 0.0) is None
    cells = light_of(VIEW, maplets(), MapletImageOptions())
    assert align(cells, (image, np.zeros((50, 50), bool)), (5, 5), 0.0) is None
