"""Arcs after the images: tables ``poses`` and ``arcs``."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from pydantic import ValidationError

from catalogs.matches import Arc
from pipeline.errors import ConfigurationError
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.pose.arc_factors import ArcImage
from pipeline.pose.arcs import ArcOptions, ArcResult, smooth_arc
from pipeline.pose.estimator import place_of, vehicle_orientation
from pipeline.pose.records import (
    CameraCalibration,
    MatchError,
    PnpFailureError,
    Pose,
    PoseEstimate,
    PosePrior,
    SourceLabel,
    frame_id_of,
)
from pipeline.records import FloatArray
from workflows.pose import UPPER, PoseRow

Row = dict[str, str | int | float | bool | None]

_COVARIANCE = (
    "upper triangle by rows of the errors (x, y, z, rx, ry, rz), km and rad, body-fixed: "
    "position estimated minus true, body_from_camera_true = Exp(r) body_from_camera_estimated"
)


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


_TEXT, _REAL, _WHOLE, _FLAG = pa.string(), pa.float64(), pa.int64(), pa.bool_()


def _pose_fields(prefix: str, what: str) -> list[pa.Field]:
    place = [_field(f"{prefix}{axis}_km", _REAL, "km", f"{what}: position of the camera, body-fixed") for axis in "xyz"]
    turn = [_field(f"{prefix}q{part}", _REAL, "", f"{what}: camera_from_body quaternion") for part in "wxyz"]
    axes = ("x", "y", "z", "rx", "ry", "rz")
    units = {(False, False): "km2", (False, True): "km rad", (True, True): "rad2"}
    spread = [
        _field(
            f"{prefix}cov_{i}{j}",
            _REAL,
            units[i > 2, j > 2],
            f"{what}: covariance of the errors of {axes[i]} and {axes[j]}",
        )
        for i, j in UPPER
    ]
    return [*place, *turn, *spread]


POSE_SCHEMA = pa.schema([
    _field("arc_id", _TEXT, "", "arc"),
    _field("view_id", _WHOLE, "", "image"),
    _field("frame_id", _TEXT, "", "uuid5 of the image's id"),
    _field("et", _REAL, "s", "TDB seconds past J2000"),
    _field("label", _TEXT, "", "satellite_anchored, visual_propagated or dead_reckoned"),
    _field("last_satellite_anchor_age_ms", _WHOLE, "ms", "since the last anchored image; null before the first"),
    _field("covariance_mode", _TEXT, "", "marginals or jacobian, of the raw pose; null without one"),
    _field("method", _TEXT, "", "what started the raw pose: ippe or sqpnp"),
    _field("matches_used", _WHOLE, "count", "inliers of the raw pose"),
    _field("rms_px", _REAL, "px", "of their residuals, per axis"),
    _field("failure", _TEXT, "", "why there is no raw pose; null where there is one"),
    _field("outlier", _FLAG, "", "the raw pose contradicts the arc and does not hold it"),
    _field("lat_deg", _REAL, "deg", "planetodetic latitude of the vehicle, smoothed"),
    _field("lon_deg", _REAL, "deg", "longitude, positive east, smoothed"),
    _field("alt_m", _REAL, "m", "above mean sea level, smoothed; null without a geoid"),
    _field("ellipsoidal_m", _REAL, "m", "above the ellipsoid of the datum, smoothed"),
    _field("datum", _TEXT, "", "name of the ellipsoid"),
    *[_field(f"vehicle_q{part}", _REAL, "", "quaternion that turns vehicle axes onto body-fixed ones, smoothed")
      for part in "wxyz"],
    *_pose_fields("", "smoothed"),
    *_pose_fields("raw_", "image alone"),
], metadata={"frame": "body-fixed; x_camera = camera_from_body (X - position)", "covariance": _COVARIANCE})  # fmt: skip

ARC_SCHEMA = pa.schema([
    _field("arc_id", _TEXT, "", "arc"),
    _field("images", _WHOLE, "count", "images"),
    _field("anchored", _WHOLE, "count", "held by their own points"),
    _field("propagated", _WHOLE, "count", "held by neighbours"),
    _field("dead_reckoned", _WHOLE, "count", "held by the trajectory alone"),
    _field("outliers", _WHOLE, "count", "raw poses that contradict the arc"),
    *[_field(f"bias_{name}_rad", _REAL, "rad", f"common {text} of the camera against its believed attitude")
      for name, text in (("x", "offset about x"), ("y", "offset about y"), ("twist", "twist about z"))],
    *[_field(f"sigma_bias_{name}_rad", _REAL, "rad", "1 sigma") for name in ("x", "y", "twist")],
])  # fmt: skip


def smooth(arcs: Sequence[Arc], rows: Sequence[PoseRow], calibration: CameraCalibration) -> tuple[pa.Table, pa.Table]:
    """Smooth every arc.

    Parameters
    ----------
    arcs
        Of the cameras' file.
    rows
        Views solved alone.
    calibration
        Datum and mounting.

    Returns
    -------
    tuple of pyarrow.Table
        ``poses`` and ``arcs``.

    Raises
    ------
    ConfigurationError
        If an arc is none, or its options are not.
    """
    answers = {row.view_id: row.answer for row in rows}
    poses: list[Row] = []
    summary: list[Row] = []
    for arc in arcs:
        try:
            result = smooth_arc(
                [_image(view.view_id, view.et, view.prior, answers) for view in arc.views], _options(arc)
            )
        except MatchError as error:
            raise ConfigurationError(f"arc {arc.arc_id}: {error}") from error
        for k, view in enumerate(arc.views):
            poses.append(_pose_row(arc, view.view_id, view.et, k, result, answers.get(view.view_id), calibration))
        summary.append(_arc_row(arc, result, [row for row in poses if row["arc_id"] == arc.arc_id]))
    return pa.Table.from_pylist(poses, schema=POSE_SCHEMA), pa.Table.from_pylist(summary, schema=ARC_SCHEMA)


def _options(arc: Arc) -> ArcOptions:
    try:
        return ArcOptions.model_validate(arc.options)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigurationError(
            f"arc {arc.arc_id}: options.{'.'.join(map(str, first['loc']))}: {first['msg']}"
        ) from error


def _image(view_id: int, et: float, prior: Pose, answers: dict[int, PoseEstimate | PnpFailureError]) -> ArcImage:
    answer = answers.get(view_id)
    fix = PosePrior(answer.pose, answer.covariance_6x6) if isinstance(answer, PoseEstimate) else None
    return ArcImage(str(view_id), et, prior, fix)


def _numbers(prefix: str, pose: Pose, covariance: FloatArray) -> Row:
    row: Row = {f"{prefix}{axis}_km": float(pose.position_km[k]) for k, axis in enumerate("xyz")}
    quaternion = quaternion_from_matrix(pose.camera_from_body)
    row |= {f"{prefix}q{part}": float(quaternion[k]) for k, part in enumerate("wxyz")}
    return row | {f"{prefix}cov_{i}{j}": float(covariance[i, j]) for i, j in UPPER}


def _pose_row(
    arc: Arc,
    view_id: int,
    et: float,
    index: int,
    result: ArcResult,
    answer: PoseEstimate | PnpFailureError | None,
    calibration: CameraCalibration,
) -> Row:
    pose = result.pose(index)
    place = place_of(pose, calibration)
    row: Row = {
        "arc_id": arc.arc_id, "view_id": view_id, "frame_id": str(frame_id_of(str(view_id))), "et": et,
        "label": result.label[index].value, "last_satellite_anchor_age_ms": result.anchor_age_ms[index],
        "lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "alt_m": place.alt_m,
        "ellipsoidal_m": place.ellipsoidal_m, "datum": place.datum, "outlier": False,
    }  # fmt: skip
    vehicle = vehicle_orientation(pose, calibration)
    row |= {f"vehicle_q{part}": float(vehicle[k]) for k, part in enumerate("wxyz")}
    row |= _numbers("", pose, result.covariance[index])
    if isinstance(answer, PoseEstimate):
        row |= _numbers("raw_", answer.pose, answer.covariance_6x6)
        row |= {
            "covariance_mode": answer.covariance_mode.value, "method": answer.method,
            "matches_used": int(answer.inlier.sum()), "rms_px": float(np.sqrt((answer.rms_px**2).mean())),
            "outlier": not bool(result.used[index]),
        }  # fmt: skip
    else:
        row["failure"] = "too_few" if answer is None else answer.reason.value
    return row


def _arc_row(arc: Arc, result: ArcResult, poses: list[Row]) -> Row:
    sigma = np.sqrt(np.diag(result.bias_covariance_rad2))
    row: Row = {
        "arc_id": arc.arc_id, "images": len(result.label), "outliers": sum(bool(row["outlier"]) for row in poses),
        "anchored": result.label.count(SourceLabel.SATELLITE_ANCHORED),
        "propagated": result.label.count(SourceLabel.VISUAL_PROPAGATED),
        "dead_reckoned": result.label.count(SourceLabel.DEAD_RECKONED),
    }  # fmt: skip
    for k, name in enumerate(("x", "y", "twist")):
        row[f"bias_{name}_rad"], row[f"sigma_bias_{name}_rad"] = float(result.bias_rad[k]), float(sigma[k])
    return row
