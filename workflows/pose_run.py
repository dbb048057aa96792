"""Poses of a run: landmark matches of its documents, arcs by camera, body and time, tables ``poses`` and ``arcs``."""

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from catalogs.matches import MatchTable, read_image_matches
from pipeline.camera import pixel_scale_rad
from pipeline.curate import Json
from pipeline.errors import ConfigurationError
from pipeline.pose.arc_factors import ArcImage
from pipeline.pose.arc_landmarks import PointSightings, sightings_of
from pipeline.pose.arcs import ArcOptions, fitted_options
from pipeline.pose.estimator import OpenCVGtsamPoseEstimator, PoseOptions
from pipeline.pose.records import (
    CovarianceDegradedWarning,
    MatchError,
    MatchResult,
    PnpFailure,
    PnpFailureError,
    PoseEstimate,
    PosePrior,
)
from pipeline.pose.views import solve_view
from pipeline.pose_documents import DocumentedImage, body_names, documented_image
from pipeline.records import FloatArray
from pipeline.tables import SCHEMAS
from workflows.execute import ClusterOptions, map_in_order
from workflows.pose import Budget
from workflows.pose_arcs import ArcIdentity, ArcMember, SmoothedArc, fix_of, smooth_members, table_of
from workflows.store import RunFolder, partition_file, read_json, table_writer

_STAGE = "pose"
# What is believed of an arc that does not show it and of which nothing is told: 1 sigma of the position as a share of
# the distance, of one attitude and of the common offset in pixels, of the common twist.
_POSITION_SHARE, _ATTITUDE_PX, _BORESIGHT_PX, _TWIST_RAD = 0.01, 20.0, 50.0, 0.02
# Beyond the first of images at one instant, each belongs to an arc beside: two products of one exposure.
_Group = tuple[str, str, str, int]


@dataclass(frozen=True)
class PoseRunOptions:
    """How the images of a run become arcs.

    Attributes
    ----------
    arc
        Uncertainties.
    gap_s
        A longer time without an image ends an arc.
    body
        In whose frame; None takes each camera's body with most landmarks, or else that most often nearest.
    budget
        For covariances; seconds count per arc.
    sidecars
        Folder of ``<image_id>.matches.parquet``, which take the place of a run's own landmarks; None without.
    """

    arc: ArcOptions
    gap_s: float
    budget: Budget
    body: str | None = None
    sidecars: Path | None = None


@dataclass(frozen=True)
class ArcJob:
    """One arc to be solved, by names of files alone, so that it weighs nothing on its way to a worker."""

    folder: RunFolder
    identity: ArcIdentity
    image_ids: tuple[str, ...]
    options: PoseRunOptions


@dataclass(frozen=True)
class ArcAnswer:
    """Rows of one arc, rows of its timings, and its images whose documents or matches could not be used."""

    smoothed: SmoothedArc | None
    timings: list[dict[str, Json]]
    troubles: tuple[str, ...]


@dataclass(frozen=True)
class PoseRunReport:
    """What came out.

    Attributes
    ----------
    arcs, images, solved, failed, without
        Arcs; their images; those with a pose of their own; those whose matches gave none; images of the run that are in
        no arc.
    troubles
        One line each.
    """

    arcs: int
    images: int
    solved: int
    failed: int
    without: int
    troubles: tuple[str, ...]


@dataclass(frozen=True)
class _Seen:
    """Where an image belongs."""

    image_id: str
    mission: str
    camera: str
    et: float
    bodies: tuple[str, ...]
    landmarks: bool


def plan_arcs(folder: RunFolder, image_ids: Iterable[str], options: PoseRunOptions) -> tuple[list[ArcJob], int]:
    """Group a run's images into arcs: one camera, one body, no gap in time.

    Parameters
    ----------
    folder
        The run.
    image_ids
        Its images.
    options
        Body and gap.

    Returns
    -------
    tuple
        Arcs, sorted by mission, camera and name; number of images in none of them.

    Raises
    ------
    ConfigurationError
        If there is an asked-for body that no image has.
    """
    seen = [image for image_id in image_ids if (image := _seen(folder, image_id)) is not None]
    seen.sort(key=lambda image: (image.mission, image.camera, image.et, image.image_id))
    members: dict[_Group, list[_Seen]] = {}
    for (mission, camera), images in groupby(seen, key=lambda image: (image.mission, image.camera)):
        listed = list(images)
        body = options.body or _commonest(listed)
        times: Counter[float] = Counter()
        for image in listed:
            if body in image.bodies:
                members.setdefault((mission, camera, str(body), times[image.et]), []).append(image)
                times[image.et] += 1
    if options.body is not None and not members:
        raise ConfigurationError(f"--body {options.body}: no image of this run has it in or near its field")
    jobs = [
        ArcJob(folder, ArcIdentity(arc[0].image_id, body, mission, camera), tuple(i.image_id for i in arc), options)
        for (mission, camera, body, _), images in sorted(members.items())
        for arc in _cut(images, options.gap_s)
    ]
    return jobs, len(seen) - sum(len(job.image_ids) for job in jobs)


