"""The log of a run: whole lines, one per image, appended by each start, and no clock anywhere else."""

import json
import logging
from datetime import datetime
from pathlib import Path

import pytest

from tests.support import answers, pilotage, run_serial, some_frames
from workflows.run_log import FILE, JsonLines, kept_lines, logged_to, read_log, say

FRAMES = 4


@pytest.fixture(scope="module")
def run(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("log")
    some_frames(lorri_archive, root / "archive", FRAMES)
    assert run_serial(root / "archive", root / "run").code in (0, 1)
    return root / "run"


def test_every_start_appends_and_a_cut_line_spoils_no_other(run: Path) -> None:
    first = read_log(run)
    assert [line["event"] for line in first if line["event"] != "note"] == [
        "start", "workers", *["image"] * FRAMES, "end",
    ]  # fmt: skip
    answered = answers(run)
    with (run / FILE).open("ab") as log:
        # As a kill leaves it.
        log.write(b'{"emitted_at": "2026-')
    marks = sorted((run / "state").glob("[!.]*.json"))
    marks[0].unlink()
    run_serial(run.parent / "archive", run)
    lines = read_log(run)
    assert lines[: len(first)] == first
    again = [line for line in lines[len(first) :] if line["event"] == "image"]
    assert [line["image_id"] for line in again] == [marks[0].stem]
    assert answers(run) == answered
    times = [datetime.fromisoformat(str(line["emitted_at"])) for line in lines]
    assert times == sorted(times)


def test_no_result_knows_the_clock_of_the_log(run: Path) -> None:
    day = str(read_log(run)[0]["emitted_at"])[:10].encode()
    for path in [*(run / "images").iterdir(), *(run / "offsets").rglob("*.parquet")]:
        assert day not in path.read_bytes(), path
        assert b"emitted_at" not in path.read_bytes(), path


def test_a_terminal_gets_the_same_lines(run: Path) -> None:
    (run / "state" / sorted(path.name for path in (run / "state").iterdir())[0]).unlink()
    before = len(read_log(run))
    ended = run_serial(run.parent / "archive", run, "--log-format", "json")
    assert [json.loads(line) for line in ended.err.splitlines()] == read_log(run)[before:]
    assert pilotage("run", run.parent / "archive", "-o", run, "--log-format", "xml").code == 3


def test_what_a_worker_logs_comes_with_its_image(tmp_path: Path) -> None:
    with kept_lines() as lines:
        logging.getLogger("pilotage.part").info("seen")
        logging.getLogger("pilotage.part").debug("too fine")
        logging.getLogger("library").info("not ours")
        logging.getLogger("library").warning("worth knowing")
        for _ in range(100):
            logging.getLogger("library").error("x" * 10_000)
    assert [(line.logger, line.text) for line in lines[:2]] == [("pilotage.part", "seen"), ("library", "worth knowing")]
    assert len(lines) == 50
    assert len(lines[-1].text) == 2000
    with logged_to(tmp_path):
        say("line", lines[0].text, lines[0].level, image_id="N1", logger=lines[0].logger)
    (line,) = read_log(tmp_path)
    assert (line["image_id"], line["level"], line["message"]) == ("N1", "INFO", "seen")


def test_a_value_that_json_does_not_know_is_written_as_text() -> None:
    record = logging.LogRecord("pilotage", logging.INFO, "", 0, "at %s\nand on", (Path("here"),), None)
    record.pilotage_fields = {"where": Path("there")}
    text = JsonLines().format(record)
    assert "\n" not in text
    line = json.loads(text)
    assert (line["message"], line["where"]) == ("at here\nand on", "there")
