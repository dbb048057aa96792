"""Questions in SQL to the tables of a run."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from pipeline.errors import ConfigurationError
from workflows.store import RunFolder
from workflows.tables_reader import open_tables

# DuckDB has none, and the length of an offset is the most natural question.
_HYPOT = "CREATE MACRO hypot(a, b) AS sqrt(a * a + b * b)"


@contextmanager
def _database(folder: RunFolder) -> Iterator[tuple[duckdb.DuckDBPyConnection, dict[str, list[str]]]]:
    """Connection that sees the run's tables and nothing else, and the columns of each."""
    tables = open_tables(folder)
    # One thread adds numbers up in one order: the same question gets the same bytes.
    with duckdb.connect(":memory:", config={"threads": 1}) as database:
        for name, table in tables.items():
            database.register(name, table)
        database.execute(_HYPOT)
        database.execute("SET python_enable_replacements = false")
        database.execute("SET enable_external_access = false")
        database.execute("SET lock_configuration = true")
        yield database, {name: table.schema.names for name, table in tables.items()}


def ask(folder: RunFolder, question: str) -> pa.Table:
    """Answer of one SELECT.

    Parameters
    ----------
    folder
        The run.
    question
        SQL as DuckDB speaks it; every table of the run goes by its name.

    Returns
    -------
    pyarrow.Table
        The rows; their order is the question's own where it says one.

    Raises
    ------
    ConfigurationError
        If the run has no tables, or the question is not one SELECT that can be answered.
    """
    with _database(folder) as (database, columns):
        try:
            statements = database.extract_statements(question)
            if len(statements) != 1 or statements[0].type != duckdb.StatementType.SELECT:
                raise ConfigurationError("query: ask one SELECT; the tables of a run are not written to")
            return database.sql(question).to_arrow_table()
        except duckdb.Error as error:
            raise ConfigurationError(f"query: {_reason(str(error), question, columns)}") from error


def ask_many(folder: RunFolder, steps: Mapping[str, str], questions: Mapping[str, str]) -> dict[str, pa.Table]:
    """Answers of several SELECTs of our own that share intermediate tables.

    Parameters
    ----------
    folder
        The run.
    steps
        SELECT by name of an intermediate table, which later ones and the questions may use.
    questions
        SELECT by name of an answer.

    Returns
    -------
    dict
        Rows by name of the question.

    Raises
    ------
    ConfigurationError
        If the run has no tables.
    """
    with duckdb.connect(":memory:", config={"threads": 1}) as database:
        for name, table in open_tables(folder).items():
            _view(database, name, table)
        for name, step in steps.items():
            database.execute(f"CREATE TEMP TABLE {name} AS {step}")
        return {name: database.sql(question).to_arrow_table() for name, question in questions.items()}


def _view(database: duckdb.DuckDBPyConnection, name: str, table: ds.Dataset) -> None:
    """A table by DuckDB's own reader, in a third of Arrow's memory (measured); columns that no file has are null."""
    empty = f"no_{name}"
    database.register(empty, table.schema.empty_table())
    files = ", ".join("'" + path.replace("'", "''") + "'" for path in getattr(table, "files", []))
    written = (
        f" UNION ALL BY NAME SELECT * FROM read_parquet([{files}], hive_partitioning = true,"
        " hive_types_autocast = false, union_by_name = true)"
        if files
        else ""
    )
    database.execute(f"CREATE VIEW {name} AS SELECT * FROM {empty}{written}")


def _reason(text: str, question: str, columns: dict[str, list[str]]) -> str:
    """The first sentence of an error, and the names that can be used instead."""
    first = text.splitlines()[0] if text else "cannot be answered"
    named = [name for name in columns if name in question.lower()]
    if first.startswith("Binder Error") and named:
        known = "; ".join(f"{name}: {', '.join(columns[name])}" for name in named)
        return f"{first} (columns of {known})"
    return f"{first} (tables: {', '.join(columns)})"


def count_rows(folder: RunFolder) -> dict[str, int]:
    """Number of rows of each table.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    dict
        Rows by table.

    Raises
    ------
    ConfigurationError
        If the run has no tables.
    """
    return {name: int(table.count_rows()) for name, table in open_tables(folder).items()}


def to_csv(answer: pa.Table) -> bytes:
    """An answer as CSV with a line of names; null is empty.

    Parameters
    ----------
    answer
        Rows.

    Returns
    -------
    bytes
        UTF-8.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(answer.column_names)
    writer.writerows(zip(*(column.to_pylist() for column in answer.columns), strict=True))
    return text.getvalue().encode()


def to_json_rows(answer: pa.Table) -> bytes:
    """An answer as a JSON array of objects; what is no finite number is null.

    Parameters
    ----------
    answer
        Rows.

    Returns
    -------
    bytes
        UTF-8, one row per line.
    """
    names = answer.column_names
    rows = zip(*(column.to_pylist() for column in answer.columns), strict=True)
    lines = [
        json.dumps(dict(zip(names, map(_finite, row), strict=True)), ensure_ascii=False, default=str) for row in rows
    ]
    return ("[" + ",\n".join(lines) + "]\n").encode()


def _finite(value: object) -> object:
    # The difference of a number that is not finite to itself is not a number.
    return None if isinstance(value, float) and value - value != 0.0 else value


def to_parquet(answer: pa.Table) -> bytes:
    """An answer as a Parquet file.

    Parameters
    ----------
    answer
        Rows.

    Returns
    -------
    bytes
        The file.
    """
    buffer = io.BytesIO()
    pq.write_table(answer, buffer, compression="zstd")
    return buffer.getvalue()
