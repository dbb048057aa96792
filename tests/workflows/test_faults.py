"""Every way in which one image can be bad: a reason of its own in its record, while its neighbours succeed."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from tests.support import describe, document, pilotage, reasons, run_serial, some_frames, write_sidecar

Pixels = NDArray[Any]
Spoil = Callable[[Path], None]


def _shorten(share: float) -> Spoil:
    return lambda frame: os.truncate(frame, int(frame.stat().st_size * share))


def _bytes(data: bytes) -> Spoil:
    return lambda frame: _write(frame, data)


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _pixels(change: Callable[[Pixels], Pixels]) -> Spoil:
    def spoil(frame: Path) -> None:
        with fits.open(frame) as hdus:
            header, flags = hdus[0].header, [hdu.copy() for hdu in hdus[1:]]
            primary = fits.PrimaryHDU(change(hdus[0].data.astype(float)), header)
        fits.HDUList([primary, *flags]).writeto(frame, overwrite=True)

    return spoil


def _cards(**cards: object) -> Spoil:
    def spoil(frame: Path) -> None:
        with fits.open(frame, mode="update") as hdus:
            for key, value in cards.items():
                if value is None:
                    del hdus[0].header[key]
                else:
                    hdus[0].header[key] = value

    return spoil


def _sidecar(**changes: object) -> Spoil:
    def spoil(frame: Path) -> None:
        write_sidecar(frame, **changes)

    return spoil


def _sidecar_text(data: bytes) -> Spoil:
    return lambda frame: _write(frame.with_suffix(".geometry.json"), data)


def _stars(table: pd.DataFrame | bytes) -> Spoil:
    def spoil(frame: Path) -> None:
        path = frame.with_suffix(".stars.parquet")
        path.write_bytes(table) if isinstance(table, bytes) else table.to_parquet(path)

    return spoil


def _garbled_card(frame: Path) -> None:
    data = frame.read_bytes()
    start = data.index(b"SPCQA   =")
    frame.write_bytes(data[:start] + b"SPCQA   = 0.1 ] 7 garbage".ljust(80) + data[start + 80 :])


def _few_nans(image: Pixels) -> Pixels:
    changed = np.array(image, dtype=float)
    changed[::17, ::13], changed[5, :], changed[:, 7] = np.nan, np.inf, -np.inf
    return changed


@dataclass(frozen=True)
class Fault:
    """One spoiled frame: what is done to it, and how it must end."""

    spoil: Spoil
    reason: str
    said: str = ""


def _flat(value: float) -> Spoil:
    return _pixels(lambda image: np.full(image.shape, value, np.float32))


NO_STARS = pd.DataFrame({"ra_deg": [1.0], "dec_deg": [2.0]})
FAULTS: dict[str, Fault] = {
    "zero_bytes": Fault(_bytes(b""), "image_empty"),
    "cut_in_header": Fault(_shorten(0.003), "image_truncated"),
    "cut_in_first_block": Fault(_bytes(b"SIMPLE  =                    T"), "image_truncated"),
    "cut_in_data": Fault(_shorten(0.2), "image_truncated"),
    "cut_in_extension": Fault(_shorten(0.95), "image_truncated"),
    "text": Fault(_bytes(b"[/red] not an image\n" * 500), "image_format_unknown", "[/red]"),
    "garbage_after_simple": Fault(_bytes(b"SIMPLE  =                    T" + b"\xffgarbage" * 5000), "image_"),
    "nan": Fault(_flat(np.nan), "image_not_finite"),
    "infinite": Fault(_flat(np.inf), "image_not_finite"),
    "saturated": Fault(_flat(4095.0), "image_overexposed"),
    "constant": Fault(_flat(7.0), "image_blank"),
    "missing": Fault(_pixels(lambda image: np.full(image.shape, -1.0, np.float32)), "image_blank"),
    "wrong_shape": Fault(_pixels(lambda image: image[:200, :100]), "image_shape_mismatch", "200x100"),
    "cube": Fault(_pixels(lambda image: np.stack([image] * 3)), "image_shape_mismatch", "3x256x256"),
    "spectrum": Fault(_pixels(lambda image: image[0]), "image_unreadable"),
    "no_quaternion": Fault(_cards(SPCQA=None), "geometry_missing", "SPCQA"),
    "garbled_quaternion": Fault(_garbled_card, "geometry_missing", "SPCQA"),
    "short_quaternion": Fault(_cards(SPCQA=0.0, SPCQX=0.0), "geometry_missing"),
    "no_time": Fault(_cards(SPCSCET=None), "geometry_missing", "SPCSCET"),
    "absurd_time": Fault(_cards(SPCSCET=1e300), "geometry_invalid", "year"),
    "unknown_camera": Fault(_cards(INSTRU="mvic"), "camera_unknown"),
    "unknown_mode": Fault(_cards(SFORMAT="3X3"), "camera_unknown", "3X3"),
    "empty_mode": Fault(_cards(SFORMAT=""), "camera_unknown", "missing"),
    "sidecar_no_json": Fault(_sidecar_text(b"{"), "geometry_invalid"),
    "sidecar_list": Fault(_sidecar_text(b"[]"), "geometry_invalid"),
    "sidecar_deep": Fault(_sidecar_text(b"[" * 100_000), "geometry_invalid"),
    "sidecar_schema": Fault(_sidecar(schema="geometry/9"), "geometry_invalid", "schema"),
    "sidecar_nan": Fault(_sidecar(attitude={"camera_from_j2000_wxyz": [float("nan"), 0, 0, 1]}), "geometry_invalid"),
    "sidecar_length": Fault(_sidecar(attitude={"camera_from_j2000_wxyz": [1, 1, 0, 0]}), "geometry_invalid", "length"),
    "sidecar_time": Fault(_sidecar(mid_time_utc="9999-12-31T23:59:59"), "geometry_invalid", "year"),
    "sidecar_infinite_exposure": Fault(_sidecar(exposure_s=float("inf")), "geometry_invalid", "exposure_s"),
    "stars_no_table": Fault(_stars(b"no table"), "catalog_invalid"),
    "stars_empty_file": Fault(_stars(b""), "catalog_invalid"),
    "stars_column": Fault(_stars(NO_STARS), "catalog_invalid", "mag"),
    "stars_nan": Fault(_stars(NO_STARS.assign(mag=np.nan)), "catalog_invalid", "mag"),
    "stars_text": Fault(_stars(NO_STARS.assign(mag="bright")), "catalog_invalid", "mag"),
}  # fmt: skip
# Odd, but right: such frames are navigated like any other.
ODDITIES: dict[str, Spoil] = {
    "some_not_finite": _pixels(_few_nans),
    "double": _pixels(lambda image: image.astype(np.float64)),
    "huge_values": _pixels(lambda image: np.where(np.arange(256) == 9, 1e300, image)),
    "long_axis_of_one": _pixels(lambda image: image[None].astype(np.float32)),
    "integers": _pixels(lambda image: np.round(image * 4).astype(np.int16)),
    "sidecar": _sidecar(),
    "stars_of_its_own": _stars(NO_STARS.assign(mag=3.0)),
}


@pytest.fixture(scope="module")
def spoiled(lorri_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over one frame, copied under many names and spoiled in as many ways."""
    folder = tmp_path_factory.mktemp("faults") / "archive"
    donor = _good_frame(lorri_archive, folder)
    for name, spoil in [*((n, f.spoil) for n, f in FAULTS.items()), *ODDITIES.items(), ("good", lambda frame: None)]:
        frame = donor.with_name(f"{name}.fits")
        frame.write_bytes(donor.read_bytes())
        if name.startswith("sidecar"):
            write_sidecar(frame)
        spoil(frame)
    donor.unlink()
    describe(folder, stars=["gaia", {"path": "faint.parquet"}, "per-image"])
    # Ids by file name: some sidecars claim none.
    run = folder.parent / "run"
    ended = run_serial(folder, run)
    assert ended.code == 2, ended.err
    return run


