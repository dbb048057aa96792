"""Corrected C-kernels: read back by SPICE, and images navigated again with them."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from catalogs.kernels import check_kernels
from pipeline.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, rotation_about
from pipeline.records import FloatArray
from tests.scenes.kernels import START_ET, write_kernels
from tests.support import describe, document, pilotage, run_serial
from workflows.config import load_configuration
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_options import FlybyOptions

OPTIONS = FlybyOptions(
    frames=6, seed=11, processes=1, cameras=("lorri_4x4", "cassini_nac_sum2", "voyager_na"), diameter_px=(60.0, 150.0),
    star_share=0.0, trap_share=0.0,
)  # fmt: skip
BLOCKS = load_configuration().instruments
# Of the acceptance: attitude back to a nanoradian.
PROMISE_RAD = 1e-9


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flyby") / "archive"
    make_flyby_sample(folder, OPTIONS)
    return folder


@pytest.fixture(scope="module")
def run(archive: Path) -> Path:
    folder = archive.parent / "run"
    run_serial(archive, folder)
    return folder


@pytest.fixture(scope="module")
def corrected(archive: Path, run: Path) -> Path:
    ended = pilotage("ck", run, archive)
    assert ended.code == 0, ended.err
    assert ended.out.split()[-1] == str(run / "ck" / "corrected.tm")
    return run / "ck" / "corrected.tm"


def navigated(run: Path) -> list[dict[str, object]]:
    found = [document(run, path.stem) for path in sorted((run / "images").glob("*.json"))]
    return [content for content in found if content["status"] == "success"]


def attitude(content: dict[str, object], et: float | None = None) -> FloatArray:
    """camera_from_j2000 that the loaded kernels give."""
    label, when = content["label"], content["et"] if et is None else et
    assert isinstance(label, dict)
    names = BLOCKS[label["block"]].spice
    assert names is not None
    instrument: FloatArray = np.array(spiceypy.pxform("J2000", names.frame, float(str(when))))
    return np.asarray(names.rotation() @ instrument)


def angle(a: FloatArray, b: FloatArray) -> float:
    """Small angle between two attitudes."""
    return float(np.linalg.norm(a - b) / np.sqrt(2.0))


def test_attitudes_come_back(archive: Path, run: Path, corrected: Path) -> None:
    documents = navigated(run)
    assert len(documents) >= 4
    check_kernels(str(archive), str(corrected), run)
    for content in documents:
        pointing = content["pointing"]
        assert isinstance(pointing, dict)
        wanted = matrix_from_quaternion(np.array(pointing["camera_from_j2000_wxyz"]))
        before = matrix_from_quaternion(np.array(pointing["a_priori_camera_from_j2000_wxyz"]))
        assert angle(attitude(content), wanted) < PROMISE_RAD
        assert angle(before, wanted) > 100 * PROMISE_RAD
    spiceypy.kclear()


def test_outside_of_exposures_the_original_pointing_holds(archive: Path, run: Path, corrected: Path) -> None:
    content = navigated(run)[0]
    after = float(str(content["et"])) + float(str(content["exposure_s"])) / 2 + 0.3
    check_kernels(str(archive), "kernels/meta.tm", run)
    original = attitude(content, after)
    check_kernels(str(archive), str(corrected), run)
    assert angle(attitude(content, after), original) == 0.0
    spiceypy.kclear()


def answered(image_id: str, et: float, turn: FloatArray, sigma: float, exposure: float = 1.0) -> dict[str, object]:
    """Document of an image of the loaded scene, its attitude corrected by a turn in the camera's frame."""
    names = BLOCKS["coiss_nac"].spice
    assert names is not None
    before = names.rotation() @ np.array(spiceypy.pxform("J2000", names.frame, et))
    return {
        "image_id": image_id, "status": "success", "time_utc": "2009-07-04", "et": et, "exposure_s": exposure,
        "label": {"block": "coiss_nac"}, "offset_px": [1.0, 2.0], "sigma_px": [sigma, sigma],
        "pointing": {"camera_from_j2000_wxyz": quaternion_from_matrix(turn @ before).tolist()},
    }  # fmt: skip


