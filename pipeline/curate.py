"""From a Navigation to the image's JSON document."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from pipeline.ensemble import _CombinedEstimate
from pipeline.frame import Frame
from pipeline.geometry.pointing import corrected_attitude
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.json_values import Json as Json
from pipeline.navigate import Navigation, corrected_sigma_px
from pipeline.options import Options
from pipeline.predict.bodies import BodyFate
from pipeline.predict.rings import RingFate
from pipeline.records import FloatArray, State
from pipeline.status import Rank, Status, StatusReason, status_of
from pipeline.techniques.base import FeatureTable, TechniqueFailure, TechniqueResult, covariance_of
from pipeline.techniques.landmark_table import LandmarkTable
from pipeline.techniques.ring_edges import RingEdgeTable
from pipeline.techniques.surface_features import SurfaceFix

SCHEMA = "pilotage/1"
# Digits kept of feature positions, in decimals of a pixel; a hundredth of the best centroid's sigma.
_PIXEL_DIGITS = 5
# No measured offset is known only to a thousand pixels: beyond that a variance is a share of the sentinel, a null.
_UNKNOWN_VARIANCE = 1.0e6


class RankTier(Options):
    """What an answer needs to be in a tier."""

    min_confidence: float = Field(ge=0, le=1, description="least confidence")
    max_sigma_px: float = Field(gt=0, description="largest of the translation's two sigmas, pixels")


class RankOptions(Options):
    """Tiers of the seed; whatever reaches neither is low."""

    high: RankTier = RankTier(min_confidence=0.999, max_sigma_px=0.3)
    medium: RankTier = RankTier(min_confidence=0.95, max_sigma_px=1.0)


@dataclass(frozen=True)
class Provenance:
    """What an answer was made from.

    Attributes
    ----------
    software, config_digest
        Version of Pilotage and digest of the configuration.
    image_path, image_sha256
        The file, relative to the archive.
    geometry_source, geometry_sha256
        Provider, and digest of what it read.
    catalogs
        (name, sha256) of each star table.
    shapes, kernels
        (name, sha256) of each shape file and SPICE kernel, kernels in the order in which they were loaded.
    """

    software: str
    config_digest: str
    image_path: str
    image_sha256: str | None = None
    geometry_source: str | None = None
    geometry_sha256: str | None = None
    catalogs: tuple[tuple[str, str], ...] = ()
    shapes: tuple[tuple[str, str], ...] = ()
    kernels: tuple[tuple[str, str], ...] = ()


def build_metadata_dict(
    navigation: Navigation, options: RankOptions, provenance: Provenance, label: dict[str, Json] | None = None
) -> dict[str, Json]:
    """The JSON document of one image (seed 000's conditional keys).

    ``rotation_deg`` and ``sigma_rotation_deg`` are there only when a rotation was fitted, and null when it was fitted
    but not observable.

    Parameters
    ----------
    navigation
        What became of the image.
    options
        Rank tiers.
    provenance
        What it was made from.
    label
        What the product's own label says, as JSON values.

    Returns
    -------
    dict
        JSON values only; no clock, no path of this machine.
    """
    state, estimate = navigation.state, navigation.estimate
    document: dict[str, Json] = {
        "schema": SCHEMA, "image_id": state.image_id, "mission": state.mission, "camera": state.camera,
        "time_utc": state.time_utc, "et": state.et, "exposure_s": state.exposure_s,
        "status": status_of(navigation.reason).value, "status_reason": navigation.reason.value,
        "detail": navigation.detail, "rank": rank_of(navigation, options).value,
        "confidence": None if estimate is None else float(estimate.confidence),
    }  # fmt: skip
    document |= _answer(estimate, state)
    document["pointing"] = _pointing(estimate, state, navigation.reason)
    document["geometry"] = _geometry(state)
    document["bodies"] = [_body(fate) for fate in navigation.bodies]
    document["rings"] = [_ring(fate) for fate in navigation.rings]
    document["ring_edges"] = None if navigation.ring_edges is None else _ring_edges(navigation.ring_edges)
    table = None if navigation.landmarks is None else navigation.landmarks.table
    document["landmarks"] = None if table is None else _landmarks(table)
    document["landmark_state"] = None if navigation.landmarks is None else _landmark_state(navigation.landmarks)
    document["frame"] = None if navigation.frame is None else _frame_figures(navigation.frame)
    answers: list[Json] = [_technique(result, estimate) for result in navigation.results]
    document["techniques"] = [*answers, *(_failure(failure) for failure in navigation.failures)]
    document["label"] = label
    document["provenance"] = _provenance(provenance)
    return document


def error_document(
    image_id: str, reason: StatusReason, detail: str, provenance: Provenance, label: dict[str, Json] | None = None
) -> dict[str, Json]:
    """Document of an image that could not be worked on: same keys, nothing known.

    Parameters
    ----------
    image_id
        Identity.
    reason, detail
        Why.
    provenance
        As far as it goes.
    label
        What the product's own label says, where it could be read.

    Returns
    -------
    dict
        JSON values only.
    """
    status = status_of(reason)
    return {
        "schema": SCHEMA, "image_id": image_id, "mission": "UNKNOWN", "camera": "UNKNOWN", "time_utc": None, "et": None,
        "exposure_s": None, "status": status.value, "status_reason": reason.value, "detail": detail,
        "rank": Rank.FAILED.value, "confidence": None, "offset_px": None, "sigma_px": None, "covariance_px2": None,
        "observable": None, "pointing": None, "geometry": None, "bodies": [], "rings": [], "ring_edges": None,
        "landmarks": None, "landmark_state": None, "frame": None, "techniques": [], "label": label,
        "provenance": _provenance(provenance),
    }  # fmt: skip


def rank_of(navigation: Navigation, options: RankOptions) -> Rank:
    """Tier of an answer, from its confidence and the translation's sigma alone; low at the edge of the search.

    Parameters
    ----------
    navigation
        The image's outcome.
    options
        Tiers.

    Returns
    -------
    Rank
        A good rotation never lifts a poor translation.
    """
    status, estimate = status_of(navigation.reason), navigation.estimate
    if status is Status.CONFLICTED:
        return Rank.CONFLICTED
    if status is not Status.SUCCESS or estimate is None:
        return Rank.FAILED
    if navigation.reason is StatusReason.NAVIGATED_AT_EDGE:
        return Rank.LOW
    worst = float(np.max(corrected_sigma_px(estimate)))
    for rank, tier in ((Rank.HIGH, options.high), (Rank.MEDIUM, options.medium)):
        if estimate.confidence >= tier.min_confidence and worst <= tier.max_sigma_px:
            return rank
    return Rank.LOW


def _numbers(values: FloatArray, digits: int | None = None) -> Json:
    """Nested lists with null for not-a-number."""
    if values.ndim > 1:
        return [_numbers(row, digits) for row in values]
    plain = values.tolist()
    return [None if v != v else (v if digits is None else round(v, digits)) for v in plain]


def _answer(estimate: _CombinedEstimate | None, state: State) -> dict[str, Json]:
    if estimate is None:
        answer: dict[str, Json] = {"offset_px": None, "sigma_px": None, "covariance_px2": None, "observable": None}
    elif estimate.observable_vu is not None:
        answer = {
            "offset_px": None, "sigma_px": None, "covariance_px2": None,
            "observable": {
                "direction_vu": _numbers(estimate.observable_vu), "offset_along_px": estimate.along_px,
                "sigma_along_px": estimate.sigma_along_px,
            },
        }  # fmt: skip
    else:
        answer = {
            "offset_px": _numbers(estimate.offset_vu), "sigma_px": _numbers(corrected_sigma_px(estimate)),
            "covariance_px2": _numbers(estimate.covariance[:2, :2]), "observable": None,
        }  # fmt: skip
    if state.settings.fit_camera_rotation:
        answer["rotation_deg"] = answer["sigma_rotation_deg"] = None
        if estimate is not None and estimate.rotation_rad is not None:
            answer["rotation_deg"] = float(np.degrees(estimate.rotation_rad))
            answer["sigma_rotation_deg"] = float(np.degrees(np.sqrt(estimate.covariance[2, 2])))
    return answer


def _pointing(estimate: _CombinedEstimate | None, state: State, reason: StatusReason) -> dict[str, Json]:
    prior = state.attitude.camera_from_j2000
    pointing: dict[str, Json] = {
        "a_priori_camera_from_j2000_wxyz": _numbers(quaternion_from_matrix(prior)),
        "camera_from_j2000_wxyz": None, "covariance": None,
    }  # fmt: skip
    if estimate is not None and estimate.observable_vu is None and status_of(reason) is Status.SUCCESS:
        after = corrected_attitude(state.camera_model, prior, estimate.offset_vu, estimate.rotation_rad or 0.0)
        pointing["camera_from_j2000_wxyz"] = _numbers(quaternion_from_matrix(after))
        known = 2 if estimate.rotation_rad is None else len(estimate.covariance)
        # (dv, du, theta) at the array centre, px^2 and rad^2; without theta where that is not known.
        pointing["covariance"] = _numbers(estimate.covariance[:known, :known])
    return pointing


def _geometry(state: State) -> dict[str, Json]:
    """The camera, and from where it was believed to see each body: what poses are estimated against."""
    camera = state.camera_model
    model: dict[str, Json] = {
        "shape_vu": list(camera.shape_vu), "focal_length_mm": camera.focal_length_mm,
        "k_px_per_mm": _numbers(camera.k_px_per_mm), "principal_point_vu": _numbers(camera.principal_point_vu),
        "distortion_eps": _numbers(camera.distortion_eps), "k_xy_px_per_mm2": _numbers(camera.k_xy_px_per_mm2),
    }  # fmt: skip
    bodies: list[Json] = [
        {
            "name": body.name, "naif_id": body.naif_id, "radii_km": _numbers(body.radii_km),
            "camera_in_body_km": _numbers(-body.body_from_j2000 @ body.position_km),
            "body_from_j2000_wxyz": _numbers(quaternion_from_matrix(body.body_from_j2000)),
        }
        for body in state.bodies
    ]  # fmt: skip
    return {"camera_model": model, "bodies": bodies}


def _frame_figures(frame: Frame) -> dict[str, Json]:
    return {
        "image_class": frame.image_class.value, "background_dn": frame.background_dn, "noise_dn": frame.noise_dn,
        "gain_e_per_dn": frame.gain_e_per_dn, "missing_share": frame.missing_share,
        "saturated_share": frame.saturated_share, "psf_sigma_px": frame.spread.sigma_px,
        "trail_px": list(frame.spread.trail_vu),
    }  # fmt: skip


def _body(fate: BodyFate) -> Json:
    centre: Json = None if fate.centre_vu is None else [round(x, _PIXEL_DIGITS) for x in fate.centre_vu]
    return {
        "name": fate.name, "centre_vu": centre, "diameter_px": round(fate.diameter_px, _PIXEL_DIGITS),
        "phase_deg": round(fate.phase_deg, _PIXEL_DIGITS), "left_out": fate.reason,
    }  # fmt: skip


def _ring(fate: RingFate) -> Json:
    return {
        "name": fate.name, "kind": fate.kind, "visible_px": round(fate.visible_px, 1), "straight": fate.straight,
        "left_out": fate.reason,
    }  # fmt: skip


def _ring_edges(table: RingEdgeTable) -> dict[str, Json]:
    """Columns of the measured edges; a pixel may be metres or thousands of kilometres, so radii keep six decimals."""
    digits = {"v_px": _PIXEL_DIGITS, "u_px": _PIXEL_DIGITS, "sigma_px": _PIXEL_DIGITS, "contrast_dn": 3, "weight": 3}
    columns: dict[str, Json] = {"feature": table.feature.tolist(), "outer": table.outer.tolist()}
    for name in (
        "radius_km", "longitude_deg", "sigma_km", "predicted_km", "v_px", "u_px", "sigma_px", "contrast_dn", "weight",
    ):  # fmt: skip
        columns[name] = _numbers(getattr(table, name), digits.get(name, 6))
    return columns


def _landmarks(table: LandmarkTable) -> dict[str, Json]:
    """Columns of the landmarks: predicted, observed, and what was in between."""
    offset, covariance = table.observed_vu - table.predicted_vu, table.covariance_px2
    columns: dict[str, Json] = {
        "landmark": table.name.tolist(), "status": table.status.tolist(), "reason": table.reason.tolist(),
        "used": table.used.tolist(), "bin": table.bin_size.tolist(),
    }  # fmt: skip
    reals = {
        "predicted_v_px": table.predicted_vu[:, 0], "predicted_u_px": table.predicted_vu[:, 1],
        "observed_v_px": table.observed_vu[:, 0], "observed_u_px": table.observed_vu[:, 1],
        "offset_dv_px": offset[:, 0], "offset_du_px": offset[:, 1],
        "sigma_dv_px": np.sqrt(covariance[:, 0, 0]), "sigma_du_px": np.sqrt(covariance[:, 1, 1]),
        "cov_dv_du_px2": covariance[:, 0, 1], "correlation": table.correlation, "incidence_deg": table.incidence_deg,
        "emission_deg": table.emission_deg, "cells_per_pixel": table.ratio,
        "illuminated_share": table.illuminated, "removed_share": table.removed,
    }  # fmt: skip
    for name, values in reals.items():
        columns[name] = _numbers(values, _PIXEL_DIGITS + 1)
    for axis, name in enumerate(("x_km", "y_km", "z_km")):
        columns[name] = _numbers(table.landmark_km[:, axis])
    for i, j in zip(*np.triu_indices(3), strict=True):
        columns[f"cov_{'xyz'[i]}{'xyz'[j]}_km2"] = _numbers(table.landmark_covariance_km2[:, i, j])
    return columns


def _landmark_state(fix: SurfaceFix) -> dict[str, Json] | None:
    """Body-fixed place of the camera; covariance order (x, y, z, rx, ry, rz), km and rad."""
    state = fix.state
    if state is None or isinstance(fix.answer, TechniqueFailure):
        return None
    return {
        "body": fix.answer.error_sources[0].removeprefix("body:"),
        "position_km": _numbers(state.view.position_km),
        "camera_from_body_wxyz": _numbers(quaternion_from_matrix(state.view.camera_from_body)),
        "covariance": _numbers(state.covariance), "landmarks_used": int(state.used.sum()),
        "landmarks_rejected": int((~state.used).sum()), "observable_directions": state.observable,
        "converged": state.converged,
    }  # fmt: skip


def _technique(result: TechniqueResult, estimate: _CombinedEstimate | None) -> dict[str, Json]:
    covariance = covariance_of(result.information)
    unknown = np.diag(covariance) > _UNKNOWN_VARIANCE
    covariance[unknown, :] = covariance[:, unknown] = np.nan
    turns = result.degrees_of_freedom == 3 and not unknown[2]
    excluded = dict(estimate.excluded) if estimate is not None else {}
    document: dict[str, Json] = {
        "technique": result.technique, "status_reason": StatusReason.NAVIGATED.value, "detail": "",
        "offset_px": _numbers(result.offset_vu), "pivot_vu": _numbers(result.pivot_vu),
        "sigma_px": _numbers(np.sqrt(np.diag(covariance)[:2])), "covariance_px2": _numbers(covariance[:2, :2]),
        "confidence": float(result.confidence), "at_edge": result.at_edge, "spurious": result.spurious,
        "in_ensemble": estimate is not None and result.technique in estimate.members,
        "left_out": excluded.get(result.technique), "diagnostics": {k: float(v) for k, v in result.diagnostics.items()},
        "features": None if result.features is None else _features(result.features),
    }  # fmt: skip
    if result.degrees_of_freedom == 3:
        document["rotation_deg"] = float(np.degrees(result.rotation_rad)) if turns else None
        document["sigma_rotation_deg"] = float(np.degrees(np.sqrt(covariance[2, 2]))) if turns else None
        document["at_edge_rotation"] = result.at_edge_rotation
    return document


def _failure(failure: TechniqueFailure) -> dict[str, Json]:
    return {"technique": failure.technique, "status_reason": failure.reason.value, "detail": failure.detail}


def _features(table: FeatureTable) -> dict[str, Json]:
    """Columns of the inventory: an image's hundred stars take one list each, not a hundred objects."""
    return {
        "name": table.name.tolist(), "kind": table.kind.tolist(),
        "predicted_v_px": _numbers(table.predicted_vu[:, 0], _PIXEL_DIGITS),
        "predicted_u_px": _numbers(table.predicted_vu[:, 1], _PIXEL_DIGITS),
        "measured_v_px": _numbers(table.measured_vu[:, 0], _PIXEL_DIGITS),
        "measured_u_px": _numbers(table.measured_vu[:, 1], _PIXEL_DIGITS),
        "residual_v_px": _numbers(table.residual_vu[:, 0], _PIXEL_DIGITS),
        "residual_u_px": _numbers(table.residual_vu[:, 1], _PIXEL_DIGITS),
        "sigma_px": _numbers(table.sigma_px, _PIXEL_DIGITS), "mag": _numbers(table.mag, 3),
        "snr": _numbers(table.snr, 2), "used": table.used.tolist(), "reason": table.reason.tolist(),
    }  # fmt: skip


def _provenance(provenance: Provenance) -> dict[str, Json]:
    return {
        "software": provenance.software, "config_digest": provenance.config_digest, "image_path": provenance.image_path,
        "image_sha256": provenance.image_sha256, "geometry_source": provenance.geometry_source,
        "geometry_sha256": provenance.geometry_sha256,
        "catalogs": _digests(provenance.catalogs), "shapes": _digests(provenance.shapes),
        "kernels": _digests(provenance.kernels),
    }  # fmt: skip


def _digests(files: tuple[tuple[str, str], ...]) -> Json:
    return [{"name": name, "sha256": sha256} for name, sha256 in files]
