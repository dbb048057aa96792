"""What is known of a frame of the asteroid sample."""

from __future__ import annotations

import numpy as np

from workflows.samples.asteroid_plan import GRID, AsteroidShot, eye_of, looked_at, pixels_of
from workflows.samples.asteroid_rays import Ground
from workflows.samples.attitude import wxyz_from_matrix
from workflows.samples.cameras import FloatArray
from workflows.samples.write import Json, JsonValue

CONVENTION = (
    "actual = pivot + R(theta)(predicted - pivot) + (dv,du); (v,u) row,col of the stored array, first pixel centre "
    "(0,0); pivot = array centre; positive theta turns +u toward +v; predicted = what the kernels give. The kernels "
    "err in attitude and in position, which no offset tells fully: offset and rotation are those that fit the seen "
    "surface best, misfit_rms_px is what they leave. true_position_km: of the camera from the body's centre, "
    "body-fixed, with light time and aberration in the attitude; true_camera_from_body_wxyz belongs to it; "
    "position_error_km is told less true, body-fixed"
)


def best_offset(before: FloatArray, after: FloatArray, pivot: FloatArray) -> tuple[FloatArray, float, float]:
    """Return offset (2,), rotation (rad) and misfit (rms px) that carry pixels (n, 2) to others, about a pivot."""
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    # Positive rotation carries (v, u) to (v cos + u sin, u cos - v sin).
    cross, dot = float((b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]).sum()), float((a * b).sum())
    angle = float(np.arctan2(cross, dot))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    misfit = float(np.sqrt(((b - a @ turn.T) ** 2).sum(axis=1).mean()))
    offset: FloatArray = after.mean(axis=0) - pivot - turn @ (before.mean(axis=0) - pivot)
    return offset, angle, misfit


def _listed(values: FloatArray) -> list[JsonValue]:
    return [float(value) for value in values]


def truth_entry(item: AsteroidShot, ground: Ground, snr: float) -> Json:
    """Return a frame's entry of truth.json."""
    shot, sighting, told = item.shot, item.sighting(), item.told_sighting()
    optics = shot.camera.optics
    places, pixels = looked_at(optics, shot.truth, sighting, ground)
    before = pixels_of(optics, shot.apriori, told, places)
    offset, rotation, misfit = best_offset(before, pixels, optics.centre_vu)
    return {
        "offset_dv_px": float(offset[0]),
        "offset_du_px": float(offset[1]),
        "rotation_deg": float(np.degrees(rotation)),
        "misfit_rms_px": round(misfit, 4),
        "camera": shot.camera.name,
        "target": shot.target,
        "kind": item.kind,
        "range_km": round(sighting.range_km, 6),
        "pixel_km": round(sighting.range_km * optics.rad_per_px, 7),
        "phase_deg": round(float(np.degrees(sighting.phase_rad)), 3),
        "snr": round(snr, 3),
        "surface_share": round(len(places) / GRID**2, 4),
        "exposure_s": shot.exposure_s,
        "pointing_dv_px": float(shot.offset_vu[0]),
        "pointing_du_px": float(shot.offset_vu[1]),
        "twist_deg": float(np.degrees(shot.rotation_rad)),
        "position_error_km": _listed(eye_of(told) - eye_of(sighting)),
        "true_position_km": _listed(eye_of(sighting)),
        "true_camera_from_body_wxyz": _listed(wxyz_from_matrix(shot.truth @ sighting.from_j2000.T)),
        "true_camera_from_j2000_wxyz": _listed(wxyz_from_matrix(shot.truth)),
    }
