"""Corrected pointing of a run as SPICE C-kernels, to be loaded after the archive's own."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import numpy as np
import spiceypy
from spiceypy.utils.exceptions import SpiceyError

from catalogs.archive import Archive
from catalogs.instruments import SpiceNames
from catalogs.kernels import Kernel, reason_of
from catalogs.spice import instrument_attitude, structure_of
from pipeline.errors import ConfigurationError, GeometryError
from pipeline.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from pipeline.json_values import Json
from pipeline.records import FloatArray
from pipeline.status import Status
from workflows.config import Configuration
from workflows.plan import open_kernels, software_id
from workflows.store import RunFolder, read_json, write_atomically

META_KERNEL = "corrected.tm"
FOLDER = "ck"
_REFERENCE = "J2000"
_SEGMENT = "PILOTAGE CORRECTED POINTING"
# Pointing is given this much beyond the exposure's ends, for labels that round their times.
_PAD_S = 0.1
# Exposures whose middles lie closer than this are one exposure in two products.
_SAME_EXPOSURE_S = 1e-3
# Turns below this are left to the rate's rounding (rad).
_NO_TURN_RAD = 1e-12
# Longest string of a text kernel, and of a file name in CSPICE (required reading on kernels).
_PIECE, _LONGEST_PATH = 76, 255
# Room of the comment area per line, its end included.
_COMMENT_WIDTH = 200


@dataclass(frozen=True, eq=False)
class Pointing:
    """Corrected attitude of one image.

    Attributes
    ----------
    image_id, time_utc
        Identity.
    et
        Mid-exposure, TDB seconds past J2000.
    half_s
        Time before and after it for which the attitude is given.
    camera_from_j2000
        (3, 3) corrected.
    sigma_px
        Larger of the offset's two sigmas.
    figures
        Offset, sigma and rotation for the comment area.
    """

    image_id: str
    time_utc: str
    et: float
    half_s: float
    camera_from_j2000: FloatArray
    sigma_px: float
    figures: str


def write_c_kernels(folder: RunFolder, archive: Archive, configuration: Configuration, output: Path) -> list[Path]:
    """Write one C-kernel per camera with the corrected attitude of every navigated image, and a meta-kernel.

    Parameters
    ----------
    folder
        A run.
    archive
        Its archive, which names the kernels that the run used.
    configuration
        With the camera blocks.
    output
        Folder to write, made if it is not there.

    Returns
    -------
    list of pathlib.Path
        C-kernels, then the meta-kernel that loads the archive's kernels and these after them.

    Raises
    ------
    ConfigurationError
        If the archive has no kernels, a clock or frame is missing, or no image has a corrected attitude.
    """
    kernels = open_kernels(archive, configuration)
    if not kernels:
        raise ConfigurationError(f"{archive.url} has no SPICE kernels to be corrected")
    cameras = _pointings(folder, configuration)
    if not cameras:
        raise ConfigurationError(f"{folder.root} has no corrected pointing of a camera that SPICE knows")
    output.mkdir(parents=True, exist_ok=True)
    written = []
    for name, pointings in sorted(cameras.items()):
        names = configuration.instruments[name].spice
        if names is not None:
            path = output / f"{_file_stem(name)}_corrected.bc"
            _write_camera(path, names, pointings, _comments(name, names, configuration, pointings))
            written.append(path)
    meta = output / META_KERNEL
    write_atomically(meta, _meta_kernel(kernels, written, output).encode())
    return [*written, meta]


def _file_stem(name: str) -> str:
    return re.sub(r"[^\w-]", "_", name)


def _pointings(folder: RunFolder, configuration: Configuration) -> dict[str, list[Pointing]]:
    """Corrected attitudes by camera block, in the order of time, one per exposure."""
    plan = read_json(folder.plan)
    if plan is None or not isinstance(plan.get("images"), list):
        raise ConfigurationError(f"{folder.root} holds no run")
    cameras: dict[str, list[Pointing]] = {}
    for image_id in plan["images"]:  # type: ignore[union-attr]
        document = read_json(folder.document(str(image_id)))
        label = document.get("label") if document else None
        name = label.get("block") if isinstance(label, dict) else None
        block = configuration.instruments.get(str(name))
        if document is not None and block is not None and block.spice is not None:
            pointing = _pointing(document)
            if pointing is not None:
                cameras.setdefault(str(name), []).append(pointing)
    return {name: _one_per_exposure(found) for name, found in cameras.items()}


def _pointing(document: dict[str, Json]) -> Pointing | None:
    """Corrected attitude of a document, None where it has none."""
    pointing, et, exposure = document.get("pointing"), document.get("et"), document.get("exposure_s")
    quaternion = pointing.get("camera_from_j2000_wxyz") if isinstance(pointing, dict) else None
    if document.get("status") != Status.SUCCESS.value or not isinstance(quaternion, list) or not isinstance(et, float):
        return None
    half = (exposure / 2 if isinstance(exposure, int | float) else 0.0) + _PAD_S
    offset, sigma = (np.array(document[key], dtype=float) for key in ("offset_px", "sigma_px"))
    figures = f"dv {offset[0]:+10.4f} du {offset[1]:+10.4f} px, sigma {sigma[0]:.4f} {sigma[1]:.4f} px"
    rotation, turn_sigma = document.get("rotation_deg"), document.get("sigma_rotation_deg")
    if isinstance(rotation, float) and isinstance(turn_sigma, float):
        figures += f", rotation {rotation:+.5f} sigma {turn_sigma:.5f} deg"
    return Pointing(
        str(document["image_id"]), str(document["time_utc"]), et, half, matrix_from_quaternion(np.array(quaternion)),
        float(sigma.max()), figures,
    )  # fmt: skip


def _one_per_exposure(found: Sequence[Pointing]) -> list[Pointing]:
    """By time; of products of one exposure the one with the smallest sigma."""
    kept: list[Pointing] = []
    for pointing in sorted(found, key=lambda pointing: (pointing.et, pointing.image_id)):
        if kept and pointing.et - kept[-1].et < _SAME_EXPOSURE_S:
            kept[-1] = min(kept[-1], pointing, key=lambda candidate: candidate.sigma_px)
        else:
            kept.append(pointing)
    return kept


def _write_camera(path: Path, names: SpiceNames, pointings: Sequence[Pointing], comments: Sequence[str]) -> None:
    """One type 3 segment: three attitudes and rates per image, interpolated within its exposure only."""
    try:
        structure, instrument_from_structure = structure_of(names.frame, pointings[0].et)
        structure_from_camera = (names.rotation() @ instrument_from_structure).T
        clock = int(spiceypy.ckmeta(structure, "SCLK"))
        records = [_records(pointing, span, names) for pointing, span in zip(pointings, _spans(pointings), strict=True)]
        ticks = np.array([float(spiceypy.sce2c(clock, et)) for ets, _, _ in records for et in ets])
    except (SpiceyError, GeometryError) as error:
        text = reason_of(error) if isinstance(error, SpiceyError) else error.detail
        raise ConfigurationError(f"no C-kernel of {names.frame} can be written: {text}") from error
    attitudes = [structure_from_camera @ camera for _, cameras, _ in records for camera in cameras]
    quaternions = np.array([quaternion_from_matrix(attitude) for attitude in attitudes])
    rates = np.array([rate for _, cameras, rate in records for _ in cameras])
    with _new_kernel(path, comments) as handle:
        spiceypy.ckw03(
            handle, ticks[0], ticks[-1], structure, _REFERENCE, True, _SEGMENT, len(ticks), ticks, quaternions, rates,
            len(records), ticks[::3].copy(),
        )  # fmt: skip


def _spans(pointings: Sequence[Pointing]) -> list[tuple[float, float]]:
    """Start and end of each image's attitude; neighbours end half-way to each other at the latest."""
    ets = np.array([pointing.et for pointing in pointings])
    halves = np.array([pointing.half_s for pointing in pointings])
    # A hair apart: times of a segment must differ.
    gaps = 0.499 * np.diff(ets)
    before = np.minimum(halves, np.concatenate([[np.inf], gaps]))
    after = np.minimum(halves, np.concatenate([gaps, [np.inf]]))
    return list(zip((ets - before).tolist(), (ets + after).tolist(), strict=True))


