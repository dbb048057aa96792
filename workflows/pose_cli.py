"""``pilotage pose``: poses from matches that any program made, or from the landmarks of a run."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import typer

from pipeline.errors import ConfigurationError
from pipeline.pose.records import PnpFailureError
from pipeline.tables import SCHEMAS
from workflows.config import parse_setting
from workflows.execute import ClusterOptions
from workflows.store import RunFolder, exclusive, read_json, write_atomically

if TYPE_CHECKING:
    from catalogs.matches import Cameras
    from workflows.pose import Budget, PoseRow, Views

_SHOWN_TROUBLES = 20


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error


def _write(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, sink.getvalue().to_pybytes())
    except OSError as error:
        raise ConfigurationError(f"cannot write {path}: {error.strerror}") from error


def pose(
    matches: Annotated[
        Path, typer.Argument(help="Folder of a run, or Parquet: view_id, point_id, v_px, u_px; places and covariances.")
    ],
    cameras: Annotated[
        Path | None, typer.Option("--cameras", help="JSON: K and shape_vu or camera_model, views with poses.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Parquet to write; a run has its own.")] = None,
    every: Annotated[bool, typer.Option("--every", help="Also solve views with given poses, from the others.")] = False,
    covariance: Annotated[
        Literal["auto", "marginals", "jacobian"], typer.Option(help="Graph marginals, Jacobian, or by budget.")
    ] = "auto",
    budget_s: Annotated[float | None, typer.Option(min=0.0, help="Seconds after which auto turns cheap.")] = None,
    bundle: Annotated[bool, typer.Option("--bundle", help="Then adjust all views and points together.")] = False,
    given_sigma_km: Annotated[float, typer.Option(min=1e-9, help="Of given positions, in the bundle.")] = 2.0,
    given_sigma_mrad: Annotated[float, typer.Option(min=1e-9, help="Of given attitudes, in the bundle.")] = 0.5,
    arcs: Annotated[
        Path | None, typer.Option("--arcs", help="Folder for poses, arcs and timings of a file's arcs.")
    ] = None,
    body: Annotated[str | None, typer.Option(help="Of a run: body in whose frame poses are.")] = None,
    gap_s: Annotated[float, typer.Option(min=0.0, help="Of a run: a longer time without image ends an arc.")] = 86400.0,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Of a run's arcs: position_sigma_km=5, walk_km_per_sqrt_s=0.1, …")
    ] = None,
    sidecars: Annotated[
        Path | None, typer.Option("--matches", help="Of a run: folder of <image_id>.matches.parquet to use instead.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Worker processes for many arcs.")] = 2,
    serial: Annotated[bool, typer.Option("--serial", help="No cluster: one arc after the other.")] = False,
    scheduler: Annotated[str | None, typer.Option(help="Address of an existing Dask scheduler.")] = None,
    memory_limit: Annotated[str, typer.Option(help="Per local worker; one beyond it is restarted.")] = "4GiB",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A JSON line per view.")] = False,
) -> None:
    """Solve views from points of known place, or of places that views with given poses make known; or a run's arcs.

    Exit code: 0 all views solved, 1 some without a pose, 3 could not start.
    """
    # The factor graph's library takes a while to load, which no other command should pay.
    from workflows.pose import Budget, CovarianceChoice

    if serial and scheduler:
        raise ConfigurationError("--serial and --scheduler exclude each other")
    logging.basicConfig(level=logging.CRITICAL, format="%(message)s")
    logging.getLogger("pilotage.pose").setLevel(logging.DEBUG if verbose else logging.CRITICAL)
    budget = Budget(CovarianceChoice(covariance), budget_s)
    cluster = ClusterOptions(0 if serial else workers, scheduler, memory_limit)
    if matches.is_dir():
        _refuse(cameras=cameras, output=output, every=every, bundle=bundle, arcs=arcs)
        raise typer.Exit(_of_run(matches, _run_settings(settings or []), budget, (body, gap_s, sidecars), cluster))
    _refuse(body=body, set=settings, matches=sidecars)
    if cameras is None or output is None:
        raise ConfigurationError(f"{matches}: matches in a file need --cameras and --output")
    how = (every, bundle, given_sigma_km, given_sigma_mrad)
    raise typer.Exit(_of_file((matches, cameras, output), budget, how, (arcs, cluster)))


def _refuse(**options: object) -> None:
    """Options of the other kind of input."""
    told = [name for name, value in options.items() if value]
    if told:
        raise ConfigurationError(f"--{told[0]} makes no sense for this kind of input; see pilotage pose --help")


def _run_settings(settings: Sequence[str]) -> dict[str, object]:
    told: dict[str, object] = {}
    for setting in settings:
        told |= parse_setting(setting)
    return told


def _of_run(
    root: Path, told: dict[str, object], budget: "Budget", choice: tuple[str | None, float, Path | None],
    cluster: ClusterOptions,
) -> int:  # fmt: skip
    """Poses and arcs of a run; its exit code."""
    from workflows.pose_arcs import options_of
    from workflows.pose_run import PoseRunOptions, pose_run

    body, gap_s, sidecars = choice
    folder = RunFolder(root)
    if sidecars is not None and not sidecars.is_dir():
        raise ConfigurationError(f"--matches {sidecars}: no such folder")
    plan = read_json(folder.plan)
    image_ids = plan.get("images") if plan else None
    if not isinstance(image_ids, list) or not (folder.root / "offsets").is_dir():
        raise ConfigurationError(f"{root} holds no finished run")
    options = PoseRunOptions(
        options_of("of the run", told), gap_s, budget, body, None if sidecars is None else sidecars.resolve()
    )
    with exclusive(folder):
        report = pose_run(folder, [str(i) for i in image_ids], options, cluster, typer.echo)
    for line in report.troubles[:_SHOWN_TROUBLES]:
        typer.echo(line, err=True)
    if len(report.troubles) > _SHOWN_TROUBLES:
        typer.echo(f"and {len(report.troubles) - _SHOWN_TROUBLES} more", err=True)
    failed = f", {report.failed} whose matches gave none" if report.failed else ""
    beside = f", {report.without} images in no arc" if report.without else ""
    typer.echo(
        f"{report.arcs} arcs of {report.images} images: {report.solved} with a pose of their own{failed}{beside}"
    )
    return 1 if report.troubles or report.failed else 0


def _of_file(
    paths: tuple[Path, Path, Path], budget: "Budget", how: tuple[bool, bool, float, float],
    then: tuple[Path | None, ClusterOptions],
) -> int:  # fmt: skip
    """Poses of a file's views; their exit code."""
    from catalogs.matches import read_cameras, read_matches
    from workflows.pose import bundle_views, pose_table, prepare, solve_views, unusable_sightings

    matches, cameras, output = paths
    (every, bundle, given_sigma_km, given_sigma_mrad), (arcs, cluster) = how, then
    told = read_cameras(_read(cameras), str(cameras))
    if arcs is not None and not told.arcs:
        raise ConfigurationError(f"{cameras}: no arcs to smooth")
    views = prepare(read_matches(_read(matches), str(matches)), told)
    if bundle and not views.given:
        raise ConfigurationError(f"{cameras}: a bundle needs a given pose, which holds frame and scale")
    if views.turned:
        typer.echo(
            f"{cameras}: the given cameras look away from their points; positions are read, and written, as vectors "
            "from the camera to the body", err=True,
        )  # fmt: skip
    lost = unusable_sightings(views)
    if lost:
        typer.echo(f"{matches}: {lost} sightings of views with given poses are not finite, and left out", err=True)
    with_points = arcs is not None and any(arc.options.get("solve_landmarks") for arc in told.arcs)
    rows = list(solve_views(views, budget, every, with_points))
    if bundle:
        rows = bundle_views(views, rows, given_sigma_km, 1e-3 * given_sigma_mrad)
    failed = [row for row in rows if isinstance(row.answer, PnpFailureError)]
    for row in failed:
        typer.echo(f"view {row.view_id}: {row.answer}", err=True)
    _write(output, pose_table(views, rows))
    if arcs is not None:
        _smooth(arcs, told, rows, cluster)
    typer.echo(f"{len(rows)} views, {len(rows) - len(failed)} with a pose, in {output}")
    _compare(views, rows)
    return 1 if failed else 0


