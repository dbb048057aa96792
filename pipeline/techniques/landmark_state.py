"""Position and attitude of a camera from landmarks: weighted Gauss-Newton with an a-priori state (seed 001 section 2).

The state is the camera's body-fixed position and a small rotation with ``T' = Exp(-dtheta) T``, T turning body-fixed
into camera axes. Results are reported in the project's order (x, y, z, rx, ry, rz), all body-fixed:
``dp = p_est - p_true`` and ``body_from_camera_true = Exp(r) body_from_camera_est``.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.special import chdtri

from pipeline.camera import project, project_jacobian
from pipeline.geometry.maplet import MapletView
from pipeline.geometry.rotations import rotation_about
from pipeline.options import Options
from pipeline.records import BoolArray, FloatArray, Record

_STEPS = 40
# Rounds at most in which outliers are only weighted down, before any is rejected.
_SOFT_ROUNDS = 15
_HUBER_SIGMAS = 1.5
# Median of a chi-square of two degrees of freedom.
_MEDIAN_CHI2 = 2.0 * float(np.log(2.0))
# An update shorter than this share of its own sigma changes nothing.
_SETTLED_SIGMAS = 1e-4
# A scaled eigenvalue below this says that the landmarks alone do not see a direction.
_BLIND = 1e-9


class LandmarkStateOptions(Options):
    """Weighting and outliers."""

    landmark_errors: Literal["solve", "consider"] = Field(
        "solve", description="landmarks are estimated along, or their errors only inflate the covariance"
    )
    outlier_chance: float = Field(1e-3, gt=0, lt=0.5, description="chance by which a good landmark is rejected")
    least_landmarks: int = Field(4, ge=1, description="landmarks that must remain")
    common_sigma_px: float = Field(
        0.03, ge=0, le=10,
        description="1 sigma per axis of a shift that all landmarks of a picture share, as shading pulls them sunward",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class LandmarkState(Record):
    """Updated state.

    Attributes
    ----------
    view
        Camera at its new place.
    covariance
        (6, 6), km and rad, order (x, y, z, rx, ry, rz), body-fixed.
    residual_vu
        (n, 2) observed minus predicted at the new state.
    used
        (n,) landmarks that took part.
    observable
        Directions of the state, of six, that the landmarks see without the a-priori state.
    steps
        Gauss-Newton steps.
    converged
        The last step was as short as asked for.
    """

    view: MapletView
    covariance: FloatArray
    residual_vu: FloatArray
    used: BoolArray
    observable: int
    steps: int
    converged: bool

    def __post_init__(self) -> None:
        n = len(self.used)
        self._freeze(covariance=(6, 6), residual_vu=(n, 2), used=(n,))


def state_partials(view: MapletView, landmarks_km: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Partials of the measurement (eq. 2.20-2.32 as corrected).

    Parameters
    ----------
    view
        Camera and body.
    landmarks_km
        (n, 3) body-fixed.

    Returns
    -------
    tuple
        (n, 2, 6) d(v, u)/d(position, dtheta), per km and rad; (n, 2, 3) d(v, u)/d(landmark), per km. With
        a = T (x - t): da/dt = -T, da/dtheta = [a x], da/dx = T.
    """
    turn = view.camera_from_body
    seen = (landmarks_km - view.position_km) @ turn.T
    pixels = project_jacobian(view.camera, seen)
    by_place = pixels @ turn
    zero = np.zeros(len(seen))
    x, y, z = seen.T
    cross = np.stack(
        [np.stack([zero, -z, y], axis=1), np.stack([z, zero, -x], axis=1), np.stack([-y, x, zero], axis=1)], axis=1
    )
    return np.concatenate([-by_place, pixels @ cross], axis=2), by_place