def _seen(folder: RunFolder, image_id: str) -> _Seen | None:
    document = read_json(folder.document(image_id))
    if document is None:
        return None
    et, bodies = document.get("et"), body_names(document)
    when = float(et) if isinstance(et, int | float) else 0.0
    landmarks = isinstance(document.get("landmark_state"), dict)
    return _Seen(image_id, str(document["mission"]), str(document["camera"]), when, bodies, landmarks)


def _commonest(images: Sequence[_Seen]) -> str | None:
    """Body with most landmarks, else that most often nearest."""
    counts = Counter(image.bodies[0] for image in images if image.bodies and image.landmarks)
    counts = counts or Counter(image.bodies[0] for image in images if image.bodies)
    return min(counts, key=lambda name: (-counts[name], name)) if counts else None


def _cut(images: Sequence[_Seen], gap_s: float) -> list[list[_Seen]]:
    """Cut where the time between neighbours is longer than a gap."""
    arcs = [[images[0]]]
    for one, other in pairwise(images):
        if other.et - one.et > gap_s:
            arcs.append([])
        arcs[-1].append(other)
    return arcs


def solve_arc(job: ArcJob) -> ArcAnswer:
    """Solve the images of one arc, each alone, and smooth them.

    Parameters
    ----------
    job
        The arc.

    Returns
    -------
    ArcAnswer
        Its rows.
    """
    estimator, started = OpenCVGtsamPoseEstimator(), time.monotonic()
    members: list[ArcMember] = []
    timings: list[dict[str, Json]] = []
    troubles: list[str] = []
    believed: ArcOptions | None = None
    for image_id in job.image_ids:
        begun = time.monotonic()
        try:
            image = _documented(job, image_id)
        except MatchError as error:
            troubles.append(str(error))
            continue
        believed = believed or _believed(image, job.options.arc)
        if image.trouble is not None:
            troubles.append(image.trouble)
        answer = _solved(estimator, image, job.options.budget, started)
        members.append(
            ArcMember(
                ArcImage(
                    image_id, image.et, image.prior, fix_of(answer), image.offset, _sightings(job, image, answer)
                ),
                answer, image.calibration,
            )
        )
        timings.append({
            "image_id": image_id, "stage": _STAGE, "seconds": time.monotonic() - begun,
            "emitted_at_ns": time.monotonic_ns() if isinstance(answer, PoseEstimate) else None,
        })  # fmt: skip
    options = fitted_options([member.image for member in members], believed or job.options.arc)
    smoothed = smooth_members(job.identity, members, options) if members else None
    return ArcAnswer(smoothed, timings, tuple(troubles))


def _sightings(
    job: ArcJob, image: DocumentedImage, answer: PoseEstimate | PnpFailureError | None
) -> PointSightings | None:
    """What an image's pose rests on, where points are solved too."""
    if not job.options.arc.solve_landmarks or image.matches is None or not isinstance(answer, PoseEstimate):
        return None
    return sightings_of(image.matches, answer, image.calibration, PoseOptions().assumed_sigma_px)


def _believed(image: DocumentedImage, told: ArcOptions) -> ArcOptions:
    """Uncertainties that nobody has told, wide enough for any trajectory and pointing worth navigating."""
    pixel = float(pixel_scale_rad(image.calibration.camera).max())
    wide = {
        "position_sigma_km": _POSITION_SHARE * float(np.linalg.norm(image.prior.position_km)),
        "attitude_sigma_rad": _ATTITUDE_PX * pixel, "boresight_sigma_rad": _BORESIGHT_PX * pixel,
        "twist_sigma_rad": _TWIST_RAD,
    }  # fmt: skip
    return told.model_copy(update={name: value for name, value in wide.items() if name not in told.model_fields_set})


def _documented(job: ArcJob, image_id: str) -> DocumentedImage:
    """An image with its matches: those of a sidecar, where it has one."""
    document = read_json(job.folder.document(image_id))
    if document is None:
        raise MatchError(f"{image_id}: its document is gone or cannot be read")
    image = documented_image(document, job.identity.body)
    prior = PosePrior(image.prior, _prior_covariance(_believed(image, job.options.arc)))
    if image.matches is not None:
        image = replace(image, matches=replace(image.matches, prior=prior))
    sidecar = None if job.options.sidecars is None else job.options.sidecars / f"{image_id}.matches.parquet"
    if sidecar is None or not sidecar.is_file():
        return image
    try:
        table = read_image_matches(sidecar.read_bytes(), str(sidecar))
        return replace(image, matches=_matches_of(image_id, table, prior), trouble=None)
    except (ConfigurationError, MatchError) as error:
        return replace(image, matches=None, trouble=str(error))


def _matches_of(image_id: str, table: MatchTable, prior: PosePrior) -> MatchResult:
    assert table.points_km is not None
    return MatchResult(
        image_id, table.point_id, table.pixels_vu, table.points_km, table.pixel_covariance_px2,
        table.point_covariance_km2, prior,
    )  # fmt: skip


