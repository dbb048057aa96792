"""Offsets, rotations, attitudes and pivots: signs, exact inverses, and covariances under a Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from pipeline.camera import project, unproject
from pipeline.geometry.pointing import attitude_information, corrected_attitude, move_pivot, offset_between
from pipeline.geometry.rotations import plane_rotation
from pipeline.records import CameraModel, FloatArray

EPS = np.array([-2e-4, 1e-7, 1e-4, -2e-4, 1e-4, 0.0])
CAMERAS = {
    "plain": CameraModel((400, 600), 60.0, np.diag([50.0, 50.0]), np.array([190.0, 310.0])),
    "mirrored": CameraModel((400, 600), 60.0, np.diag([50.0, -50.0]), np.array([190.0, 310.0])),
    "half turn": CameraModel((400, 600), 60.0, np.diag([-50.0, -50.0]), np.array([199.5, 299.5]), EPS),
    "mirrored and turned": CameraModel((400, 600), 60.0, np.array([[0, 50.0], [50, 0]]), np.array([190.0, 300]), EPS),
}
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
PRIOR: FloatArray = Rotation.from_euler("zyx", [200.0, -35.0, 12.0], degrees=True).as_matrix()


@every_camera
@given(st.floats(-120, 120), st.floats(-120, 120), st.floats(-1.5, 1.5))
@settings(deadline=None, max_examples=60)
def test_offset_between_inverts_corrected_attitude(camera: CameraModel, dv: float, du: float, theta: float) -> None:
    after = corrected_attitude(camera, PRIOR, np.array([dv, du]), theta)
    assert_allclose(after @ after.T, np.eye(3), atol=1e-13)
    offset, angle = offset_between(camera, PRIOR, after)
    assert_allclose(offset, [dv, du], atol=3e-8)  # the camera's inverse is good to 1e-8 px
    assert angle == pytest.approx(theta, abs=1e-12)


@every_camera
@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=40)
def test_corrected_attitude_inverts_offset_between(camera: CameraModel, seed: int) -> None:
    after = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-0.03, 0.03, 3)).as_matrix() @ PRIOR
    # 1e-8 px of 3e-4 rad, and rounding.
    assert_allclose(corrected_attitude(camera, PRIOR, *offset_between(camera, PRIOR, after)), after, atol=2e-11)


@every_camera
def test_predicted_plus_offset_is_actual_at_the_centre(camera: CameraModel) -> None:
    star = PRIOR.T @ unproject(camera, camera.centre_vu[None])[0][0]
    after = corrected_attitude(camera, PRIOR, np.array([12.0, -30.0]), 0.05)
    seen = project(camera, (after @ star)[None])[0][0]
    assert_allclose(seen, camera.centre_vu + np.array([12.0, -30.0]), atol=1e-7)


@every_camera
def test_a_positive_rotation_turns_columns_toward_rows_in_every_camera(camera: CameraModel) -> None:
    """In a mirrored array the same turn in the image is the opposite turn of the camera."""
    centre = camera.centre_vu
    near = centre + np.array([[0.0, 40.0], [40.0, 0.0]])
    stars = unproject(camera, near)[0] @ PRIOR
    theta = 0.02
    seen = project(camera, stars @ corrected_attitude(camera, PRIOR, np.zeros(2), theta).T)[0]
    expected = (near - centre) @ plane_rotation(theta).T + centre
    # A plane similarity holds to the tangent plane's tilt (4 px off the axis: 1e-3) and the distortion's shear.
    assert_allclose(seen, expected, atol=5e-3)
    assert seen[0, 0] > near[0, 0] + 0.7  # +u moved toward +v


def test_no_correction_is_the_prior() -> None:
    assert_allclose(corrected_attitude(CAMERAS["mirrored"], PRIOR, np.zeros(2)), PRIOR, atol=1e-15)


@given(st.integers(0, 10_000), st.floats(-1, 1))
@settings(deadline=None)
def test_a_moved_pivot_is_the_same_similarity(seed: int, theta: float) -> None:
    rng = np.random.default_rng(seed)
    points, old, new = rng.uniform(-500, 500, (5, 2)), rng.uniform(-500, 500, 2), rng.uniform(-500, 500, 2)
    offset = rng.normal(0, 30, 2)
    turn = plane_rotation(theta)
    moved, _ = move_pivot(offset, theta, old, new)
    assert_allclose((points - new) @ turn.T + new + moved, (points - old) @ turn.T + old + offset, atol=1e-10)
    assert_allclose(move_pivot(moved, theta, new, old)[0], offset, atol=1e-10)


def test_the_pivots_jacobian_has_its_numerical_twin() -> None:
    old, new, theta = np.array([10.0, 700.0]), np.array([300.0, 200.0]), 0.07
    parameters, step = np.array([3.0, -2.0, theta]), 1e-5

    def moved(p: FloatArray) -> FloatArray:
        return np.append(move_pivot(p[:2], float(p[2]), old, new)[0], p[2])

    twin = np.stack([(moved(parameters + e) - moved(parameters - e)) / (2 * step) for e in step * np.eye(3)], axis=1)
    inverse = move_pivot(parameters[:2], theta, old, new)[1]
    assert_allclose(inverse @ twin, np.eye(3), atol=1e-5)  # truncation: arm 500 px * step^2, rounding 1e-13/1e-5
    assert abs(inverse[0, 2]) > 100.0  # an arm of hundreds of pixels: the identity would not pass


def test_a_moved_covariance_is_the_monte_carlos() -> None:
    rng = np.random.default_rng(4)
    old, new = np.array([50.0, 900.0]), np.array([512.0, 512.0])
    sigma, theta = np.array([0.2, 0.4, 1e-3]), 0.05
    correlated = np.diag(sigma) @ np.array([[1, 0.5, 0.3], [0.5, 1, -0.2], [0.3, -0.2, 1]]) @ np.diag(sigma)
    draws = rng.multivariate_normal([5.0, -3.0, theta], correlated, 4000)
    moved = np.array([np.append(move_pivot(d[:2], float(d[2]), old, new)[0], d[2]) for d in draws])
    inverse = move_pivot(np.array([5.0, -3.0]), theta, old, new)[1]
    information = inverse.T @ np.linalg.inv(correlated) @ inverse
    pulls = np.einsum("ni,ij,nj->n", moved - moved.mean(axis=0), information, moved - moved.mean(axis=0))
    assert pulls.mean() == pytest.approx(3.0, abs=0.16)  # four sigmas of a mean of 4000 chi-squares of 3
    scale = np.sqrt(np.diag(np.linalg.inv(information)))
    # Correlations from 4000 draws: 1/sqrt(4000) = 0.016 each.
    assert_allclose(np.cov(moved.T) / np.outer(scale, scale),
                    np.linalg.inv(information) / np.outer(scale, scale), atol=0.09)  # fmt: skip


@every_camera
def test_information_about_an_attitude_is_that_of_its_offsets(camera: CameraModel) -> None:
    rng = np.random.default_rng(5)
    offset, theta = np.array([14.0, -9.0]), 0.01
    factor = rng.normal(size=(3, 3)) * np.array([0.4, 0.4, 2e-3])[:, None]
    covariance = factor @ factor.T
    middle = corrected_attitude(camera, PRIOR, offset, theta)
    turns = []
    for error in rng.multivariate_normal(np.zeros(3), covariance, 3000):
        moved = corrected_attitude(camera, PRIOR, offset + error[:2], theta + error[2])
        turns.append(Rotation.from_matrix(moved @ middle.T).as_rotvec())
    # White in the information's own measure: unit variances, nothing in common, within the sample's scatter.
    root = np.linalg.cholesky(attitude_information(camera, offset, theta, covariance))
    assert_allclose(np.cov((np.array(turns) @ root).T), np.eye(3), atol=0.1)
    blind = attitude_information(camera, offset, theta, covariance[:2, :2])
    values, vectors = np.linalg.eigh(blind)
    assert abs(values[0]) < 1e-9 * values[1]
    # What is not known is the turn about the direction that the array's centre sees.
    sight = unproject(camera, camera.centre_vu[None] + offset)[0][0]
    assert abs(vectors[:, 0] @ sight) > 1 - 1e-9
