"""What is to be done: a second run does nothing, a change redoes exactly what it affects."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import fsspec
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from catalogs.archive import Archive, open_archive
from pipeline.errors import ConfigurationError
from tests.support import answers, describe, pilotage, reasons, run_serial, some_frames, temporary_files, write_sidecar
from workflows.config import load_configuration
from workflows.execute import ClusterOptions
from workflows.plan import Plan, make_plan
from workflows.run import RunListener, execute
from workflows.store import RunFolder

FRAMES = 5


@pytest.fixture(scope="module")
def finished(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small archive and its finished run, to be copied."""
    folder = tmp_path_factory.mktemp("finished")
    frames = some_frames(lorri_archive, folder / "archive", FRAMES)
    write_sidecar(frames[0])
    pd.DataFrame({"ra_deg": [1.0], "dec_deg": [2.0], "mag": [3.0]}).to_parquet(frames[1].with_suffix(".stars.parquet"))
    describe(folder / "archive", stars=["gaia", {"path": "faint.parquet"}, "per-image"])
    assert run_serial(folder / "archive", folder / "run").code in (0, 1)
    return folder


@pytest.fixture
def again(finished: Path, tmp_path: Path) -> Path:
    """A copy with all times kept."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def planned(folder: Path, verify: bool = False, **layers: list[str]) -> Plan:
    archive = open_archive(str(folder / "archive"), {})
    return make_plan(archive, load_configuration(**layers), RunFolder(folder / "run"), verify)  # type: ignore[arg-type]


def todo(folder: Path, verify: bool = False, **layers: list[str]) -> list[str]:
    return [ref.image_id for ref in planned(folder, verify, **layers).todo]


def frames_of(folder: Path) -> list[Path]:
    return sorted((folder / "archive" / "frames").glob("*.fits"))


def _flip_a_byte(path: Path) -> None:
    """Change content, keep size and time."""
    times, data = path.stat(), bytearray(path.read_bytes())
    data[-5000] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def test_second_run_does_nothing(again: Path) -> None:
    before = answers(again / "run")
    marks = {path.name: path.stat().st_mtime_ns for path in (again / "run" / "state").iterdir()}
    ended = run_serial(again / "archive", again / "run")
    assert f"{FRAMES} answered before, 0 to do" in ended.err
    assert answers(again / "run") == before
    assert {path.name: path.stat().st_mtime_ns for path in (again / "run" / "state").iterdir()} == marks


def test_plan_writes_nothing(again: Path) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in again.rglob("*"))
    assert "0 to do" in pilotage("plan", again / "archive", "--output", again / "run").out
    assert sorted((path, path.stat().st_mtime_ns) for path in again.rglob("*")) == before
    assert not (again / "new").exists()
    ended = pilotage("plan", again / "archive", "--output", again / "new")
    assert f"0 answered, {FRAMES} to do" in ended.out
    assert not (again / "new").exists()


def test_touching_files_redoes_nothing(again: Path) -> None:
    for path in (again / "archive").rglob("*"):
        os.utime(path, (1, 1))
    assert todo(again) == []
    assert todo(again, verify=True) == []


def _change_image(archive: Path) -> list[int]:
    _flip_a_byte(sorted((archive / "frames").glob("*.fits"))[2])
    os.utime(sorted((archive / "frames").glob("*.fits"))[2], (5, 5))
    return [2]


def _longer_image(archive: Path) -> list[int]:
    frame = sorted((archive / "frames").glob("*.fits"))[3]
    frame.write_bytes(frame.read_bytes() + bytes(2880))
    return [3]


def _change_sidecar(archive: Path) -> list[int]:
    path = next((archive / "frames").glob("*.geometry.json"))
    path.write_text(path.read_text() + " ")
    return [0]


def _remove_sidecar(archive: Path) -> list[int]:
    next((archive / "frames").glob("*.geometry.json")).unlink()
    return [0]


def _add_sidecar(archive: Path) -> list[int]:
    write_sidecar(sorted((archive / "frames").glob("*.fits"))[4])
    return [4]


def _change_own_stars(archive: Path) -> list[int]:
    path = next((archive / "frames").glob("*.stars.parquet"))
    pd.DataFrame({"ra_deg": [1.0], "dec_deg": [2.0], "mag": [4.0]}).to_parquet(path)
    return [1]


def _add_own_stars(archive: Path) -> list[int]:
    frames = sorted((archive / "frames").glob("*.fits"))
    shutil.copy(frames[1].with_suffix(".stars.parquet"), frames[2].with_suffix(".stars.parquet"))
    return [2]


def _change_table(archive: Path) -> list[int]:
    table = pd.read_parquet(archive / "faint.parquet")
    table.iloc[1:].to_parquet(archive / "faint.parquet")
    return list(range(FRAMES))


def _change_setting(archive: Path) -> list[int]:
    describe(archive, settings={"search_margin_vu": [31, 61]})
    return list(range(FRAMES))


def _change_place(archive: Path) -> list[int]:
    describe(archive, stars=["gaia", {"path": "faint.parquet", "place": "apparent"}, "per-image"])
    return list(range(FRAMES))


def _rename(archive: Path) -> list[int]:
    describe(archive, name="another", images=["frames/*.fits"])
    return []


CHANGES = [
    _change_image, _longer_image, _change_sidecar, _remove_sidecar, _add_sidecar, _change_own_stars, _add_own_stars,
    _change_table, _change_setting, _change_place, _rename,
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__.strip("_"))
def test_a_change_redoes_what_it_affects(again: Path, change: Callable[[Path], list[int]]) -> None:
    names = [frame.stem for frame in frames_of(again)]
    assert todo(again) == []
    affected = change(again / "archive")
    assert todo(again) == [names[k] for k in affected]
    assert run_serial(again / "archive", again / "run").code in (0, 1)
    assert todo(again) == []
    fresh = run_serial(again / "archive", again / "fresh")
    assert fresh.code in (0, 1)
    assert answers(again / "run") == answers(again / "fresh")


def test_a_configuration_redoes_everything_and_back_again(again: Path) -> None:
    setting = "techniques.StarRefineNav.min_snr=7"
    before = answers(again / "run")
    assert len(todo(again, settings=[setting])) == FRAMES
    assert run_serial(again / "archive", again / "run", "--set", setting).code in (0, 1)
    assert todo(again, settings=[setting]) == []
    assert len(todo(again)) == FRAMES
    run_serial(again / "archive", again / "run")
    assert answers(again / "run") == before


def test_a_run_cut_short_does_not_vouch_for_the_old_answer(again: Path) -> None:
    # Killed between document and mark of another configuration; then the first one is asked for again.
    name = frames_of(again)[0].stem
    other = again / "other"
    run_serial(again / "archive", other, "--set", "techniques.StarRefineNav.enabled=false")
    shutil.copy(other / "images" / f"{name}.json", again / "run" / "images" / f"{name}.json")
    assert todo(again) == [name]


def test_verify_catches_what_size_and_time_hide(again: Path) -> None:
    frame = frames_of(again)[2]
    _flip_a_byte(frame)
    assert todo(again) == []
    assert todo(again, verify=True) == [frame.stem]
    assert "1 to do" in run_serial(again / "archive", again / "run", "--verify").err
    assert todo(again, verify=True) == []


@pytest.mark.parametrize("folder", ["images", "state"])
@pytest.mark.parametrize("damage", ["gone", "empty", "half", "garbage", "list", "other"])
def test_damaged_documents_and_marks_are_done_again(again: Path, folder: str, damage: str) -> None:
    before = answers(again / "run")
    names = [frame.stem for frame in frames_of(again)]
    path = again / "run" / folder / f"{names[1]}.json"
    data = path.read_bytes()
    path.unlink()
    spoiled = {"empty": b"", "half": data[: len(data) // 2], "garbage": b"\xff\x00", "list": b"[]"}
    if damage in spoiled:
        path.write_bytes(spoiled[damage])
    elif damage == "other":
        shutil.copy(path.with_name(f"{names[2]}.json"), path)
    assert todo(again) == [names[1]]
    run_serial(again / "archive", again / "run")
    assert answers(again / "run") == before


def test_half_written_files_are_swept(again: Path) -> None:
    before = answers(again / "run")
    for place in ("", "images", "state", "offsets"):
        (again / "run" / place / f".x.json.{'0' * 32}").write_bytes(b"{")
    run_serial(again / "archive", again / "run")
    assert temporary_files(again / "run") == []
    assert answers(again / "run") == before


def test_removed_images_leave_the_tables_and_added_ones_enter(again: Path, lorri_archive: Path) -> None:
    gone, added = frames_of(again)[3], sorted((lorri_archive / "frames").glob("*.fits"))[FRAMES]
    gone.unlink()
    shutil.copy(added, gone.with_name(added.name))
    assert todo(again) == [added.stem]
    run_serial(again / "archive", again / "run")
    expected = {frame.stem for frame in frames_of(again)}
    for table in ("offsets", "techniques", "timings"):
        assert set(pq.read_table(again / "run" / table)["image_id"].to_pylist()) <= expected
    assert set(pq.read_table(again / "run" / "offsets")["image_id"].to_pylist()) == expected
    assert f"{FRAMES} of {FRAMES} images done" in pilotage("status", again / "run").out


def test_file_changed_while_it_is_read_is_read_again(again: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = frames_of(again)[0]
    shutil.rmtree(again / "run")
    read = Archive.read

    def read_then_change(self: Archive, path: str) -> bytes:
        data = read(self, path)
        if path.endswith(frame.name):
            _flip_a_byte(frame)
            os.utime(frame, (7, 7))
        return data

    monkeypatch.setattr(Archive, "read", read_then_change)
    run_serial(again / "archive", again / "run")
    monkeypatch.undo()
    assert todo(again) == [frame.stem]


def test_failed_reading_is_tried_again(again: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = answers(again / "run")
    frame = frames_of(again)[1]
    os.utime(frame, (9, 9))
    shutil.rmtree(again / "run")
    read = Archive.read

    def fails(self: Archive, path: str) -> bytes:
        if path.endswith(frame.name):
            raise TimeoutError(110, "Connection timed out", "/secret/place")
        return read(self, path)

    monkeypatch.setattr(Archive, "read", fails)
    assert run_serial(again / "archive", again / "run").code == 2
    monkeypatch.undo()
    assert reasons(again / "run")[frame.stem] == "image_unreadable"
    assert "/secret" not in (again / "run" / "images" / f"{frame.stem}.json").read_text()
    assert todo(again) == [frame.stem]
    assert run_serial(again / "archive", again / "run").code in (0, 1)
    assert answers(again / "run") == before


def test_archives_by_url_give_the_same_answers(again: Path) -> None:
    memory = fsspec.filesystem("memory")
    archive = again / "archive"
    memory.put(f"{archive}/", "/planned/", recursive=True)
    packed = shutil.make_archive(str(again / "packed"), "zip", archive)
    try:
        for k, url in enumerate((f"file://{archive}", "memory://planned", f"zip://::{packed}")):
            assert run_serial(url, again / f"by_url_{k}").code in (0, 1), url
            assert answers(again / f"by_url_{k}") == answers(again / "run")
            assert "0 to do" in pilotage("plan", url, "--output", again / f"by_url_{k}").out
    finally:
        memory.rm("/planned", recursive=True)


def test_changes_in_memory_are_seen(again: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(f"{again / 'archive'}/", "/changing/", recursive=True)
    try:
        run_serial("memory://changing", again / "new")
        name = frames_of(again)[2].name
        data = memory.cat_file(f"/changing/frames/{name}")
        memory.pipe(f"/changing/frames/{name}", data + bytes(2880))
        ended = pilotage("plan", "memory://changing", "--output", again / "new")
        assert "1 to do" in ended.out
        assert name in ended.out
    finally:
        memory.rm("/changing", recursive=True)


def test_no_image_of_a_plan_is_forgotten(again: Path) -> None:
    plan = planned(again)
    listener = RunListener(lambda text: None, lambda outcome: None)
    statuses = execute(plan, ClusterOptions(workers=0), listener)
    assert sum(statuses.values()) == FRAMES
    summary = json.loads((again / "run" / "run.json").read_bytes())
    assert summary["images"] == FRAMES
    assert summary["done_in_this_run"] == 0


def test_tables_that_cannot_be_used_stop_the_plan(again: Path) -> None:
    for stars, said in [
        ("tycho", "tycho"),
        ([{"path": "none.csv"}], "none.csv"),
        (["../x"], "../x"),
        ([{"path": "frames"}], "frames"),
    ]:
        describe(again / "archive", stars=stars)
        with pytest.raises(ConfigurationError, match="stars") as error:
            planned(again)
        assert said in str(error.value)
        assert "place=" not in str(error.value)


def test_ids_are_of_the_answer_not_of_the_machine(finished: Path, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(finished, tmp_path / "elsewhere"))
    for path in (moved / "archive").rglob("*"):
        os.utime(path, (3, 3))
    assert todo(moved) == []
    marks = [
        json.loads((folder / "run" / "state" / f"{frames_of(finished)[0].stem}.json").read_bytes())
        for folder in (finished, moved)
    ]
    assert marks[0]["task_id"] == marks[1]["task_id"]
    assert np.unique([len(mark["task_id"]) for mark in marks]).tolist() == [64]
