"""The run folder: every file is written under a temporary name and renamed, so nothing half-written is ever read."""

import fcntl
import json
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO
from urllib.parse import quote
from uuid import uuid4

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import ConfigurationError
from pipeline.json_values import Json
from pipeline.tables import (
    SCHEMA_VERSION,
    SCHEMAS,
    VERSION_KEY,
    block_columns,
    feature_columns,
    landmark_pose_row,
    offset_row,
    technique_rows,
)

# Images whose rows are written together: bounds memory and fixes the row groups whatever the worker count.
_IMAGES_PER_GROUP = 2000
_LOCK = ".lock"
# Looking at a lock holds it for microseconds.
_GLANCE_S = 0.05
_TEMPORARY = re.compile(r"^\.[^/]+\.[0-9a-f]{32}$")


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @property
    def images(self) -> Path:
        """JSON documents, one per image."""
        return self.root / "images"

    @property
    def state(self) -> Path:
        """What each image was made from, and its timings: the marks by which a run resumes."""
        return self.root / "state"

    @property
    def plan(self) -> Path:
        """Ids of the images of the latest run."""
        return self.root / "plan.json"

    @property
    def lock(self) -> Path:
        """Held by the process at work."""
        return self.root / _LOCK

    def document(self, image_id: str) -> Path:
        """Document of an image."""
        return self.images / f"{image_id}.json"

    def mark(self, image_id: str) -> Path:
        """Mark of an image."""
        return self.state / f"{image_id}.json"


