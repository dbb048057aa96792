"""``pilotage status``: how far a run is."""

import time
from pathlib import Path
from typing import Annotated

import typer

from workflows.run_status import RunState, status_of_run
from workflows.store import RunFolder


def status(
    run_folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    watch: Annotated[bool, typer.Option("--watch", help="Say it again until the run ends.")] = False,
    every: Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds between two lines of --watch.")] = 5.0,
) -> None:
    """Say how far a run is, from its files alone: running, finished, or killed."""
    now = status_of_run(RunFolder(run_folder))
    typer.echo(now.line())
    while watch and now.state is RunState.RUNNING:
        time.sleep(every)
        now = status_of_run(RunFolder(run_folder))
        typer.echo(now.line())
