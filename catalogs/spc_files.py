"""Binary maps of SPC (MAPFILES): records of 72 bytes with heights and albedos, read and written byte for byte.

Layout: the Planetary Science Institute's public description of SPC. Floats are big-endian, the half size is
little-endian; a cell is a big-endian 16-bit height and one byte of albedo, both zero where there are no data.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from catalogs.spc_text import LandmarkFile, SpcProblem
from pipeline.geometry.maplet import Maplet
from pipeline.records import FloatArray, Record

RECORD = 72
_CELLS_PER_RECORD = 24
_HEADER = struct.Struct(">6s f 2s 3s 3f 3f 3f 3f f f 1s")
_CELL = np.dtype([("height", ">i2"), ("albedo", "u1")])
# Heights fill this many steps of the 16-bit range, albedos this many steps of one unit.
_HEIGHT_STEPS = 30_000
_ALBEDO_STEPS = 100
_ALBEDO_RANGE = (1, 199)
# A map of more cells than this along a side has never been made; a wrong byte order shows itself here.
_LARGEST_HALF = 5000


@dataclass(frozen=True, eq=False)
class MapFile(Record):
    """One map as it stands in its file.

    Attributes
    ----------
    half, scale_km
        Half size in cells; width of a cell.
    landmark_km
        (3,) centre, body-fixed; single precision.
    axes
        (3, 3) rows Ux, Uy, Uz; single precision.
    height_step
        Cells that one step of a height stands for.
    steps
        (n, n) int16 heights in steps.
    albedo_steps
        (n, n) int16 hundredths; zero where unknown.
    sigma_direction
        (3,) int16, direction of the position's uncertainty in 255ths.
    sigma_km
        Its length.
    spare
        7 bytes that mean nothing.
    padding
        Bytes that fill the last record.
    """

    half: int
    scale_km: float
    landmark_km: FloatArray
    axes: FloatArray
    height_step: float
    steps: NDArray[np.int16]
    albedo_steps: NDArray[np.int16]
    sigma_direction: NDArray[np.int16]
    sigma_km: float
    spare: bytes = bytes(7)
    padding: bytes = b""

    def __post_init__(self) -> None:
        n = 2 * self.half + 1
        self._freeze(landmark_km=(3,), axes=(3, 3), steps=(n, n), albedo_steps=(n, n), sigma_direction=(3,))


def read_map(data: bytes, name: str) -> MapFile:
    """Read a MAP file.

    Parameters
    ----------
    data
        The file's bytes.
    name
        For messages.

    Returns
    -------
    MapFile
        Its content, complete: :func:`write_map` gives the same bytes.

    Raises
    ------
    SpcProblem
        If it is malformed or truncated, with the byte.
    """
    if len(data) < RECORD:
        raise SpcProblem(f"{name}: byte {len(data) + 1}: the file ends within its first record of {RECORD} bytes")
    lead, scale, size, direction, *numbers, step, sigma, last = _HEADER.unpack(data[:RECORD])
    half = int.from_bytes(size, "little")
    _check_header(name, half, scale, np.array(numbers), step, sigma)
    cells = (2 * half + 1) ** 2
    length = RECORD * (1 + -(-cells // _CELLS_PER_RECORD))
    if len(data) != length:
        what = "the file ends here" if len(data) < length else "bytes follow the last record"
        at = min(len(data), length) + 1
        raise SpcProblem(f"{name}: byte {at}: {what}; a half size of {half} takes {length} bytes")
    end = RECORD + cells * _CELL.itemsize
    grid = np.frombuffer(data[RECORD:end], _CELL).reshape(2 * half + 1, 2 * half + 1)
    return MapFile(
        half, scale, np.array(numbers[:3]), np.array(numbers[3:]).reshape(3, 3), step,
        grid["height"].astype(np.int16), grid["albedo"].astype(np.int16), np.array(list(direction), np.int16), sigma,
        lead + last, data[end:],
    )  # fmt: skip


def _check_header(name: str, half: int, scale: float, numbers: FloatArray, step: float, sigma: float) -> None:
    if not (np.isfinite(scale) and 0 < scale < 1e6):
        raise SpcProblem(f"{name}: byte 7: {scale:g} km is no scale")
    if not 1 <= half <= _LARGEST_HALF:
        raise SpcProblem(f"{name}: byte 11: {half} is no half size")
    axes = numbers[3:].reshape(3, 3)
    if not np.isfinite(numbers).all() or np.abs(axes @ axes.T - np.eye(3)).max() > 1e-4:
        raise SpcProblem(f"{name}: byte 28: the axes of the map's frame are not orthonormal")
    if not (np.isfinite(step) and step > 0):
        raise SpcProblem(f"{name}: byte 64: {step:g} is no step of heights")
    if not (np.isfinite(sigma) and sigma >= 0):
        raise SpcProblem(f"{name}: byte 68: {sigma:g} km is no uncertainty")


def padding_bytes(half: int) -> int:
    """Bytes that fill the last record of a map.

    Parameters
    ----------
    half
        Half size in cells.

    Returns
    -------
    int
        0 to 71.
    """
    return -((2 * half + 1) ** 2) * _CELL.itemsize % RECORD


def write_map(file: MapFile) -> bytes:
    """Bytes of a MAP file.

    Parameters
    ----------
    file
        Content.

    Returns
    -------
    bytes
        Whole records.
    """
    header = _HEADER.pack(
        file.spare[:6], file.scale_km, file.half.to_bytes(2, "little"), bytes(file.sigma_direction.tolist()),
        *file.landmark_km, *file.axes.ravel(), file.height_step, file.sigma_km, file.spare[6:],
    )  # fmt: skip
    grid = np.empty(file.steps.shape, _CELL)
    grid["height"], grid["albedo"] = file.steps, file.albedo_steps
    body = grid.tobytes() + file.padding
    return header + body + bytes(-len(body) % RECORD)


def maplet_of(file: MapFile, name: str, landmark: LandmarkFile | None = None) -> Maplet:
    """Maplet of a map and, where there is one, its landmark file.

    Parameters
    ----------
    file
        Map.
    name
        Landmark's name.
    landmark
        Brings more digits of the place, which count where they round to the map's, and the place's uncertainty.

    Returns
    -------
    Maplet
        Cells without data are not-a-number.
    """
    place = file.landmark_km
    sigma = file.sigma_km * file.sigma_direction / 255.0
    if landmark is not None:
        sigma = landmark.sigma_landmark_km
        if np.array_equal(landmark.landmark_km.astype(np.float32), file.landmark_km.astype(np.float32)):
            place = landmark.landmark_km
    known = file.albedo_steps > 0
    heights = np.where(known | (file.steps != 0), file.steps * file.height_step, np.nan)
    albedo = np.where(known, file.albedo_steps / _ALBEDO_STEPS, np.nan)
    return Maplet(name, place, file.axes, file.scale_km, heights, albedo, np.diag(sigma**2))


def map_of(maplet: Maplet, height_step: float | None = None) -> MapFile:
    """Map file of a maplet.

    Parameters
    ----------
    maplet
        Maplet.
    height_step
        Step of heights in cells; None takes the format's rule, the highest one over 30 000.

    Returns
    -------
    MapFile
        Heights rounded to steps, albedos to hundredths between 0.01 and 1.99.
    """
    known = np.isfinite(maplet.heights)
    heights = np.where(known, maplet.heights, 0.0)
    step = float(np.float32(max(1.0, np.abs(heights).max()) / _HEIGHT_STEPS)) if height_step is None else height_step
    steps = np.rint(heights / step)
    albedo = np.clip(np.rint(np.nan_to_num(maplet.albedo) * _ALBEDO_STEPS), *_ALBEDO_RANGE)
    seen = np.isfinite(maplet.albedo)
    sigma = np.sqrt(np.clip(np.diag(maplet.covariance_km2), 0.0, None))
    length = float(np.linalg.norm(sigma))
    direction = np.rint(255.0 * sigma / length) if length > 0 else np.zeros(3)
    return MapFile(
        maplet.half, maplet.scale_km, maplet.landmark_km, maplet.maplet_from_body, step,
        np.asarray(steps, np.int16), np.where(seen, albedo, 0).astype(np.int16), direction.astype(np.int16), length,
    )  # fmt: skip
