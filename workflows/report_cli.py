"""``pilotage report``."""

import os
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer

from pipeline.errors import ConfigurationError
from workflows.store import RunFolder, read_json, write_atomically


def report(
    run_folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="HTML to write; RUN/report.html.")] = None,
    compare: Annotated[Path | None, typer.Option("--compare", help="An earlier run of the same images.")] = None,
) -> None:
    """Write one HTML file that says how a run went and what to look at; it needs no network."""
    # Drawing libraries take a second to load, which no other command should pay.
    from workflows.html_report.page import Pictures, render
    from workflows.html_report.rows import changes, collect, collect_answers

    folder = RunFolder(run_folder)
    rows = collect(folder)
    change = changes(collect_answers(RunFolder(compare)), rows.answers) if compare is not None else None
    if change is not None and change.common == 0:
        raise ConfigurationError(f"{run_folder} and {compare} have no image in common")
    provenance = read_json(run_folder / "run.json")
    if provenance is None:
        raise ConfigurationError(f"{run_folder} has no run.json: the run has not ended yet")
    title = f"{provenance.get('archive') or run_folder.resolve().name}"
    target = output or run_folder / "report.html"
    place = run_folder / "pictures"
    # As a link from where the page lies, which need not be the run's folder.
    address = quote(os.path.relpath(place.resolve(), target.resolve().parent))
    write_atomically(target, render(title, rows, provenance, Pictures(place, address), change).encode())
    typer.echo(f"{target}")