def _smooth(target: Path, told: "Cameras", rows: "list[PoseRow]", cluster: ClusterOptions) -> None:
    """Smooth a file's arcs into a folder."""
    from workflows.execute import map_in_order
    from workflows.pose_arcs import POINT_SCHEMA, ArcJobOfFile, solve_arc_of_file, table_of, timing_rows

    jobs = [ArcJobOfFile.of(arc, rows, told.calibration) for arc in told.arcs]
    found = list(map_in_order(solve_arc_of_file, jobs, cluster if len(jobs) > 1 else ClusterOptions(0)))
    lost = [job.identity.arc_id for job, answer in zip(jobs, found, strict=True) if answer is None]
    if lost:
        raise ConfigurationError(f"arc {lost[0]}: its worker died, alone, twice; nothing was smoothed")
    smoothed = [answer for answer in found if answer is not None]
    _write(target / "poses.parquet", table_of([row for arc in smoothed for row in arc.poses], SCHEMAS["poses"]))
    _write(target / "arcs.parquet", table_of([arc.summary for arc in smoothed], SCHEMAS["arcs"]))
    _write(target / "timings.parquet", table_of(timing_rows(rows), SCHEMAS["timings"]))
    points = [row for arc in smoothed for row in arc.points]
    if points:
        _write(target / "points.parquet", table_of(points, POINT_SCHEMA))
    else:
        (target / "points.parquet").unlink(missing_ok=True)
    for job, arc in zip(jobs, smoothed, strict=True):
        if job.options.solve_landmarks and not arc.points:
            typer.echo(f"arc {job.identity.arc_id}: no two of its images see a point of uncertain place", err=True)


def _compare(views: "Views", rows: "list[PoseRow]") -> None:
    """Say how far the answers are from given poses."""
    from workflows.pose import compare_given

    given = compare_given(views, rows)
    if len(given):
        middle = np.median(given, axis=0)
        typer.echo(
            f"against {len(given)} given poses, medians: {middle[0]:.3g} km, {1e3 * middle[1]:.3g} mrad, "
            f"rms {middle[2]:.2f} and {middle[3]:.2f} px, NEES {middle[4]:.1f}"
        )
