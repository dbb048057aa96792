"""``pilotage catalog``: star tables of the user's, and what is known; maplets by the commands of ``maplet_cli``."""

import hashlib
import json
from pathlib import Path
from typing import Annotated

import typer

from catalogs.star_sources import TableProblem, read_table
from catalogs.stars import BUILT_IN_NAMES, added_index, build_index, cache_folder, is_catalog_name, open_index
from pipeline.errors import ConfigurationError
from workflows.maplet_cli import export_spc, import_spc, make_maplets
from workflows.store import write_atomically

app = typer.Typer(help="Star and maplet catalogues.", rich_markup_mode=None)
app.command("import-spc")(import_spc)
app.command("export-spc")(export_spc)
app.command("make-maplets")(make_maplets)


@app.command()
def add(
    table: Annotated[Path, typer.Argument(help="Parquet, CSV or FITS with ra_deg, dec_deg, mag.")],
    name: Annotated[str | None, typer.Option(help="Name for archive.yaml's stars; the file's stem by default.")] = None,
    apparent: Annotated[bool, typer.Option("--apparent", help="Places are as seen, not catalogue places.")] = False,
) -> None:
    """Index a star table and give it a name."""
    label = name or table.stem
    if not is_catalog_name(label):
        raise ConfigurationError(
            f"{label!r} cannot be a catalogue's name: letters, digits, - and _; not {', '.join(BUILT_IN_NAMES)}"
        )
    try:
        data = table.read_bytes()
        stars = read_table(data, table.name, apparent)
    except OSError as error:
        raise ConfigurationError(f"{table}: {error.strerror}") from error
    except TableProblem as error:
        raise ConfigurationError(str(error)) from error
    folder = cache_folder()
    digest = hashlib.sha256(data + (b"apparent" if apparent else b"mean")).hexdigest()
    try:
        index = build_index(stars, label, digest, folder)
        (folder / "added").mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "added" / f"{label}.json", json.dumps({"file": index.path.name}).encode())
    except OSError as error:
        raise ConfigurationError(f"cannot write the cache {folder}: {error.strerror}") from error
    typer.echo(f"{label}: {len(stars)} stars")


@app.command("list")
def list_catalogs() -> None:
    """List the catalogues that archive.yaml may name."""
    for name in BUILT_IN_NAMES:
        typer.echo(f"{name}: built in")
    for link in sorted((cache_folder() / "added").glob("*.json")):
        path = added_index(link.stem, cache_folder())
        if path is None or not path.exists():
            typer.echo(f"{link.stem}: its index is gone; add it again")
            continue
        index = open_index(path)
        typer.echo(f"{link.stem}: {len(index.rows)} stars, sha256 {index.sha256[:16]}")
