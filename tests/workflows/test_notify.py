"""The command that a run's end calls."""

import json
import sys
from pathlib import Path

import pytest

from workflows.notify import notify
from workflows.store import RunFolder

COPY = "import sys, pathlib; pathlib.Path(sys.argv[1]).write_bytes(sys.stdin.buffer.read())"


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    (tmp_path / "run.json").write_text('{"images": 3}')
    return RunFolder(tmp_path)


def test_the_summary_arrives(folder: RunFolder) -> None:
    target = folder.root / "got me.json"
    assert notify(f"'{sys.executable}' -c '{COPY}' '{target}'", folder)
    assert json.loads(target.read_text()) == {"images": 3}


@pytest.mark.parametrize("command", ["/no/such/program", "false", "'unclosed", ""])
def test_a_command_that_fails_is_a_warning(folder: RunFolder, command: str, caplog: pytest.LogCaptureFixture) -> None:
    assert not notify(command, folder)
    assert "notification failed" in caplog.text
