"""Tables of a run as datasets, whatever version of their schemas wrote them."""

from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from pipeline.errors import ConfigurationError
from pipeline.tables import SCHEMA_VERSION, SCHEMAS, VERSION_KEY
from workflows.store import RunFolder

_PARTITION = ("mission", "camera")


def open_tables(folder: RunFolder) -> dict[str, ds.Dataset]:
    """All tables, in today's columns; those that a run has no rows of are empty.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    dict
        Datasets by table; a column that an older version did not write is null.

    Raises
    ------
    ConfigurationError
        If there are none, or one of them cannot be read or comes from a newer version.
    """
    tables = {name: table for name in SCHEMAS if (table := _open_table(folder.root / name, name)) is not None}
    if not tables:
        raise ConfigurationError(f"{folder.root} holds no finished run: it has no tables")
    # An older version knew fewer of them, and questions are asked by name.
    return {name: tables.get(name) or ds.dataset(schema.empty_table()) for name, schema in SCHEMAS.items()}


def _open_table(root: Path, name: str) -> ds.Dataset | None:
    # Names with a dot are unfinished files.
    files = sorted(path for path in root.rglob("*.parquet") if not path.name.startswith("."))
    for path in files:
        _check_version(path)
    if not files:
        return None
    partition = pa.schema([SCHEMAS[name].field(column) for column in _PARTITION])
    return ds.dataset(
        [str(path) for path in files], schema=SCHEMAS[name], format="parquet", partition_base_dir=str(root),
        partitioning=ds.partitioning(partition, flavor="hive"),
    )  # fmt: skip


def _check_version(path: Path) -> None:
    try:
        metadata = pq.read_schema(path).metadata or {}
        version = int(metadata.get(VERSION_KEY, b"1"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} is no table of a run: {error}") from error
    if version > SCHEMA_VERSION:
        raise ConfigurationError(
            f"{path} was written by a newer Pilotage: tables of version {version}, known up to {SCHEMA_VERSION}"
        )
