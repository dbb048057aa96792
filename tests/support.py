"""Helpers of the tests of catalogues and workflows: the command in this process, and small archives to spoil."""

import contextlib
import io
import json
import shutil
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.io import fits

from catalogs.header import state_from_header
from catalogs.images import read_image
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.records import FloatArray, State
from pipeline.tables import SCHEMAS
from workflows.cli import main
from workflows.config import load_configuration

ROOT = Path(__file__).parents[1]
Document = dict[str, object]


@dataclass(frozen=True)
class Ended:
    """How a command ended and what it said."""

    code: int
    out: str
    err: str

    def refusal(self) -> str:
        """The one line with which it refused to start."""
        assert self.code == 3, (self.code, self.err)
        assert self.err.count("\n") == 1, self.err
        assert self.err.startswith("pilotage: ")
        assert "Traceback" not in self.err
        return self.err.strip()


def pilotage(*arguments: object) -> Ended:
    """Run the command in this process."""
    out, err = io.StringIO(), io.StringIO()
    signals = {number: signal.getsignal(number) for number in (signal.SIGPIPE, signal.SIGINT)}
    before, sys.argv = sys.argv, ["pilotage", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as end:
            main()
    finally:
        sys.argv = before
        for number, handler in signals.items():
            signal.signal(number, handler)
    assert isinstance(end.value.code, int)
    return Ended(end.value.code, out.getvalue(), err.getvalue())


def run_serial(archive: Path | str, run: Path, *arguments: object) -> Ended:
    """Run an archive in this process."""
    return pilotage("run", archive, "--output", run, "--serial", *arguments)


def some_frames(source: Path, folder: Path, count: int) -> list[Path]:
    """Copy an archive with its first frames; returns these."""
    (folder / "frames").mkdir(parents=True)
    for name in ("archive.yaml", "faint.parquet"):
        shutil.copy(source / name, folder / name)
    frames = sorted((source / "frames").glob("*.fits"))[:count]
    return [Path(shutil.copy(frame, folder / "frames" / frame.name)) for frame in frames]


def describe(folder: Path, **changes: object) -> None:
    """Change keys of an archive.yaml; None removes one."""
    path = folder / "archive.yaml"
    content = yaml.safe_load(path.read_text()) if path.exists() else {}
    content = {key: value for key, value in {**content, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def document(run: Path, image_id: str) -> Document:
    """Document of an image."""
    content = json.loads((run / "images" / f"{image_id}.json").read_bytes())
    assert isinstance(content, dict)
    return content


def inputs_of(run: Path, image_id: str) -> dict[str, object]:
    """What an image was made from, by its mark."""
    content = json.loads((run / "state" / f"{image_id}.json").read_bytes())["inputs"]
    assert isinstance(content, dict)
    return content


def reasons(run: Path) -> dict[str, str]:
    """Reason by image id."""
    return {path.stem: str(document(run, path.stem)["status_reason"]) for path in sorted((run / "images").iterdir())}


def answers(run: Path) -> dict[str, bytes]:
    """Bytes of everything that must not depend on how a run went: documents, and all tables but the timings."""
    files = [path for path in run.rglob("*") if path.is_file()]
    names = {path.relative_to(run).as_posix(): path for path in files}
    kept = ("images/", *(f"{table}/" for table in SCHEMAS if table != "timings"))
    return {name: path.read_bytes() for name, path in sorted(names.items()) if name.startswith(kept)}


def temporary_files(run: Path) -> list[str]:
    """Hidden files but the lock."""
    return [path.name for path in run.rglob(".*") if path.is_file() and path.name != ".lock"]


def state_of_frame(frame: Path) -> State:
    """State that a LORRI frame's own header tells."""
    block = load_configuration().instruments["nhlorri"]
    return state_from_header(read_image(frame.read_bytes(), frame.name), frame.stem, block, {})


def _listed(values: FloatArray | None) -> list[float] | None:
    return None if values is None else np.asarray(values).tolist()


def sidecar_of(frame: Path, **changes: object) -> Document:
    """The geometry/1 record that says what a LORRI frame's header says."""
    state = state_of_frame(frame)
    camera, detector = state.camera_model, state.detector
    content: Document = {
        "schema": "geometry/1", "image_id": frame.stem, "mission": state.mission, "camera": state.camera,
        "mid_time_utc": fits.getheader(frame)["SPCUTCAL"], "exposure_s": state.exposure_s,
        "camera_model": {
            "shape_vu": list(camera.shape_vu), "focal_length_mm": camera.focal_length_mm,
            "k_px_per_mm": _listed(camera.k_px_per_mm), "principal_point_vu": _listed(camera.principal_point_vu),
            "distortion_eps": _listed(camera.distortion_eps), "psf_sigma_px": detector.psf_sigma_px,
            "model_residual_px": detector.model_residual_px, "read_noise_dn": detector.read_noise_dn,
            "gain_e_per_dn": detector.gain_e_per_dn, "saturation_dn": detector.saturation_dn,
            "star_dn_per_s_mag0": detector.star_dn_per_s_mag0,
        },
        "search_margin_vu": list(state.settings.search_margin_vu),
        "attitude": {
            "camera_from_j2000_wxyz": _listed(quaternion_from_matrix(state.attitude.camera_from_j2000)),
            "rate_rad_s": _listed(state.attitude.rate_rad_s),
        },
        "spacecraft": {
            "position_km_ssb": _listed(state.spacecraft.position_km),
            "velocity_kms_ssb": _listed(state.spacecraft.velocity_km_s),
        },
    }  # fmt: skip
    return {**content, **changes}


def write_sidecar(frame: Path, **changes: object) -> Path:
    """Write a frame's sidecar beside it."""
    path = frame.with_suffix("").with_suffix(".geometry.json")
    path.write_text(json.dumps(sidecar_of(frame, **changes)))
    return path
