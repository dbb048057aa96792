"""Rigid motions against scipy, and the three tangents against samples of real errors."""

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from pipeline.pose.records import MatchError, Pose
from pipeline.pose.se3 import SE3Utils


def _pose(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 5.0)


def _covariance(seed: int, scale: float) -> np.ndarray:
    factor = np.random.default_rng(seed).normal(size=(6, 6))
    return scale**2 * factor @ factor.T


def test_exp_and_log() -> None:
    for vector in np.random.default_rng(0).normal(size=(20, 3)):
        assert_allclose(SE3Utils.exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
        short = vector / np.linalg.norm(vector) * 3.0
        assert_allclose(SE3Utils.log(SE3Utils.exp(short)), short, atol=1e-12)
    assert_allclose(SE3Utils.exp(np.zeros(3)), np.eye(3))
    assert_allclose(SE3Utils.log(SE3Utils.exp(np.array([1e-13, 0, 0])))[0], 1e-13, rtol=1e-2)


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 7, 3))
    assert_allclose((SE3Utils.skew(a) @ b[:, :, None])[:, :, 0], np.cross(a, b), atol=1e-14)


def test_an_error_is_what_the_convention_says() -> None:
    true, estimated = _pose(2), _pose(3)
    error = SE3Utils.error(estimated, true)
    assert_allclose(error[:3], estimated.position_km - true.position_km)
    assert_allclose(true.camera_from_body.T, SE3Utils.exp(error[3:]) @ estimated.camera_from_body.T, atol=1e-12)


def test_a_correction_undoes_an_error() -> None:
    true, estimated = _pose(4), _pose(5)
    error = SE3Utils.error(estimated, true)
    back = SE3Utils.corrected(estimated, np.concatenate([-error[:3], error[3:]]))
    assert_allclose(back.camera_from_body, true.camera_from_body, atol=1e-12)
    assert_allclose(back.position_km, true.position_km, atol=1e-12)


def test_there_and_back_through_gtsam() -> None:
    pose = _pose(6)
    back = SE3Utils.from_gtsam(SE3Utils.to_gtsam(pose))
    assert_allclose(back.camera_from_body, pose.camera_from_body, atol=1e-15)
    assert_allclose(back.position_km, pose.position_km)
    covariance = _covariance(7, 1.0)
    there = SE3Utils.gtsam_from_error(covariance, pose.camera_from_body)
    assert_allclose(SE3Utils.error_from_gtsam(there, pose.camera_from_body), covariance, atol=1e-12)


def test_the_adjoint_moves_a_tangent_to_the_other_side() -> None:
    pose = _pose(8)
    step = np.random.default_rng(9).normal(size=6) * 0.1
    right = SE3Utils.to_gtsam(pose).compose(gtsam.Pose3.Expmap(step))
    left = gtsam.Pose3.Expmap(SE3Utils.adjoint(pose) @ step).compose(SE3Utils.to_gtsam(pose))
    assert right.equals(left, 1e-10)


@pytest.mark.parametrize("tangent", ["gtsam", "seed"])
def test_converted_covariances_are_those_of_sampled_errors(tangent: str) -> None:
    """Truth is drawn about one estimate in the tangent's own words; errors are measured by their definition."""
    estimated, covariance = _pose(10), _covariance(11, 1e-3)
    draws = np.random.default_rng(12).multivariate_normal(np.zeros(6), covariance, 20000)
    errors = np.empty_like(draws)
    for i, x in enumerate(draws):
        if tangent == "gtsam":
            true = SE3Utils.from_gtsam(SE3Utils.to_gtsam(estimated).retract(x))
        else:
            true = Pose(SE3Utils.exp(-x[3:]) @ estimated.camera_from_body, estimated.position_km + x[:3])
        errors[i] = SE3Utils.error(estimated, true)
    convert = SE3Utils.error_from_gtsam if tangent == "gtsam" else SE3Utils.error_from_seed
    expected = convert(covariance, estimated.camera_from_body)
    unit = 1.0 / np.sqrt(np.diag(expected))
    # Each entry of a sample's correlation matrix is good to 1 / sqrt(20000) = 0.007.
    assert_allclose(np.cov(errors.T) * np.outer(unit, unit), expected * np.outer(unit, unit), atol=0.035)
    # The signs between position and rotation are what a wrong conversion loses; here they are far from zero.
    assert np.abs((expected * np.outer(unit, unit))[:3, 3:]).max() > 0.3


def test_what_is_no_rotation_is_refused() -> None:
    with pytest.raises(MatchError, match="rotation"):
        Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with pytest.raises(MatchError, match="finite"):
        Pose(np.eye(3), np.array([0.0, np.nan, 0.0]))
