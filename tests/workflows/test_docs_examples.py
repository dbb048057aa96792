"""Examples of README and documentation are executed, in their order, beside a run of real frames.

Blocks fenced as `sh` and `python` are. One that begins with the line `# not run by the tests: ...` needs what is not
here. Commands find a folder with ARCHIVE, its finished RUN and an EARLIER one; IMAGE stands for an image of the run.
"""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from catalogs.archive import ArchiveDescription
from tests.support import ROOT, pilotage, run_serial, some_frames
from workflows.config import load_configuration

FRAMES = 4
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NOT_RUN = "# not run by the tests:"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def fenced(path: Path) -> list[tuple[str, str]]:
    """Language and text of each block that is to be executed, or that is no program."""
    found = [(match[1], match[2]) for match in _FENCED.finditer(path.read_text(encoding="utf-8"))]
    return [(language, text) for language, text in found if not text.startswith(_NOT_RUN)]


def programs(path: Path) -> list[tuple[str, str]]:
    return [block for block in fenced(path) if block[0] in ("sh", "python")]


@pytest.fixture(scope="module")
def place(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a finished run, by the names that the pages use."""
    folder = tmp_path_factory.mktemp("docs")
    some_frames(lorri_archive, folder / "ARCHIVE", FRAMES)
    assert run_serial(folder / "ARCHIVE", folder / "RUN").code in (0, 1)
    for copy in ("run", "EARLIER"):
        shutil.copytree(folder / "RUN", folder / copy)
    (folder / "mine.yaml").write_text("detection: {threshold_sigma: 5.5}\n")
    pd.DataFrame({"ra_deg": [10.0], "dec_deg": [5.0], "mag": [8.0]}).to_parquet(folder / "mystars.parquet")
    return folder


def _run_commands(text: str, image: str) -> None:
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        assert words[0] == "pilotage"
        arguments = [image if word == "IMAGE" else word for word in words[1:]]
        ended = pilotage(*arguments)
        # A run, and what reports of it, ends with 1 where an image could not be navigated.
        assert ended.code == 0 or (arguments[0] == "run" and ended.code == 1), (line, ended.err)
        if arguments[0] == "query" and "--output" in arguments:
            assert len(pd.read_parquet(arguments[arguments.index("--output") + 1])) > 0
        else:
            assert ended.out or ended.err, line


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.slow] * (page.stem == "tutorial"))
        for page in PAGES
        if programs(page)
    ],
)
def test_examples_of_a_page(place: Path, page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    image = sorted((place / "RUN" / "images").glob("[!.]*.json"))[0].stem
    names: dict[str, object] = {}
    for language, text in programs(page):
        if language == "sh":
            _run_commands(text, image)
        else:
            exec(compile(text, page.name, "exec"), names)
    if page.stem == "cookbook":
        _check_cookbook(names)


def _check_cookbook(names: dict[str, object]) -> None:
    offsets, stars, residuals = names["offsets"], names["stars"], names["residuals"]
    assert isinstance(offsets, pd.DataFrame)
    assert isinstance(stars, pd.DataFrame)
    assert isinstance(residuals, pd.DataFrame)
    assert len(offsets) == FRAMES
    assert len(stars) == len(residuals) > FRAMES
    expected = np.mean(stars["measured_v_px"] - stars["predicted_v_px"])
    assert float(names["shift"].sel(axis="v")) == pytest.approx(expected)  # type: ignore[attr-defined]


def test_descriptions_of_archives_are_valid() -> None:
    blocks = [text for language, text in fenced(ROOT / "README.md") if language == "yaml"]
    text = (ROOT / "docs" / "missions.md").read_text(encoding="utf-8")
    indented = re.findall(r"(?:^    [a-z].*\n)+", text, re.MULTILINE)
    missions = ["images: x\n" + block for block in indented if "images:" not in block]
    for block in [*blocks, *missions, *(block for block in indented if "images:" in block)]:
        content = yaml.safe_load(re.sub(r"^    ", "", block, flags=re.MULTILINE))
        ArchiveDescription.model_validate(content)


def test_the_missions_page_has_each_camera_as_it_is_configured() -> None:
    text = (ROOT / "docs" / "missions.md").read_text(encoding="utf-8")
    for name, block in load_configuration((), ()).instruments.items():
        assert block.spice is not None
        assert f"`{block.spice.frame}`" in text, name
        assert str(block.spice.instrument_id) in text, name
