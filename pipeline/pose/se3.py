"""Rigid motions, and covariances carried between the tangents in which programs and papers write them.

Here a correction of a pose is (dp, r): the true position minus the estimated one, and r with
``body_from_camera_true = Exp(r) body_from_camera_estimated``. An *error* has the sign of the position turned round
(``p_estimated - p_true``), so the blocks between position and rotation change sign between the two; everything that
leaves this package is in errors.
"""

import gtsam
import numpy as np

from pipeline.geometry.rotations import rotation_about
from pipeline.pose.records import Pose
from pipeline.records import FloatArray

_SMALL_RAD = 1e-12


class SE3Utils:
    """Lie algebra of rotations and poses (seed 002 section 6)."""

    @staticmethod
    def skew(vector: FloatArray) -> FloatArray:
        """(..., 3, 3) matrices of the cross products with (..., 3) vectors."""
        if np.ndim(vector) == 1:
            a, b, c = vector
            return np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
        x, y, z = np.moveaxis(np.asarray(vector, dtype=float), -1, 0)
        zero = np.zeros_like(x)
        rows = [np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
        return np.stack(rows, axis=-2)

    @staticmethod
    def exp(rotation_rad: FloatArray) -> FloatArray:
        """(3, 3) rotation of a (3,) rotation vector."""
        angle = float(np.linalg.norm(rotation_rad))
        if angle < _SMALL_RAD:
            return np.eye(3) + SE3Utils.skew(rotation_rad)
        return rotation_about(rotation_rad, angle)

    @staticmethod
    def log(rotation: FloatArray) -> FloatArray:
        """(3,) rotation vector of a (3, 3) rotation, at most pi long."""
        return np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(rotation)))

    @staticmethod
    def adjoint(pose: Pose) -> FloatArray:
        """(6, 6) adjoint of body_from_camera, tangent order (rotation, translation)."""
        return np.asarray(SE3Utils.to_gtsam(pose).AdjointMap())

    @staticmethod
    def to_gtsam(pose: Pose) -> gtsam.Pose3:
        """``Pose3(body_from_camera)``, which is how GTSAM writes a camera's pose."""
        return gtsam.Pose3(gtsam.Rot3(pose.camera_from_body.T), pose.position_km)

    @staticmethod
    def from_gtsam(pose: gtsam.Pose3) -> Pose:
        """Inverse of :meth:`to_gtsam`; the rotation is made orthonormal to the last digit."""
        u, _, vt = np.linalg.svd(pose.rotation().matrix().T)
        return Pose(u @ vt, pose.translation())

    @staticmethod
    def error(estimated: Pose, true: Pose) -> FloatArray:
        """(6,) error (dp, r) of an estimated pose, km and rad, body-fixed."""
        turn = SE3Utils.log(true.camera_from_body.T @ estimated.camera_from_body)
        return np.concatenate([estimated.position_km - true.position_km, turn])

    @staticmethod
    def corrected(pose: Pose, correction: FloatArray) -> Pose:
        """Pose after a (6,) correction (p_true - p_estimated, r)."""
        return Pose(pose.camera_from_body @ SE3Utils.exp(-correction[3:]), pose.position_km + correction[:3])

    @staticmethod
    def error_from_correction(covariance: FloatArray) -> FloatArray:
        """(6, 6) covariance of errors from that of corrections, and the other way round."""
        sign = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
        return np.asarray(covariance * np.outer(sign, sign))

    @staticmethod
    def error_from_gtsam(covariance: FloatArray, camera_from_body: FloatArray) -> FloatArray:
        """Covariance of errors from that of GTSAM's tangent (rotation, translation), which lives in the camera frame.

        ``true = estimated Exp(xi)`` gives p_true - p = R t and r = R omega with R = body_from_camera: two rotations
        of blocks, and no adjoint, since position and rotation are each turned about themselves.

        Parameters
        ----------
        covariance
            (6, 6) of ``Marginals.marginalCovariance``.
        camera_from_body
            (3, 3) at which it was linearised.

        Returns
        -------
        numpy.ndarray
            (6, 6) in the order (x, y, z, rx, ry, rz).
        """
        turn = np.zeros((6, 6))
        turn[:3, 3:] = -camera_from_body.T
        turn[3:, :3] = camera_from_body.T
        return np.asarray(turn @ covariance @ turn.T)

    @staticmethod
    def gtsam_from_error(covariance: FloatArray, camera_from_body: FloatArray) -> FloatArray:
        """Inverse of :meth:`error_from_gtsam`."""
        turn = np.zeros((6, 6))
        turn[3:, :3] = -camera_from_body
        turn[:3, 3:] = camera_from_body
        return np.asarray(turn @ covariance @ turn.T)

    @staticmethod
    def error_from_seed(covariance: FloatArray, camera_from_body: FloatArray) -> FloatArray:
        """Covariance of errors from that of (t_B, delta theta), seed 001 eq. 2.9.

        There ``camera_from_body_true = Exp(-delta_theta) camera_from_body``, so r = body_from_camera delta_theta, and
        t_B is a correction of the position.

        Parameters
        ----------
        covariance
            (6, 6) in the seed's order, km and rad.
        camera_from_body
            (3, 3) at which it was linearised.

        Returns
        -------
        numpy.ndarray
            (6, 6) in the order (x, y, z, rx, ry, rz).
        """
        turn = np.zeros((6, 6))
        turn[:3, :3] = -np.eye(3)
        turn[3:, 3:] = camera_from_body.T
        return np.asarray(turn @ covariance @ turn.T)
