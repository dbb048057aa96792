"""The data dictionary: every table and column, from the schemas themselves.

``python -m workflows.dictionary`` writes ``outputs/README.md``.
"""

from pathlib import Path

import pyarrow as pa

from pipeline.status import StatusReason, status_of
from pipeline.tables import SCHEMAS

TARGET = Path("outputs/README.md")

_HEAD = """# Outputs

`make demo` and `make bench` write here; nothing but this file is kept. A run folder holds

| path | what |
|---|---|
| `images/<id>.json` | per image: answer, covariance, corrected pointing, every technique's features, provenance |
| `offsets/`, `techniques/`, `features/`, `timings/` | Parquet datasets, partitioned by mission and camera |
| `state/<id>.json` | what an image was made from (sizes, times, sha256) and its timings: marks for resuming |
| `plan.json`, `run.json` | images of the latest run; archive, versions, configuration, catalogues, counts, times |
| `log.jsonl` | the log of all starts, one JSON object per line |

Every file is written under a temporary name and renamed. Two runs on the same input compare equal byte for byte,
whatever the number of workers, but for `timings`, `state`, `run.json` and the log, which hold clocks. A table has one
Parquet file per mission and camera, written anew by each run, so there are no small files to compact. Pixels are
(v, u), rows first, the centre of the first pixel at (0, 0); null means not known or not observable, never a sentinel.

"""

_TABLES = {
    "offsets": "One row per image.",
    "techniques": "One row per technique that ran on an image, about the technique's own pivot.",
    "features": "One row per predicted feature, technique and image.",
    "ring_edges": "One row per measured piece of a ring's edge and image, some 24 pixels long.",
    "landmarks": "One row per landmark looked for and image.",
    "poses": "One row per image with a pose of its own, after `pilotage pose` per image of an arc, smoothed.",
    "arcs": "One row per arc, written by `pilotage pose`.",
    "timings": "One row per stage and image, and one for the total.",
}


_NO_ANSWER = "no answer"
_NO_FULL = "no answer, or only one direction of it is observable"
_NOT_FITTED = "the rotation was not fitted, or is not observable"
_NO_LABEL = "the label does not say"
_NOT_FOUND = "not found in the image"
_REFUSED = "the technique gave no answer: see status_reason"
_NO_RAW = "the image alone has no pose"
# By table: columns that may be null, and what a null means. No other column ever is.
_NULLS: dict[str, dict[tuple[str, ...], str]] = {
    "offsets": {
        ("time_utc",): "neither geometry nor label says when",
        ("product_id", "target", "filter", "exposure_s"): _NO_LABEL,
        ("confidence",): _NO_ANSWER,
        ("offset_dv_px", "offset_du_px", "sigma_dv_px", "sigma_du_px", "cov_dv_du_px2"): _NO_FULL,
        ("rotation_deg", "sigma_rotation_deg"): _NOT_FITTED,
        ("observable_dv", "observable_du", "offset_along_px", "sigma_along_px"): "both directions, or none, are known",
        ("qw", "qx", "qy", "qz"): _NO_FULL,
        ("features_used",): "no technique was fused",
        ("image_class",): "the image was refused before it was looked at",
        ("rows", "columns"): "no camera model, or written by an older version",
    },
    "techniques": {
        ("offset_dv_px", "offset_du_px", "sigma_dv_px", "sigma_du_px", "cov_dv_du_px2", "confidence", "at_edge",
         "pivot_v_px", "pivot_u_px", "in_ensemble"): _REFUSED,
        ("rotation_deg", "sigma_rotation_deg"): _NOT_FITTED,
        ("left_out",): "fused, or without an answer",
        ("features_used",): "the technique keeps no list of features",
        ("extra_sigma_px",): "the technique does not estimate it",
        ("detail",): "nothing to say",
    },
    "features": {
        ("predicted_v_px", "predicted_u_px"): "a body that has no single place, such as a limb",
        ("measured_v_px", "measured_u_px", "residual_v_px", "residual_u_px", "sigma_px"): _NOT_FOUND,
        ("mag",): "no star",
        ("snr",): "not a star, nor a piece of a limb or terminator",
    },
    "ring_edges": {
        ("longitude_deg", "radius_km", "sigma_km"): "the line of sight misses the ring plane",
    },
    "landmarks": {
        ("predicted_v_px", "predicted_u_px"): "outside the camera's field",
        ("observed_v_px", "observed_u_px", "offset_dv_px", "offset_du_px", "sigma_dv_px", "sigma_du_px",
         "cov_dv_du_px2", "correlation", "bin"): _NOT_FOUND,
        ("incidence_deg", "emission_deg", "cells_per_pixel"): "removed before it was known",
        ("reason", "illuminated_share", "removed_share"): "written by an older version",
        ("cov_xx_km2", "cov_xy_km2", "cov_xz_km2", "cov_yy_km2", "cov_yz_km2", "cov_zz_km2"): (
            "the catalogue does not say"
        ),
    },
    "poses": {
        ("mission", "camera"): "from a file of matches",
        ("arc_id",): "arcs were not smoothed yet",
        ("view_id",): "from a run's images",
        ("covariance_mode", "method", "matches_used", "rms_px"): _NO_RAW,
        ("failure",): "the image alone has a pose",
        ("offset_used",): "no navigated offset",
        ("last_satellite_anchor_age_ms",): "no anchored image before this one",
        ("lat_deg", "lon_deg", "ellipsoidal_m", "datum"): "the body has no datum",
        ("alt_m",): "no geoid",
        ("raw_",): _NO_RAW,
    },
    "arcs": {("mission", "camera"): "from a file of matches"},
    "timings": {("emitted_at_ns",): "no stage that emits a pose"},
}  # fmt: skip


def null_meaning(table: str, column: str) -> str:
    """What a null in a column means.

    Parameters
    ----------
    table, column
        Names; a beginning that ends in ``_`` stands for all columns that share it.

    Returns
    -------
    str
        Empty where the column is never null.
    """
    for names, meaning in _NULLS[table].items():
        if any(column == name or (name.endswith("_") and column.startswith(name)) for name in names):
            return meaning
    return ""


def _describe(parts: list[str], name: str, text: str, schema: pa.Schema) -> None:
    """Append the section of one table."""
    parts.append(f"## {name}\n\n{text}\n\n")
    parts.append("| column | type | unit | meaning | null means |\n|---|---|---|---|---|\n")
    for field in schema:
        said = {key.decode(): value.decode() for key, value in field.metadata.items()}
        cells = (f"`{field.name}`", str(field.type), said["unit"], said["meaning"], null_meaning(name, field.name))
        parts.append(f"| {' | '.join(cells)} |\n")
    parts.append("\n")


def data_dictionary() -> str:
    """Markdown of all tables and of the reasons behind a status.

    Returns
    -------
    str
        Content of ``outputs/README.md``.
    """
    parts = [_HEAD]
    for name, schema in SCHEMAS.items():
        _describe(parts, name, f"{_TABLES[name]} Partition columns (`mission`, `camera`) live in the path.", schema)
    parts.append("## Status and reason\n\n| status | reasons |\n|---|---|\n")
    for status in dict.fromkeys(status_of(reason) for reason in StatusReason):
        reasons = ", ".join(f"`{reason.value}`" for reason in StatusReason if status_of(reason) is status)
        parts.append(f"| `{status.value}` | {reasons} |\n")
    return "".join(parts)


if __name__ == "__main__":
    TARGET.write_text(data_dictionary(), encoding="utf-8")
