"""What is found on this machine, at a scheduler's address and in an archive."""

import socket
from pathlib import Path

import numpy as np
import pytest

from tests.support import describe, pilotage, some_frames
from workflows.doctor import Finding, examine_machine, examine_scheduler


def found(output: Path) -> dict[str, Finding]:
    return {finding.subject: finding for finding in examine_machine(output)}


def test_machine_of_the_tests_can_run(tmp_path: Path) -> None:
    findings = found(tmp_path / "not" / "yet")
    assert findings["numpy"].said == np.__version__
    assert findings["output"].good
    assert not (tmp_path / "not").exists()


def test_no_room_and_no_right_to_write_are_bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflows.doctor._LEAST_DISK", 2**80)
    monkeypatch.setattr("workflows.doctor._LEAST_MEMORY", 2**80)
    monkeypatch.setattr("workflows.doctor.os.access", lambda path, mode: path != tmp_path)
    findings = found(tmp_path)
    assert {subject for subject, finding in findings.items() if not finding.good} >= {"disk", "memory", "output"}
    assert "not writable" in findings["output"].said


def test_scheduler_is_tried() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert examine_scheduler(f"tcp://127.0.0.1:{port}").good
        assert examine_scheduler(f"127.0.0.1:{port}").good
    for address in (f"tcp://127.0.0.1:{port}", "tcp://127.0.0.1", "tcp://127.0.0.1:x", ""):
        assert not examine_scheduler(address).good


def test_archive_is_looked_at(lorri_archive: Path, tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    some_frames(lorri_archive, archive, 2)
    ended = pilotage("doctor", archive, "--output", tmp_path / "run")
    assert "ok  archive: 2 images, 0 of them not there" in ended.out
    assert "ok  star catalogue: " in ended.out
    assert not (tmp_path / "run").exists()
    describe(archive, images=["frames/gone.fits"])
    gone = pilotage("doctor", archive, "--output", tmp_path / "run")
    assert gone.code == 1
    assert "BAD archive: 1 images, 1 of them not there" in gone.out
    none = pilotage("doctor", tmp_path / "none")
    assert none.code == 1
    assert "BAD archive: " in none.out
