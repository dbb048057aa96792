"""Maplet catalogues: xarray datasets in Zarr, the index in memory and height fields read when asked for.

One group holds the maplets of one size. A catalogue is a folder: ``maplets.zarr``, beside it the text files of SPC that
came with the maps.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from catalogs.spc_files import RECORD, MapFile, map_of, maplet_of, padding_bytes
from catalogs.spc_text import LandmarkFile, SpcProblem
from pipeline.geometry.maplet import Maplet, MapletIndex, vertex_radius_km
from pipeline.records import FloatArray

STORE = "maplets.zarr"
# One chunk is one read: 16 maplets of 99 x 99 cells are 600 kB, and a run of neighbours shares them.
_CHUNK = 16
_BATCH = 16 * _CHUNK
_CHUNKS_KEPT = 8
_NAME_BYTES = 24
_UNITS = {
    "heights": "cells", "albedo": "1", "landmark": "km", "scale": "km", "covariance": "km2", "radius": "km",
    "height_step": "cells", "sigma": "km",
}  # fmt: skip


class MapletCatalogProblem(Exception):
    """One line on why a folder is no maplet catalogue."""


@dataclass(frozen=True)
class MapletCatalog:
    """An open catalogue.

    Attributes
    ----------
    folder
        Where it lies.
    groups
        Lazily read datasets by group name.
    """

    folder: Path
    groups: Mapping[str, xr.Dataset]

    @cached_property
    def index(self) -> MapletIndex:
        """All maplets without their height fields, group by group."""
        return MapletIndex.concatenate([_index_of(data) for data in self.groups.values()])

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        return np.cumsum([0, *(data.sizes["maplet"] for data in self.groups.values())])

    @cached_property
    def _columns(self) -> list[dict[str, NDArray[np.generic]]]:
        """Per group what a maplet has beside its height field."""
        wide = ("heights", "albedo")
        return [{str(k): v.values for k, v in g.data_vars.items() if k not in wide} for g in self.groups.values()]

    @cached_property
    def _read(self) -> OrderedDict[tuple[int, int], tuple[FloatArray, FloatArray]]:
        """Height fields and albedos of the chunks that were read last, by group and chunk."""
        return OrderedDict()

    def _fields(self, group: int, row: int) -> tuple[FloatArray, FloatArray]:
        key = group, row // _CHUNK
        if key not in self._read:
            part = list(self.groups.values())[group].isel(maplet=slice(key[1] * _CHUNK, (key[1] + 1) * _CHUNK))
            self._read[key] = part["heights"].values.astype(float), part["albedo"].values.astype(float)
            if len(self._read) > _CHUNKS_KEPT:
                self._read.popitem(last=False)
        heights, albedo = self._read[key]
        return heights[row % _CHUNK], albedo[row % _CHUNK]

    def _place(self, number: int) -> tuple[int, int]:
        """Group of a row of the index, and its row there."""
        group = int(np.searchsorted(self._starts, number, side="right")) - 1
        return group, number - int(self._starts[group])

    def maplet(self, number: int) -> Maplet:
        """Read one maplet.

        Parameters
        ----------
        number
            Row of the index.

        Returns
        -------
        Maplet
            With its height field.
        """
        group, row = self._place(number)
        heights, albedo = self._fields(group, row)
        columns = self._columns[group]
        return Maplet(
            _text(columns["name"][row]), columns["landmark"][row], columns["frame"][row], float(columns["scale"][row]),
            heights, albedo, columns["covariance"][row],
        )  # fmt: skip

    def map_file(self, number: int) -> MapFile:
        """One maplet as SPC's map file, with the bytes that it came with.

        Parameters
        ----------
        number
            Row of the index.

        Returns
        -------
        MapFile
            For writing.
        """
        group, place = self._place(number)
        row = {key: values[place] for key, values in self._columns[group].items()}
        maplet = self.maplet(number)
        plain = map_of(maplet, float(row["height_step"]))
        spare = bytes(row["spare"].tolist())
        padding = bytes(row["padding"].tolist())[: padding_bytes(maplet.half)]
        return MapFile(
            plain.half, plain.scale_km, row["map_landmark"], plain.axes, plain.height_step, plain.steps,
            plain.albedo_steps, row["sigma_direction"], float(row["sigma"]), spare, padding,
        )  # fmt: skip


def _text(name: NDArray[np.uint8]) -> str:
    return bytes(name.tolist()).rstrip(b"\0").decode()


def _index_of(data: xr.Dataset) -> MapletIndex:
    half = data.sizes["i"] // 2
    n = data.sizes["maplet"]
    return MapletIndex(
        np.array([_text(row) for row in data["name"].values]), data["landmark"].values, data["frame"].values,
        data["scale"].values, np.full(n, half), data["radius"].values, data["covariance"].values,
    )  # fmt: skip


def open_catalog(folder: Path) -> MapletCatalog:
    """Open a catalogue; nothing but its structure is read.

    Parameters
    ----------
    folder
        That :func:`write_catalog` wrote.

    Returns
    -------
    MapletCatalog
        Its maplets are read when asked for.

    Raises
    ------
    MapletCatalogProblem
        If the folder holds none.
    """
    store = folder / STORE
    if not store.is_dir():
        raise MapletCatalogProblem(f"{folder} holds no {STORE}")
    names = sorted(path.name for path in store.iterdir() if path.is_dir())
    try:
        groups = {
            name: xr.open_dataset(store, engine="zarr", group=name, chunks=None, consolidated=False) for name in names
        }
    except (OSError, KeyError, ValueError) as error:
        raise MapletCatalogProblem(f"{folder}: {error}") from error
    if not groups:
        raise MapletCatalogProblem(f"{folder} holds no maplets")
    return MapletCatalog(folder, groups)


def catalog_digest(folder: Path) -> str:
    """Digest of a catalogue without reading its height fields.

    Parameters
    ----------
    folder
        That :func:`write_catalog` wrote.

    Returns
    -------
    str
        sha256 over the names and sizes of all files, and the content of those that hold no heights or albedos.
    """
    digest = hashlib.sha256()
    store = folder / STORE
    for path in sorted(path for path in store.rglob("*") if path.is_file()):
        parts = path.relative_to(store).parts
        digest.update(f"{'/'.join(parts)}:{path.stat().st_size};".encode())
        if not {"heights", "albedo"} & set(parts):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def write_catalog(folder: Path, entries: Iterable[tuple[str, MapFile, LandmarkFile | None]]) -> int:
    """Write a catalogue, maps taken one after the other.

    Parameters
    ----------
    folder
        Gets or gains ``maplets.zarr``; must not hold one.
    entries
        Landmark's name, its map, and its landmark file where there is one.

    Returns
    -------
    int
        Number of maplets.

    Raises
    ------
    SpcProblem
        For a name that is too long or occurs twice.
    """
    store = folder / STORE
    zarr.open_group(store, mode="w")
    waiting: dict[int, list[xr.Dataset]] = {}
    begun: set[int] = set()
    names: set[str] = set()
    for name, file, landmark in entries:
        if name in names or len(name.encode()) > _NAME_BYTES:
            raise SpcProblem(f"{name}: the name {'occurs twice' if name in names else 'is too long'}")
        names.add(name)
        rows = waiting.setdefault(file.half, [])
        rows.append(_dataset(name, file, landmark))
        if len(rows) == _BATCH:
            _append(store, file.half, waiting.pop(file.half), begun)
    for half, rows in waiting.items():
        _append(store, half, rows, begun)
    return len(names)


def _append(store: Path, half: int, rows: list[xr.Dataset], begun: set[int]) -> None:
    data = xr.concat(rows, dim="maplet")
    group = f"half{half:04d}"
    if half in begun:
        data.to_zarr(store, group=group, append_dim="maplet", consolidated=False)
        return
    begun.add(half)
    # Small columns are read whole, height fields maplet by maplet.
    wide = {name: _CHUNK if name in ("heights", "albedo") else 4096 for name in data.data_vars}
    encoding = {name: {"chunks": (wide[name], *data[name].shape[1:])} for name in data.data_vars}
    data.to_zarr(store, group=group, mode="a", encoding=encoding, consolidated=False)


def _dataset(name: str, file: MapFile, landmark: LandmarkFile | None) -> xr.Dataset:
    maplet = maplet_of(file, name, landmark)
    label = np.frombuffer(name.encode().ljust(_NAME_BYTES, b"\0"), np.uint8)
    columns: dict[str, tuple[tuple[str, ...], object]] = {
        "name": (("letter",), label),
        "landmark": (("axis",), maplet.landmark_km),
        "map_landmark": (("axis",), file.landmark_km),
        "frame": (("row", "axis"), maplet.maplet_from_body),
        "scale": ((), maplet.scale_km),
        "heights": (("i", "j"), maplet.heights.astype(np.float32)),
        "albedo": (("i", "j"), maplet.albedo.astype(np.float32)),
        "covariance": (("axis", "axis_2"), maplet.covariance_km2),
        "radius": ((), vertex_radius_km(maplet)),
        "height_step": ((), file.height_step),
        "sigma_direction": (("axis",), file.sigma_direction),
        "sigma": ((), file.sigma_km),
        "spare": (("byte",), np.frombuffer(file.spare, np.uint8)),
        "padding": (("fill",), np.frombuffer(file.padding.ljust(RECORD, b"\0"), np.uint8)),
    }
    data = xr.Dataset({key: (("maplet", *dims), np.asarray(value)[None]) for key, (dims, value) in columns.items()})
    for key, unit in _UNITS.items():
        data[key].attrs["units"] = unit
    return data


def map_files(catalog: MapletCatalog) -> Iterator[tuple[str, MapFile]]:
    """All maps of a catalogue with their names, one at a time.

    Parameters
    ----------
    catalog
        Open catalogue.

    Yields
    ------
    tuple
        Landmark's name; its map.
    """
    for number, name in enumerate(catalog.index.name):
        yield str(name), catalog.map_file(number)
