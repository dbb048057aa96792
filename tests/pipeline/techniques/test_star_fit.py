"""Pointing from matched stars: planted attitudes, wrong stars, and sigmas that hold."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from pipeline.camera import project, unproject
from pipeline.geometry.pointing import corrected_attitude, move_pivot
from pipeline.records import CameraModel, FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.star_fit import StarFit, StarFitOptions, _design, _sandwich, fit_stars, predict_at

OPTIONS = StarFitOptions()
PRIOR: FloatArray = Rotation.from_euler("zyx", [120.0, 35.0, -70.0], degrees=True).as_matrix()
TRUE_OFFSET = np.array([14.0, -9.0])
TRUE_THETA = float(np.radians(1.5))


def _camera(focal_mm: float = 500.0, mirrored: bool = False) -> CameraModel:
    return CameraModel((1000, 1000), focal_mm, np.diag([50.0, -50.0 if mirrored else 50.0]), np.array([499.5, 499.5]))


def _context(turns: bool, camera: CameraModel | None = None) -> NavContext:
    return NavContext(camera or _camera(), PRIOR, turns, 5.0, (50.0, 50.0))


def _true_attitude(context: NavContext) -> FloatArray:
    theta = TRUE_THETA if context.fit_camera_rotation else 0.0
    return corrected_attitude(context.camera_model, PRIOR, TRUE_OFFSET, theta)


def _stars(context: NavContext, measured_vu: FloatArray) -> FloatArray:
    """J2000 directions of stars that the true attitude puts on these pixels."""
    return np.asarray(unproject(context.camera_model, measured_vu)[0] @ _true_attitude(context))


def _fit(context: NavContext, stars: FloatArray, measured: FloatArray, covariance: FloatArray) -> StarFit:
    predicted = project(context.camera_model, stars @ PRIOR.T)[0]
    return fit_stars(context, stars, predicted, measured, covariance, OPTIONS)


def _isotropic(count: int, sigma: float = 0.1) -> FloatArray:
    return np.broadcast_to(sigma**2 * np.eye(2), (count, 2, 2))


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("focal_mm", [500.0, 20.0], ids=["narrow", "53 degrees wide"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_exact_measurements_give_back_the_planted_pointing(turns: bool, focal_mm: float, mirrored: bool) -> None:
    context = _context(turns, _camera(focal_mm, mirrored))
    places = np.random.default_rng(0).uniform(20, 980, (12, 2))
    fit = _fit(context, _stars(context, places), places, _isotropic(12))
    # Each of two times five rounds of re-prediction shrinks the error by the square of the field's size, 0.2 in the
    # wide camera: far below any sigma. Without re-prediction it would be off by tenths.
    assert_allclose(fit.centre_offset_vu, TRUE_OFFSET, atol=3e-4 if focal_mm < 100 else 1e-6)
    assert fit.rotation_rad == pytest.approx(TRUE_THETA if turns else 0.0, abs=1e-6 if focal_mm < 100 else 1e-9)
    assert fit.inlier.all()
    assert fit.extra_sigma_px == 0.0
    # Without a rotation parameter several smallest rotations in a row leave 1e-6 rad of twist, 500 px from the centre.
    assert np.abs(fit.residual_vu).max() < 1e-3
    assert_allclose(predict_at(context, _stars(context, places), fit.centre_offset_vu, fit.rotation_rad), places,
                    atol=1e-3)  # fmt: skip


def test_about_its_pivot_and_at_the_centre_it_is_one_answer() -> None:
    context = _context(True)
    places = np.random.default_rng(1).uniform([20, 500], [300, 980], (9, 2))
    fit = _fit(context, _stars(context, places), places, _isotropic(9))
    moved, _ = move_pivot(fit.offset_vu, fit.rotation_rad, fit.pivot_vu, context.camera_model.centre_vu)
    assert_allclose(moved, fit.centre_offset_vu, atol=1e-9)
    assert np.linalg.norm(fit.offset_vu - fit.centre_offset_vu) > 1.0
    # About the weighted centroid translation and rotation are uncorrelated for isotropic stars of one weight.
    assert np.abs(fit.information[:2, 2]).max() < 1e-6 * np.sqrt(fit.information[0, 0] * fit.information[2, 2])


@pytest.mark.parametrize(("turns", "count"), [(False, 4), (True, 5), (True, 20)])
@pytest.mark.parametrize("miss", [(3.0, 0.0), (-8.0, 25.0)])
def test_a_star_in_a_wrong_place_loses(turns: bool, count: int, miss: tuple[float, float]) -> None:
    context = _context(turns)
    rng = np.random.default_rng(2)
    places = rng.uniform(50, 950, (count, 2))
    measured = places + rng.normal(0, 0.05, places.shape)
    measured[1] += miss
    fit = _fit(context, _stars(context, places), measured, _isotropic(count, 0.05))
    assert fit.inlier.tolist() == [k != 1 for k in range(count)]
    # The wrong star is out of the fit, not down-weighted: five sigmas of what is left.
    assert np.abs(fit.centre_offset_vu - TRUE_OFFSET).max() < 0.25
    assert_allclose(fit.residual_vu[1], miss, atol=0.5)


def test_several_wrong_stars_lose_to_a_majority() -> None:
    context = _context(True)
    rng = np.random.default_rng(3)
    places = rng.uniform(50, 950, (15, 2))
    measured = places + rng.normal(0, 0.05, places.shape)
    measured[:4] += rng.choice([-1, 1], (4, 2)) * rng.uniform(3, 20, (4, 2))
    fit = _fit(context, _stars(context, places), measured, _isotropic(15, 0.05))
    assert not fit.inlier[:4].any()
    assert fit.inlier[4:].all()


def test_good_stars_are_hardly_ever_thrown_out() -> None:
    context, rng, lost = _context(True), np.random.default_rng(4), 0
    for _ in range(40):
        places = rng.uniform(20, 980, (15, 2))
        fit = _fit(context, _stars(context, places), places + rng.normal(0, 0.2, (15, 2)), _isotropic(15, 0.2))
        lost += int((~fit.inlier).sum())
    assert lost <= 4  # 600 stars at a chance below 1e-3 each: five or more have a chance below 4e-4


def test_one_star_says_nothing_of_the_rotation() -> None:
    context = _context(True)
    place = np.array([[200.0, 800.0]])
    fit = _fit(context, _stars(context, place), place, _isotropic(1, 0.2))
    assert fit.rotation_rad == 0.0
    assert fit.information[2].tolist() == [0.0, 0.0, 0.0]
    assert_allclose(fit.information[:2, :2], np.eye(2) / 0.04, rtol=1e-9)
    star = project(context.camera_model, _stars(context, place) @ PRIOR.T)[0]
    # Offset at the star itself: measured minus predicted, but for the plane's curvature, 17 px times (400/25,000)^2.
    assert_allclose(fit.offset_vu, place[0] - star[0], atol=1e-2)


def test_without_a_rotation_parameter_there_are_two() -> None:
    context = _context(False)
    places = np.random.default_rng(5).uniform(50, 950, (5, 2))
    fit = _fit(context, _stars(context, places), places, _isotropic(5, 0.2))
    assert fit.information.shape == (2, 2)
    assert_allclose(fit.information, 5 / 0.04 * np.eye(2), rtol=1e-9)


def _anisotropic(rng: np.random.Generator, count: int) -> FloatArray:
    """Trailed and round stars mixed: axes up to five to one at any angle."""
    angle, long = rng.uniform(0, np.pi, count), rng.uniform(0.1, 0.5, count)
    c, s = np.cos(angle), np.sin(angle)
    axes = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.asarray(np.einsum("nij,nj,nkj->nik", axes, np.stack([long**2, np.full(count, 0.01)], axis=1), axes))


def _pulls(turns: bool, count: int, anisotropic: bool, inflate: float, draws: int, focal_mm: float) -> FloatArray:
    """(draws, 2 or 3) errors about the fit's pivot over their sigmas, and the squared Mahalanobis distance."""
    context = _context(turns, _camera(focal_mm))
    rng = np.random.default_rng(count + 100 * turns + 1000 * anisotropic)
    rows = []
    for _ in range(draws):
        places = rng.uniform(20, 980, (count, 2))
        covariance = _anisotropic(rng, count) if anisotropic else _isotropic(count, 0.2)
        root = np.linalg.cholesky(covariance)
        measured = places + inflate * np.einsum("nij,nj->ni", root, rng.normal(size=(count, 2)))
        fit = _fit(context, _stars(context, places), measured, covariance)
        theta = TRUE_THETA if turns else 0.0
        truth, _ = move_pivot(TRUE_OFFSET, theta, context.camera_model.centre_vu, fit.pivot_vu)
        error = np.append(fit.offset_vu - truth, fit.rotation_rad - theta)[: 3 if turns else 2]
        sigma = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        rows.append(np.append(error / sigma, error @ fit.information @ error))
    return np.array(rows)