def _records(
    pointing: Pointing, span: tuple[float, float], names: SpiceNames
) -> tuple[list[float], list[FloatArray], FloatArray]:
    """Times, corrected camera attitudes, and the angular rate in J2000 axes: the predicted motion as a whole."""
    ets = [span[0], pointing.et, span[1]]
    middle = pointing.camera_from_j2000
    try:
        predicted = [names.rotation() @ instrument_attitude(names, et) for et in ets]
    except SpiceyError:
        # The original pointing ends within the exposure: the camera is taken to stand still.
        return ets, [middle] * 3, np.zeros(3)
    correction = middle @ predicted[1].T
    cameras = [correction @ predicted[0], middle, correction @ predicted[2]]
    # The rotation that carries the camera's axes of the start, in J2000, onto those of the end.
    axis, angle = spiceypy.raxisa(cameras[2].T @ cameras[0])
    rate = np.array(axis) * (angle if abs(angle) > _NO_TURN_RAD else 0.0) / (ets[2] - ets[0])
    return ets, cameras, rate


@contextmanager
def _new_kernel(path: Path, comments: Sequence[str]) -> Iterator[int]:
    """Handle of a C-kernel that gets its name when it is complete."""
    temporary = path.with_name(f".{path.stem[:40]}.{uuid4().hex}")
    if len(os.fsencode(str(temporary.absolute()))) > _LONGEST_PATH:
        raise ConfigurationError(f"{path}: the path is longer than the {_LONGEST_PATH} bytes that CSPICE takes")
    try:
        handle = spiceypy.ckopn(str(temporary), path.name[:60], (len(comments) + 1) * _COMMENT_WIDTH)
        try:
            spiceypy.dafac(handle, list(comments))
            yield handle
        except BaseException:
            # Closing it as a C-kernel would complain that it is not complete.
            spiceypy.dafcls(handle)
            raise
        spiceypy.ckcls(handle)
        os.replace(temporary, path)
    except SpiceyError as error:
        raise ConfigurationError(f"{path} cannot be written: {reason_of(error)}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _comments(name: str, names: SpiceNames, configuration: Configuration, pointings: Sequence[Pointing]) -> list[str]:
    """Comment area: what this is, what made it, and one line per image."""
    lines = [
        "Corrected pointing from images", "",
        f"Camera {name}, frame {names.frame}. Attitudes are those of the structure that carries it, chosen so that the",
        "fixed offsets of the frame kernels give the corrected camera. Load after the original C-kernels.",
        f"Made by {software_id()}, configuration {configuration.digest()}.",
        "Offset is actual minus predicted pixel at the array's centre, v along columns (row), u along rows (column);",
        "sigmas are one standard deviation. Within an exposure the motion is that of the original pointing.", "",
    ]  # fmt: skip
    lines += [f"{pointing.image_id}  {pointing.time_utc}  {pointing.figures}" for pointing in pointings]
    printable = (re.sub(r"[^ -~]", "?", line) for line in lines)
    return [line[: _COMMENT_WIDTH - 1] or " " for line in printable]


def _meta_kernel(kernels: Sequence[Kernel], written: Sequence[Path], output: Path) -> str:
    """Text that loads the archive's kernels in their order, then the corrected ones.

    A meta-kernel must not list another one, so the archive's is spelt out.
    """
    base = os.path.realpath(output)
    files = [os.path.relpath(os.path.realpath(k.path), base) for k in kernels if not k.is_meta]
    entries = "\n".join(f"   {_pieces(file)}" for file in [*files, *(path.name for path in written)])
    return (
        "KPL/MK\n\nThe archive's kernels, then corrected pointing. Names are relative to this file's folder.\n\n"
        f"\\begindata\n\n   KERNELS_TO_LOAD = (\n{entries}\n   )\n\n\\begintext\n"
    )


def _pieces(file: str) -> str:
    """A file name as strings of allowed length, '+' at the end of all but the last."""
    parts = [file[at : at + _PIECE] for at in range(0, len(file), _PIECE)]
    quoted = [part.replace("'", "''") for part in parts]
    return "\n   ".join(f"'{part}{'+' if at < len(quoted) - 1 else ''}'" for at, part in enumerate(quoted))
