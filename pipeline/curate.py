"""From a Navigation to the image's JSON document, and from that document to table rows."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from pydantic import Field

from pipeline.ensemble import _CombinedEstimate
from pipeline.frame import Frame
from pipeline.geometry.pointing import corrected_attitude
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.navigate import Navigation, corrected_sigma_px
from pipeline.options import Options
from pipeline.records import FloatArray, State
from pipeline.status import Rank, Status, StatusReason, status_of
from pipeline.techniques.base import FeatureTable, TechniqueFailure, TechniqueResult, covariance_of

Json = str | int | float | bool | None | list["Json"] | dict[str, "Json"]
Row = dict[str, Json]

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
    """

    software: str
    config_digest: str
    image_path: str
    image_sha256: str | None = None
    geometry_source: str | None = None
    geometry_sha256: str | None = None
    catalogs: tuple[tuple[str, str], ...] = ()


def build_metadata_dict(navigation: Navigation, options: RankOptions, provenance: Provenance) -> dict[str, Json]:
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
    document["frame"] = None if navigation.frame is None else _frame_figures(navigation.frame)
    answers: list[Json] = [_technique(result, estimate) for result in navigation.results]
    document["techniques"] = [*answers, *(_failure(failure) for failure in navigation.failures)]
    document["provenance"] = _provenance(provenance)
    return document