@dataclass(frozen=True)
class Turning:
    """A made-up run of a camera that turns: its archive, its documents, and what was planted."""

    archive: Path
    documents: dict[str, dict[str, object]]
    turn: FloatArray
    rate: FloatArray

    def write(self) -> None:
        """The run's files, and the C-kernels of it, which stay loaded."""
        run = self.archive.parent / "run"
        (run / "images").mkdir(parents=True)
        (run / "plan.json").write_text(json.dumps({"images": sorted(self.documents)}))
        for name, content in self.documents.items():
            (run / "images" / f"{name}.json").write_text(json.dumps(content))
        assert pilotage("ck", run, self.archive).code == 0
        check_kernels(str(self.archive), str(run / "ck" / "corrected.tm"), run)


@pytest.fixture
def turning(tmp_path: Path) -> Iterator[Turning]:
    write_kernels(tmp_path / "archive" / "kernels")
    describe(tmp_path / "archive", images="*.IMG", geometry="spice", kernels="kernels/meta.tm")
    check_kernels(str(tmp_path / "archive"), "kernels/meta.tm", tmp_path)
    turn = rotation_about(np.array([0.3, -0.5, 0.8]), 1e-3)
    et = START_ET + 1000.0
    shots = [
        ("a", et, 0.1, 1.0), ("b", et + 30.0, 0.2, 4.0), ("c", et + 31.0, 0.2, 4.0), ("d", et + 60.0, 0.3, 1.0),
        ("e", et + 60.0, 0.1, 1.0),
    ]  # fmt: skip
    documents = {name: answered(name, at, turn, sigma, exposure) for name, at, sigma, exposure in shots}
    # The other product of d's exposure was answered otherwise, and is the worse one.
    documents["d"] = answered("d", et + 60.0, np.eye(3), 0.3)
    _, rate = spiceypy.xf2rav(spiceypy.sxform("J2000", "CASSINI_ISS_NAC", et))
    yield Turning(tmp_path / "archive", documents, turn, np.array(rate))
    spiceypy.kclear()


def test_the_motion_within_an_exposure_is_the_original_one(turning: Turning) -> None:
    a = turning.documents["a"]
    times = [float(str(a["et"])) + dt for dt in (-0.5, -0.2, 0.0, 0.3, 0.5)]
    wanted = [turning.turn @ attitude(a, t) for t in times]
    turning.write()
    for t, attitude_then in zip(times, wanted, strict=True):
        assert angle(attitude(a, t), attitude_then) < PROMISE_RAD
    assert np.linalg.norm(turning.rate) == pytest.approx(2e-5, rel=1e-9)
    names = BLOCKS["coiss_nac"].spice
    assert names is not None
    _, rate = spiceypy.xf2rav(spiceypy.sxform("J2000", names.frame, times[2]))
    # In J2000 axes a correction in the camera's frame leaves the rate as it was.
    assert np.array(rate) == pytest.approx(turning.rate, abs=PROMISE_RAD)


def test_neighbours_share_the_time_between_them(turning: Turning) -> None:
    b, c = turning.documents["b"], turning.documents["c"]
    start, between = float(str(b["et"])), float(str(b["et"])) + 0.5
    wanted = {t: turning.turn @ attitude(b, t) for t in (start - 1.9, start, between - 0.05, between + 0.05)}
    wanted[start + 1.0] = turning.turn @ attitude(c)
    turning.write()
    for t, attitude_then in wanted.items():
        assert angle(attitude(b, t), attitude_then) < PROMISE_RAD


def test_of_two_products_of_an_exposure_the_surer_counts(turning: Turning) -> None:
    wanted = turning.turn @ attitude(turning.documents["e"])
    turning.write()
    assert angle(attitude(turning.documents["d"]), wanted) < PROMISE_RAD


