import numpy as np
import pytest

from pipeline.geometry.pointing import move_pivot
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.edges import distance_to_edges, edge_field
from pipeline.records import CameraModel, FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import about, compose, predicted_place, rotation_shows, settle, turn_lever
from pipeline.techniques.contour_fit import Segments
from pipeline.techniques.lm import lm_subpixel_refine
from pipeline.techniques.relief import Field_, ReliefOptions, fit_relief

CAMERA = CameraModel((200, 220), 1000.0, np.diag([100.0, 100.0]), np.array([99.5, 109.5]))
CONTEXT = NavContext(CAMERA, np.eye(3), True, 5.0, (20.0, 20.0))


def _circle(count: int, radius: float, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    angle = np.linspace(0.0, np.pi, count)
    normal = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return centre + radius * normal, normal


def test_a_composed_step_is_the_product_of_similarities() -> None:
    offset, rotation, pivot, step = np.array([3.0, -7.0]), 0.03, np.array([40.0, 150.0]), np.array([0.4, -0.2, 0.01])
    places = np.array([[10.0, 20.0], [150.0, 33.0], [99.0, 180.0]])
    centre = CAMERA.centre_vu
    first = centre + offset + (places - centre) @ plane_rotation(rotation).T
    expected = pivot + step[:2] + (first - pivot) @ plane_rotation(step[2]).T
    new, turned = compose(CONTEXT, offset, rotation, pivot, step)
    assert centre + new + (places - centre) @ plane_rotation(turned).T == pytest.approx(expected, abs=1e-9)


def test_a_reported_pivot_carries_the_answer() -> None:
    offset, rotation, seen = np.array([3.0, -7.0]), 0.03, np.array([40.0, 150.0])
    pivot = predicted_place(CONTEXT, offset, rotation, seen)
    assert pivot + about(CONTEXT, offset, rotation, pivot) == pytest.approx(seen, abs=1e-9)
    back = move_pivot(about(CONTEXT, offset, rotation, pivot), rotation, pivot, CAMERA.centre_vu)[0]
    assert back == pytest.approx(offset, abs=1e-9)


def test_half_a_circle_does_not_show_a_rotation_and_is_known_at_its_centre() -> None:
    centre = np.array([90.0, 120.0])
    places, normal = _circle(80, 50.0, centre)
    pivot = places.mean(axis=0)
    design = np.column_stack([normal, (normal * turn_lever(places, pivot)).sum(axis=1)])
    information = design.T @ design / 0.1**2
    assert not rotation_shows(information, CONTEXT)
    settled = settle(information, pivot, CONTEXT)
    assert not settled.observed
    assert settled.pivot_vu == pytest.approx(centre, abs=1e-6)
    assert not settled.information[2].any()


def test_a_long_line_with_corners_shows_it() -> None:
    rng = np.random.default_rng(3)
    places, normal = rng.uniform(0, 200, (60, 2)), rng.normal(size=(60, 2))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    design = np.column_stack([normal, (normal * turn_lever(places, places.mean(axis=0))).sum(axis=1)])
    assert rotation_shows(design.T @ design / 0.1**2, CONTEXT)


def test_a_line_is_brought_onto_the_edges() -> None:
    v, u = np.mgrid[:200, :220].astype(float)
    turn, shift = 0.02, np.array([4.3, -3.6])
    pivot = np.array([100.0, 100.0])
    corners = np.array([[60.0, 60.0], [60.0, 150.0], [140.0, 150.0], [140.0, 60.0]])
    sides = [a + (b - a) * t for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
             for t in np.linspace(0.02, 0.98, 60)[:, None]]  # fmt: skip
    vertices = np.array(sides).reshape(-1, 2)
    # The image's rectangle is the predicted one, turned and moved.
    back = (np.stack([v.ravel(), u.ravel()], axis=1) - pivot - shift) @ plane_rotation(turn) + pivot
    inside = (back > corners.min(axis=0)).all(axis=1) & (back < corners.max(axis=0)).all(axis=1)
    image = (100.0 * inside.reshape(v.shape)).astype(np.float32)
    field = edge_field(image, np.zeros(image.shape, bool), np.ones(image.shape, np.float32))
    lines = distance_to_edges(field, 5.0)
    fit = lm_subpixel_refine(lines, vertices, np.ones(len(vertices)), (2.0, -2.0, 0.0), True, pivot, 60.0)
    assert fit.offset_vu == pytest.approx(shift, abs=0.4)
    assert fit.rotation_rad == pytest.approx(turn, abs=0.004)
    assert (np.linalg.eigvalsh(fit.covariance) > 0).all()


def test_relief_gives_sigmas_that_hold() -> None:
    rng = np.random.default_rng(8)
    angle = np.linspace(0.0, np.pi, 90)
    normal = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    direction = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    gap = np.arccos(np.clip(direction @ direction.T, -1.0, 1.0))
    rms, reach = 0.3, 6.0
    root = np.linalg.cholesky(rms**2 * np.exp(-gap / np.radians(reach)) + 1e-9 * np.eye(90))
    pulls = []
    for _ in range(60):
        shift = root @ rng.normal(size=90) + rng.normal(0.0, 0.05, 90) + normal @ np.array([0.4, -0.3])
        segments = Segments(
            50.0 * normal, normal, direction, np.zeros(90, np.int64), shift, np.full(90, 0.05), np.full(90, 20.0),
            np.ones(90, bool), np.array([0.0, 1.0]), np.array([1e-6, 0.0]),
        )  # fmt: skip
        fit = fit_relief(segments, None, {0: Field_(rms, reach, True, rms)}, ReliefOptions())
        sigma = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        pulls.append((fit.step - [0.4, -0.3]) / sigma)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.25


def test_a_function_of_distance_that_is_no_covariance_ends_no_fit() -> None:
    angle = np.linspace(0.0, np.pi, 60)
    normal = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    direction = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    # Even up to 40 px and then gone: its matrix has negative eigenvalues beyond the noise.
    lags, texture = np.array([0.0, 40.0, 40.1]), np.array([1.0, 1.0, 0.0])
    shift = normal @ np.array([0.4, -0.3])
    segments = Segments(
        50.0 * normal, normal, direction, np.zeros(60, np.int64), shift, np.full(60, 0.01), np.full(60, 20.0),
        np.ones(60, bool), lags, texture,
    )  # fmt: skip
    fit = fit_relief(segments, None, {0: Field_(0.02, 6.0, True, 0.02)}, ReliefOptions())
    assert np.allclose(fit.step, [0.4, -0.3], atol=0.05)
    assert (np.linalg.eigvalsh(fit.information) > 0).all()
