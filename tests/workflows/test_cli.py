"""The command: what it prints, its exit codes, and one line for everything that cannot be run."""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import fsspec
import pandas as pd
import pytest
import yaml

from tests.support import ROOT, Ended, describe, document, pilotage, reasons, run_serial, some_frames
from workflows.store import RunFolder, exclusive


@pytest.fixture(scope="module")
def archive(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "archive"
    some_frames(lorri_archive, folder, 4)
    shutil.copy(lorri_archive / "truth.json", folder / "truth.json")
    return folder


@pytest.fixture(scope="module")
def run(archive: Path) -> Path:
    folder = archive.parent / "run"
    assert run_serial(archive, folder).code in (0, 1)
    return folder


@pytest.fixture
def mine(archive: Path, tmp_path: Path) -> Path:
    """A copy to be spoiled."""
    return Path(shutil.copytree(archive, tmp_path / "archive"))


def refusals(archive: object, output: Path, *arguments: object) -> list[str]:
    """What `run` and `plan` say when they refuse; nothing may be written."""
    before = sorted(output.parent.rglob("*"))
    said = [
        pilotage("plan", archive, "--output", output, *arguments).refusal(),
        pilotage("run", archive, "--output", output, *arguments).refusal(),
    ]
    assert sorted(output.parent.rglob("*")) == before
    return said


ARCHIVES = [
    ({"images": None}, "images"),
    ({"images": "none/*.fits"}, "none/*.fits"),
    ({"images": ["/etc/x.fits"]}, "/etc/x.fits"),
    ({"colour": "red"}, "colour"),
    ({"geometry": "horoscope"}, "geometry"),
    ({"geometry": "spice"}, "geometry"),
    ({"instrument": "hubble"}, "nhlorri"),
    ({"settings": {"colour": 1}}, "search_margin_vu"),
    ({"settings": {"max_rotation_deg": 90}}, "max_rotation_deg"),
    ({"settings": {"max_rotation_deg": "many"}}, "max_rotation_deg"),
    ({"settings": {"fit_camera_rotation": True, "max_rotation_deg": 0}}, "max_rotation_deg"),
    ({"stars": "tycho"}, "catalog add"),
    ({"stars": [{"path": "none.parquet"}]}, "none.parquet"),
    ({"stars": [{"path": "archive.yaml"}]}, ".parquet, .csv or .fits"),
    ({"stars": [{"path": "text.csv"}]}, "lacks the column"),
    ({"stars": [{"path": "broken.parquet"}]}, "cannot be read"),
    ({"stars": [{"path": "nan.csv"}]}, "no finite mag"),
    ({"stars": [{"path": "words.csv"}]}, "not numeric"),
    ({"stars": [{"path": "frames"}]}, "frames"),
    ({"stars": [{"path": "faint.parquet", "place": "here"}]}, "place"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "said"), ARCHIVES)
def test_archives_that_cannot_be_run(mine: Path, changes: dict[str, object], said: str) -> None:
    (mine / "text.csv").write_text("a,b\n1,2\n")
    (mine / "broken.parquet").write_text("no table")
    (mine / "nan.csv").write_text("ra_deg,dec_deg,mag\n1,2,\n")
    (mine / "words.csv").write_text("ra_deg,dec_deg,mag\nx,2,3\n")
    describe(mine, **changes)
    for line in refusals(mine, mine.parent / "run"):
        assert said in line
        assert str(mine) in line or "images" in line


@pytest.mark.parametrize("text", ["- a", "images: [", "\t", "5"])
def test_descriptions_that_are_none(mine: Path, text: str) -> None:
    (mine / "archive.yaml").write_text(text)
    for line in refusals(mine, mine.parent / "run"):
        assert "archive.yaml" in line


def test_colliding_ids(mine: Path) -> None:
    for frame in sorted((mine / "frames").glob("*.fits"))[:2]:
        frame.with_suffix(".geometry.json").write_text('{"image_id": "same"}')
    for line in refusals(mine, mine.parent / "run"):
        assert "same" in line


def test_places_that_are_no_archive(tmp_path: Path, archive: Path) -> None:
    assert "none" in refusals(tmp_path / "none", tmp_path / "run")[0]
    assert "archive.yaml" in refusals(tmp_path, tmp_path / "run")[0]
    assert "no such folder" in refusals(archive / "truth.json", tmp_path / "run")[0]
    assert "gopher" in refusals("gopher://x", tmp_path / "run")[0]


ARGUMENTS = [
    (["--set", "detection.colour=1"], "--set detection.colour=1: detection.colour is not a key"),
    (["--set", "detection.threshold_sigma=-1"], "greater than"),
    (["--set", "a\nb=1"], "--set a b=1"),
    (["--set", "nothing"], "KEY=VALUE"),
    (["--set", "archive.colour=red"], "--set archive.colour"),
    (["--set", "archive.geometry=moon"], "--set archive.geometry"),
    (["--set", "archive.stars=tycho"], "tycho"),
    (["--config", "/none.yaml"], "/none.yaml"),
    (["--nonsense"], "--nonsense"),
    (["one too many"], "one too many"),
]


@pytest.mark.parametrize(("arguments", "said"), ARGUMENTS)
def test_command_lines_that_cannot_be_run(archive: Path, tmp_path: Path, arguments: list[str], said: str) -> None:
    for line in refusals(archive, tmp_path / "run", *arguments):
        assert said in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--workers", "0"], "--workers"), (["--workers", "x"], "--workers"),
        (["--serial", "--scheduler", "tcp://x:1"], "--serial"), (["--memory-limit", "much"], "--memory-limit"),
        (["--memory-limit", "1MB"], "512.00 MiB"), (["--scheduler", "nonsense"], "nonsense"),
        (["--scheduler", "gopher://x:1"], "gopher://x:1"),
    ],
)  # fmt: skip
def test_runs_that_cannot_start(archive: Path, tmp_path: Path, arguments: list[str], said: str) -> None:
    assert said in pilotage("run", archive, "--output", tmp_path / "run", *arguments).refusal()
    assert not (tmp_path / "run").exists()