@pytest.mark.parametrize(
    ("turns", "count", "anisotropic", "focal_mm"),
    [
        (False, 1, False, 500.0), (False, 3, True, 500.0), (False, 25, False, 500.0), (True, 2, False, 500.0),
        (True, 4, True, 500.0), (True, 25, True, 500.0), (True, 12, False, 20.0),
    ],
)  # fmt: skip
def test_sigmas_hold(turns: bool, count: int, anisotropic: bool, focal_mm: float) -> None:
    draws = 300
    rows = _pulls(turns, count, anisotropic, 1.0, draws, focal_mm)
    size = rows.shape[1] - 1
    rms = np.sqrt((rows[:, :size] ** 2).mean(axis=0))
    # An rms of 300 draws scatters by 0.041: four of that. The shrunk scatter term can only lower it, by up to 7 %.
    assert (rms < 1.17).all()
    assert (rms > 0.77).all()
    assert np.abs(rows[:, :size].mean(axis=0)).max() < 4.0 / np.sqrt(draws)
    assert 0.65 < rows[:, size].mean() / size < 1.3
    within = (np.abs(rows[:, :size]) <= 2.0).mean(axis=0)
    assert (within > 0.91).all()  # 0.9545 less four sigmas of 300 draws (0.012 each)


@pytest.mark.parametrize(("turns", "count"), [(False, 20), (True, 30)])
def test_scatter_beyond_the_stated_sigmas_is_found_and_paid_for(turns: bool, count: int) -> None:
    rows = _pulls(turns, count, False, 3.0, 200, 500.0)
    rms = np.sqrt((rows[:, :-1] ** 2).mean(axis=0))
    # Without the extra scatter it would be 3; shrinkage by 4 of 40 to 60 degrees of freedom leaves about 1.05.
    assert (rms < 1.3).all()
    assert (rms > 0.8).all()


