"""Examples of the documentation are executed, in their order, beside a run of real frames."""

import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support import ROOT, pilotage, run_serial, some_frames

FRAMES = 4
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def fenced(path: Path) -> list[tuple[str, str]]:
    """Language and text of each block."""
    return [(match[1], match[2]) for match in _FENCED.finditer(path.read_text(encoding="utf-8"))]


@pytest.fixture(scope="module")
def place(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a finished run named `run`."""
    folder = tmp_path_factory.mktemp("docs")
    some_frames(lorri_archive, folder / "archive", FRAMES)
    assert run_serial(folder / "archive", folder / "run").code in (0, 1)
    return folder


COOKBOOK = fenced(ROOT / "docs" / "cookbook.md")


@pytest.mark.parametrize("text", [text for language, text in COOKBOOK if language == "sh"])
def test_commands_of_the_cookbook(place: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(place)
    for line in text.splitlines():
        name, *arguments = shlex.split(line)
        assert name == "pilotage"
        ended = pilotage(*arguments)
        assert ended.code == 0, ended.err
        if "--output" in arguments:
            assert len(pd.read_parquet(arguments[arguments.index("--output") + 1])) > 0
        else:
            assert ended.out


def test_python_of_the_cookbook(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    names: dict[str, object] = {}
    for language, text in COOKBOOK:
        assert language in ("sh", "python", "text")
        if language == "python":
            exec(compile(text, "cookbook.md", "exec"), names)
    offsets, stars, residuals = names["offsets"], names["stars"], names["residuals"]
    assert isinstance(offsets, pd.DataFrame)
    assert isinstance(stars, pd.DataFrame)
    assert isinstance(residuals, pd.DataFrame)
    assert len(offsets) == FRAMES
    assert len(stars) == len(residuals) > FRAMES
    expected = np.mean(stars["measured_v_px"] - stars["predicted_v_px"])
    assert float(names["shift"].sel(axis="v")) == pytest.approx(expected)  # type: ignore[attr-defined]
