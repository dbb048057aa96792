"""Camera equations of the SPC navigation document, as corrected, each by a closed form of its own."""

import numpy as np
import pytest

from catalogs.spc_text import Sighting, camera_of, read_picture
from pipeline.camera import distort, project, unproject
from pipeline.records import CameraModel, FloatArray
from tests.scenes.data import DATA, needs_data


def camera(
    k: list[list[float]], eps: tuple[float, ...] = (0.0,) * 6, k_xy: tuple[float, float] = (0.0, 0.0)
) -> CameraModel:
    return CameraModel((1024, 1024), 100.0, np.array(k), np.array([511.5, 500.0]), np.array(eps), np.array(k_xy))


def test_eq_1_5_and_2_2_the_photo_frame_is_positive() -> None:
    pixels, ahead = project(camera([[50.0, 0.0], [0.0, 40.0]]), np.array([[1.0, 2.0, 100.0], [1.0, 2.0, -100.0]]))
    # x = f X/Z = 1 mm to the right, y = 2 mm down.
    assert pixels[0] == pytest.approx([511.5 + 80.0, 500.0 + 50.0])
    assert list(ahead) == [True, False]


@pytest.mark.parametrize("term", range(6))
def test_eq_1_12_to_1_15_each_distortion_by_itself(term: int) -> None:
    x, y, size = 3.0, -4.0, 1e-4
    eps = np.zeros(6)
    eps[term] = size
    radial = np.array([x, y])
    swirl = np.array([-y, x])
    wanted = [25.0 * radial, 625.0 * radial, y * radial, x * radial, 5.0 * swirl, 125.0 * swirl][term]
    moved = distort(camera([[1.0, 0.0], [0.0, 1.0]], tuple(eps)), np.array([[x, y]]))[0] - radial
    assert moved == pytest.approx(size * wanted, rel=1e-12)


def test_eq_1_16_every_entry_of_k_and_the_products_are_used() -> None:
    model = camera([[50.0, 0.7], [-0.3, 40.0]], k_xy=(0.2, -0.1))
    pixel = project(model, np.array([[3.0, -4.0, 100.0]]))[0][0]
    u = 50.0 * 3.0 + 0.7 * -4.0 + 0.2 * -12.0 + 500.0
    v = -0.3 * 3.0 + 40.0 * -4.0 - 0.1 * -12.0 + 511.5
    assert pixel == pytest.approx([v, u])


def fixed_point(model: CameraModel, pixel_vu: FloatArray) -> FloatArray:
    """The printed iteration, which divides by K's diagonal."""
    wanted = (pixel_vu - model.principal_point_vu)[::-1]
    photo = np.zeros(2)
    for _ in range(60):
        off = wanted - model.k_px_per_mm @ distort(model, photo[None])[0]
        photo = np.clip(photo + off / np.diag(model.k_px_per_mm), -1e3, 1e3)
    return photo


def test_eq_3_18_and_3_19_newton_inverts_where_the_printed_iteration_does_not() -> None:
    # A detector turned by 60 degrees behind a lens that stretches corners by a tenth.
    turn = np.radians(60.0)
    k = 50.0 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    model = camera(k.tolist(), (5e-4, 0.0, 1e-4, -2e-4, 1e-4, 0.0))
    pixels = np.random.default_rng(3).uniform(0.0, 1023.0, (500, 2))
    rays, ok = unproject(model, pixels)
    assert ok.all()
    assert np.abs(project(model, rays)[0] - pixels).max() < 1e-8
    photo = fixed_point(model, pixels[0])
    back = project(model, np.array([[*photo, 100.0]]))[0][0]
    assert not np.abs(back - pixels[0]).max() < 1.0


@needs_data
def test_eq_3_22_the_vertex_is_seen_from_the_spacecraft_whatever_the_stored_sign() -> None:
    picture = read_picture((DATA / "spc" / "W46908480918.SUM").read_bytes(), "W46908480918.SUM")
    # SCOBJ runs from the spacecraft to the body, so the vertex less the spacecraft's place is vertex + SCOBJ.
    seen = picture.camera_from_body @ picture.object_km
    pixel = project(camera_of(picture), seen[None])[0][0]
    assert seen[2] > 0.0
    assert all(isinstance(entry, Sighting) for entry in picture.landmarks)
    measured = np.array([entry.values for entry in picture.landmarks])[:, ::-1] - 1.0
    # The body's centre lies amid the landmarks, within their extent.
    assert (pixel > measured.min(axis=0) - np.ptp(measured, axis=0)).all()
    assert (pixel < measured.max(axis=0) + np.ptp(measured, axis=0)).all()
