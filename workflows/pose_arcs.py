"""Arcs after the images: tables ``poses`` and ``arcs``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

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
from pipeline.pose.schemas import UPPER
from pipeline.records import FloatArray
from workflows.pose import PoseRow

_TOLD = ("position_sigma_km", "walk_km_per_sqrt_s", "attitude_sigma_rad", "boresight_sigma_rad", "twist_sigma_rad")
_AXES = "xyz"
_PAIRS = tuple(combinations_with_replacement(enumerate(_AXES), 2))
POINT_SCHEMA = pa.schema([
    ("arc_id", pa.string()), ("point_id", pa.int64()), ("sightings", pa.int64()),
    *[(f"{axis}_km", pa.float64()) for axis in _AXES],
    *[(f"cov_{a}{b}_km2", pa.float64()) for (_, a), (_, b) in _PAIRS],
])  # fmt: skip
Row = dict[str, str | int | float | bool | None]


@dataclass(frozen=True)
class ArcIdentity:
    """What an arc is called and whose it is; mission and camera are None in a file of matches."""

    arc_id: str
    body: str
    mission: str | None = None
    camera: str | None = None


@dataclass(frozen=True)
class ArcMember:
    """One image of an arc with what its own matches gave; ``answer`` is None for an image without matches."""

    image: ArcImage
    answer: PoseEstimate | PnpFailureError | None
    calibration: CameraCalibration
    view_id: int | None = None


@dataclass(frozen=True)
class SmoothedArc:
    """Rows of tables ``poses`` and ``arcs``, and of the points that were solved with the poses."""

    poses: list[Row]
    summary: Row
    points: list[Row]


def members_of(arc: Arc, rows: Sequence[PoseRow], calibration: CameraCalibration) -> list[ArcMember]:
    """Views of a file's arc with the poses that they had alone.

    Parameters
    ----------
    arc
        Of the cameras' file.
    rows
        Views solved alone.
    calibration
        Datum and mounting.

    Returns
    -------
    list of ArcMember
        In the order of the arc.
    """
    answers = {row.view_id: row.answer for row in rows}
    seen = {row.view_id: row.sightings for row in rows}
    return [
        ArcMember(
            ArcImage(
                str(view.view_id), view.et, view.prior, fix_of(answers.get(view.view_id)),
                sightings=seen.get(view.view_id),
            ),
            answers.get(view.view_id), calibration, view.view_id,
        )
        for view in arc.views
    ]  # fmt: skip


@dataclass(frozen=True)
class ArcJobOfFile:
    """One arc of a cameras' file, for a worker."""

    identity: ArcIdentity
    members: list[ArcMember]
    options: ArcOptions

    @staticmethod
    def of(arc: Arc, rows: Sequence[PoseRow], calibration: CameraCalibration) -> "ArcJobOfFile":
        """Arc of a file with the poses that its views had alone."""
        identity = ArcIdentity(arc.arc_id, calibration.datum.name)
        return ArcJobOfFile(identity, members_of(arc, rows, calibration), options_of(arc.arc_id, arc.options))


def solve_arc_of_file(job: ArcJobOfFile) -> SmoothedArc:
    """Smooth one arc of a file."""
    return smooth_members(job.identity, job.members, job.options)


def timing_rows(rows: Sequence[PoseRow]) -> list[Row]:
    """Rows of table ``timings`` of views solved alone."""
    return [
        {
            "image_id": str(row.view_id), "stage": "pose", "seconds": row.seconds, "emitted_at_ns": row.emitted_at_ns,
        }
        for row in rows
    ]  # fmt: skip


def fix_of(answer: PoseEstimate | PnpFailureError | None) -> PosePrior | None:
    """What an image's own pose says in its arc."""
    return PosePrior(answer.pose, answer.covariance_6x6) if isinstance(answer, PoseEstimate) else None


def smooth_members(identity: ArcIdentity, members: Sequence[ArcMember], options: ArcOptions) -> SmoothedArc:
    """Smooth one arc.

    Parameters
    ----------
    identity
        Its name.
    members
        Its images in the order of time.
    options
        Uncertainties.

    Returns
    -------
    SmoothedArc
        A row per image and one for the arc.

    Raises
    ------
    ConfigurationError
        If the arc is none.
    """
    try:
        result = smooth_arc([member.image for member in members], options)
    except MatchError as error:
        raise ConfigurationError(f"arc {identity.arc_id}: {error}") from error
    poses = [_pose_row(identity, member, k, result) for k, member in enumerate(members)]
    used: Row = {name: getattr(options, name) for name in _TOLD}
    return SmoothedArc(poses, _arc_row(identity, members, result) | used, _point_rows(identity, result))