def test_a_design_row_is_the_derivative_of_the_actual_pixel() -> None:
    rng = np.random.default_rng(6)
    predicted, pivot, offset, theta, step = rng.uniform(0, 1000, (6, 2)), rng.uniform(0, 1000, 2), np.ones(2), 0.1, 1e-6

    def actual(p: FloatArray) -> FloatArray:
        c, s = np.cos(p[2]), np.sin(p[2])
        return np.asarray((predicted - pivot) @ np.array([[c, -s], [s, c]]) + pivot + p[:2])

    at = np.append(offset, theta)
    twin = np.stack([(actual(at + e) - actual(at - e)) / (2 * step) for e in step * np.eye(3)], axis=2)
    assert_allclose(_design(predicted, pivot, theta, 3), twin, atol=1e-6)  # rounding: 1e-13 / 1e-6


def test_the_sandwich_is_the_inverse_information_when_weights_are_right() -> None:
    rng = np.random.default_rng(7)
    design = _design(rng.uniform(0, 100, (6, 2)), np.array([50.0, 50.0]), 0.0, 3)
    variance = rng.uniform(0.5, 2, 6)
    information = np.einsum("n,nij,nik->jk", 1 / variance, design, design)
    covariance = _sandwich(design, 1 / variance, variance[:, None, None] * np.eye(2))
    assert_allclose(covariance @ information, np.eye(3), atol=1e-9)
