"""An archive looked through before its run."""

from pathlib import Path

import pytest
from astropy.io import fits

from workflows.cli import app
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    options = StarSampleOptions(frames=4, seed=3, cameras=("lorri_4x4",), min_stars=6, max_stars=20, processes=1)
    return make_star_sample(tmp_path / "archive", options).parent


def say(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[str]]:
    code = app(["validate", *words], standalone_mode=False)
    return int(code or 0), capsys.readouterr().out.splitlines()


def test_a_good_archive_is_ready_and_nothing_is_written(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(archive.rglob("*"))
    assert say(capsys, str(archive)) == (0, ["4 images: 4 ready"])
    code, lines = say(capsys, str(archive), "-v")
    assert code == 0
    assert sum(" ready " in line for line in lines) == 4
    assert sorted(archive.rglob("*")) == before


def test_each_bad_image_says_why(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = sorted((archive / "frames").glob("*.fits"))
    frames[0].write_bytes(frames[0].read_bytes()[:1000])
    with fits.open(frames[1], mode="update") as opened:
        del opened[0].header["SPCQX"]
    code, lines = say(capsys, str(archive))
    assert code == 2
    assert lines[0].startswith(f"{frames[0].stem}  image_truncated  ")
    assert lines[1].startswith(f"{frames[1].stem}  geometry_missing  ")
    assert lines[2] == "4 images: 2 ready, 1 image_truncated, 1 geometry_missing"


def test_a_key_of_the_archive_can_be_replaced(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = sorted((archive / "frames").glob("*.fits"))[0].name
    assert say(capsys, str(archive), "--set", f"archive.images=frames/{one}") == (0, ["1 images: 1 ready"])