def turned(camera_from_body: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Attitude after an update: ``Exp(-dtheta) T``, exact and not to first order.

    Parameters
    ----------
    camera_from_body
        (3, 3).
    dtheta
        (3,) rad, camera axes.

    Returns
    -------
    numpy.ndarray
        (3, 3) rotation.
    """
    angle = float(np.linalg.norm(dtheta))
    if angle == 0.0:
        return camera_from_body
    return np.asarray(rotation_about(-dtheta / angle, angle) @ camera_from_body)


def _angle_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """The dtheta of :func:`turned` that leads from one attitude to a near one."""
    change = before @ after.T
    vector = 0.5 * np.array([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]])
    sine = float(np.linalg.norm(vector))
    cosine = (float(np.trace(change)) - 1.0) / 2.0
    return vector * (np.arctan2(sine, cosine) / sine if sine > 0 else 1.0)


def update_state(
    view: MapletView, matches: tuple[FloatArray, FloatArray, FloatArray, FloatArray], prior_covariance: FloatArray,
    options: LandmarkStateOptions,
) -> LandmarkState | str:  # fmt: skip
    """Camera's position and attitude from observed landmarks.

    Parameters
    ----------
    view
        A-priori geometry.
    matches
        (n, 3) landmarks, body-fixed km; (n, 3, 3) their covariances; (n, 2) observed pixels; (n, 2, 2) their
        covariances.
    prior_covariance
        (6, 6) of the a-priori state, km and rad, order (x, y, z, rx, ry, rz), body-fixed; infinite on the diagonal of
        what is not known.
    options
        Weighting and outliers.

    Returns
    -------
    LandmarkState or str
        Updated state, or why there is none.
    """
    place, _, observed, _ = matches
    n = len(place)
    if n < options.least_landmarks:
        return f"{n} landmarks"
    prior = _prior_information(prior_covariance, view.camera_from_body)
    weight, used, soft = np.ones(n), np.ones(n, bool), True
    limit = float(chdtri(2, options.outlier_chance))
    now, settled, step = view, False, 0
    for step in range(1, _STEPS + 1):
        if not project(view.camera, (place - now.position_km) @ now.camera_from_body.T)[1].all():
            return "a landmark came to lie behind the camera"
        sums = _normal_equations(now, view, matches, weight * used, prior, options)
        update = np.linalg.pinv(sums.normal, hermitian=True) @ sums.right
        now = replace(
            now, position_km=now.position_km + update[:3], camera_from_body=turned(now.camera_from_body, update[3:])
        )
        settled = float(update @ sums.normal @ update) < _SETTLED_SIGMAS**2
        if soft:
            # Half of the landmarks tell the scale while the state is still far away.
            scaled = sums.distance2 / max(1.0, float(np.median(sums.distance2)) / _MEDIAN_CHI2)
            weight = np.minimum(1.0, _HUBER_SIGMAS / np.sqrt(np.maximum(scaled, 1e-12)))
            soft = not (settled or step >= _SOFT_ROUNDS)
            if not soft:
                weight, used = np.ones(n), scaled <= limit
        elif settled:
            keep = sums.distance2 <= limit
            if np.array_equal(keep, used):
                break
            used = keep
        if used.sum() < options.least_landmarks:
            return f"{int(used.sum())} of {n} landmarks agree"
    residual = observed - now.pixels(place)[0]
    return LandmarkState(now, _covariance(sums, now, options), residual, used, _seen(sums), step, settled)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Normal equations at one state."""

    normal: FloatArray
    alone: FloatArray
    right: FloatArray
    considered: FloatArray
    shared: FloatArray
    distance2: FloatArray


def _normal_equations(
    now: MapletView, start: MapletView, matches: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    weight: FloatArray, prior: FloatArray, options: LandmarkStateOptions,
) -> _Sums:  # fmt: skip
    place, place_covariance, observed, covariance = matches
    partials, by_place = state_partials(now, place)
    residual = observed - now.pixels(place)[0]
    from_place = by_place @ place_covariance @ by_place.transpose(0, 2, 1)
    total = np.linalg.inv(covariance + from_place)
    chosen = total if options.landmark_errors == "solve" else np.linalg.inv(covariance)
    weights = chosen * weight[:, None, None]
    alone = np.einsum("nia,nij,njb->ab", partials, weights, partials)
    behind = np.concatenate(
        [start.position_km - now.position_km, -_angle_between(start.camera_from_body, now.camera_from_body)]
    )
    right = np.einsum("nia,nij,nj->a", partials, weights, residual) + prior @ behind
    considered = np.einsum("nia,nij,njk,nkl,nlb->ab", partials, weights, from_place, weights, partials)
    shift = np.einsum("nia,nij->aj", partials, weights)
    shared = options.common_sigma_px**2 * shift @ shift.T
    distance2 = np.einsum("ni,nij,nj->n", residual, total, residual)
    return _Sums(alone + prior, alone, right, considered, shared, distance2)


def _prior_information(covariance: FloatArray, camera_from_body: FloatArray) -> FloatArray:
    """Information of the a-priori state in (position, dtheta); zero for what is not known.

    See :func:`_into_body` for the signs.
    """
    known = np.isfinite(np.diag(covariance))
    information = np.zeros((6, 6))
    information[np.ix_(known, known)] = np.linalg.inv(covariance[np.ix_(known, known)])
    turn = _into_body(camera_from_body)
    return np.asarray(turn.T @ information @ turn)


def _into_body(camera_from_body: FloatArray) -> FloatArray:
    """From what a state lacks to its error: ``dp = -(lacking position)``, but ``r = T' dtheta``."""
    turn = -np.eye(6)
    turn[3:, 3:] = camera_from_body.T
    return turn


def _covariance(sums: _Sums, now: MapletView, options: LandmarkStateOptions) -> FloatArray:
    plain = np.linalg.pinv(sums.normal, hermitian=True)
    covariance = plain + plain @ sums.shared @ plain
    if options.landmark_errors == "consider":
        covariance = covariance + plain @ sums.considered @ plain
    turn = _into_body(now.camera_from_body)
    return np.asarray(turn @ covariance @ turn.T)


def _seen(sums: _Sums) -> int:
    """Directions that the landmarks alone see, on a scale on which each parameter by itself counts one."""
    scale = np.sqrt(np.maximum(np.diag(sums.alone), 1e-300))
    return int((np.linalg.eigvalsh(sums.alone / np.outer(scale, scale)) > _BLIND).sum())
