"""Lines of expected ring edges in pictures, against circles and ellipses known in closed form."""

import numpy as np
import pytest

from catalogs.ring_catalog import RingCatalog, parse_rings
from pipeline.json_values import Json
from pipeline.records import FloatArray
from workflows.picture_canvas import SKY, Canvas
from workflows.picture_marks import draw_marks
from workflows.picture_rings import expected_edges

DISTANCE_KM, RADIUS_KM, EDGE_KM = 1.0e6, 1000.0, 2500.0
FOCAL_PX = 100_000.0
SIDE = 801


@pytest.fixture(scope="module")
def catalog() -> RingCatalog:
    text = f"""
planet: HOST
epoch_utc: "2000-01-01T12:00:00"
features:
- {{name: rim, kind: edge_outer, a_km: {EDGE_KM}, sigma_a_km: 1.0, tau: 1.0}}
- {{name: band, kind: ringlet, a_km: 1500.0, width_km: 100.0, sigma_a_km: 1.0, tau: 1.0}}
"""
    return parse_rings(text, "rings.yaml")


def document(opening_deg: float, focal_px: float = FOCAL_PX, aside_px: float = 0.0) -> dict[str, Json]:
    """Planet in the middle of the image, or aside of it along u; its pole leans from up toward the camera."""
    b = np.radians(opening_deg)
    # Ring axes in camera axes (x right, y down, z ahead): x to the right, pole up and toward the camera.
    body_from_camera = np.array([[1, 0, 0], [0, np.sin(b), np.cos(b)], [0, -np.cos(b), -np.sin(b)]])
    body_from_camera[1] = np.cross(body_from_camera[2], body_from_camera[0])
    place = np.array([aside_px / focal_px, 0.0, 1.0]) * DISTANCE_KM
    body: dict[str, Json] = {
        "name": "HOST", "naif_id": 1, "radii_km": [RADIUS_KM] * 3,
        "camera_in_body_km": (-body_from_camera @ place).tolist(),
        "body_from_j2000_wxyz": quaternion(body_from_camera),
    }  # fmt: skip
    camera: dict[str, Json] = {
        "shape_vu": [SIDE, SIDE], "focal_length_mm": focal_px, "k_px_per_mm": [[1.0, 0.0], [0.0, 1.0]],
        "principal_point_vu": [400.0, 400.0], "distortion_eps": [0.0] * 6, "k_xy_px_per_mm2": [0.0, 0.0],
    }  # fmt: skip
    fates: list[Json] = [{"name": name, "left_out": ""} for name in ("rim", "band")]
    return {
        "et": 0.0, "rings": fates, "ring_edges": None, "bodies": [], "techniques": [], "landmarks": None,
        "geometry": {"camera_model": camera, "bodies": [body]},
        "pointing": {"a_priori_camera_from_j2000_wxyz": [1.0, 0.0, 0.0, 0.0]},
    }  # fmt: skip


def quaternion(matrix: FloatArray) -> list[Json]:
    w = np.sqrt(max(1.0 + np.trace(matrix), 1e-12)) / 2
    anti = (matrix - matrix.T) / (4 * w)
    return [float(w), float(anti[2, 1]), float(anti[0, 2]), float(anti[1, 0])]


def test_an_edge_is_the_ellipse_that_perspective_makes_of_it(catalog: RingCatalog) -> None:
    lines = expected_edges(document(30.0), [catalog])
    assert [name for name, _ in lines] == ["rim", "band", "band"]
    places = lines[0][1] - 400.0
    seen = places[np.isfinite(places).all(axis=1)]
    semi = FOCAL_PX * EDGE_KM / DISTANCE_KM
    # Perspective changes an ellipse of this size by a few thousandths.
    form = np.hypot(seen[:, 1] / semi, seen[:, 0] / (semi * np.sin(np.radians(30.0))))
    np.testing.assert_allclose(form, 1.0, atol=0.006)
    assert seen[:, 1].max() > 0.99 * semi
    assert seen[:, 1].min() < -0.99 * semi
    gaps = np.hypot(*np.diff(seen, axis=0).T)
    assert np.median(gaps) < 8.0


def test_the_planet_hides_the_far_side_alone(catalog: RingCatalog) -> None:
    inner = expected_edges(document(20.0), [catalog])[1][1] - 400.0
    seen = inner[np.isfinite(inner).all(axis=1)]
    disc = FOCAL_PX * RADIUS_KM / DISTANCE_KM
    covering = seen[np.hypot(*seen.T) < 0.98 * disc]
    # What lies on the disc is the near side, below the centre where the pole leans to the camera.
    assert len(covering) > 10
    assert (covering[:, 0] > 0).all()


def test_a_close_look_has_the_line_through_the_field(catalog: RingCatalog) -> None:
    # The rim's right end in the middle of the image, at 20 m a pixel: 0.7 % of the ring is in the field.
    focal = 50.0 * DISTANCE_KM
    places = expected_edges(document(30.0, focal, aside_px=-EDGE_KM * focal / DISTANCE_KM), [catalog])[0][1]
    inside = places[((places >= 0) & (places < SIDE)).all(axis=1)]
    assert inside[:, 0].min() < 30
    assert inside[:, 0].max() > SIDE - 30
    assert np.diff(np.sort(inside[:, 0])).max() < 60


def test_what_was_not_looked_for_or_is_unknown_is_not_drawn(catalog: RingCatalog) -> None:
    said = document(30.0)
    fates: list[Json] = [{"name": "rim", "left_out": "outside_field"}, {"name": "band", "left_out": ""}]
    assert [name for name, _ in expected_edges({**said, "rings": fates}, [catalog])] == ["band", "band"]
    assert expected_edges(said, []) == []
    assert expected_edges({**said, "rings": []}, [catalog]) == []


def test_the_lines_are_in_the_picture_and_its_key(catalog: RingCatalog) -> None:
    said = document(30.0)
    canvas = Canvas(np.zeros((SIDE, SIDE, 3), np.uint8), (0, 0), 1.0)
    keys = draw_marks(canvas, said, (SIDE, SIDE), expected_edges(said, [catalog]))
    assert [key.label for key in keys] == ["ring edge predicted (3)"]
    blue = np.argwhere((np.abs(canvas.pixels.astype(int) - SKY) < 30).all(axis=2))
    # Names stand to the right of their edges.
    assert blue[:, 1].min() == pytest.approx(400 - FOCAL_PX * EDGE_KM / DISTANCE_KM, abs=2)
    assert not draw_marks(canvas, said, (SIDE, SIDE))
