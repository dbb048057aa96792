"""Runs over images with labels of their own: what they say is recorded, and decides whether an answer still holds."""

from pathlib import Path

import numpy as np
import pyarrow.dataset
import pytest

from catalogs.images import read_image
from tests.catalogs.planetary import pds3_label, prefixed, vicar
from tests.support import answers, describe, document, inputs_of, reasons, run_serial, some_frames, write_sidecar

NAME = "N1473172656_1"
WORDS = """PRODUCT_ID = "1_N1473172656.118"
INSTRUMENT_HOST_NAME = "CASSINI ORBITER"
INSTRUMENT_ID = "ISSNA"
START_TIME = 2004-250T14:12:40.732
EXPOSURE_DURATION = 2600.0
FILTER_NAME = ("CL1","CB2")
TARGET_NAME = "{target}"
MISSING_LINES = 3"""


@pytest.fixture
def archive(lorri_archive: Path, tmp_path: Path) -> Path:
    """A star field with a sidecar, its pixels as a VICAR file with a detached PDS3 label."""
    folder = tmp_path / "archive"
    frame = some_frames(lorri_archive, folder, 1)[0]
    write_sidecar(frame)
    pixels = read_image(frame.read_bytes(), frame.name).pixels.astype(">f4")
    stored = vicar(pixels, prefix=24, header_records=1)
    (folder / "frames" / f"{NAME}.IMG").write_bytes(stored)
    records = stored.index(prefixed(pixels[:1], before=24)) // (24 + 4 * pixels.shape[1])
    assert records > 0
    write_label(folder, "SATURN", pixels.shape)
    sidecar = frame.with_suffix("").with_suffix(".geometry.json")
    text = sidecar.read_text().replace(frame.stem, NAME)
    (folder / "frames" / f"{NAME}.geometry.json").write_text(text)
    describe(folder, images="frames/*", geometry="auto")
    return folder


def write_label(folder: Path, target: str, shape: tuple[int, ...] = (256, 256)) -> None:
    label = pds3_label(
        f'("{NAME}.IMG",4)', "IEEE_REAL", 32, (shape[0], shape[1]), extra=WORDS.format(target=target),
        more="LINE_PREFIX_BYTES = 24",
    )  # fmt: skip
    (folder / "frames" / f"{NAME}.LBL").write_bytes(label)


def test_the_format_does_not_change_the_answer(archive: Path, tmp_path: Path) -> None:
    fits = next((archive / "frames").glob("*.fits"))
    describe(archive, images=["frames/*.fits", "frames/*.LBL"])
    assert run_serial(archive, tmp_path / "run").code == 0
    one, other = document(tmp_path / "run", fits.stem), document(tmp_path / "run", NAME)
    assert one["status"] == other["status"] == "success"
    assert np.allclose(one["offset_px"], other["offset_px"], atol=1e-3)  # type: ignore[arg-type]
    assert set(reasons(tmp_path / "run")) == {fits.stem, NAME}


def test_the_label_is_recorded(archive: Path, tmp_path: Path) -> None:
    describe(archive, images="frames/*.IMG")
    assert run_serial(archive, tmp_path / "run").code == 0
    label = document(tmp_path / "run", NAME)["label"]
    # The sidecar's camera has another array than Cassini's modes but for the one summed four times.
    assert label == {
        "product_id": "1_N1473172656.118", "block": "coiss_nac", "mode": "256_CALIB",
        "start_utc": "2004-09-06T14:12:40.732", "mid_utc": "2004-09-06T14:12:42.032", "exposure_s": 2.6,
        "filters": ["CL1", "CB2"], "target": "SATURN", "summation": None, "missing_lines": 3, "anomalies": [],
    }  # fmt: skip
    row = pyarrow.dataset.dataset(tmp_path / "run" / "offsets", partitioning="hive").to_table().to_pylist()[0]
    assert {key: row[key] for key in ("product_id", "target", "filter")} == {
        "product_id": "1_N1473172656.118", "target": "SATURN", "filter": "CL1+CB2",
    }  # fmt: skip
    assert row["exposure_s"] == document(tmp_path / "run", NAME)["exposure_s"]


def test_a_changed_label_is_a_changed_input(archive: Path, tmp_path: Path) -> None:
    describe(archive, images="frames/*.IMG")
    run = tmp_path / "run"
    assert run_serial(archive, run).code == 0
    assert set(inputs_of(run, NAME)) >= {f"frames/{NAME}.IMG", f"frames/{NAME}.LBL"}
    before = answers(run)
    assert run_serial(archive, run).code == 0
    assert answers(run) == before
    write_label(archive, "TITAN")
    assert run_serial(archive, run).code == 0
    label = document(run, NAME)["label"]
    assert isinstance(label, dict)
    assert label["target"] == "TITAN"


def test_labels_outlive_failures(archive: Path, tmp_path: Path) -> None:
    describe(archive, images="frames/*.IMG")
    (archive / "frames" / f"{NAME}.geometry.json").write_text("{")
    run_serial(archive, tmp_path / "run")
    failed = document(tmp_path / "run", NAME)
    assert failed["status_reason"] == "geometry_invalid"
    assert isinstance(failed["label"], dict)
    assert failed["label"]["target"] == "SATURN"
    (archive / "frames" / f"{NAME}.IMG").write_bytes(b"")
    run_serial(archive, tmp_path / "run")
    assert document(tmp_path / "run", NAME)["label"] is None


def test_selection_from_the_command_line(archive: Path, tmp_path: Path) -> None:
    describe(archive, images="frames/*.IMG")
    ended = run_serial(archive, tmp_path / "run", "--set", "archive.select.target=SATURN")
    assert "select.target needs an index table" in ended.refusal()
    ended = run_serial(archive, tmp_path / "run", "--set", "archive.select.image_numbers=[1, 5]")
    assert "select leaves none" in ended.refusal()
    assert run_serial(archive, tmp_path / "run", "--set", "archive.select.image_numbers=1473172656").code == 0
