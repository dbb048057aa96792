"""The documentation builds, without a warning, from what is in the checkout."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import ROOT
from workflows.config_cli import all_keys
from workflows.docs_hook import configuration_page


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    ended = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert "WARNING" not in ended.stderr
    tables = (tmp_path / "site" / "tables.html").read_text()
    assert "offset_dv_px" in tables
    assert "pipeline.navigate" in (tmp_path / "site" / "api.html").read_text()


def test_every_configuration_key_stands_on_its_page() -> None:
    page = configuration_page()
    assert re.findall(r"^\| `([\w.]+)`", page, re.MULTILINE) == [key for key, _ in all_keys()]
