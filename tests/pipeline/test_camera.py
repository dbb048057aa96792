"""Owen camera against the printed formulas written a second time, numerical derivatives and its own inverse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.camera import (
    UNPROJECT_TOLERANCE_PX,
    distort,
    distort_jacobian,
    field_of_view,
    pixel_scale_rad,
    project,
    project_jacobian,
    unproject,
    unproject_jacobian,
)
from pipeline.records import CameraModel, FloatArray

SHAPE = (400, 600)
FOCAL_MM = 60.0
PX_PER_MM = 50.0
# Array corner on the photo plane: half of 400 x 600 pixels at 50 px/mm.
CORNER_MM = float(np.hypot(4.0, 6.0))
STRONG = np.array([-1.5e-3, 4e-6, 2e-3, -1.5e-3, 1e-3, -1e-5])
NO_DISTORTION = np.zeros(6)


def _k(angle_deg: float, mirrored: bool, stretch: float = 1.0) -> FloatArray:
    """Photo-plane axes turned by an angle, one of them mirrored or longer."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned = np.array([[c, -s], [s, c]]) @ np.diag([stretch, -1.0 if mirrored else 1.0])
    return PX_PER_MM * turned


def _camera(
    k: FloatArray | None = None, eps: FloatArray = STRONG, k_xy: tuple[float, float] = (0.0, 0.0)
) -> CameraModel:
    k = _k(0.0, False) if k is None else k
    return CameraModel(SHAPE, FOCAL_MM, k, np.array([190.0, 310.0]), eps, np.array(k_xy))


CAMERAS = {
    "pinhole": _camera(eps=NO_DISTORTION),
    "distorted": _camera(),
    "mirrored": _camera(_k(0.0, True)),
    "half turn": _camera(_k(180.0, False)),
    "rotated": _camera(_k(57.0, False, 1.02)),
    "rotated and mirrored": _camera(_k(-130.0, True)),
    "product term": _camera(_k(10.0, False), k_xy=(0.02, -0.03)),
    "product term alone": _camera(eps=NO_DISTORTION, k_xy=(0.05, 0.02)),
}
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def _outline_and_inside(count: int = 200) -> FloatArray:
    rng = np.random.default_rng(1)
    corners = np.array([[v, u] for v in (-0.5, SHAPE[0] - 0.5) for u in (-0.5, SHAPE[1] - 0.5)])
    return np.concatenate([corners, rng.uniform(-0.5, np.array(SHAPE) - 0.5, (count, 2))])


def _printed_model(camera: CameraModel, point: FloatArray) -> tuple[float, float]:
    """Eq. 1.12-1.16 for one point in complex numbers: the pinwheel is a multiple of i times the point."""
    e1, e2, e3, e4, e5, e6 = camera.distortion_eps
    z = camera.focal_length_mm * complex(point[0], point[1]) / point[2]
    r = abs(z)
    d = z * (1 + e1 * r**2 + e2 * r**4 + e3 * z.imag + e4 * z.real) + 1j * z * (e5 * r + e6 * r**3)
    (kx, kxy), (kyx, ky) = camera.k_px_per_mm
    kxxy, kyxy = camera.k_xy_px_per_mm2
    u = kx * d.real + kxy * d.imag + kxxy * d.real * d.imag + camera.principal_point_vu[1]
    v = kyx * d.real + ky * d.imag + kyxy * d.real * d.imag + camera.principal_point_vu[0]
    return v, u


@every_camera
def test_project_is_the_printed_model(camera: CameraModel) -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (50, 2)), np.ones(50)]) * rng.uniform(0.1, 9.0, (50, 1))
    pixels, ahead = project(camera, points)
    assert ahead.all()
    # Some hundred pixels in double precision, a dozen operations each.
    assert_allclose(pixels, [_printed_model(camera, p) for p in points], atol=1e-10)


@every_camera
def test_unproject_inverts_project_to_a_hundred_millionth_of_a_pixel(camera: CameraModel) -> None:
    pixels = _outline_and_inside()
    rays, ok = unproject(camera, pixels)
    assert ok.all()
    assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=1e-14)
    assert np.abs(project(camera, rays)[0] - pixels).max() <= UNPROJECT_TOLERANCE_PX
    assert UNPROJECT_TOLERANCE_PX == 1e-8
    if not camera.distortion_eps.any() and not camera.k_xy_px_per_mm2.any():
        corner_mm2 = float((((pixels[0] - camera.principal_point_vu) / PX_PER_MM) ** 2).sum())
        assert rays[0, 2] == pytest.approx(FOCAL_MM / np.sqrt(FOCAL_MM**2 + corner_mm2), rel=1e-12)


