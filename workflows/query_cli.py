"""``pilotage query``: SQL over the tables of a run."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pyarrow as pa
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipeline.errors import ConfigurationError
from workflows.query import ask, count_rows, to_csv, to_json_rows, to_parquet
from workflows.store import RunFolder, write_atomically

_STDIN = "-"
# Of a table that goes into a file or a pipe, which has no width of its own.
_WIDE = 10_000


class Format(StrEnum):
    """How an answer is written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"


def query(
    run_folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    question: Annotated[str | None, typer.Argument(help="One SELECT; - reads it from standard input.")] = None,
    form: Annotated[Format, typer.Option("--format", help="How the answer is written.")] = Format.TABLE,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write instead.")] = None,
    tables: Annotated[bool, typer.Option("--tables", help="List the tables and their rows.")] = False,
) -> None:
    """Ask the tables of a run in SQL (DuckDB): offsets, techniques, features, landmarks and the others by name."""
    folder = RunFolder(run_folder)
    if tables == (question is not None):
        raise ConfigurationError("query: say either a SELECT or --tables")
    if form is Format.PARQUET and output is None:
        raise ConfigurationError("query: --format parquet needs --output")
    if question is None:
        counts = count_rows(folder)
        answer = pa.table({"table": list(counts), "rows": list(counts.values())})
    else:
        answer = ask(folder, sys.stdin.read() if question == _STDIN else question)
    names = answer.column_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice and form is not Format.TABLE:
        raise ConfigurationError(f"query: two columns are called {twice[0]}; name one of them by AS")
    data = _written(answer, form)
    if output is None:
        typer.echo(data.decode(), nl=False)
    else:
        write_atomically(output, data)


def _written(answer: pa.Table, form: Format) -> bytes:
    writers = {Format.CSV: to_csv, Format.JSON: to_json_rows, Format.PARQUET: to_parquet}
    return writers[form](answer) if form in writers else _drawn(answer).encode()


def _shown(value: object) -> str:
    """A value in a table: the other forms hold all digits."""
    if isinstance(value, float):
        text = f"{value:.7g}"
        # Large ones are times, of which milliseconds count.
        return f"{value:.3f}" if "e+" in text else text
    return "" if value is None else str(value)


def _drawn(answer: pa.Table) -> str:
    """Columns for a person: numbers to seven digits, null empty."""
    table = Table(box=None, pad_edge=False)
    for field in answer.schema:
        right = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
        table.add_column(Text(field.name), justify="right" if right else "left", no_wrap=True)
    for row in zip(*(column.to_pylist() for column in answer.columns), strict=True):
        table.add_row(*(Text(_shown(value)) for value in row))
    console = Console(width=_WIDE, color_system=None, highlight=False)
    with console.capture() as captured:
        console.print(table)
    return "\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n"
