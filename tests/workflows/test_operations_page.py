"""The page on operations: its units parse, and its commands exist."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support import ROOT, pilotage

PAGE = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
PROGRAM = "/opt/pilotage/bin/pilotage"
_UNIT = re.compile(r"^`/etc/systemd/system/(\S+)`:\n\n```systemd\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_units_parse(tmp_path: Path) -> None:
    units = dict(_UNIT.findall(PAGE))
    assert set(units) == {"pilotage.service", "pilotage.timer"}
    for name, text in units.items():
        (tmp_path / name).write_text(text.replace(PROGRAM, "/bin/true"))
    paths = [str(tmp_path / name) for name in units]
    done = subprocess.run(["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if str(tmp_path) in line or line.startswith("pilotage.")]


def test_commands_exist_with_their_options() -> None:
    said = re.findall(rf"(?:{PROGRAM}|`pilotage) ([^`\n]+)", PAGE)
    assert len(said) >= 5
    for line in said:
        name, *arguments = shlex.split(line.split(" 2>>")[0])
        offered = pilotage(name, "--help")
        assert offered.code == 0, line
        for option in (argument for argument in arguments if argument.startswith("--")):
            assert option in offered.out, line
