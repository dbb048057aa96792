"""``pilotage doctor``: whether this machine can run, and an archive be run."""

from pathlib import Path
from typing import Annotated

import typer

from workflows.config import load_configuration
from workflows.doctor import examine_archive, examine_machine, examine_scheduler


def doctor(
    archive: Annotated[str | None, typer.Argument(help="Archive to look at too.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Where a run is to be written.")] = Path(),
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to be tried.")] = None,
) -> None:
    """Look at versions, caches, disk, memory, and at an archive's kernels and catalogues.

    Exit code: 0 all is well, 1 something is not.
    """
    findings = list(examine_machine(output))
    if scheduler is not None:
        findings.append(examine_scheduler(scheduler))
    if archive is not None:
        findings += examine_archive(archive, load_configuration(), output)
    for finding in findings:
        typer.echo(f"{'ok ' if finding.good else 'BAD'} {finding.subject}: {finding.said}")
    raise typer.Exit(0 if all(finding.good for finding in findings) else 1)
