"""``pilotage sample``: archives with planted truth."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.errors import ConfigurationError
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample

app = typer.Typer(help="Make sample archives with planted truth.", rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Make sample archives with planted truth."""


@app.command()
def stars(
    directory: Annotated[Path, typer.Argument(help="New or empty folder.")],
    frames: Annotated[int, typer.Option(min=1, help="Images to make.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 1,
    false_fraction: Annotated[
        float, typer.Option(min=0.0, max=0.95, help="Share of detections that are no star.")
    ] = 0.5,
    processes: Annotated[int, typer.Option(min=1, help="Processes that draw.")] = 2,
) -> None:
    """Star fields of LORRI-, Cassini- and Voyager-like cameras with real catalogue stars."""
    options = StarSampleOptions(frames=frames, seed=seed, false_fraction=false_fraction, processes=processes)
    try:
        path = make_star_sample(directory, options)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{directory}: {error}") from error
    typer.echo(f"{frames} images and truth.json in {path.parent}")
