"""The run folder: atomic files, its lock, what it refuses, and its tables."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from pipeline.curate import Json, Provenance, error_document
from pipeline.errors import ConfigurationError
from pipeline.status import StatusReason
from pipeline.tables import SCHEMAS
from workflows.store import (
    RunFolder,
    exclusive,
    prepare,
    read_json,
    refuse_foreign,
    to_json,
    write_atomically,
    write_tables,
)

TEMPORARY = "0123456789abcdef" * 2


def files_of(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


@pytest.mark.parametrize("name", ["notes.txt", "images", "state", ".hidden", "archive.yaml", "run.json"])
def test_foreign_folders_are_refused_and_left_alone(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    before = files_of(tmp_path)
    for use in (refuse_foreign, prepare):
        with pytest.raises(ConfigurationError, match="holds no run"):
            use(RunFolder(tmp_path))
    with pytest.raises(ConfigurationError, match="holds no run"), exclusive(RunFolder(tmp_path)):
        pass
    assert files_of(tmp_path) == before


def test_strangers_beside_a_lock_are_refused(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ConfigurationError, match=r"notes\.txt"):
        refuse_foreign(RunFolder(tmp_path))


def test_files_in_the_way_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for root in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ConfigurationError), exclusive(RunFolder(root)):
            pass
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "plan.json").touch()
    (tmp_path / "run" / "images").touch()
    with pytest.raises(ConfigurationError, match="cannot write"), exclusive(RunFolder(tmp_path / "run")):
        pass


def test_what_a_kill_leaves_is_swept(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    with exclusive(folder):
        pass
    left = [
        folder.root / f".plan.json.{TEMPORARY}",
        folder.images / f".a.json.{TEMPORARY}",
        folder.state / f".a.json.{TEMPORARY}",
    ]
    for path in left:
        path.write_bytes(b"{")
    (folder.images / "a.json").write_bytes(b"{}")
    # No plan.json yet: killed while the first one was written.
    with exclusive(folder):
        assert files_of(folder.root) == [".lock", "images", "images/a.json", "state"]


def test_one_at_a_time(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    with exclusive(folder), pytest.raises(ConfigurationError, match="another run is at work"), exclusive(folder):
        pass
    with exclusive(folder):
        pass


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"5", b"\xff", b"[" * 50_000])
def test_unreadable_documents_are_none(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x.json").write_bytes(data)
    assert read_json(tmp_path / "x.json") is None


def test_documents_that_are_not_there_are_none(tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "file").touch()
    for path in (tmp_path / "none.json", tmp_path / "folder.json", tmp_path / "file" / "x.json"):
        assert read_json(path) is None


def test_bytes_are_canonical() -> None:
    assert to_json({"b": 1.0, "a": [None, "ü"]}) == '{"b":1.0,"a":[null,"ü"]}\n'.encode()
    with pytest.raises(ValueError, match="JSON"):
        to_json({"a": float("nan")})


def test_writing_replaces(tmp_path: Path) -> None:
    write_atomically(tmp_path / "x", b"1")
    write_atomically(tmp_path / "x", b"2")
    assert files_of(tmp_path) == ["x"]
    assert (tmp_path / "x").read_bytes() == b"2"


def _document(image_id: str, mission: str = "M", camera: str = "C") -> dict[str, Json]:
    provenance = Provenance("software", "digest", f"{image_id}.fits")
    document = error_document(image_id, StatusReason.IMAGE_EMPTY, "no bytes", provenance)
    return {**document, "mission": mission, "camera": camera}


def _written(folder: RunFolder, *documents: dict[str, Json]) -> list[str]:
    for document in documents:
        folder.document(str(document["image_id"])).write_bytes(to_json(document))
    return [str(document["image_id"]) for document in documents]


def test_tables_hold_the_documents_in_order(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    prepare(folder)
    ids = _written(folder, _document("a"), _document("b", "M 2/x"), _document("c"))
    write_tables(folder, ids)
    assert set(SCHEMAS) <= {path.name for path in tmp_path.iterdir()}
    rows = pq.read_table(tmp_path / "offsets").to_pylist()
    assert sorted(row["image_id"] for row in rows) == ids
    assert (tmp_path / "offsets" / "mission=M%202%2Fx" / "camera=C" / "offsets.parquet").exists()
    field = pq.read_schema(tmp_path / "offsets" / "mission=M" / "camera=C" / "offsets.parquet").field("offset_dv_px")
    assert field.metadata[b"unit"] == b"px"


def test_removed_images_and_unfinished_files_leave_the_tables(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    prepare(folder)
    ids = _written(folder, _document("a"), _document("b", "other"))
    write_tables(folder, ids)
    (tmp_path / "offsets" / "mission=M" / "camera=C" / f".offsets.parquet.{TEMPORARY}").touch()
    write_tables(folder, ids[:1])
    assert [row["image_id"] for row in pq.read_table(tmp_path / "offsets").to_pylist()] == ["a"]
    assert not list((tmp_path / "offsets").rglob("*other*"))
    assert not list((tmp_path / "offsets").rglob(".*"))


def test_tables_forget_nothing_of_a_group_boundary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflows.store._IMAGES_PER_GROUP", 3)
    folder = RunFolder(tmp_path)
    prepare(folder)
    ids = _written(folder, *(_document(f"i{k}") for k in range(7)))
    write_tables(folder, ids)
    assert [row["image_id"] for row in pq.read_table(tmp_path / "offsets").to_pylist()] == ids
    assert json.loads(folder.document("i0").read_bytes())["status_reason"] == "image_empty"
