import shutil
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from catalogs.archive import open_archive
from catalogs.images import read_image
from pipeline.errors import ConfigurationError
from tests.catalogs.planetary import pds3_label
from tests.scenes.runs import run_archive
from tests.support import pilotage
from workflows.cli import app
from workflows.exits import EXIT_SOME_IN_ERROR
from workflows.picture import draw_image
from workflows.picture_canvas import Canvas
from workflows.picture_marks import _runs
from workflows.pictures import chosen, draw_all
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample
from workflows.store import RunFolder, read_json


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("picture")
    options = StarSampleOptions(frames=2, seed=3, cameras=("lorri_4x4",), min_stars=6, max_stars=20, processes=1)
    archive = make_star_sample(root / "archive", options)
    run_archive(archive, root / "run")
    return root


def test_navigated_stars_are_boxed_where_they_are(run: Path) -> None:
    path = sorted((run / "run" / "images").glob("*.json"))[0]
    document = read_json(path)
    assert document is not None
    raw = read_image((run / "archive" / "frames" / f"{path.stem}.fits").read_bytes(), path.stem)
    picture = imread(BytesIO(draw_image(raw.pixels, document)), format="png")
    # The frame, three times as large, between the margins that hold its axes.
    assert picture.shape[1] == 3 * 256 + 52 + 16
    orange = np.array([0xE6, 0x9F, 0x00]) / 255
    assert (np.abs(picture[..., :3] - orange).max(axis=2) < 0.02).sum() > 50


def test_an_image_without_an_answer_still_has_a_picture(run: Path) -> None:
    document = read_json(sorted((run / "run" / "images").glob("*.json"))[0])
    assert document is not None
    document |= {"offset_px": None, "sigma_px": None, "techniques": [], "status": "failed"}
    assert draw_image(np.zeros((100, 100), np.float32), document).startswith(b"\x89PNG")


def test_a_run_keeps_the_pictures_that_are_asked_for(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, archive = RunFolder(run / "run"), open_archive(str(run / "archive"), {})
    ids = [path.stem for path in folder.images.glob("*.json")]
    assert chosen(folder, ids, "all") == sorted(ids)
    assert chosen(folder, ids, "failed") == []
    one = chosen(folder, ids, "sample:1")
    assert len(one) == 1
    with pytest.raises(ConfigurationError, match="sample:N"):
        chosen(folder, ids, "sample:x")
    first = draw_all(archive, folder, one)[0]
    made = first.stat().st_mtime_ns
    assert draw_all(archive, folder, one)[0].stat().st_mtime_ns == made
    app(["picture", str(run / "run"), str(run / "archive"), *ids], standalone_mode=False)
    assert capsys.readouterr().out.split() == [str(folder.root / "pictures" / f"{i}.png") for i in ids]


def test_an_image_that_is_gone_costs_its_picture_alone(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder, archive = RunFolder(run / "run"), open_archive(str(run / "archive"), {})
    gone = sorted(path.stem for path in folder.images.glob("*.json"))[-1]
    (run / "archive" / "frames" / f"{gone}.fits").write_bytes(b"no image")
    (folder.root / "pictures" / f"{gone}.png").unlink(missing_ok=True)
    assert draw_all(archive, folder, [gone]) == []
    assert gone in caplog.text


def test_an_image_that_never_was_costs_its_picture_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    options = StarSampleOptions(frames=2, seed=3, cameras=("lorri_4x4",), processes=1)
    make_star_sample(tmp_path / "archive", options)
    there = next((tmp_path / "archive" / "frames").glob("*.fits"))
    listed = f"archive.images=[frames/{there.name}, frames/gone.fits]"
    command = ["run", str(tmp_path / "archive"), "--output", str(tmp_path / "run"), "--serial", "--set", listed]
    assert app([*command, "--pictures", "all"], standalone_mode=False) == EXIT_SOME_IN_ERROR
    assert [path.name for path in (tmp_path / "run" / "pictures").iterdir()] == [f"{there.stem}.png"]
    assert "no picture of frames__gone" in caplog.text


def test_a_label_finds_its_pixels(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    archive.mkdir()
    (archive / "a.lbl").write_bytes(pds3_label('"pixels.dat"', "UNSIGNED_INTEGER", 8, (32, 48)))
    (archive / "pixels.dat").write_bytes(np.arange(32 * 48, dtype=np.uint8).tobytes())
    (archive / "archive.yaml").write_text('images: ["a.lbl"]\n')
    run_archive(archive, tmp_path / "run")
    drawn = draw_all(open_archive(str(archive), {}), RunFolder(tmp_path / "run"), ["pixels"])
    assert [path.name for path in drawn if path.exists()] == ["pixels.png"]


def test_the_run_remembers_its_archive(run: Path, tmp_path: Path) -> None:
    folder = RunFolder(run / "run")
    first, *_ = sorted(path.stem for path in folder.images.glob("[!.]*.json"))
    shutil.rmtree(folder.root / "pictures", ignore_errors=True)
    for words in ([first], [run / "archive", first], ["--archive", run / "archive", first]):
        ended = pilotage("picture", folder.root, *words)
        assert ended.code == 0, ended.err
        assert ended.out.split() == [str(folder.root / "pictures" / f"{first}.png")]
    assert "has no image nothing" in pilotage("picture", folder.root, "nothing").refusal()
    shutil.copytree(folder.root, tmp_path / "unfinished")
    (tmp_path / "unfinished" / "run.json").unlink()
    assert "--archive" in pilotage("picture", tmp_path / "unfinished", first).refusal()


@pytest.mark.parametrize(("x", "y"), [(195.0, 50.0), (5.0, 3.0), (198.0, 99.0)])
def test_a_name_near_the_border_is_written_inside_whole(x: float, y: float) -> None:
    inner, outer = (Canvas(np.zeros((*side, 3), np.uint8), (0, 0), 1.0) for side in ((100, 200), (300, 400)))
    inner.text(x, y, "Ringlet 7", 12)
    outer.text(150.0, 150.0, "Ringlet 7", 12)
    assert inner.pixels.sum() == pytest.approx(outer.pixels.sum())


def test_no_chord_is_drawn_over_a_wide_gap_of_an_edge() -> None:
    # Sparse pieces: their median distance is as wide as the gaps.
    places = np.array([[0.0, 0.0], [100.0, 0.0], [200.0, 0.0], [224.0, 0.0], [248.0, 0.0]])
    (run,) = _runs(places, 60.0)
    np.testing.assert_array_equal(run, places[2:])
    assert len(_runs(places)) == 1
