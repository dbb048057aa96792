"""What is said of a run that goes on, was killed, and has finished: real processes."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.support import ROOT, pilotage, run_serial, some_frames
from workflows.run_status import RunState, RunStatus, status_of_run
from workflows.store import RunFolder, exclusive

FRAMES = 6
_PATIENCE_S = 120.0


@pytest.fixture
def archive(lorri_archive: Path, tmp_path: Path) -> Path:
    some_frames(lorri_archive, tmp_path / "archive", FRAMES)
    return tmp_path / "archive"


@pytest.fixture
def at_work(archive: Path, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A run held still after its first answer, still alive."""
    arguments = ("run", archive, "--output", tmp_path / "run", "--serial")
    with subprocess.Popen(
        [sys.executable, "-m", "workflows.cli", *map(str, arguments)], cwd=ROOT, stderr=subprocess.DEVNULL
    ) as process:
        until = time.monotonic() + _PATIENCE_S
        while len(list((tmp_path / "run" / "state").glob("[!.]*.json"))) < 2:
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGSTOP)
        yield process
        process.kill()


@pytest.mark.slow
def test_a_run_at_work_killed_and_finished(archive: Path, tmp_path: Path, at_work: subprocess.Popen[bytes]) -> None:
    folder = RunFolder(tmp_path / "run")
    now = status_of_run(folder)
    assert now.state is RunState.RUNNING
    assert now.planned == FRAMES
    assert now.answered_now >= 2
    assert now.left == FRAMES - now.answered_now
    assert now.last_outcome is not None
    assert abs((datetime.now(UTC) - now.last_outcome).total_seconds()) < _PATIENCE_S
    assert "not finished: running; " in pilotage("status", folder.root).out
    at_work.kill()
    at_work.wait()
    assert status_of_run(folder).state is RunState.STOPPED
    said = pilotage("status", folder.root, "--watch")
    assert "killed or interrupted; run the same command again" in said.out
    assert run_serial(archive, folder.root).code in (0, 1)
    after = status_of_run(folder)
    assert after.state is RunState.FINISHED
    assert after.left == 0
    assert after.answered_now == now.left


def test_looking_does_not_keep_a_run_from_starting(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    with exclusive(folder):
        pass
    (folder.root / "plan.json").write_text('{"images": ["a"], "digest": "d"}')
    assert status_of_run(folder).state is RunState.STOPPED
    with exclusive(folder):
        assert status_of_run(folder).state is RunState.RUNNING
    assert status_of_run(folder).rate_per_s is None


def test_line_counts_what_is_left_by_the_rate() -> None:
    when = datetime(2024, 1, 2, 3, 4, 5, tzinfo=UTC)
    line = RunStatus(RunState.RUNNING, 100, Counter(success=30, failed=10), 21, 10.0, when).line()
    assert line == (
        "40 of 100 images done (10 failed, 30 success); last outcome 2024-01-02T03:04:05+00:00; "
        "not finished: running; 2 images/s, 30 s left"
    )
