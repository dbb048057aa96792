"""``lm_subpixel_refine``: vertices of a predicted line brought onto the nearest edges of the image.

The shared kernel of limb, terminator and ring edges (seed 000): Levenberg-Marquardt on the distance transform, Tukey
weights, rotation as a third parameter whose derivative is a central difference of rotated samples, covariance by the
pseudo-inverse of the M-estimator's information.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinvh

from pipeline.geometry.rotations import plane_rotation
from pipeline.records import FloatArray, Image, Record

# Tukey's biweight: 95 % efficient for normal errors.
TUKEY_C = 4.685
_MAX_STEPS = 40
_SETTLED_PX = 1e-3
_STEP_PX = 0.25
# Smallest scatter of distances to edges that lie on whole pixels: a uniform half pixel either way.
_LEAST_SCATTER_PX = 0.29
_NULL = 1e-9


@dataclass(frozen=True, eq=False)
class LineFit(Record):
    """Where a line's vertices meet the edges.

    Attributes
    ----------
    offset_vu, rotation_rad
        Similarity about the pivot.
    covariance
        (2, 2) or (3, 3), px^2 and rad^2, zero along directions that the line does not see.
    weight
        (n,) Tukey weights at the end.
    scatter_px
        Robust scatter of the distances.
    """

    offset_vu: FloatArray
    rotation_rad: float
    covariance: FloatArray
    weight: FloatArray
    scatter_px: float

    def __post_init__(self) -> None:
        size = len(self.covariance)
        self._freeze(offset_vu=(2,), covariance=(size, size), weight=(None,))


def sample(image: Image, places_vu: FloatArray, outside: float) -> FloatArray:
    """Bilinear samples.

    Parameters
    ----------
    image
        (rows, cols).
    places_vu
        (n, 2) pixels.
    outside
        Value beyond the array.

    Returns
    -------
    numpy.ndarray
        (n,).
    """
    rows, cols = image.shape
    inside = (places_vu >= 0).all(axis=1) & (places_vu[:, 0] <= rows - 1) & (places_vu[:, 1] <= cols - 1)
    v, u = np.where(inside[:, None], places_vu, 0.0).T
    i, j = np.minimum(v.astype(np.int64), rows - 2), np.minimum(u.astype(np.int64), cols - 2)
    fv, fu = v - i, u - j
    top = image[i, j] * (1 - fu) + image[i, j + 1] * fu
    bottom = image[i + 1, j] * (1 - fu) + image[i + 1, j + 1] * fu
    return np.where(inside, top * (1 - fv) + bottom * fv, outside)


def tukey_weight(residual: FloatArray, scale: float) -> FloatArray:
    """Tukey's biweight.

    Parameters
    ----------
    residual
        (n,).
    scale
        Robust standard deviation.

    Returns
    -------
    numpy.ndarray
        (n,) in [0, 1].
    """
    ratio = np.clip(np.abs(residual) / (TUKEY_C * scale), 0.0, 1.0)
    return np.asarray((1.0 - ratio**2) ** 2)


def lm_subpixel_refine(
    distance: Image,
    vertices_vu: FloatArray,
    weights: FloatArray,
    start: tuple[float, float, float],
    fit_rotation: bool,
    pivot_vu: FloatArray,
    pivot_distance_px: float,
) -> LineFit:
    """Fit offset and rotation of vertices to the nearest edges.

    Parameters
    ----------
    distance
        (rows, cols) of :func:`pipeline.imaging.edges.distance_to_edges`.
    vertices_vu
        (n, 2) predicted.
    weights
        (n,) how much each counts.
    start
        (dv, du, theta) to begin at.
    fit_rotation
        Whether theta is a parameter.
    pivot_vu
        (2,) centre of the rotation.
    pivot_distance_px
        Turns rotation steps into pixels, for the end test and the difference step.

    Returns
    -------
    LineFit
        Where it settled; vertices outside the array do not count.
    """
    size = 3 if fit_rotation else 2
    state = np.array(start, float)
    far = float(max(distance.shape))
    arm = max(pivot_distance_px, 1.0)

    def distances(at: FloatArray) -> FloatArray:
        moved = pivot_vu + (vertices_vu - pivot_vu) @ plane_rotation(at[2]).T + at[:2]
        return sample(distance, moved, np.nan)

    def cost(at: FloatArray, scale: float) -> tuple[float, FloatArray, FloatArray]:
        residual = np.nan_to_num(distances(at), nan=far)
        weight = weights * tukey_weight(residual, scale)
        inside = np.minimum(residual / (TUKEY_C * scale), 1.0)
        return float((weights * (1.0 - (1.0 - inside**2) ** 3)).sum()), residual, weight

    damping = 1e-3
    scale = max(_LEAST_SCATTER_PX, 1.4826 * float(np.nanmedian(np.abs(np.nan_to_num(distances(state), nan=far)))))
    scale = min(scale, 3.0)
    value, residual, weight = cost(state, scale)
    information = np.zeros((size, size))
    for _ in range(_MAX_STEPS):
        jacobian = np.zeros((len(vertices_vu), size))
        for k, step in enumerate((_STEP_PX, _STEP_PX, _STEP_PX / arm)[:size]):
            move = np.zeros(3)
            move[k] = step
            jacobian[:, k] = np.nan_to_num(distances(state + move) - distances(state - move)) / (2.0 * step)
        information = (jacobian * weight[:, None]).T @ jacobian
        gradient = jacobian.T @ (weight * residual)
        scaled = np.array([1.0, 1.0, arm])[:size]
        matrix = information + damping * np.diag(np.maximum(np.diag(information), 1e-9 * scaled**2))
        change = np.zeros(3)
        change[:size] = -np.linalg.solve(matrix + 1e-12 * np.diag(scaled**2), gradient)
        if np.hypot(*change[:2]) + arm * abs(change[2]) < _SETTLED_PX:
            break
        trial = cost(state + change, scale)
        if trial[0] < value:
            state, (value, residual, weight), damping = state + change, trial, damping / 5.0
            used = weight > 0
            fresh = 1.4826 * float(np.median(residual[used])) if used.any() else scale
            scale = max(_LEAST_SCATTER_PX, min(scale, fresh))
            value, residual, weight = cost(state, scale)
        else:
            damping *= 5.0
            if damping > 1e8:
                break
    return LineFit(state[:2], float(state[2]), _covariance(information, scale, arm), weight, scale)


def _covariance(information: FloatArray, scale: float, arm: float) -> FloatArray:
    """Pseudo-inverse of the information with theta in pixels, so that like is compared with like."""
    unit = np.diag([1.0, 1.0, 1.0 / arm])[: len(information), : len(information)]
    inverse = pinvh(unit @ information @ unit, rtol=_NULL)
    return np.asarray(scale**2 * unit @ inverse @ unit)