def table_of(rows: Sequence[Row], schema: pa.Schema) -> pa.Table:
    """Arrow table of rows; a column that a row does not name is null."""
    return pa.Table.from_pylist(list(rows), schema=schema)


def options_of(arc_id: str, told: Mapping[str, object]) -> ArcOptions:
    """Uncertainties of an arc.

    Parameters
    ----------
    arc_id
        For the message.
    told
        Fields of ``ArcOptions``.

    Returns
    -------
    ArcOptions
        With defaults for the rest.

    Raises
    ------
    ConfigurationError
        If there is no such field, or a value is out of its bounds.
    """
    try:
        return ArcOptions.model_validate(told)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigurationError(f"arc {arc_id}: options.{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _numbers(prefix: str, pose: Pose, covariance: FloatArray) -> Row:
    row: Row = {f"{prefix}{axis}_km": float(pose.position_km[k]) for k, axis in enumerate("xyz")}
    quaternion = quaternion_from_matrix(pose.camera_from_body)
    row |= {f"{prefix}q{part}": float(quaternion[k]) for k, part in enumerate("wxyz")}
    return row | {f"{prefix}cov_{i}{j}": float(covariance[i, j]) for i, j in UPPER}


def _pose_row(identity: ArcIdentity, member: ArcMember, index: int, result: ArcResult) -> Row:
    pose, image, answer = result.pose(index), member.image, member.answer
    place = place_of(pose, member.calibration)
    row: Row = {
        "image_id": image.image_id, "mission": identity.mission, "camera": identity.camera, "arc_id": identity.arc_id,
        "body": identity.body, "view_id": member.view_id, "frame_id": str(frame_id_of(image.image_id)), "et": image.et,
        "label": result.label[index].value, "last_satellite_anchor_age_ms": result.anchor_age_ms[index],
        "lat_deg": place.lat_deg, "lon_deg": place.lon_deg, "alt_m": place.alt_m,
        "ellipsoidal_m": place.ellipsoidal_m, "datum": place.datum, "outlier": False,
        "offset_used": None if image.offset is None else bool(result.offset_used[index]),
    }  # fmt: skip
    vehicle = vehicle_orientation(pose, member.calibration)
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


def _point_rows(identity: ArcIdentity, result: ArcResult) -> list[Row]:
    if result.landmarks is None:
        return []
    points = result.landmarks
    return [
        {
            "arc_id": identity.arc_id, "point_id": int(points.point_id[k]), "sightings": int(points.sightings[k]),
            **{f"{axis}_km": float(points.places_km[k, i]) for i, axis in enumerate(_AXES)},
            **{f"cov_{a}{b}_km2": float(points.covariance_km2[k, i, j]) for (i, a), (j, b) in _PAIRS},
        }
        for k in range(len(points.point_id))
    ]  # fmt: skip


def _arc_row(identity: ArcIdentity, members: Sequence[ArcMember], result: ArcResult) -> Row:
    sigma = np.sqrt(np.diag(result.bias_covariance_rad2))
    row: Row = {
        "arc_id": identity.arc_id, "mission": identity.mission, "camera": identity.camera, "body": identity.body,
        "start_et": members[0].image.et, "stop_et": members[-1].image.et, "images": len(members),
        "outliers": sum(
            member.image.fix is not None and not used for member, used in zip(members, result.used, strict=True)
        ),
        "offsets_used": int(result.offset_used.sum()),
        "landmarks_solved": 0 if result.landmarks is None else len(result.landmarks.point_id),
        "anchored": result.label.count(SourceLabel.SATELLITE_ANCHORED),
        "propagated": result.label.count(SourceLabel.VISUAL_PROPAGATED),
        "dead_reckoned": result.label.count(SourceLabel.DEAD_RECKONED),
    }  # fmt: skip
    for k, name in enumerate(("x", "y", "twist")):
        row[f"bias_{name}_rad"], row[f"sigma_bias_{name}_rad"] = float(result.bias_rad[k]), float(sigma[k])
    return row