def _good_frame(source: Path, folder: Path) -> Path:
    """An archive of the one frame with the most stars."""
    truth = json.loads((source / "truth.json").read_text())["frames"]
    frames = some_frames(source, folder, 99)
    best = max(
        frames, key=lambda frame: float(truth[frame.stem]["n_stars"]) - 100 * bool(truth[frame.stem].get("trail_px"))
    )
    for frame in frames:
        if frame != best:
            frame.unlink()
    return best


def _document_of(run: Path, name: str) -> dict[str, object]:
    every = [document(run, path.stem) for path in (run / "images").iterdir()]
    return next(d for d in every if d["provenance"]["image_path"] == f"frames/{name}.fits")  # type: ignore[index]


@pytest.mark.parametrize("name", FAULTS)
def test_fault_has_its_reason(spoiled: Path, name: str) -> None:
    found, fault = _document_of(spoiled, name), FAULTS[name]
    assert str(found["status_reason"]).startswith(fault.reason), found["detail"]
    assert fault.said in str(found["detail"])
    assert "\n" not in str(found["detail"])
    assert found["offset_px"] is None
    assert found["rank"] == "failed"


@pytest.mark.parametrize("name", ["good", *ODDITIES])
def test_neighbours_and_oddities_succeed(spoiled: Path, name: str) -> None:
    found = _document_of(spoiled, name)
    assert found["status"] == "success", found["detail"]


