"""Tables of a run: their schemas, and rows made from the images' documents."""

from collections.abc import Iterable, Mapping

import pyarrow as pa

from pipeline.json_values import Json
from pipeline.pose.records import frame_id_of
from pipeline.pose.schemas import ARC_SCHEMA, POSE_SCHEMA, UPPER

Row = dict[str, Json]


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


_TEXT, _REAL, _FLAG = pa.string(), pa.float64(), pa.bool_()
_IDENTITY = (
    _field("image_id", _TEXT, "", "image"),
    _field("mission", _TEXT, "", "mission (partition)"),
    _field("camera", _TEXT, "", "camera (partition)"),
)
_PIXEL = "px"

# Raised when a column changes its name or meaning; one more column needs no new version, older tables have it null.
SCHEMA_VERSION = 1
VERSION_KEY = b"pilotage_tables"

SCHEMAS: dict[str, pa.Schema] = {
    "offsets": pa.schema([
        *_IDENTITY,
        _field("time_utc", _TEXT, "ISO-8601 UTC", "mid-exposure"),
        _field("product_id", _TEXT, "", "the label's name of the product; null where it has none"),
        _field("target", _TEXT, "", "what the label says was aimed at"),
        _field("filter", _TEXT, "", "filters by the label, separated by '+'"),
        _field("exposure_s", _REAL, "s", "exposure; null where unknown"),
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
        _field("rows", pa.int64(), _PIXEL, "rows of the array; null where nothing was known of the camera"),
        _field("columns", pa.int64(), _PIXEL, "columns of the array; null where nothing was known of the camera"),
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
        _field("kind", _TEXT, "", "star, limb, terminator, disc, blob, ringlet, gap, edge_outer or edge_inner"),
        _field("predicted_v_px", _REAL, _PIXEL, "under the a-priori attitude"),
        _field("predicted_u_px", _REAL, _PIXEL, "under the a-priori attitude"),
        _field("measured_v_px", _REAL, _PIXEL, "null where not found"),
        _field("measured_u_px", _REAL, _PIXEL, "null where not found"),
        _field("residual_v_px", _REAL, _PIXEL, "measured minus predicted under the fitted pointing"),
        _field("residual_u_px", _REAL, _PIXEL, "measured minus predicted under the fitted pointing"),
        _field("sigma_px", _REAL, _PIXEL, "1 sigma of the measurement per axis"),
        _field("mag", _REAL, "mag", "catalogue magnitude"),
        _field("snr", _REAL, "", "signal to noise: expected of a star, of the edge in a piece of limb or terminator"),
        _field("used", _FLAG, "", "took part in the fit"),
        _field("reason", _TEXT, "", "why not; empty where used"),
    ]),
    "ring_edges": pa.schema([
        *_IDENTITY,
        _field("feature", _TEXT, "", "catalogue name"),
        _field("outer", _FLAG, "", "outer edge of a ringlet or gap"),
        _field("radius_km", _REAL, "km", "radius in the ring plane at which the edge is seen, pointing corrected"),
        _field("longitude_deg", _REAL, "deg", "longitude of the sample in the ring plane, from the plane's reference"),
        _field("sigma_km", _REAL, "km", "1 sigma of the radius from the sample's own pixels, the pointing's aside"),
        _field("predicted_km", _REAL, "km", "radius by the catalogue"),
        _field("v_px", _REAL, _PIXEL, "where in the image"),
        _field("u_px", _REAL, _PIXEL, "where in the image"),
        _field("sigma_px", _REAL, _PIXEL, "1 sigma across the edge"),
        _field("contrast_dn", _REAL, "DN", "brightness outside less inside"),
        _field("weight", _REAL, "", "robust weight in the fit, 0 where the sample was not believed"),
    ]),
    "landmarks": pa.schema([
        *_IDENTITY,
        _field("landmark", _TEXT, "", "name in the maplet catalogue"),
        _field("status", _TEXT, "", "found, not_found or removed"),
        _field("reason", _TEXT, "", "how the correlation ended, or the criterion of removal; empty where found"),
        _field("used", _FLAG, "", "took part in the fit of the state, or where there is none in that of the pointing"),
        _field("predicted_v_px", _REAL, _PIXEL, "under the a-priori geometry"),
        _field("predicted_u_px", _REAL, _PIXEL, "under the a-priori geometry"),
        _field("observed_v_px", _REAL, _PIXEL, "null where not found"),
        _field("observed_u_px", _REAL, _PIXEL, "null where not found"),
        _field("offset_dv_px", _REAL, _PIXEL, "observed minus predicted"),
        _field("offset_du_px", _REAL, _PIXEL, "observed minus predicted"),
        _field("sigma_dv_px", _REAL, _PIXEL, "1 sigma of the observation, the landmark's own place aside"),
        _field("sigma_du_px", _REAL, _PIXEL, "1 sigma of the observation, the landmark's own place aside"),
        _field("cov_dv_du_px2", _REAL, "px2", "covariance of the two"),
        _field("correlation", _REAL, "", "at the peak of the last correlation"),
        _field("bin", pa.int64(), "cells", "bin of the last correlation"),
        _field("incidence_deg", _REAL, "deg", "Sun from the maplet's mean normal"),
        _field("emission_deg", _REAL, "deg", "camera from the maplet's mean normal"),
        _field("cells_per_pixel", _REAL, "", "resolution ratio: above 1 the maplet is finer than the picture"),
        _field("illuminated_share", _REAL, "", "lit share of the predicted image"),
        _field("removed_share", _REAL, "", "share of the extracted image that the filter took out"),
        _field("x_km", _REAL, "km", "landmark, body-fixed"),
        _field("y_km", _REAL, "km", "landmark, body-fixed"),
        _field("z_km", _REAL, "km", "landmark, body-fixed"),
        *[_field(f"cov_{a}{b}_km2", _REAL, "km2", f"covariance of its {a} and {b}")
          for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")],
    ]),
    "poses": POSE_SCHEMA,
    "arcs": ARC_SCHEMA,
    "timings": pa.schema([
        *_IDENTITY,
        _field("stage", _TEXT, "", "stage of the pipeline, or total"),
        _field("seconds", _REAL, "s", "wall-clock time on its worker"),
        _field("emitted_at_ns", pa.int64(), "ns", "monotonic clock of the worker when a pose was emitted; else null"),
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
    row |= _said_by_label(document)
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
    geometry = document.get("geometry")
    model = geometry["camera_model"] if isinstance(geometry, dict) else None
    row["rows"], row["columns"] = _pair(model["shape_vu"]) if isinstance(model, dict) else (None, None)
    row["config_digest"] = provenance["config_digest"] if isinstance(provenance, dict) else None
    return row


def _said_by_label(document: Mapping[str, Json]) -> Row:
    label = document.get("label")
    said = label if isinstance(label, dict) else {}
    filters = said.get("filters")
    exposure = document["exposure_s"]
    return {
        "product_id": said.get("product_id"), "target": said.get("target"),
        "filter": "+".join(map(str, filters)) if isinstance(filters, list) and filters else None,
        "exposure_s": said.get("exposure_s") if exposure is None else exposure,
    }  # fmt: skip


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


def landmark_pose_row(document: Mapping[str, Json]) -> Row | None:
    """Row of table ``poses``: what an image's own landmarks say, before arcs are smoothed.

    Parameters
    ----------
    document
        An image's JSON document.

    Returns
    -------
    dict or None
        One value for each column that is known; None for an image without a pose of its own.
    """
    state = document.get("landmark_state")
    if not isinstance(state, dict):
        return None
    place, turn, covariance = state["position_km"], state["camera_from_body_wxyz"], state["covariance"]
    assert isinstance(place, list)
    assert isinstance(turn, list)
    assert isinstance(covariance, list)
    row = _identity(document)
    row |= {
        "frame_id": str(frame_id_of(str(document["image_id"]))), "et": document["et"], "body": state["body"],
        "label": "satellite_anchored", "last_satellite_anchor_age_ms": 0, "covariance_mode": "marginals",
        "method": "landmark_state", "matches_used": state["landmarks_used"], "outlier": False,
    }  # fmt: skip
    row |= {f"raw_{axis}_km": place[k] for k, axis in enumerate("xyz")}
    row |= {f"raw_q{part}": turn[k] for k, part in enumerate("wxyz")}
    return row | {f"raw_cov_{i}{j}": covariance[i][j] for i, j in UPPER}  # type: ignore[index]


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


def block_columns(documents: Iterable[Mapping[str, Json]], table: str) -> dict[str, list[Json]]:
    """Columns of a table that images keep as one block of columns under its name: ``ring_edges``, ``landmarks``.

    Parameters
    ----------
    documents
        Images' JSON documents.
    table
        Name.

    Returns
    -------
    dict
        One list per column, all of one length.
    """
    columns: dict[str, list[Json]] = {name: [] for name in SCHEMAS[table].names}
    for document in documents:
        block = document.get(table)
        if not isinstance(block, dict):
            continue
        count = len(block[next(iter(block))])  # type: ignore[arg-type]
        for name, values in columns.items():
            # A document of an older version lacks columns.
            values.extend(block[name] if name in block else [document.get(name)] * count)  # type: ignore[arg-type]
    return columns
