"""Corrected C-kernels: read back by SPICE, and images navigated again with them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from catalogs.kernels import check_kernels
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.records import FloatArray
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


def test_the_motion_within_an_exposure_is_the_original_one(archive: Path, run: Path, corrected: Path) -> None:
    content = navigated(run)[0]
    et, exposure = float(str(content["et"])), float(str(content["exposure_s"]))
    ends = (et - exposure / 2, et + exposure / 2)
    check_kernels(str(archive), "kernels/meta.tm", run)
    before = [attitude(content, t) for t in (et, *ends)]
    names = BLOCKS[str(content["label"]["block"])].spice  # type: ignore[index]
    assert names is not None
    _, rate = spiceypy.xf2rav(spiceypy.sxform("J2000", names.frame, et))
    check_kernels(str(archive), str(corrected), run)
    after = [attitude(content, t) for t in (et, *ends)]
    for old, new in zip(before[1:], after[1:], strict=True):
        assert angle(new, after[0] @ before[0].T @ old) < PROMISE_RAD
    _, now = spiceypy.xf2rav(spiceypy.sxform("J2000", names.frame, et))
    # The rate is that between the ends: its rounding is a nanoradian over the exposure.
    assert np.array(now) == pytest.approx(np.array(rate), abs=PROMISE_RAD / exposure)
    # Out of the exposures the original pointing holds.
    check_kernels(str(archive), "kernels/meta.tm", run)
    original = attitude(content, et + exposure / 2 + 0.3)
    check_kernels(str(archive), str(corrected), run)
    assert angle(attitude(content, et + exposure / 2 + 0.3), original) == 0.0
    spiceypy.kclear()


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
