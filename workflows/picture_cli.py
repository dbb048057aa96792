"""``pilotage picture``: images of a run with what was predicted, used and refused."""

from pathlib import Path
from typing import Annotated

import typer

from catalogs.archive import open_archive
from pipeline.errors import ConfigurationError
from workflows.opening import open_remembered
from workflows.store import RunFolder, document_of, write_atomically


def picture(
    run_folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    images: Annotated[list[str], typer.Argument(metavar="[ARCHIVE] IMAGE...", help="Image ids.")],
    archive: Annotated[
        str | None, typer.Option(help="Where the images lie now; by default where the run found them.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="PNG to write, for one image; RUN/pictures/IMAGE.png.")
    ] = None,
) -> None:
    """Draw images with what was predicted, used and refused."""
    # Drawing libraries take half a second to load, which no other command should pay.
    from workflows.pictures import RingSource, draw, draw_all

    folder = RunFolder(run_folder)
    if archive is None and len(images) > 1 and not folder.document(images[0]).exists():
        archive, images = images[0], images[1:]
    documents = [document_of(folder, image) for image in images]
    opened = open_remembered(folder, "--archive ARCHIVE") if archive is None else open_archive(archive, {})
    if output is None:
        for path in draw_all(opened, folder, images):
            typer.echo(f"{path}")
        return
    if len(images) > 1:
        raise ConfigurationError("--output is for one image")
    write_atomically(output, draw(opened, folder, documents[0], RingSource(opened)))
    typer.echo(f"{output}")
