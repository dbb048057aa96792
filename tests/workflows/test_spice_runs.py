"""Runs whose geometry comes from SPICE kernels: what of them decides an answer, and one image outside of them."""

import json
import shutil
from pathlib import Path

import pytest
import yaml

from tests.support import describe, document, pilotage, reasons, run_serial
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_options import FlybyOptions

OPTIONS = FlybyOptions(
    frames=4, seed=7, processes=1, cameras=("lorri_4x4", "cassini_nac_sum2"), diameter_px=(40.0, 120.0),
    star_share=0.0, trap_share=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flyby") / "archive"
    make_flyby_sample(folder, OPTIONS)
    return folder


@pytest.fixture
def archive(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "archive"))


def provenance(run: Path, image_id: str) -> dict[str, object]:
    content = document(run, image_id)["provenance"]
    assert isinstance(content, dict)
    return content


def test_kernels_give_the_geometry_and_stand_in_the_record(archive: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert run_serial(archive, run).code in (0, 1)
    found = reasons(run)
    assert len(found) == OPTIONS.frames
    truth = json.loads((archive / "truth.json").read_text())["frames"]
    for image_id in found:
        said = provenance(run, image_id)
        assert said["geometry_source"] == "spice"
        kernels = said["kernels"]
        assert isinstance(kernels, list)
        names = [kernel["name"] for kernel in kernels]
        assert names[0] == "meta.tm"
        assert "cas_apriori.bc" in names
        pointing, offset = document(run, image_id)["offset_px"], truth[image_id]
        if pointing is not None:
            # Twenty sigma of the faintest: whether the sign and the frame of the kernels are understood at all.
            assert pointing == pytest.approx([offset["offset_dv_px"], offset["offset_du_px"]], abs=2.0)
    assert sum(reason == "navigated" for reason in found.values()) >= 3
    # Nothing is done twice, and a changed kernel does all anew.
    assert " 0 to do" in run_serial(archive, run).err
    with (archive / "kernels" / "sample.tpc").open("a") as file:
        file.write("\nOnly a remark.\n")
    assert f" {OPTIONS.frames} to do" in run_serial(archive, run).err


def test_auto_takes_kernels_where_there_are_any(archive: Path, tmp_path: Path) -> None:
    describe(archive, geometry="auto", images=["data/lor_*.fit"])
    run_serial(archive, tmp_path / "run")
    assert {provenance(tmp_path / "run", name)["geometry_source"] for name in reasons(tmp_path / "run")} == {"spice"}


def test_an_image_out_of_coverage_fails_alone(archive: Path, tmp_path: Path) -> None:
    label = sorted((archive / "data").glob("*.LBL"))[0]
    year = label.read_bytes().split(b"IMAGE_MID_TIME")[1].split(b"-")[0][-4:]
    label.write_bytes(label.read_bytes().replace(year + b"-", b"1999-"))
    run = tmp_path / "run"
    assert run_serial(archive, run).code == 2
    found = reasons(run)
    assert found.pop(label.stem) == "kernels_unavailable"
    assert "kernels_unavailable" not in found.values()
    content = document(run, label.stem)
    assert str(tmp_path) not in json.dumps(content)
    assert "1999-" in str(content["detail"])


def test_kernels_are_checked_before_anything_starts(archive: Path, tmp_path: Path) -> None:
    def refusal() -> str:
        return pilotage("run", archive, "--output", tmp_path / "run", "--serial").refusal()

    said = yaml.safe_load((archive / "archive.yaml").read_text())["kernels"]
    describe(archive, kernels=None)
    assert "needs kernels" in refusal()
    describe(archive, kernels="kernels/none.tm")
    assert "none.tm is not there" in refusal()
    describe(archive, kernels=said)
    (archive / "kernels" / "nh.bsp").unlink()
    assert "nh.bsp is not there" in refusal()
    (archive / "kernels" / "nh.bsp").write_bytes(b"DAF/SPK ")
    assert "nh.bsp" in refusal()
    assert not (tmp_path / "run").exists()
