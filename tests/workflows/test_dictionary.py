import shutil
from collections import Counter
from pathlib import Path

from pipeline.tables import SCHEMAS
from tests.support import run_serial, some_frames
from workflows.dictionary import _NULLS, data_dictionary, null_meaning
from workflows.store import RunFolder
from workflows.tables_reader import open_tables


def test_published_dictionary_is_that_of_the_schemas() -> None:
    published = Path(__file__).parents[2] / "outputs" / "README.md"
    assert published.read_text(encoding="utf-8") == data_dictionary()


def test_every_column_says_its_unit_and_meaning() -> None:
    for schema in SCHEMAS.values():
        for field in schema:
            assert set(field.metadata) == {b"unit", b"meaning"}, field.name
            assert field.metadata[b"meaning"], field.name


def test_what_null_means_is_said_of_columns_that_there_are() -> None:
    assert list(_NULLS) == list(SCHEMAS)
    for table, meanings in _NULLS.items():
        names = SCHEMAS[table].names
        told = [name for group in meanings for name in group]
        assert len(told) == len(set(told)), table
        for name in told:
            assert name in names or (name.endswith("_") and any(column.startswith(name) for column in names)), name


def test_every_null_of_a_run_has_a_meaning_and_every_table_one_file(lorri_archive: Path, tmp_path: Path) -> None:
    frames = some_frames(lorri_archive, tmp_path / "archive", 5)
    frames[0].write_bytes(b"no image")
    run_serial(tmp_path / "archive", tmp_path / "run")
    # Images that come later make no further files.
    shutil.copy(frames[1], frames[1].with_name("later.fits"))
    frames[2].write_bytes(frames[3].read_bytes()[:-2880])
    run_serial(tmp_path / "archive", tmp_path / "run")
    nulls = 0
    for name, table in open_tables(RunFolder(tmp_path / "run")).items():
        rows = table.to_table()
        for column in rows.column_names:
            if rows[column].null_count:
                nulls += 1
                assert null_meaning(name, column), (name, column)
        files = Counter(path.parent for path in (tmp_path / "run" / name).rglob("*.parquet"))
        assert set(files.values()) == {1}, name
    assert nulls > 20
