"""SQL over a run's tables: answers, refusals, and tables of older and newer versions."""

import csv
import io
import json
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.curate import Json, Provenance, error_document
from pipeline.errors import ConfigurationError
from pipeline.status import StatusReason
from pipeline.tables import SCHEMA_VERSION, SCHEMAS, VERSION_KEY
from tests.support import pilotage
from workflows.query import ask, count_rows, to_json_rows
from workflows.store import RunFolder, prepare, to_json, write_tables

IMAGES = {"a": ("M 1/x", "C"), "b": ("M", "C"), "c": ("M", "D")}


def _document(image_id: str, mission: str, camera: str) -> dict[str, Json]:
    provenance = Provenance("software", "digest", f"{image_id}.fits")
    document = error_document(image_id, StatusReason.IMAGE_EMPTY, "no bytes", provenance)
    return {**document, "mission": mission, "camera": camera, "detail": f'"{image_id}", ü'}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of three images in as many partitions."""
    folder = RunFolder(tmp_path / "run")
    prepare(folder)
    for image_id, place in IMAGES.items():
        folder.document(image_id).write_bytes(to_json(_document(image_id, *place)))
    write_tables(folder, list(IMAGES))
    return folder.root


QUESTION = "SELECT image_id, mission, camera, detail, offset_dv_px FROM offsets ORDER BY image_id"


def test_answer_holds_partitions_and_nulls(run: Path) -> None:
    rows = ask(RunFolder(run), QUESTION).to_pylist()
    assert [(row["image_id"], row["mission"], row["camera"]) for row in rows] == [
        (image_id, *place) for image_id, place in IMAGES.items()
    ]
    assert all(row["offset_dv_px"] is None for row in rows)


def test_hypot_is_known_and_tables_are_for_eyes(run: Path) -> None:
    assert pilotage("query", run, "SELECT hypot(3, 4) AS length").out.split() == ["length", "5"]
    drawn = pilotage("query", run, "SELECT 2.0 / 3 AS third, 548312300.0891376::DOUBLE AS et").out
    assert drawn.split() == ["third", "et", "0.6666667", "548312300.089"]
    said = json.loads(pilotage("query", run, "SELECT 2.0 / 3 AS third", "--format", "json").out)
    assert said == [{"third": 2.0 / 3}]


def test_formats_say_the_same(run: Path, tmp_path: Path) -> None:
    said = json.loads(pilotage("query", run, QUESTION, "--format", "json").out)
    assert said == ask(RunFolder(run), QUESTION).to_pylist()
    lines = list(csv.DictReader(io.StringIO(pilotage("query", run, QUESTION, "--format", "csv").out)))
    assert [line["detail"] for line in lines] == [row["detail"] for row in said]
    assert pilotage("query", run, QUESTION, "--format", "parquet", "--output", tmp_path / "x.parquet").code == 0
    assert pd.read_parquet(tmp_path / "x.parquet")["mission"].tolist() == ["M 1/x", "M", "M"]
    drawn = pilotage("query", run, QUESTION).out.splitlines()
    assert drawn[0].split() == ["image_id", "mission", "camera", "detail", "offset_dv_px"]
    assert len(drawn) == 4


def test_tables_are_listed_with_their_rows(run: Path) -> None:
    counts = dict.fromkeys(SCHEMAS, 0) | {"offsets": 3}
    assert count_rows(RunFolder(run)) == counts
    assert "offsets" in pilotage("query", run, "--tables").out


@pytest.mark.parametrize(
    ("question", "said"),
    [
        ("SELECT image FROM offsets", "offset_du_px"),
        ("SELECT * FROM offset", "ring_edges"),
        ("SELEC", "syntax"),
        ("", "one SELECT"),
        ("SELECT 1; SELECT 2", "one SELECT"),
        ("CREATE TABLE t AS SELECT 1", "one SELECT"),
        ("COPY offsets TO '/dev/null'", "one SELECT"),
        ("SET threads = 4", "one SELECT"),
        ("SELECT * FROM read_csv('/etc/passwd')", "disabled"),
        ("SELECT * FROM '/etc/passwd'", ""),
        ("SELECT * FROM SCHEMAS", "tables: offsets"),
        ("SELECT CAST(image_id AS INTEGER) FROM offsets", "Conversion"),
    ],
)
def test_what_is_no_question_is_refused_in_one_line(run: Path, question: str, said: str) -> None:
    assert said in pilotage("query", run, question).refusal()


def test_combinations_that_say_nothing_are_refused(run: Path, tmp_path: Path) -> None:
    assert "--tables" in pilotage("query", run).refusal()
    assert "--output" in pilotage("query", run, QUESTION, "--format", "parquet").refusal()
    assert "called a" in pilotage("query", run, "SELECT 1 AS a, 2 AS a", "--format", "json").refusal()
    assert f"{run}/no/x.csv: No such file" in pilotage("query", run, "SELECT 1", "-o", run / "no" / "x.csv").refusal()
    assert "no tables" in pilotage("query", tmp_path / "none", QUESTION).refusal()


def test_numbers_that_are_not_finite_are_null_in_json() -> None:
    assert json.loads(to_json_rows(pa.table({"x": [1.5, float("nan"), float("-inf")]}))) == [
        {"x": 1.5}, {"x": None}, {"x": None}
    ]  # fmt: skip


def _rewrite(path: Path, table: pa.Table, version: bytes | None) -> None:
    pq.write_table(table.replace_schema_metadata({VERSION_KEY: version} if version else None), path)


def test_older_tables_have_their_missing_columns_null(run: Path) -> None:
    path = run / "offsets" / "mission=M" / "camera=C" / "offsets.parquet"
    _rewrite(path, pq.ParquetFile(path).read().drop_columns(["detail"]), None)
    rows = ask(RunFolder(run), QUESTION).to_pylist()
    assert [row["detail"] is None for row in rows] == [False, True, False]


def test_newer_and_broken_tables_are_refused(run: Path) -> None:
    path = run / "offsets" / "mission=M" / "camera=D" / "offsets.parquet"
    assert pq.read_schema(path).metadata[VERSION_KEY] == str(SCHEMA_VERSION).encode()
    _rewrite(path, pq.ParquetFile(path).read(), str(SCHEMA_VERSION + 1).encode())
    with pytest.raises(ConfigurationError, match="newer"):
        ask(RunFolder(run), QUESTION)
    path.write_bytes(b"PAR1")
    with pytest.raises(ConfigurationError, match="no table of a run"):
        ask(RunFolder(run), QUESTION)
    path.rename(path.with_name(f".{path.name}"))
    assert ask(RunFolder(run), QUESTION).num_rows == 2
