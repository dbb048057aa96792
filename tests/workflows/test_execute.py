"""Clusters and kills: one answer whatever the workers, and nothing lost or left by processes that die."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from astropy.io import fits

from pipeline.tables import SCHEMAS
from tests.support import (
    ROOT,
    answers,
    describe,
    document,
    pilotage,
    reasons,
    run_serial,
    sidecar_of,
    some_frames,
    temporary_files,
)

# A cluster takes ten seconds to start on a busy machine, and a worker as long to start again.
PATIENCE_S = 240


class Running:
    """A run in a process of its own, at the head of its own process group."""

    def __init__(self, archive: Path, run: Path, *arguments: object) -> None:
        self.run = run
        self._log = run.parent / f"{run.name}.log"
        command = [sys.executable, "-m", "workflows.cli", "run", archive, "--output", run, *arguments]
        # Where the tests run in a shell's background, interrupts are ignored, and a child would inherit that.
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                list(map(str, command)), cwd=ROOT, stdout=log, stderr=log, start_new_session=True
            )
        self._seen: set[psutil.Process] = set()

    def log(self) -> str:
        """What it has said so far."""
        return self._log.read_text()

    def workers(self) -> list[psutil.Process]:
        """Worker processes that are alive."""
        children = [child for child in self._children() if "spawn_main" in " ".join(_command_of(child))]
        return sorted(children, key=lambda child: int(child.pid))

    def _children(self) -> list[psutil.Process]:
        try:
            children: list[psutil.Process] = psutil.Process(self.process.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            return []
        self._seen.update(children)
        return children

    def done(self) -> int:
        """Images that have their mark."""
        folder = self.run / "state"
        return sum(not name.startswith(".") for name in os.listdir(folder)) if folder.exists() else 0

    def wait_until(self, condition: Callable[[], bool]) -> bool:
        """False if the run ended before the condition held."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            self._children()
            if condition():
                return True
            if self.process.poll() is not None:
                return False
            time.sleep(0.003)
        raise AssertionError(f"waited too long: {self.log()}")

    def ended(self) -> int:
        """Exit code, once all processes that it ever started are gone; those left over get ten seconds."""
        self.wait_until(lambda: False)
        _, left = psutil.wait_procs(list(self._seen), timeout=10)
        # A zombie is dead; where nobody collects orphans (a bare container) it keeps its entry.
        alive = [process for process in left if _is_alive(process)]
        assert not alive, f"left behind: {alive}"
        return int(self.process.wait())


