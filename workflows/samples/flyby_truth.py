"""What is known of a frame of the flyby sample, and how well anyone could find its offset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workflows.samples.attitude import wxyz_from_matrix
from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_bodies import centre_and_radius
from workflows.samples.flyby_expose import Scene, Taken, predicted_centre
from workflows.samples.flyby_plan import Shot
from workflows.samples.write import Json, JsonValue

PRIOR_ROTATION_RAD = np.radians(5.0) / np.sqrt(3.0)
"""Sigma of the rotation before a frame is looked at, where one is to be fitted: even within five degrees."""
WEAKEST = 1e-12
"""Information below this, px^-2, counts as none."""

CONVENTION = (
    "actual = pivot + R(theta)(predicted - pivot) + (dv,du); (v,u) row,col of the stored array, first pixel centre "
    "(0,0); pivot = array centre; positive theta turns +u toward +v; predicted = what the kernels give. Cramer-Rao "
    "sigmas: of the offset at the array centre, from the noise-free frame with smooth grey bodies, the photon and read "
    "noise of the pixels that carry information, an unknown brightness and background, and, where a rotation is "
    "fitted, an unknown rotation with a prior of five degrees over the root of three. target_d*_px: by how much the "
    "target's centre lies off its predicted pixel. bodies: discs that touch the array, hidden ones among them"
)


def cramer_rao(
    derivatives: list[FloatArray], variance: FloatArray, useful: NDArray[np.bool_], prior: tuple[float, ...]
) -> FloatArray:
    """Return the smallest covariance (n, n) with which n unknowns can be found.

    Parameters
    ----------
    derivatives
        Of the expected frame with respect to each unknown, (rows, columns) each.
    variance
        Of the pixels (rows, columns), DN^2.
    useful
        Pixels that count.
    prior
        Information on each unknown beforehand.
    """
    weight = 1.0 / np.sqrt(variance[useful])
    columns = np.stack([derivative[useful] * weight for derivative in derivatives])
    information = columns @ columns.T + np.diag(prior)
    # Unknowns of very different size: made alike before the inversion.
    size = np.sqrt(np.maximum(np.diag(information), WEAKEST))
    covariance: FloatArray = np.linalg.pinv(information / np.outer(size, size), rcond=1e-12, hermitian=True)
    covariance /= np.outer(size, size)
    return covariance


def sigmas(shot: Shot, scene: Scene, taken: Taken) -> tuple[float, float, float | None]:
    """Return the Cramér-Rao sigmas of dv and du, px, and of the rotation, rad, None where it is not fitted."""
    optics = shot.camera.optics
    variance = optics.read_noise_dn**2 + np.maximum(scene.expected, 0.0) / optics.gain_e_per_dn
    unknowns = [scene.shift_v, scene.shift_u]
    prior = [0.0, 0.0]
    if optics.fit_camera_rotation:
        v = np.arange(optics.shape_vu[0])[:, None] - optics.centre_vu[0]
        u = np.arange(optics.shape_vu[1])[None, :] - optics.centre_vu[1]
        # The scene turns from +u toward +v: a point at (v, u) moves by (u, -v) per radian.
        unknowns.append(scene.shift_v * u - scene.shift_u * v)
        prior.append(1.0 / PRIOR_ROTATION_RAD**2)
    unknowns += [scene.scale, np.ones(optics.shape_vu)]
    covariance = cramer_rao(unknowns, variance, ~taken.useless, (*prior, 0.0, 0.0))
    sigma = np.sqrt(np.diag(covariance))
    return float(sigma[0]), float(sigma[1]), float(sigma[2]) if optics.fit_camera_rotation else None


def inside_share(centre: FloatArray, radius: float, shape_vu: tuple[int, int]) -> float:
    """Return the share of a disc that lies on the array, by a thousand samples."""
    golden = np.pi * (3.0 - np.sqrt(5.0))
    n = np.arange(1000)
    r, angle = radius * np.sqrt((n + 0.5) / len(n)), golden * n
    points = centre + np.stack([r * np.sin(angle), r * np.cos(angle)], axis=1)
    on = np.all((points > -0.5) & (points < np.array(shape_vu) - 0.5), axis=1)
    return float(on.mean())


def rounded(values: FloatArray) -> list[JsonValue]:
    """Return numbers rounded to four decimals, for JSON."""
    return [round(float(value), 4) for value in values]


def truth_entry(shot: Shot, scene: Scene, taken: Taken) -> Json:
    """Return a frame's entry of truth.json."""
    optics = shot.camera.optics
    target = next(s for s in shot.sightings() if s.body.name == shot.target)
    centre, radius = centre_and_radius(optics, shot.truth, target)
    before = predicted_centre(shot, target)
    sigma_v, sigma_u, sigma_rotation = sigmas(shot, scene, taken)
    bodies: Json = {
        name: {"centre_vu": rounded(place), "diameter_px": round(diameter, 3)}
        for name, (place, diameter) in sorted(scene.bodies.items())
    }
    return {
        "offset_dv_px": float(shot.offset_vu[0]),
        "offset_du_px": float(shot.offset_vu[1]),
        "rotation_deg": float(np.degrees(shot.rotation_rad)),
        "camera": shot.camera.name,
        "target": shot.target,
        "kind": shot.kind,
        "diameter_px": round(2.0 * radius, 3),
        "phase_deg": round(float(np.degrees(target.phase_rad)), 3),
        "snr": round(scene.snr, 3),
        "cramer_rao_sigma_dv_px": sigma_v,
        "cramer_rao_sigma_du_px": sigma_u,
        "cramer_rao_sigma_rotation_deg": None if sigma_rotation is None else float(np.degrees(sigma_rotation)),
        "target_dv_px": float(centre[0] - before[0]),
        "target_du_px": float(centre[1] - before[1]),
        "target_inside_share": round(inside_share(centre, radius, optics.shape_vu), 4),
        "target_predicted_inside_share": round(inside_share(before, radius, optics.shape_vu), 4),
        "n_bodies_in_frame": len(scene.bodies),
        "bodies": bodies,
        "n_stars": scene.n_stars,
        "exposure_s": shot.exposure_s,
        "missing_lines": taken.missing_lines,
        "overexposure": round(shot.overexposure, 3),
        "useless_px": int(taken.useless.sum()),
        "true_camera_from_j2000_wxyz": [float(x) for x in wxyz_from_matrix(shot.truth)],
    }
