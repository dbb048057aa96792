"""``pilotage sample``: archives with planted truth."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.errors import ConfigurationError
from workflows.maplet_cli import import_spc
from workflows.samples.aerial import AerialOptions, make_aerial_sample
from workflows.samples.asteroid import MAPLETS, SPC, make_asteroid_sample
from workflows.samples.asteroid_options import AsteroidOptions
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_options import FlybyOptions
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


@app.command()
def flyby(
    directory: Annotated[Path, typer.Argument(help="New or empty folder.")],
    frames: Annotated[int, typer.Option(min=0, help="Images of bodies to make.")] = 24,
    ring_frames: Annotated[int, typer.Option(min=0, help="Images of rings to make.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 1,
    largest: Annotated[float, typer.Option(min=6.0, max=10000.0, help="Largest target, pixels across.")] = 3000.0,
    haze: Annotated[float, typer.Option(min=0.0, max=500.0, help="Scale height of the planet's air, km.")] = 0.0,
    stars: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of images with stars.")] = 0.2,
    traps: Annotated[bool, typer.Option("--traps", help="Only scenes of which something wrong is told.")] = False,
    smooth: Annotated[bool, typer.Option("--smooth", help="Smooth grey ellipsoids.")] = False,
    processes: Annotated[int, typer.Option(min=1, help="Processes that draw.")] = 2,
) -> None:
    """Planets, moons and rings before Cassini-, Voyager- and LORRI-like cameras, with SPICE kernels."""
    default = FlybyOptions()
    options = FlybyOptions(
        frames=frames, ring_frames=ring_frames, seed=seed, processes=processes,
        diameter_px=(default.diameter_px[0], largest), haze_km=haze, star_share=stars,
        trap_share=1.0 if traps else default.trap_share, smooth=smooth,
    )  # fmt: skip
    try:
        path = make_flyby_sample(directory, options)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{directory}: {error}") from error
    typer.echo(f"{frames + ring_frames} images, kernels and truth.json in {path.parent}")


@app.command()
def aerial(
    directory: Annotated[Path, typer.Argument(help="New or empty folder.")],
    frames: Annotated[int, typer.Option(min=10, max=20_000, help="Frames, one per second.")] = 120,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 1,
    outliers: Annotated[float, typer.Option(min=0.0, max=0.6, help="Largest share of wrong matches.")] = 0.5,
) -> None:
    """A flight over terrain on WGS 84 with ground points matched, for `pilotage pose`."""
    try:
        path = make_aerial_sample(directory, AerialOptions(frames, seed, outliers))
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{directory}: {error}") from error
    typer.echo(f"{frames} frames, matches.parquet, cameras.json and truth.json in {path.parent}")


@app.command()
def asteroid(
    directory: Annotated[Path, typer.Argument(help="New or empty folder.")],
    images: Annotated[int, typer.Option(min=1, help="Images to make.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 1,
    camera: Annotated[str, typer.Option(help="cassini_wac_sum2 (512 px), or cassini_wac (1024 px).")] = (
        AsteroidOptions().camera
    ),
    coverage: Annotated[float, typer.Option(min=0.01, max=20.0, help="Maplets over each place, per scale.")] = 2.0,
    processes: Annotated[int, typer.Option(min=1, help="Processes that draw.")] = 2,
) -> None:
    """An asteroid mapped by maplets, before a camera whose attitude and place are known badly, with SPICE kernels."""
    options = AsteroidOptions(frames=images, seed=seed, camera=camera, coverage=coverage, processes=processes)
    try:
        path = make_asteroid_sample(directory, options)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"{directory}: {error}") from error
    import_spc(path.parent / SPC, path.parent / MAPLETS)
    typer.echo(f"{images} images, kernels, maplets and truth.json in {path.parent}")
