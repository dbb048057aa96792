"""``pilotage pose``: poses from matches that any program made."""

import logging
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import typer

from pipeline.errors import ConfigurationError
from pipeline.pose.records import PnpFailureError
from workflows.store import write_atomically


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error


def _write(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_atomically(path, sink.getvalue().to_pybytes())


def pose(
    matches: Annotated[Path, typer.Argument(help="Parquet: view_id, point_id, v_px, u_px; places and covariances.")],
    cameras: Annotated[Path, typer.Option("--cameras", help="JSON: K and shape_vu or camera_model, views with poses.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet to write.")],
    every: Annotated[bool, typer.Option("--every", help="Also solve views with given poses, from the others.")] = False,
    covariance: Annotated[
        Literal["auto", "marginals", "jacobian"], typer.Option(help="Graph marginals, Jacobian, or by budget.")
    ] = "auto",
    budget_s: Annotated[float | None, typer.Option(min=0.0, help="Seconds after which auto turns cheap.")] = None,
    bundle: Annotated[bool, typer.Option("--bundle", help="Then adjust all views and points together.")] = False,
    given_sigma_km: Annotated[float, typer.Option(min=1e-9, help="Of given positions, in the bundle.")] = 2.0,
    given_sigma_mrad: Annotated[float, typer.Option(min=1e-9, help="Of given attitudes, in the bundle.")] = 0.5,
    arcs: Annotated[Path | None, typer.Option("--arcs", help="Folder for poses.parquet and arcs.parquet.")] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A JSON line per view.")] = False,
) -> None:
    """Solve views from points of known place, or of places that views with given poses make known.

    Exit code: 0 all views solved, 1 some without a pose, 3 could not start.
    """
    # The factor graph's library takes a while to load, which no other command should pay.
    from catalogs.matches import read_cameras, read_matches
    from workflows.pose import Budget, CovarianceChoice, bundle_views, compare_given, pose_table, prepare, solve_views

    logging.basicConfig(level=logging.CRITICAL, format="%(message)s")
    logging.getLogger("pilotage.pose").setLevel(logging.DEBUG if verbose else logging.CRITICAL)
    told = read_cameras(_read(cameras), str(cameras))
    if arcs is not None and not told.arcs:
        raise ConfigurationError(f"{cameras}: no arcs to smooth")
    views = prepare(read_matches(_read(matches), str(matches)), told)
    if views.turned:
        typer.echo(
            f"{cameras}: the given cameras look away from their points; positions are read, and written, as vectors "
            "from the camera to the body", err=True,
        )  # fmt: skip
    rows = list(solve_views(views, Budget(CovarianceChoice(covariance), budget_s), every))
    if bundle:
        if not views.given:
            raise ConfigurationError(f"{cameras}: a bundle needs a given pose, which holds frame and scale")
        rows = bundle_views(views, rows, given_sigma_km, 1e-3 * given_sigma_mrad)
    failed = [row for row in rows if isinstance(row.answer, PnpFailureError)]
    for row in failed:
        typer.echo(f"view {row.view_id}: {row.answer}", err=True)
    _write(output, pose_table(views, rows))
    if arcs is not None:
        # Imported here for the same reason as above.
        from workflows.pose_arcs import smooth

        for name, table in zip(("poses", "arcs"), smooth(told.arcs, rows, views.calibration), strict=True):
            arcs.mkdir(parents=True, exist_ok=True)
            _write(arcs / f"{name}.parquet", table)
    typer.echo(f"{len(rows)} views, {len(rows) - len(failed)} with a pose, in {output}")
    given = compare_given(views, rows)
    if len(given):
        middle = np.median(given, axis=0)
        typer.echo(
            f"against {len(given)} given poses, medians: {middle[0]:.3g} km, {1e3 * middle[1]:.3g} mrad, "
            f"rms {middle[2]:.2f} and {middle[3]:.2f} px, NEES {middle[4]:.1f}"
        )
    raise typer.Exit(1 if failed else 0)