def error_document(image_id: str, reason: StatusReason, detail: str, provenance: Provenance) -> dict[str, Json]:
    """Document of an image that could not be worked on: same keys, nothing known.

    Parameters
    ----------
    image_id
        Identity.
    reason, detail
        Why.
    provenance
        As far as it goes.

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
        "observable": None, "pointing": None, "frame": None, "techniques": [], "provenance": _provenance(provenance),
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
        "camera_from_j2000_wxyz": None,
    }
    if estimate is not None and estimate.observable_vu is None and status_of(reason) is Status.SUCCESS:
        after = corrected_attitude(state.camera_model, prior, estimate.offset_vu, estimate.rotation_rad or 0.0)
        pointing["camera_from_j2000_wxyz"] = _numbers(quaternion_from_matrix(after))
    return pointing


def _frame_figures(frame: Frame) -> dict[str, Json]:
    return {
        "image_class": frame.image_class.value, "background_dn": frame.background_dn, "noise_dn": frame.noise_dn,
        "gain_e_per_dn": frame.gain_e_per_dn, "missing_share": frame.missing_share,
        "saturated_share": frame.saturated_share, "psf_sigma_px": frame.spread.sigma_px,
        "trail_px": list(frame.spread.trail_vu),
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
        "catalogs": [{"name": name, "sha256": sha256} for name, sha256 in provenance.catalogs],
    }  # fmt: skip


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


_TEXT, _REAL, _FLAG = pa.string(), pa.float64(), pa.bool_()
_IDENTITY = (
    _field("image_id", _TEXT, "", "image"),
    _field("mission", _TEXT, "", "mission (partition)"),
    _field("camera", _TEXT, "", "camera (partition)"),
)
_PIXEL = "px"

SCHEMAS: dict[str, pa.Schema] = {
    "offsets": pa.schema([
        *_IDENTITY,
        _field("time_utc", _TEXT, "ISO-8601 UTC", "mid-exposure"),
        _field("status", _TEXT, "", "success, failed, conflicted or error"),
        _field("status_reason", _TEXT, "", "the one cause behind the status"),
        _field("rank", _TEXT, "", "high, medium, low, failed or conflicted"),
        _field("confidence", _REAL, "probability", "that the answer is no mistake; null without an answer"),
        _field("offset_dv_px", _REAL, _PIXEL, "predicted + offset = actual, along rows, at the array centre"),
        _field("offset_du_px", _REAL, _PIXEL, "the same along columns"),
        _field("sigma_dv_px", _REAL, _PIXEL, "1 sigma of offset_dv_px"),
        _field("sigma_du_px", _REAL, _PIXEL, "1 sigma of offset_du_px"),
        _field("cov_dv_du_px2", _REAL, "px2", "covariance of the two"),
        _field("rotation_deg", _REAL, "deg", "in-plane rotation, +u toward +v; null if not fitted or not observable"),
        _field("sigma_rotation_deg", _REAL, "deg", "1 sigma of rotation_deg"),
        _field("observable_dv", _REAL, "", "v of the unit vector of the one observable direction, else null"),
        _field("observable_du", _REAL, "", "u of it"),
        _field("offset_along_px", _REAL, _PIXEL, "offset along the observable direction"),
        _field("sigma_along_px", _REAL, _PIXEL, "1 sigma of it"),
        _field("qw", _REAL, "", "corrected camera_from_j2000 quaternion, scalar part; null without a full answer"),
        _field("qx", _REAL, "", "its x"),
        _field("qy", _REAL, "", "its y"),
        _field("qz", _REAL, "", "its z"),
        _field("techniques", _TEXT, "", "techniques fused, separated by '+'"),
        _field("features_used", pa.int64(), "count", "features that the most informative technique used"),
        _field("image_class", _TEXT, "", "normal, noisy or gradient; null where the image was refused"),
        _field("detail", _TEXT, "", "one line for a person"),
        _field("config_digest", _TEXT, "", "sha256 of the configuration"),
    ]),
    "techniques": pa.schema([
        *_IDENTITY,
        _field("technique", _TEXT, "", "name"),
        _field("status_reason", _TEXT, "", "navigated, or why not"),
        _field("offset_dv_px", _REAL, _PIXEL, "offset about the technique's own pivot"),
        _field("offset_du_px", _REAL, _PIXEL, "the same along columns"),
        _field("sigma_dv_px", _REAL, _PIXEL, "1 sigma"),
        _field("sigma_du_px", _REAL, _PIXEL, "1 sigma"),
        _field("cov_dv_du_px2", _REAL, "px2", "covariance of the two"),
        _field("rotation_deg", _REAL, "deg", "null if not fitted or not observable"),
        _field("sigma_rotation_deg", _REAL, "deg", "1 sigma"),
        _field("pivot_v_px", _REAL, _PIXEL, "pivot of the rotation"),
        _field("pivot_u_px", _REAL, _PIXEL, "pivot of the rotation"),
        _field("confidence", _REAL, "probability", "the technique's own"),
        _field("at_edge", _FLAG, "", "the search ran into its bound"),
        _field("in_ensemble", _FLAG, "", "fused into the image's answer"),
        _field("left_out", _TEXT, "", "why it was not fused"),
        _field("features_used", pa.int64(), "count", "features in the fit"),
        _field("extra_sigma_px", _REAL, _PIXEL, "scatter of the residuals beyond the stated sigmas"),
        _field("detail", _TEXT, "", "one line for a person"),
    ]),
    "features": pa.schema([
        *_IDENTITY,
        _field("technique", _TEXT, "", "technique that looked for it"),
        _field("name", _TEXT, "", "catalogue name"),
        _field("kind", _TEXT, "", "star"),
        _field("predicted_v_px", _REAL, _PIXEL, "under the a-priori attitude"),
        _field("predicted_u_px", _REAL, _PIXEL, "under the a-priori attitude"),
        _field("measured_v_px", _REAL, _PIXEL, "null where not found"),
        _field("measured_u_px", _REAL, _PIXEL, "null where not found"),
        _field("residual_v_px", _REAL, _PIXEL, "measured minus predicted under the fitted pointing"),
        _field("residual_u_px", _REAL, _PIXEL, "measured minus predicted under the fitted pointing"),
        _field("sigma_px", _REAL, _PIXEL, "1 sigma of the measurement per axis"),
        _field("mag", _REAL, "mag", "catalogue magnitude"),
        _field("snr", _REAL, "", "expected signal to noise"),
        _field("used", _FLAG, "", "took part in the fit"),
        _field("reason", _TEXT, "", "why not; empty where used"),
    ]),
    "timings": pa.schema([
        *_IDENTITY,
        _field("stage", _TEXT, "", "stage of the pipeline, or total"),
        _field("seconds", _REAL, "s", "wall-clock time on its worker"),
    ]),
}  # fmt: skip


def _pair(value: Json) -> tuple[Json, Json]:
    return (value[0], value[1]) if isinstance(value, list) else (None, None)


def _identity(document: Mapping[str, Json]) -> Row:
    return {key: document[key] for key in ("image_id", "mission", "camera")}


def _used(technique: Mapping[str, Json]) -> int | None:
    features = technique.get("features")
    return (
        sum(map(bool, features["used"])) if isinstance(features, dict) and isinstance(features["used"], list) else None
    )


def offset_row(document: Mapping[str, Json]) -> Row:
    """Row of table ``offsets``.

    Parameters
    ----------
    document
        An image's JSON document.

    Returns
    -------
    dict
        One value per column.
    """
    techniques = [t for t in document["techniques"] or [] if isinstance(t, dict)]  # type: ignore[union-attr]
    fused = [t for t in techniques if t.get("in_ensemble")]
    row: Row = _identity(document)
    for key in ("time_utc", "status", "status_reason", "rank", "confidence", "detail"):
        row[key] = document[key]
    row["offset_dv_px"], row["offset_du_px"] = _pair(document["offset_px"])
    row["sigma_dv_px"], row["sigma_du_px"] = _pair(document["sigma_px"])
    covariance = document["covariance_px2"]
    row["cov_dv_du_px2"] = (
        covariance[0][1] if isinstance(covariance, list) and isinstance(covariance[0], list) else None
    )
    row["rotation_deg"], row["sigma_rotation_deg"] = document.get("rotation_deg"), document.get("sigma_rotation_deg")
    observable = document["observable"]
    if isinstance(observable, dict):
        row["observable_dv"], row["observable_du"] = _pair(observable["direction_vu"])
        row["offset_along_px"], row["sigma_along_px"] = observable["offset_along_px"], observable["sigma_along_px"]
    pointing = document["pointing"]
    quaternion = pointing["camera_from_j2000_wxyz"] if isinstance(pointing, dict) else None
    if isinstance(quaternion, list):
        row["qw"], row["qx"], row["qy"], row["qz"] = quaternion
    row["techniques"] = "+".join(str(t["technique"]) for t in fused)
    row["features_used"] = max((_used(t) or 0 for t in fused), default=None)
    frame, provenance = document["frame"], document["provenance"]
    row["image_class"] = frame["image_class"] if isinstance(frame, dict) else None
    row["config_digest"] = provenance["config_digest"] if isinstance(provenance, dict) else None
    return row


def technique_rows(document: Mapping[str, Json]) -> list[Row]:
    """Rows of table ``techniques``.

    Parameters
    ----------
    document
        An image's JSON document.

    Returns
    -------
    list of dict
        One per technique that ran.
    """
    rows: list[Row] = []
    for technique in document["techniques"] or []:  # type: ignore[union-attr]
        if not isinstance(technique, dict):
            continue
        row = _identity(document)
        for key in (
            "technique", "status_reason", "detail", "rotation_deg", "sigma_rotation_deg", "confidence", "at_edge",
            "in_ensemble", "left_out",
        ):  # fmt: skip
            row[key] = technique.get(key)
        row["offset_dv_px"], row["offset_du_px"] = _pair(technique.get("offset_px"))
        row["sigma_dv_px"], row["sigma_du_px"] = _pair(technique.get("sigma_px"))
        row["pivot_v_px"], row["pivot_u_px"] = _pair(technique.get("pivot_vu"))
        covariance, diagnostics = technique.get("covariance_px2"), technique.get("diagnostics")
        row["cov_dv_du_px2"] = (
            covariance[0][1] if isinstance(covariance, list) and isinstance(covariance[0], list) else None
        )
        row["features_used"] = _used(technique)
        row["extra_sigma_px"] = diagnostics.get("extra_sigma_px") if isinstance(diagnostics, dict) else None
        rows.append(row)
    return rows


def feature_columns(documents: Iterable[Mapping[str, Json]]) -> dict[str, list[Json]]:
    """Columns of table ``features`` for many images.

    Parameters
    ----------
    documents
        Images' JSON documents.

    Returns
    -------
    dict
        One list per column, all of one length.
    """
    columns: dict[str, list[Json]] = {name: [] for name in SCHEMAS["features"].names}
    for document in documents:
        for technique in document["techniques"] or []:  # type: ignore[union-attr]
            features = technique.get("features") if isinstance(technique, dict) else None
            if not isinstance(technique, dict) or not isinstance(features, dict):
                continue
            count = len(features["name"])  # type: ignore[arg-type]
            for name, values in columns.items():
                if name in features:
                    values.extend(features[name])  # type: ignore[arg-type]
                else:
                    values.extend([technique["technique"] if name == "technique" else document[name]] * count)
    return columns