def _prior_covariance(arc: ArcOptions) -> FloatArray:
    angle2 = arc.attitude_sigma_rad**2 + max(arc.boresight_sigma_rad, arc.twist_sigma_rad) ** 2
    return np.diag([arc.position_sigma_km**2] * 3 + [angle2] * 3)


def _solved(
    estimator: OpenCVGtsamPoseEstimator, image: DocumentedImage, budget: Budget, started: float
) -> PoseEstimate | PnpFailureError | None:
    if image.trouble is not None:
        return PnpFailureError(PnpFailure.BAD_INPUT, image.trouble)
    if image.matches is None:
        return None
    with warnings.catch_warnings():
        # The mode stands in the table.
        warnings.simplefilter("ignore", CovarianceDegradedWarning)
        return solve_view(estimator, image.calibration, image.matches, budget.state(started, False))


def pose_run(
    folder: RunFolder, image_ids: Sequence[str], options: PoseRunOptions, cluster: ClusterOptions,
    on_arc: Callable[[str], None] = lambda text: None,
) -> PoseRunReport:  # fmt: skip
    """Solve and smooth all arcs of a run and write its tables ``poses``, ``arcs``, and the clocks into ``timings``.

    Parameters
    ----------
    folder
        The run, locked.
    image_ids
        Its images, sorted.
    options
        How images become arcs.
    cluster
        Where they are solved.
    on_arc
        Called with a line for each finished arc.

    Returns
    -------
    PoseRunReport
        Counts and troubles; the tables do not depend on the number of workers.

    Raises
    ------
    ConfigurationError
        If no image of the run can be in an arc, or an option makes no sense.
    """
    jobs, without = plan_arcs(folder, image_ids, options)
    if not jobs:
        raise ConfigurationError(f"{folder.root}: no image has a body in or near its field: there is nothing to pose")
    answers = zip(jobs, map_in_order(solve_arc, jobs, cluster if len(jobs) > 1 else ClusterOptions(0)), strict=True)
    report = PoseRunReport(len(jobs), 0, 0, 0, without, ())
    for partition, part in groupby(answers, key=lambda pair: _partition_of(pair[0])):
        report = _write(folder, partition, part, (report, on_arc))
    for mission, camera in _partitions_on_disk(folder) - {_partition_of(job) for job in jobs}:
        for table in ("poses", "arcs"):
            with table_writer(folder, table, mission, camera):
                pass
    return report


def _write(
    folder: RunFolder, partition: tuple[str, str], part: Iterator[tuple[ArcJob, ArcAnswer | None]],
    so_far: tuple[PoseRunReport, Callable[[str], None]],
) -> PoseRunReport:  # fmt: skip
    """Stream one camera's arcs into its two tables: memory is that of an arc."""
    report, on_arc = so_far
    timings: list[dict[str, Json]] = []
    with table_writer(folder, "poses", *partition) as poses, table_writer(folder, "arcs", *partition) as arcs:
        for job, answer in part:
            name = job.identity.arc_id
            if answer is None or answer.smoothed is None:
                lost = "its worker died, alone, twice" if answer is None else "none of its documents can be used"
                report = replace(report, troubles=(*report.troubles, f"arc {name}: {lost}"))
                continue
            rows = answer.smoothed.poses
            poses(table_of(rows, SCHEMAS["poses"]))
            arcs(table_of([answer.smoothed.summary], SCHEMAS["arcs"]))
            timings += answer.timings
            solved = sum(row.get("raw_x_km") is not None for row in rows)
            failed = sum(row.get("failure") not in (None, PnpFailure.TOO_FEW.value) for row in rows)
            report = replace(
                report, images=report.images + len(rows), solved=report.solved + solved, failed=report.failed + failed,
                troubles=(*report.troubles, *answer.troubles),
            )  # fmt: skip
            on_arc(f"arc {name}: {len(rows)} images, {solved} with a pose of their own")
    _renew_timings(folder, partition, timings)
    return report


def _renew_timings(folder: RunFolder, partition: tuple[str, str], rows: list[dict[str, Json]]) -> None:
    """Put this stage's rows into a camera's timings, in the place of those of an earlier time."""
    path, before = partition_file(folder, "timings", *partition), None
    if path.is_file():
        table = pq.ParquetFile(path).read()
        before = table.filter(np.array([stage != _STAGE for stage in table["stage"].to_pylist()], dtype=bool))
    with table_writer(folder, "timings", *partition) as write:
        if before is not None:
            write(pa.Table.from_pylist(before.to_pylist(), schema=SCHEMAS["timings"]))
        write(pa.Table.from_pylist(rows, schema=SCHEMAS["timings"]))


def _partition_of(job: ArcJob) -> tuple[str, str]:
    return str(job.identity.mission), str(job.identity.camera)


def _partitions_on_disk(folder: RunFolder) -> set[tuple[str, str]]:
    found = set()
    for path in (folder.root / "offsets").glob("mission=*/camera=*/*.parquet"):
        mission, camera = (unquote(part.split("=", 1)[1]) for part in path.parts[-3:-1])
        found.add((mission, camera))
    return found