share = st.floats(-1.0, 1.0)


@given(st.tuples(*[share] * 6), st.floats(-180, 180), st.booleans(), st.floats(0.9, 1.1), share, share)
@settings(deadline=None, max_examples=150)
def test_round_trip_for_any_camera_that_does_not_fold(
    eps: tuple[float, ...], angle: float, mirrored: bool, stretch: float, v: float, u: float
) -> None:
    # Each term displaces a corner by at most 4 %, so the radial slope stays above 1 - 3*4 - 5*4 - 4*4 % > 0.5.
    size = 0.04 / CORNER_MM ** np.array([2, 4, 1, 1, 1, 3])
    camera = _camera(_k(angle, mirrored, stretch), np.array(eps) * size)
    pixels = np.array([[v * 200 + 190.0, u * 200 + 310.0]])
    rays, ok = unproject(camera, pixels)
    assert ok.all()
    assert np.abs(project(camera, rays)[0] - pixels).max() <= UNPROJECT_TOLERANCE_PX


def _folding(e1: float, e2: float) -> CameraModel:
    k = PX_PER_MM * np.eye(2)
    return CameraModel((1000, 1000), 20.0, k, np.array([499.5, 499.5]), np.array([e1, e2, 0, 0, 0, 0]))


@pytest.mark.parametrize("e2", [0.0, 5e-6])
def test_beyond_a_fold_the_inverse_is_flagged_and_before_it_exact(e2: float) -> None:
    camera = _folding(-4e-3, e2)
    radius = np.linspace(0.0, 12.0, 1201)
    reach = radius * (1 + camera.distortion_eps[0] * radius**2 + e2 * radius**4)
    fold_mm = float(reach[: int(np.argmax(np.diff(reach) < 0)) + 1].max())
    out = np.linspace(0.02, 3.0, 120) * fold_mm * PX_PER_MM
    rays, ok = unproject(camera, np.column_stack([499.5 + 0.6 * out, 499.5 + 0.8 * out]))
    before = out < 0.999 * fold_mm * PX_PER_MM
    assert ok[before].all()
    assert not ok[out > 1.001 * fold_mm * PX_PER_MM].any()  # also where an outer branch has a root
    assert np.isnan(rays[~ok]).all()
    inside_mm = camera.focal_length_mm * np.hypot(rays[before, 0], rays[before, 1]) / rays[before, 2]
    assert (np.diff(inside_mm) > 0).all()  # one branch, not a jump to another root
    assert inside_mm.max() < radius[int(np.argmax(np.diff(reach) < 0)) + 1]


def test_the_flag_never_lies() -> None:
    """Whatever is said to be solved projects back, for cameras wild enough to fold inside the array."""
    rng = np.random.default_rng(3)
    flagged = 0
    for _ in range(150):
        eps = rng.normal(0.0, 0.3, 6) / CORNER_MM ** np.array([2, 4, 1, 1, 1, 3])
        camera = _camera(_k(rng.uniform(0, 360), bool(rng.integers(2))), eps)
        pixels = _outline_and_inside(40)
        rays, ok = unproject(camera, pixels)
        flagged += int((~ok).sum())
        assert np.isfinite(rays[ok]).all()
        assert np.isnan(rays[~ok]).all()
        assert np.abs(project(camera, rays[ok])[0] - pixels[ok]).max(initial=0.0) <= UNPROJECT_TOLERANCE_PX
    assert flagged > 100  # else nothing folded and nothing was tested


def test_pixels_that_are_no_numbers_are_flagged() -> None:
    for camera in (CAMERAS["pinhole"], CAMERAS["distorted"]):
        rays, ok = unproject(camera, np.array([[np.nan, 3.0], [10.0, 20.0], [0.0, np.nan]]))
        assert ok.tolist() == [False, True, False]
        assert np.isfinite(rays[1]).all()
        assert np.isnan(rays[[0, 2]]).all()


