"""Examples of README and documentation are executed, in their order, beside a run of real frames.

Blocks fenced as `sh` and `python` are. Commands find a folder with ARCHIVE, its finished RUN and an EARLIER one; IMAGE
stands for an image of the run. Blocks that begin with the line `# with kernels, a shape or matches` find a RUN with
SPICE kernels, a shape S.obj, and MATCHES.parquet with its cameras C.json.
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
from catalogs.maplets import open_catalog
from tests.support import ROOT, pilotage, run_serial, some_frames
from workflows.config import load_configuration
from workflows.samples.aerial import AerialOptions, make_aerial_sample
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_options import FlybyOptions

FRAMES = 4
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_SUPPLIED = "# with kernels, a shape or matches"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def fenced(path: Path) -> list[tuple[str, str]]:
    """Language and text of each block."""
    return [(match[1], match[2]) for match in _FENCED.finditer(path.read_text(encoding="utf-8"))]


def programs(path: Path, supplied: bool = False) -> list[tuple[str, str]]:
    programs = [block for block in fenced(path) if block[0] in ("sh", "python")]
    return [block for block in programs if block[1].startswith(_SUPPLIED) is supplied]


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


@pytest.fixture(scope="module")
def supplied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a run that has kernels, a shape, and matches with their cameras."""
    folder = tmp_path_factory.mktemp("supplied")
    options = FlybyOptions(
        frames=2, seed=11, processes=1, cameras=("lorri_4x4",), diameter_px=(60.0, 150.0), star_share=0.0,
        trap_share=0.0,
    )  # fmt: skip
    make_flyby_sample(folder / "ARCHIVE", options)
    assert run_serial(folder / "ARCHIVE", folder / "RUN").code in (0, 1)
    make_aerial_sample(folder / "flight", AerialOptions(frames=20, seed=3))
    shutil.copy(folder / "flight" / "matches.parquet", folder / "MATCHES.parquet")
    shutil.copy(folder / "flight" / "cameras.json", folder / "C.json")
    (folder / "S.obj").write_text(_octahedron(4, 2.0))
    return folder


def _octahedron(cuts: int, radius_km: float) -> str:
    """OBJ of a ball whose facets are those of an octahedron, each cut into cuts^2."""
    lines, corners = [], np.eye(3)
    faces = []
    for signs in np.stack(np.meshgrid(*[[1, -1]] * 3), axis=-1).reshape(-1, 3):
        order = (0, 1, 2) if signs.prod() > 0 else (0, 2, 1)
        number = {}
        for i in range(cuts + 1):
            for j in range(cuts + 1 - i):
                point = (corners[order[0]] * (cuts - i - j) + corners[order[1]] * i + corners[order[2]] * j) * signs
                lines.append("v {:.9f} {:.9f} {:.9f}".format(*radius_km * point / np.linalg.norm(point)))
                number[i, j] = len(lines)
        for i in range(cuts):
            for j in range(cuts - i):
                faces.append(f"f {number[i, j]} {number[i + 1, j]} {number[i, j + 1]}")
                if i + j < cuts - 1:
                    faces.append(f"f {number[i + 1, j]} {number[i + 1, j + 1]} {number[i, j + 1]}")
    return "\n".join([*lines, *faces]) + "\n"


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


@pytest.mark.slow
def test_examples_with_kernels_a_shape_and_matches(supplied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(supplied)
    texts = [text for page in PAGES for _, text in programs(page, supplied=True)]
    assert len(texts) >= 2
    for text in texts:
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            if words:
                assert pilotage(*words[1:]).code in (0, 1), line
    assert (supplied / "RUN" / "ck" / "corrected.tm").is_file()
    assert len(pd.read_parquet(supplied / "POSES.parquet")) > 10
    assert len(open_catalog(supplied / "C").index) > 0


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
