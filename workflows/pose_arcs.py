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
from pipeline.pose.schemas import ARC_SCHEMA, POSE_SCHEMA, UPPER
from pipeline.records import FloatArray
from workflows.pose import PoseRow

Row = dict[str, str | int | float | bool | None]

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
