"""``pilotage validate``: whether each image of an archive could be navigated."""

import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from workflows.exits import EXIT_ALL_NAVIGATED, EXIT_SOME_IN_ERROR
from workflows.opening import open_both
from workflows.plan import make_plan
from workflows.store import RunFolder
from workflows.task import ImageRunner


def validate(
    archive: Annotated[str, typer.Argument(help="Folder or URL with an archive.yaml, or the path of one.")],
    config: Annotated[list[Path], typer.Option("--config", help="YAML file on top (repeatable).")] = [],  # noqa: B006
    settings: Annotated[list[str], typer.Option("--set", help="One key, a.b=c or archive.KEY=VALUE.")] = [],  # noqa: B006
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Name the good images too.")] = False,
) -> None:
    """Read every image's pixels, label, geometry and stars; navigate nothing, write nothing.

    Exit code: 0 all can be navigated, 2 some cannot, 3 the archive cannot be used.
    """
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as nowhere:
        plan = make_plan(*open_both(archive, config, settings), RunFolder(Path(nowhere)))
        runner = ImageRunner(plan.setup)
        for ref in plan.every:
            found = runner.examine(ref)
            counts[found.reason or "ready"] += 1
            if found.reason or verbose:
                typer.echo(f"{found.image_id}  {found.reason or 'ready'}  {found.detail}")
    said = ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
    typer.echo(f"{len(plan.every)} images: {said}")
    raise typer.Exit(EXIT_ALL_NAVIGATED if set(counts) <= {"ready"} else EXIT_SOME_IN_ERROR)