def test_images_navigated_again_find_nothing(archive: Path, run: Path, corrected: Path) -> None:
    again = run.parent / "again"
    run_serial(archive, again, "--set", f"archive.kernels={corrected}")
    found = {str(content["image_id"]): content for content in navigated(again)}
    for content in navigated(run):
        offset, sigma = (np.array(found[str(content["image_id"])][key]) for key in ("offset_px", "sigma_px"))
        assert (np.abs(offset) <= 3 * sigma).all(), content["image_id"]


def test_the_comment_area_tells_the_figures(archive: Path, run: Path, corrected: Path) -> None:
    lines: list[str] = []
    for path in sorted(corrected.parent.glob("*.bc")):
        handle = spiceypy.dafopr(str(path))
        _, area, _ = spiceypy.dafec(handle, 200, 300)
        spiceypy.dafcls(handle)
        lines += area
    text = "\n".join(lines)
    for content in navigated(run):
        (line,) = [line for line in lines if line.startswith(f"{content['image_id']} ")]
        offset = content["offset_px"]
        assert isinstance(offset, list)
        assert f"dv {offset[0]:+10.4f} du {offset[1]:+10.4f}" in line
        assert ("rotation" in line) == (content.get("rotation_deg") is not None)
    assert "configuration " in text
    assert str(run.parent) not in text
    assert str(run.parent) not in corrected.read_text()


def test_the_same_run_gives_the_same_bytes(archive: Path, run: Path, corrected: Path, tmp_path: Path) -> None:
    assert pilotage("ck", run, archive, "--output", tmp_path / "other").code == 0
    for path in corrected.parent.glob("*.bc"):
        assert (tmp_path / "other" / path.name).read_bytes() == path.read_bytes()
    assert not [path for path in (tmp_path / "other").iterdir() if path.name.startswith(".")]
    # The other folder is as deep in the tree, but another one: the names in it lead to the same kernels.
    assert check_kernels(str(archive), str(tmp_path / "other" / "corrected.tm"), tmp_path)
    spiceypy.kclear()


def test_a_run_remembers_archive_and_configuration(
    archive: Path, run: Path, corrected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert pilotage("ck", run, "--output", tmp_path / "remembered").code == 0
    written = sorted(path.name for path in corrected.parent.glob("*.bc"))
    assert sorted(path.name for path in (tmp_path / "remembered").glob("*.bc")) == written
    for name in written:
        assert (tmp_path / "remembered" / name).read_bytes() == (corrected.parent / name).read_bytes()
    assert "need ARCHIVE" in pilotage("ck", run, "--set", "detection.threshold_sigma=6").refusal()
    killed = Path(shutil.copytree(run, tmp_path / "killed"))
    (killed / "run.json").unlink()
    assert "has not ended yet" in pilotage("ck", killed).refusal()
    assert "holds no run" in pilotage("ck", tmp_path).refusal()


def test_what_cannot_be_written_is_said_in_one_line(archive: Path, run: Path, tmp_path: Path) -> None:
    assert "holds no run" in pilotage("ck", tmp_path, archive).refusal()
    copy = Path(shutil.copytree(archive, tmp_path / "archive", ignore=shutil.ignore_patterns("data")))
    describe(copy, geometry="header", kernels=None)
    assert "no SPICE kernels" in pilotage("ck", run, copy).refusal()
    meta = (copy / "kernels" / "meta.tm").read_text()
    clocks = [line for line in meta.splitlines() if ".tsc'" in line]
    (copy / "kernels" / "meta.tm").write_text("\n".join(line for line in meta.splitlines() if line not in clocks))
    describe(copy, geometry="spice", kernels="kernels/meta.tm")
    assert "no C-kernel" in pilotage("ck", run, copy).refusal()
    assert not list((run / "ck").glob(".*"))
    empty = Path(shutil.copytree(run, tmp_path / "empty"))
    for path in (empty / "images").glob("*.json"):
        path.write_text(json.dumps({**json.loads(path.read_bytes()), "status": "failed"}))
    assert "no corrected pointing" in pilotage("ck", empty, archive).refusal()