def command(*arguments: object, **keys: object) -> Ended:
    """The command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "workflows.cli", *map(str, arguments)], cwd=ROOT, text=True, capture_output=True,
        timeout=120, check=False, **keys,  # type: ignore[call-overload]
    )  # fmt: skip
    return Ended(done.returncode, done.stdout, done.stderr)


def test_no_scheduler_at_the_address(archive: Path, tmp_path: Path) -> None:
    # A port that was free a moment ago. In a process of its own: what the network libraries print counts too.
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    ended = command("run", archive, "--output", tmp_path / "run", "--scheduler", address)
    assert address in ended.refusal()
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "arguments", [[], ["run"], ["nonsense"], ["show"], ["sample"], ["catalog"], ["catalog", "add"], ["--nonsense"]]
)
def test_usage_errors_are_one_line(arguments: list[str]) -> None:
    if not arguments:
        ended = pilotage()
        assert ended.code == 0
        assert "Commands" in ended.out
        return
    pilotage(*arguments).refusal()


def test_help_is_there() -> None:
    for name in ("plan", "run", "status", "show", "config", "sample", "catalog"):
        ended = pilotage(name, "--help")
        assert ended.code == 0
        assert "Usage" in ended.out


def test_foreign_output_is_refused_and_left_alone(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("x")
    for line in refusals(archive, tmp_path / "run"):
        assert "thesis.tex" in line
    assert "holds no run" in refusals(archive, archive)[0]


def test_output_that_cannot_be_written_is_refused(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert "file" in refusals(archive, tmp_path / "file")[0]
    assert "file" in pilotage("run", archive, "--serial", "--output", tmp_path / "file" / "run").refusal()
    # Even root cannot make folders there.
    assert "/proc" in pilotage("run", archive, "--serial", "--output", "/proc/run").refusal()


def test_unwritable_cache_is_refused(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PILOTAGE_CACHE", "/proc/cache")
    assert "/proc/cache" in refusals(archive, tmp_path / "run")[0]
    table = tmp_path / "t.csv"
    table.write_text("ra_deg,dec_deg,mag\n1,2,3\n")
    assert "/proc/cache" in pilotage("catalog", "add", table).refusal()


def test_second_run_in_one_folder_is_refused(archive: Path, run: Path) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))
    with exclusive(RunFolder(run)):
        assert "another run is at work" in run_serial(archive, run).refusal()
    assert sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))[1:] == before[1:]


def test_exit_codes(mine: Path, tmp_path: Path) -> None:
    frames = sorted((mine / "frames").glob("*.fits"))
    every = reasons(mine.parent / "r") if run_serial(mine, mine.parent / "r").code in (0, 1) else {}
    good = next(name for name, reason in every.items() if reason == "navigated")
    describe(mine, images=f"frames/{good}.fits")
    assert run_serial(mine, tmp_path / "0").code == 0
    # A margin of one pixel holds no planted offset: nothing can be found, and nothing may be claimed.
    ended = run_serial(mine, tmp_path / "1", "--set", "archive.settings={search_margin_vu: [1, 1]}")
    assert ended.code == 1
    describe(mine, images="frames/*.fits")
    frames[0].write_bytes(b"")
    assert run_serial(mine, tmp_path / "2").code == 2
    assert pilotage("run", mine / "none", "--output", tmp_path / "3").code == 3


def test_status_of_every_stage(archive: Path, run: Path, tmp_path: Path) -> None:
    ended = pilotage("status", run)
    assert ended.code == 0
    assert ended.out.startswith("4 of 4 images done (")
    assert ended.out.endswith("; finished\n")
    part = Path(shutil.copytree(run, tmp_path / "part"))
    name = sorted((part / "state").iterdir())[0].name
    (part / "state" / name).unlink()
    (part / "run.json").unlink()
    assert "3 of 4 images done" in pilotage("status", part).out
    assert "not finished" in pilotage("status", part).out
    assert "holds no run" in pilotage("status", archive).refusal()
    assert "holds no run" in pilotage("status", tmp_path / "none").refusal()
    assert "holds no run" in pilotage("status", archive / "truth.json").refusal()


def test_show_counts(run: Path, archive: Path, tmp_path: Path) -> None:
    ended = pilotage("show", run)
    assert ended.code == 0
    assert "navigated" in ended.out
    for place in (archive, tmp_path / "none", archive / "truth.json"):
        assert "no finished run" in pilotage("show", place).refusal()


def test_show_image(run: Path) -> None:
    name = next(path.stem for path in (run / "images").iterdir() if document(run, path.stem)["status"] == "success")
    ended = pilotage("show", run, name)
    assert ended.code == 0
    assert name in ended.out
    assert "StarFieldFromCatalogNav" in ended.out
    for wrong in ("none", "../plan", "a/b", "x" * 300, ""):
        assert pilotage("show", run, wrong).code == 3


def test_show_truth_has_whole_rows_in_a_pipe(run: Path, archive: Path) -> None:
    ended = pilotage("show", run, "--truth", archive / "truth.json")
    assert ended.code == 0
    for path in (run / "images").iterdir():
        assert path.stem in ended.out
    assert "…" not in ended.out
    assert "4 images answered" in ended.out
    assert "false successes 0" in ended.out
    assert "and 2 more" in pilotage("show", run, "--truth", archive / "truth.json", "--limit", 2).out


TRUTHS = [
    "",
    "{",
    "[]",
    "5",
    '{"frames": 5}',
    '{"frames": {"a": 5}}',
    '{"frames": {"a": {}}}',
    '{"frames": {"a": {"offset_dv_px": "x"}}}',
    "{}",
]


@pytest.mark.parametrize("text", TRUTHS)
def test_truth_that_is_none(run: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "truth.json").write_text(text)
    assert "truth.json" in pilotage("show", run, "--truth", tmp_path / "truth.json").refusal()
    assert "none.json" in pilotage("show", run, "--truth", tmp_path / "none.json").refusal()


def test_truth_of_other_images_says_nothing(run: Path, tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text('{"frames": {}}')
    assert "0 of 0 images answered" in pilotage("show", run, "--truth", tmp_path / "truth.json").out


def test_texts_with_brackets_are_shown_as_they_are(mine: Path) -> None:
    frame = sorted((mine / "frames").glob("*.fits"))[0]
    frame.write_bytes(b"[/b] [red]x")
    describe(mine, images=f"frames/{frame.name}")
    output = mine.parent / "run[/b]"
    ended = run_serial(mine, output)
    assert ended.code == 2
    assert "run[/b]" in ended.err
    assert "[/b]" in pilotage("show", output, frame.stem).out


def test_config_is_printed_as_yaml() -> None:
    ended = pilotage("config", "--set", "detection.threshold_sigma=6.5")
    assert ended.code == 0
    assert yaml.safe_load(ended.out)["detection"]["threshold_sigma"] == 6.5
    assert "detection.x" in pilotage("config", "--set", "detection.x=1").refusal()


def test_plan_lists_what_is_to_do(archive: Path, run: Path, tmp_path: Path) -> None:
    assert "4 images, 4 answered, 0 to do" in pilotage("plan", archive, "--output", run).out
    out = pilotage("plan", archive, "--output", tmp_path / "new", "--set", "archive.images=[frames/gone.fits]").out
    assert "1 images, 0 answered, 1 to do" in out
    assert "frames__gone  frames/gone.fits  (not there)" in out


def test_catalogues_are_added_listed_and_used(mine: Path, tmp_path: Path) -> None:
    table = tmp_path / "my stars.parquet"
    shutil.copy(mine / "faint.parquet", table)
    assert "letters, digits" in pilotage("catalog", "add", table).refusal()
    assert "letters, digits" in pilotage("catalog", "add", table, "--name", "gaia").refusal()
    assert "letters, digits" in pilotage("catalog", "add", table, "--name", "../x").refusal()
    ended = pilotage("catalog", "add", table, "--name", "faint-ones")
    assert ended.code == 0
    assert ended.out.startswith("faint-ones: ")
    listed = pilotage("catalog", "list").out
    assert "gaia: built in" in listed
    assert f"faint-ones: {len(pd.read_parquet(table))} stars" in listed
    by_path = run_serial(mine, tmp_path / "by_path")
    describe(mine, stars=["gaia", "faint-ones"])
    by_name = run_serial(mine, tmp_path / "by_name")
    assert by_name.code == by_path.code
    assert [
        document(tmp_path / "by_name", path.stem)["offset_px"]
        for path in sorted((tmp_path / "by_name" / "images").iterdir())
    ] == [
        document(tmp_path / "by_path", path.stem)["offset_px"]
        for path in sorted((tmp_path / "by_path" / "images").iterdir())
    ]


def test_catalogue_added_again_redoes_its_images(mine: Path, tmp_path: Path) -> None:
    table = tmp_path / "t.parquet"
    stars = pd.read_parquet(mine / "faint.parquet")
    stars.to_parquet(table)
    describe(mine, stars=["gaia", "changing"])
    pilotage("catalog", "add", table, "--name", "changing")
    run_serial(mine, tmp_path / "run")
    pilotage("catalog", "add", table, "--name", "changing")
    assert "0 to do" in pilotage("plan", mine, "--output", tmp_path / "run").out
    stars.iloc[1:].to_parquet(table)
    pilotage("catalog", "add", table, "--name", "changing")
    assert "4 to do" in pilotage("plan", mine, "--output", tmp_path / "run").out


def test_tables_that_are_no_catalogue(tmp_path: Path, star_cache: Path) -> None:
    (tmp_path / "t.csv").write_text("a\n1\n")
    (tmp_path / "d.csv").mkdir()
    assert "lacks the column" in pilotage("catalog", "add", tmp_path / "t.csv").refusal()
    assert "none.csv" in pilotage("catalog", "add", tmp_path / "none.csv").refusal()
    assert "d.csv" in pilotage("catalog", "add", tmp_path / "d.csv").refusal()
    assert not (star_cache / "added" / "t.json").exists()


def test_catalogue_whose_index_is_gone(mine: Path, tmp_path: Path, star_cache: Path) -> None:
    (tmp_path / "t.csv").write_text("ra_deg,dec_deg,mag\n1,2,3\n")
    pilotage("catalog", "add", tmp_path / "t.csv", "--name", "lost")
    (star_cache / json.loads((star_cache / "added" / "lost.json").read_text())["file"]).unlink()
    assert "lost: its index is gone" in pilotage("catalog", "list").out
    describe(mine, stars="lost")
    assert "lost" in refusals(mine, tmp_path / "run")[0]
    (star_cache / "added" / "lost.json").unlink()


def test_sample_is_made_run_and_shown(tmp_path: Path) -> None:
    ended = pilotage("sample", "stars", tmp_path / "s", "--frames", 1, "--seed", 4, "--processes", 1)
    assert ended.code == 0
    assert "truth.json" in ended.out
    assert run_serial(tmp_path / "s", tmp_path / "run").code in (0, 1)
    assert "of 1 images answered" in pilotage("show", tmp_path / "run", "--truth", tmp_path / "s" / "truth.json").out
    assert "empty" in pilotage("sample", "stars", tmp_path / "s").refusal()
    assert "frames" in pilotage("sample", "stars", tmp_path / "t", "--frames", 10**9).refusal()
    assert "frames" in pilotage("sample", "stars", tmp_path / "t", "--frames", 0).refusal()
    pilotage("sample", "stars", "/proc/x").refusal()
    assert not (tmp_path / "t").exists()


def test_archive_in_memory_from_the_command(archive: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(f"{archive}/", "/command/", recursive=True)
    try:
        assert run_serial("memory://command", tmp_path / "run").code in (0, 1)
        assert len(reasons(tmp_path / "run")) == 4
    finally:
        memory.rm("/command", recursive=True)


def test_full_disk_ends_in_one_line(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("workflows.task.write_atomically", full)
    ended = run_serial(archive, tmp_path / "run")
    assert ended.code == 3
    assert "No space left on device" in ended.err.splitlines()[-1]
    assert "Traceback" not in ended.err


def test_closed_pipe_is_no_error(run: Path) -> None:
    shell = f"{sys.executable} -m workflows.cli config | head -1; {sys.executable} -m workflows.cli show {run} | true"
    done = subprocess.run(["bash", "-c", shell], cwd=ROOT, text=True, capture_output=True, timeout=120, check=False)
    assert done.stdout == "instruments:\n"
    assert done.stderr == ""


def test_command_needs_no_terminal_and_no_home(archive: Path, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key in ("PATH", "PILOTAGE_CACHE", "PYTHONPATH")}
    ended = command("run", archive, "--output", tmp_path / "run", "--serial", env=environment, stdin=subprocess.DEVNULL)
    assert ended.code in (0, 1), ended.err
    assert ended.out == ""
    assert "4/4" in ended.err


@pytest.mark.parametrize("command", ["status", "query", "report"])
def test_a_question_to_files_does_not_load_the_science(command: str) -> None:
    program = (
        "import sys; from workflows.cli import app\n"
        f"app(['{command}', '--help'], standalone_mode=False)\n"
        "print(sorted({'numba', 'cv2', 'spiceypy', 'distributed', 'scipy'} & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", program], cwd=ROOT, text=True, capture_output=True, check=True)
    assert said.stdout.splitlines()[-1] == "[]"