def _is_alive(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _command_of(process: psutil.Process) -> list[str]:
    try:
        return list(process.cmdline())
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return []


@pytest.fixture(scope="module")
def undisturbed(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a run gives that nobody disturbs."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    assert run_serial(lorri_archive, run).code == 1
    return answers(run)


def test_some_answers_are_to_be_compared(undisturbed: dict[str, bytes]) -> None:
    assert sum(name.startswith("images/") for name in undisturbed) == 32
    assert {name.split("/")[0] for name in undisturbed} == {"images", *SCHEMAS} - {"timings"}
    found = sum(b'"status":"success"' in data for name, data in undisturbed.items() if name.startswith("images/"))
    assert found >= 24


def test_a_second_fresh_run_is_the_same(lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    run_serial(lorri_archive, tmp_path / "run")
    assert answers(tmp_path / "run") == undisturbed


@pytest.mark.parametrize("workers", [1, 2])
def test_the_number_of_workers_changes_nothing(
    lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes], workers: int
) -> None:
    running = Running(lorri_archive, tmp_path / "run", "--workers", workers)
    assert running.ended() == 1, running.log()
    assert f"{workers} worker" in running.log()
    assert answers(tmp_path / "run") == undisturbed
    assert temporary_files(tmp_path / "run") == []


@pytest.mark.slow
def test_killing_the_run_loses_nothing(lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    chance = random.Random(1)
    kills = 0
    # Before the first image, early, in the middle, and near the end (when tables may be on their way). A kill that
    # comes too late for a fast run does not count, so there are more of them than are asked for.
    targets = (0, 0, chance.randint(1, 3), chance.randint(4, 10), chance.randint(12, 20), chance.randint(24, 31))
    for target in targets:
        running = Running(lorri_archive, tmp_path / "run", "--workers", 2)
        if running.wait_until(lambda goal=target: running.done() >= goal and bool(running.workers())):  # type: ignore[misc]  # noqa: B023
            time.sleep(chance.random() * 0.05)
            kills += running.process.poll() is None
            running.process.send_signal(signal.SIGKILL)
        running.ended()
    assert kills >= 3
    assert run_serial(lorri_archive, tmp_path / "run").code == 1
    assert answers(tmp_path / "run") == undisturbed
    assert temporary_files(tmp_path / "run") == []
    assert "0 to do" in pilotage("plan", lorri_archive, "--output", tmp_path / "run").out


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_killing_workers_loses_nothing(
    lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes], seed: int
) -> None:
    chance = random.Random(seed)
    running = Running(lorri_archive, tmp_path / "run", "--workers", 2)
    kills = 0
    for target in (chance.randint(0, 8), chance.randint(9, 20), chance.randint(21, 29)):
        if running.wait_until(lambda goal=target: running.done() >= goal and bool(running.workers())):  # type: ignore[misc]
            time.sleep(chance.random() * 0.03)
            workers = running.workers()
            if workers:
                chance.choice(workers).send_signal(signal.SIGKILL)
                kills += 1
    assert running.ended() == 1, running.log()
    assert kills >= 2
    assert answers(tmp_path / "run") == undisturbed
    assert temporary_files(tmp_path / "run") == []
    assert "0 to do" in pilotage("plan", lorri_archive, "--output", tmp_path / "run").out


def _interrupted(archive: Path, folder: Path) -> Running:
    """A run that got a SIGINT after its first answer, and has ended."""
    folder.mkdir()
    running = Running(archive, folder / "run", "--workers", 2)
    assert running.wait_until(lambda: running.done() >= 1)
    running.process.send_signal(signal.SIGINT)
    running.ended()
    return running


@pytest.mark.slow
def test_an_interrupted_run_says_so_and_goes_on(
    lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    # A run may be through before this process, waiting for a core, sends its signal: then another try.
    for attempt in range(10):
        folder = tmp_path / f"try-{attempt}"
        running = _interrupted(lorri_archive, folder)
        if running.ended() == 130:
            break
    assert running.ended() == 130
    assert "run the same command again" in running.log()
    assert "Traceback" not in running.log()
    run_serial(lorri_archive, folder / "run")
    assert answers(folder / "run") == undisturbed


@pytest.mark.slow
def test_an_image_that_kills_its_worker_is_lost_alone(lorri_archive: Path, tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    frames = some_frames(lorri_archive, archive, 6)
    _huge_image(archive / "frames" / "huge.fits", frames[0])
    run = tmp_path / "run"
    running = Running(archive, run, "--workers", 2, "--memory-limit", "700MiB")
    assert running.ended() == 2, running.log()
    assert "Traceback" not in running.log()
    found = reasons(run)
    assert found.pop("huge") == "worker_lost"
    assert document(run, "huge")["detail"]
    assert found == {frame.stem: found[frame.stem] for frame in frames}
    assert "worker_lost" not in found.values()
    # The next run tries again, and with enough memory it goes on to say what is wrong with the image.
    assert "1 to do" in pilotage("plan", archive, "--output", run).out
    describe(archive, images=["frames/lor*.fits"])
    assert run_serial(archive, run).code in (0, 1)


def _huge_image(path: Path, donor: Path) -> None:
    """A file of 2 GiB of zeros, all of them in a hole."""
    side = 32768
    header = fits.PrimaryHDU(np.zeros((2, 2), np.int16)).header
    header["NAXIS1"] = header["NAXIS2"] = side
    with path.open("wb") as file:
        file.write(header.tostring().encode())
        file.truncate(file.tell() + 2 * side * side)
    content = sidecar_of(donor)
    camera = content["camera_model"]
    assert isinstance(camera, dict)
    camera["shape_vu"] = [side, side]
    path.with_suffix(".geometry.json").write_text(json.dumps({**content, "image_id": "huge"}))


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Address of a Dask scheduler with one worker, started by their own commands."""
    file = tmp_path / "scheduler.json"
    options = {"scheduler": ["--port", "0", "--no-dashboard"], "worker": ["--nthreads", "1", "--no-dashboard"]}
    with (tmp_path / "scheduler.log").open("w") as log:
        started = [
            subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{name}", *rest, "--scheduler-file", file],
                cwd=ROOT,
                stdout=log,
                stderr=log,
            )
            for name, rest in options.items()
        ]
        try:
            end = time.monotonic() + 60
            while not (file.exists() and '"address"' in file.read_text()) and time.monotonic() < end:
                time.sleep(0.1)
            yield json.loads(file.read_text())["address"]
        finally:
            for process in started:
                process.terminate()
            for process in started:
                process.wait(30)


@pytest.mark.slow
def test_an_existing_scheduler_gives_the_same(
    lorri_archive: Path, tmp_path: Path, undisturbed: dict[str, bytes], scheduler: str
) -> None:
    running = Running(lorri_archive, tmp_path / "run", "--scheduler", scheduler)
    assert running.ended() == 1, running.log()
    assert answers(tmp_path / "run") == undisturbed
