"""``pilotage catalog``: maplet catalogues from SPC's files or from a shape, and back to SPC's files."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from catalogs.maplets import MapletCatalogProblem, map_files, open_catalog, write_catalog
from catalogs.shapes import read_solid
from catalogs.spc_files import MapFile, map_of, read_map, write_map
from catalogs.spc_text import LandmarkFile, SpcProblem, read_landmark, read_picture, write_landmark
from catalogs.terrain import is_raster, read_terrain
from pipeline.errors import ConfigurationError, GeometryError
from pipeline.geometry.cutting import cut_maplet, spread_landmarks
from pipeline.geometry.maplet import Maplet
from pipeline.geometry.rays import tree_of_shape
from pipeline.geometry.shape import Shape

Entry = tuple[str, MapFile, LandmarkFile | None]
_TEXTS = (("LMKFILES", ".lmk"), ("SUMFILES", ".sum"))
_LETTERS = 26


def import_spc(
    folder: Annotated[Path, typer.Argument(help="Folder with MAPFILES, LMKFILES and SUMFILES.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Catalogue to write; must not exist.")],
) -> None:
    """Make a maplet catalogue from SPC's files."""
    maps = _files(folder / "MAPFILES", ".map")
    if not maps:
        raise ConfigurationError(f"{folder} holds no MAPFILES/*.MAP")
    texts = {kind: _files(folder / kind, ending) for kind, ending in _TEXTS}
    try:
        for path in texts["SUMFILES"].values():
            read_picture(path.read_bytes(), path.name)
        count = _write(output, _imported(maps, texts["LMKFILES"]), texts)
    except SpcProblem as error:
        raise ConfigurationError(str(error)) from error
    except OSError as error:
        raise ConfigurationError(f"{folder}: {error.strerror}") from error
    typer.echo(f"{output}: {count} maplets, {len(texts['SUMFILES'])} pictures")


def export_spc(
    catalog: Annotated[Path, typer.Argument(help="Maplet catalogue.")],
    folder: Annotated[Path, typer.Argument(help="Folder for MAPFILES, LMKFILES and SUMFILES; must not exist.")],
) -> None:
    """Write SPC's files from a maplet catalogue; what was imported comes out byte for byte."""
    if folder.exists():
        raise ConfigurationError(f"{folder} exists already")
    try:
        opened = open_catalog(catalog)
        for kind in ("MAPFILES", *(kind for kind, _ in _TEXTS)):
            (folder / kind).mkdir(parents=True)
        for kind, ending in _TEXTS:
            for path in _files(catalog / kind, ending).values():
                shutil.copyfile(path, folder / kind / path.name)
        for number, (name, file) in enumerate(map_files(opened)):
            (folder / "MAPFILES" / f"{name}.MAP").write_bytes(write_map(file))
            text = folder / "LMKFILES" / f"{name}.LMK"
            if not text.exists():
                text.write_bytes(write_landmark(_landmark_of(opened.maplet(number))))
    except MapletCatalogProblem as error:
        raise ConfigurationError(str(error)) from error
    except OSError as error:
        raise ConfigurationError(f"{folder}: {error.strerror}") from error
    typer.echo(f"{folder}: {len(opened.index)} maplets")


def make_maplets(
    shape: Annotated[Path, typer.Option("--shape", help="OBJ, ICQ, plates, DSK, or terrain model (GeoTIFF).")],
    scale: Annotated[list[float], typer.Option("--scale", help="Width of a cell in metres; may be repeated.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Catalogue to write; must not exist.")],
    size: Annotated[int, typer.Option("--size", min=9, max=999, help="Cells along a side, odd.")] = 99,
    count: Annotated[int, typer.Option("--count", min=0, help="Maplets per scale; 0 covers the surface once.")] = 0,
    sigma: Annotated[float, typer.Option("--sigma", min=0, help="1 sigma of a landmark's place, in cells.")] = 0.5,
) -> None:
    """Cut maplets from a shape, spread evenly over its surface."""
    if size % 2 == 0 or min(scale) <= 0:
        raise ConfigurationError("--size must be odd and every --scale above zero")
    try:
        data = shape.read_bytes()
        solid = read_terrain(shape) if is_raster(data) else read_solid(data, shape.name)
        number = _write(output, _cut(solid, size, [metres / 1000.0 for metres in scale], count, sigma), {})
    except OSError as error:
        raise ConfigurationError(f"{shape}: {error.strerror}") from error
    except (GeometryError, SpcProblem) as error:
        raise ConfigurationError(str(error)) from error
    typer.echo(f"{output}: {number} maplets")


def _files(folder: Path, ending: str) -> dict[str, Path]:
    """Files of a folder with an ending, in either case, by stem; empty where the folder is not there."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return {path.stem: path for path in paths if path.suffix.lower() == ending}


def _imported(maps: dict[str, Path], landmarks: dict[str, Path]) -> Iterator[Entry]:
    for name, path in maps.items():
        text = landmarks.get(name)
        landmark = None if text is None else read_landmark(text.read_bytes(), text.name)
        file = read_map(path.read_bytes(), path.name)
        if landmark is not None and landmark.half != file.half:
            raise SpcProblem(f"{path.name}: byte 11: half size {file.half}, but {landmark.half} in {name}.LMK")
        yield name, file, landmark


def _write(output: Path, entries: Iterator[Entry], texts: dict[str, dict[str, Path]]) -> int:
    """Write a catalogue under a name of its own and rename it when it is complete."""
    if output.exists():
        raise ConfigurationError(f"{output} exists already")
    part = output.with_name(f".{output.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        count = write_catalog(part, entries)
        for kind, paths in texts.items():
            (part / kind).mkdir()
            for path in paths.values():
                shutil.copyfile(path, part / kind / path.name)
        part.rename(output)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return count


def _cut(solid: Shape, size: int, scales_km: list[float], count: int, sigma: float) -> Iterator[Entry]:
    tree = tree_of_shape(solid)
    corners = solid.mesh.vertices_km[solid.mesh.facets]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    for series, scale_km in enumerate(scales_km):
        number = count or max(1, round(area / (size * scale_km) ** 2))
        points, facets = spread_landmarks(solid.mesh, number)
        for k, (point, facet) in enumerate(zip(points, facets, strict=True)):
            normal = normals[facet] / np.linalg.norm(normals[facet])
            name = f"{chr(ord('A') + series // _LETTERS)}{chr(ord('A') + series % _LETTERS)}{k:04d}"
            maplet = cut_maplet(tree, (point, normal), size // 2, scale_km, name, sigma * scale_km)
            yield name, map_of(maplet), _landmark_of(maplet)


def _landmark_of(maplet: Maplet) -> LandmarkFile:
    sigma = np.sqrt(np.diag(maplet.covariance_km2))
    return LandmarkFile(
        maplet.name, "T", "", maplet.half, maplet.scale_km, (-1, -1, -1, -1), maplet.scale_km / 2, 0.0,
        maplet.landmark_km, maplet.maplet_from_body, sigma, (), (), (),
    )  # fmt: skip