def test_oddities_find_what_the_good_one_finds(spoiled: Path) -> None:
    good = np.array(_document_of(spoiled, "good")["offset_px"])
    for name in ODDITIES:
        found = _document_of(spoiled, name)
        sigma = np.array(found["sigma_px"])
        # The same frame with some pixels lost or rounded: the same answer within its own uncertainty.
        assert (np.abs(np.array(found["offset_px"]) - good) < 3 * sigma + 0.01).all(), name


def test_nothing_is_a_bug_and_every_image_has_a_row(spoiled: Path) -> None:
    rows = pq.read_table(spoiled / "offsets").to_pylist()
    assert len(rows) == len(FAULTS) + len(ODDITIES) + 1
    assert "internal_error" not in {row["status_reason"] for row in rows}


def test_documents_name_no_place_of_this_machine(spoiled: Path) -> None:
    for path in (spoiled / "images").iterdir():
        text = path.read_text()
        assert str(spoiled.parent) not in text
        assert "0x7f" not in text


def test_every_spoiled_image_can_be_shown(spoiled: Path) -> None:
    for path in (spoiled / "images").iterdir():
        ended = pilotage("show", spoiled, path.stem)
        assert ended.code == 0
        assert str(document(spoiled, path.stem)["detail"])[:60] in ended.out


def test_spoiled_images_are_not_done_again(spoiled: Path) -> None:
    archive = spoiled.parent / "archive"
    assert f"{len(FAULTS) + len(ODDITIES) + 1} answered, 0 to do" in pilotage("plan", archive, "--output", spoiled).out


def _run_of(folder: Path, **keys: object) -> dict[str, str]:
    describe(folder, **keys)
    run = folder.parent / "run"
    assert run_serial(folder, run).code in (0, 1, 2)
    return reasons(run)


def test_missing_file_of_a_list(lorri_archive: Path, tmp_path: Path) -> None:
    good = _good_frame(lorri_archive, tmp_path / "a")
    (tmp_path / "a" / "folder.fits").mkdir()
    listed = [f"frames/{good.name}", "frames/gone.fits", f"frames/{good.name}/under.fits", "folder.fits"]
    found = _run_of(tmp_path / "a", images=listed)
    assert found[good.stem] == "navigated"
    assert found["frames__gone"] == "image_not_found"
    assert found[f"frames__{good.name}__under"] == "image_not_found"
    assert found["folder"] == "image_unreadable"


@pytest.mark.parametrize(
    ("geometry", "reason"), [("sidecar", "geometry_missing"), ("header", "navigated"), ("auto", "navigated")]
)
def test_sidecar_missing(lorri_archive: Path, tmp_path: Path, geometry: str, reason: str) -> None:
    good = _good_frame(lorri_archive, tmp_path / "a")
    assert _run_of(tmp_path / "a", geometry=geometry) == {good.stem: reason}


def test_sidecar_is_not_looked_at_where_headers_count(lorri_archive: Path, tmp_path: Path) -> None:
    good = _good_frame(lorri_archive, tmp_path / "a")
    good.with_suffix(".geometry.json").write_text("{")
    assert _run_of(tmp_path / "a", geometry="header") == {good.stem: "navigated"}


def test_missing_lines_are_left_out_or_too_many(lorri_archive: Path, tmp_path: Path) -> None:
    good = _good_frame(lorri_archive, tmp_path / "a")
    camera = json.loads(write_sidecar(good).read_text())["camera_model"]
    marked = {**camera, "missing_value": -999.0}
    every = {"all": 256, "most": 200, "few": 20}
    for name, lines in every.items():
        frame = good.with_name(f"{name}.fits")
        frame.write_bytes(good.read_bytes())
        write_sidecar(frame, camera_model=marked)
        _pixels(lambda image, n=lines: np.where(np.arange(256)[:, None] < n, -999.0, image))(frame)  # type: ignore[misc]
    good.unlink()
    good.with_suffix(".geometry.json").unlink()
    found = _run_of(tmp_path / "a", images="frames/*.fits")
    assert found["all"] == "image_blank"
    assert found["most"] == "image_mostly_missing"
    assert found["few"] == "navigated"


@pytest.mark.parametrize(
    "dtype",
    ["u1", "i2", "u2", "i4", "f4", "f8"],
)
def test_pixel_types_give_one_answer(lorri_archive: Path, tmp_path: Path, dtype: str) -> None:
    good = _good_frame(lorri_archive, tmp_path / "a")
    top = 250.0 if dtype == "u1" else 3000.0
    write_sidecar(good)
    _pixels(lambda image: np.clip(np.round(image + 20), 0, top).astype(dtype))(good)
    assert _run_of(tmp_path / "a") == {good.stem: "navigated"}