def test_behind_the_camera_there_is_no_pixel() -> None:
    pixels, ahead = project(CAMERAS["distorted"], np.array([[0.1, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert ahead.tolist() == [False, False, True]
    assert np.isnan(pixels[:2]).all()
    assert_allclose(pixels[2], [190.0, 310.0])


@every_camera
def test_distortion_jacobian_has_its_numerical_twin(camera: CameraModel) -> None:
    photo = np.random.default_rng(4).uniform(-5.0, 5.0, (40, 2))
    step = 1e-5
    twin = np.stack(
        [(distort(camera, photo + e) - distort(camera, photo - e)) / (2 * step) for e in step * np.eye(2)], axis=2
    )
    # Central differences: rounding of 10 mm at 1e-16 over 2e-5, truncation of the third derivative below 1e-12.
    assert_allclose(distort_jacobian(camera, photo), twin, atol=1e-9)


def test_distortion_jacobian_on_the_axis_is_the_identity() -> None:
    assert_allclose(distort_jacobian(_camera(), np.zeros((1, 2)))[0], np.eye(2), atol=1e-15)


@every_camera
def test_projection_jacobian_has_its_numerical_twin(camera: CameraModel) -> None:
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-0.08, 0.08, (40, 2)), np.ones(40)]) * 7.0
    step = 1e-4
    twin = np.stack(
        [(project(camera, points + e)[0] - project(camera, points - e)[0]) / (2 * step) for e in step * np.eye(3)],
        axis=2,
    )
    # Slopes are some hundred px per unit; rounding of 600 px over 2e-4 is 1e-9, truncation 1e-7 relative.
    assert_allclose(project_jacobian(camera, points), twin, rtol=1e-6, atol=1e-5)


@every_camera
def test_unprojection_jacobian_has_its_numerical_twin(camera: CameraModel) -> None:
    pixels = _outline_and_inside(40)
    step = 0.1
    twin = np.stack(
        [(unproject(camera, pixels + e)[0] - unproject(camera, pixels - e)[0]) / (2 * step) for e in step * np.eye(2)],
        axis=2,
    )
    # Slopes are 3e-4 per px; the inverse is good to 1e-8 px (5e-11 here), truncation to step^2 times curvature.
    assert_allclose(unproject_jacobian(camera, pixels), twin, atol=1e-9)


def test_a_mirrored_array_shows_the_instruments_axes_along_its_columns_and_rows() -> None:
    """LORRI: boresight -Z of the instrument, camera_from_instrument = diag(1, -1, -1), Ky < 0: +X -> +u, +Y -> +v."""
    camera_from_instrument = np.diag([1.0, -1.0, -1.0])
    camera = _camera(np.diag([PX_PER_MM, -PX_PER_MM]), NO_DISTORTION)
    instrument = np.array([[0.0, 0.0, -1.0], [0.01, 0.0, -1.0], [0.0, 0.01, -1.0]])
    pixels, ahead = project(camera, instrument @ camera_from_instrument.T)
    assert ahead.all()
    # 0.01 rad times 60 mm times 50 px/mm.
    assert_allclose(pixels - pixels[0], [[0, 0], [0, 30], [30, 0]], atol=1e-9)
    assert camera.handedness == -1.0


def test_without_mirror_x_is_along_columns_and_y_along_rows() -> None:
    pixels, _ = project(_camera(eps=NO_DISTORTION), np.array([[0.0, 0, 1], [0.01, 0, 1], [0, 0.01, 1]]))
    assert_allclose(pixels - pixels[0], [[0, 0], [0, 30], [30, 0]], atol=1e-9)


def test_pixel_scale() -> None:
    camera = CameraModel(SHAPE, FOCAL_MM, np.diag([50.0, -40.0]), np.array([199.5, 299.5]))
    assert_allclose(pixel_scale_rad(camera), [1 / (60 * 40), 1 / (60 * 50)], rtol=1e-12)


@every_camera
def test_field_of_view_holds_the_array_and_its_margin(camera: CameraModel) -> None:
    axis, half = field_of_view(camera, (20.0, 30.0))
    corners = np.array([[v, u] for v in (-20.5, 419.5) for u in (-30.5, 629.5)])
    inside = np.concatenate([corners, np.random.default_rng(6).uniform([-20, -30], [419, 629], (300, 2))])
    angle = np.arccos(np.clip(unproject(camera, inside)[0] @ axis, -1, 1))
    assert angle.max() <= half + 1e-7  # arccos near 1 keeps half of the digits
    assert half < 1.2 * angle[:4].max()  # and is not generous


def test_field_of_view_of_a_camera_that_folds_inside_its_array_is_widened() -> None:
    camera = _folding(-4e-3, 0.0)
    axis, half = field_of_view(camera)
    rays, ok = unproject(camera, np.random.default_rng(7).uniform(0, 999, (300, 2)))
    assert not ok.all()
    assert np.arccos(rays[ok] @ axis).max() <= half