def refuse_foreign(folder: RunFolder) -> None:
    """Make sure that a place is free or holds a run.

    Parameters
    ----------
    folder
        The run, not necessarily existing; nothing is written.

    Raises
    ------
    ConfigurationError
        If something else is there.
    """
    try:
        present = {entry.name for entry in folder.root.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigurationError(f"cannot use {folder.root} for a run: {error.strerror}") from error
    if folder.plan.name in present:
        return
    # A run that was killed before its plan was written has its lock, and maybe what the lock was taken for.
    ours = {_LOCK, folder.images.name, folder.state.name} if _LOCK in present else set()
    strangers = sorted(name for name in present - ours if not _TEMPORARY.match(name))
    if strangers:
        raise ConfigurationError(f"{folder.root} is not empty and holds no run: {strangers[0]}")


def prepare(folder: RunFolder) -> None:
    """Make the folders and sweep temporary files that a killed run has left.

    Parameters
    ----------
    folder
        The run.

    Raises
    ------
    ConfigurationError
        If the place cannot be written, or holds something that is no run.
    """
    refuse_foreign(folder)
    try:
        for path in (folder.images, folder.state):
            path.mkdir(parents=True, exist_ok=True)
        sweep(folder)
    except OSError as error:
        raise ConfigurationError(f"cannot write {folder.root}: {error.strerror}") from error


@contextmanager
def exclusive(folder: RunFolder) -> Iterator[None]:
    """Hold a run's lock, with its folders made; the system lets go of it when the process dies.

    Parameters
    ----------
    folder
        The run.

    Raises
    ------
    ConfigurationError
        If the place cannot be written, holds something else, or another process is at work in it.
    """
    refuse_foreign(folder)
    try:
        folder.root.mkdir(parents=True, exist_ok=True)
        lock = folder.lock.open("w")
    except OSError as error:
        raise ConfigurationError(f"cannot write {folder.root}: {error.strerror}") from error
    with lock:
        try:
            _take(lock)
        except BlockingIOError as error:
            raise ConfigurationError(f"another run is at work in {folder.root}") from error
        prepare(folder)
        yield


def _take(lock: TextIO) -> None:
    """Lock a file for this process, at the second try where somebody has just looked whether it is locked."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        time.sleep(_GLANCE_S)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def sweep(folder: RunFolder) -> None:
    """Remove temporary files that a killed process has left.

    Parameters
    ----------
    folder
        The run, locked.
    """
    for path in (folder.root, folder.images, folder.state):
        for entry in os.scandir(path):
            if _TEMPORARY.match(entry.name):
                (path / entry.name).unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it.

    Parameters
    ----------
    path
        Final name, in an existing folder.
    data
        Content.
    """
    temporary = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        with temporary.open("wb") as file:
            file.write(data)
        os.replace(temporary, path)
    except OSError as error:
        # Who reads the message knows the file by its final name.
        with suppress(OSError):
            temporary.unlink()
        raise OSError(error.errno, error.strerror, str(path)) from error


def to_json(content: Mapping[str, Json]) -> bytes:
    """Canonical bytes of a document: fixed order of keys as built, no not-a-number.

    Parameters
    ----------
    content
        JSON values.

    Returns
    -------
    bytes
        UTF-8, one line per document.
    """
    return (json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n").encode()


def read_json(path: Path) -> dict[str, Json] | None:
    """A JSON object, None where there is none or it cannot be read (then its image is done again).

    Parameters
    ----------
    path
        File.

    Returns
    -------
    dict or None
        Its content.
    """
    try:
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def document_of(folder: RunFolder, image_id: str) -> dict[str, Json]:
    """Document of one image.

    Parameters
    ----------
    folder
        The run.
    image_id
        The image.

    Returns
    -------
    dict
        JSON values.

    Raises
    ------
    ConfigurationError
        If there is no run, or it has no such image.
    """
    if not folder.plan.exists():
        raise ConfigurationError(f"{folder.root} holds no run: it has no plan.json")
    document = read_json(folder.document(image_id))
    # The name of any other file beside the documents is no image either.
    if document is None or document.get("image_id") != image_id:
        raise ConfigurationError(f"{folder.root} has no image {image_id}")
    return document


def write_tables(folder: RunFolder, image_ids: Sequence[str]) -> None:
    """Rebuild all tables from the images' documents, in the order of the ids.

    Parameters
    ----------
    folder
        The run.
    image_ids
        Images that belong to it, sorted.
    """
    partitions: dict[tuple[str, str], list[str]] = {}
    for image_id in image_ids:
        document = read_json(folder.document(image_id))
        if document is not None:
            partitions.setdefault((str(document["mission"]), str(document["camera"])), []).append(image_id)
    for (mission, camera), ids in sorted(partitions.items()):
        for table in SCHEMAS:
            _write_partition(folder, table, mission, camera, ids)
    for table in SCHEMAS:
        _remove_stale(folder.root / table, {_partition(m, c) for m, c in partitions})


def _partition(mission: str, camera: str) -> str:
    return f"mission={quote(mission, safe='')}/camera={quote(camera, safe='')}"


def partition_file(folder: RunFolder, table: str, mission: str, camera: str) -> Path:
    """Where a table's rows of one camera are.

    Parameters
    ----------
    folder
        The run.
    table, mission, camera
        Which.

    Returns
    -------
    pathlib.Path
        The Parquet file.
    """
    return folder.root / table / _partition(mission, camera) / f"{table}.parquet"


@contextmanager
def table_writer(folder: RunFolder, table: str, mission: str, camera: str) -> Iterator[Callable[[pa.Table], None]]:
    """Write a table's rows of one camera, part by part; mission and camera live in the path, as hive partitions do.

    Parameters
    ----------
    folder
        The run.
    table, mission, camera
        Which.

    Yields
    ------
    callable
        Takes rows with the columns of the schema, and writes them as a row group.
    """
    names = [name for name in SCHEMAS[table].names if name not in ("mission", "camera")]
    version = {VERSION_KEY: str(SCHEMA_VERSION).encode()}
    metadata = version | (SCHEMAS[table].metadata or {})
    schema = pa.schema([SCHEMAS[table].field(name) for name in names], metadata=metadata)
    target = partition_file(folder, table, mission, camera)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{uuid4().hex}")
    with pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
        yield lambda rows: writer.write_table(pa.Table.from_arrays([rows[name] for name in names], schema=schema))
    os.replace(temporary, target)


def _write_partition(folder: RunFolder, table: str, mission: str, camera: str, image_ids: Sequence[str]) -> None:
    with table_writer(folder, table, mission, camera) as write:
        for start in range(0, len(image_ids), _IMAGES_PER_GROUP):
            columns = _columns(folder, table, image_ids[start : start + _IMAGES_PER_GROUP])
            schema = SCHEMAS[table]
            write(pa.table([pa.array(columns[field.name], type=field.type) for field in schema], schema=schema))


def _columns(folder: RunFolder, table: str, image_ids: Iterable[str]) -> dict[str, list[Json]]:
    documents = [d for d in (read_json(folder.document(image_id)) for image_id in image_ids) if d is not None]
    if table == "features":
        return feature_columns(documents)
    if table in ("ring_edges", "landmarks"):
        return block_columns(documents, table)
    if table == "offsets":
        rows = [offset_row(document) for document in documents]
    elif table == "poses":
        # Arcs are not the images': `pilotage pose` smooths them afterwards.
        rows = [row for row in map(landmark_pose_row, documents) if row is not None]
    elif table == "arcs":
        rows = []
    elif table == "techniques":
        rows = [row for document in documents for row in technique_rows(document)]
    else:
        rows = [row for document in documents for row in _timing_rows(folder, document)]
    return {name: [row.get(name) for row in rows] for name in SCHEMAS[table].names}


def _timing_rows(folder: RunFolder, document: Mapping[str, Json]) -> list[dict[str, Json]]:
    mark = read_json(folder.mark(str(document["image_id"])))
    timings = mark.get("timings") if mark else None
    if not isinstance(timings, dict):
        return []
    return [{"image_id": document["image_id"], "stage": stage, "seconds": s} for stage, s in timings.items()]


def _remove_stale(table: Path, wanted: set[str]) -> None:
    """Drop partitions that no image of this run belongs to any more, and unfinished files."""
    for path in sorted(table.rglob("*")):
        inside = path.parent.relative_to(table).as_posix()
        if path.is_file() and (inside not in wanted or _TEMPORARY.match(path.name)):
            path.unlink()
    for path in sorted((p for p in table.rglob("*") if p.is_dir()), reverse=True):
        if not any(path.iterdir()):
            path.rmdir()
