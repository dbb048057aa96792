"""Rotation and translation between matched points in the image plane."""

import numpy as np

from pipeline.records import FloatArray


def kabsch(predicted_vu: FloatArray, measured_vu: FloatArray, weights: FloatArray) -> tuple[FloatArray, float]:
    """Weighted orthogonal Procrustes without scale (Kabsch 1976), a proper rotation by the det(U V^T) column.

    Parameters
    ----------
    predicted_vu, measured_vu
        (n, 2) pixels, n >= 2.
    weights
        (n,) positive.

    Returns
    -------
    tuple
        (2,) offset about the weighted centroid of the predictions; rotation in radians, positive from +u toward +v.
    """
    share = weights / weights.sum()
    centre_predicted, centre_measured = share @ predicted_vu, share @ measured_vu
    cross = (share[:, None] * (predicted_vu - centre_predicted)).T @ (measured_vu - centre_measured)
    u, _, vt = np.linalg.svd(cross)
    proper = np.diag([1.0, np.linalg.det(u @ vt)])
    rotation = vt.T @ proper @ u.T
    theta = float(np.arctan2(rotation[0, 1] - rotation[1, 0], rotation[0, 0] + rotation[1, 1]))
    return centre_measured - centre_predicted, theta


def pair_rotation(predicted_vu: FloatArray, measured_vu: FloatArray) -> float:
    """Rotation that turns one pair of points onto another, ``atan2(cross, dot)`` of the joining vectors.

    Parameters
    ----------
    predicted_vu, measured_vu
        (..., 2, 2) two points each, pixels.

    Returns
    -------
    float
        Radians, positive from +u toward +v.
    """
    p = predicted_vu[..., 1, :] - predicted_vu[..., 0, :]
    m = measured_vu[..., 1, :] - measured_vu[..., 0, :]
    cross = p[..., 1] * m[..., 0] - p[..., 0] * m[..., 1]
    result: float = np.arctan2(cross, (p * m).sum(axis=-1))
    return result
