"""Text files of SPC: landmarks (LMKFILES) and pictures (SUMFILES), read and written.

Sections end at lines that hold a heading and nothing else: names of landmarks may contain its letters. Numbers carry
Fortran's D exponents. Pixel coordinates stay 1-based, as in the files.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.records import CameraModel, FloatArray, Record

_LINE_SCANNER_COLUMN = 13
_LABEL_COLUMN = 62


class SpcProblem(Exception):
    """One line on what is wrong with an SPC file, with its row or byte."""


@dataclass(frozen=True)
class Sighting:
    """A landmark in a picture, or a limb point.

    Attributes
    ----------
    name
        Of the picture or of the landmark.
    values
        Pixel and line, 1-based; overlaps of maps: dx, dy, dh in cells.
    flagged
        A trailing star.
    """

    name: str
    values: tuple[float, ...]
    flagged: bool = False


@dataclass(frozen=True, eq=False)
class LandmarkFile(Record):
    """One LMK file.

    Attributes
    ----------
    name, flag, extra
        First row: name, its letter, and what some files put behind.
    half, scale_km
        Half size of the map in cells; width of a cell.
    horizon
        Four integers.
    sigma_km, residual
        SIGKM and RMSLMK.
    landmark_km, axes, sigma_landmark_km
        VLM (3,); UX, UY, UZ as rows (3, 3); SIGMA_LMK (3,); body-fixed.
    pictures, overlaps, limbs
        The three lists.
    """

    name: str
    flag: str
    extra: str
    half: int
    scale_km: float
    horizon: tuple[int, ...]
    sigma_km: float
    residual: float
    landmark_km: FloatArray
    axes: FloatArray
    sigma_landmark_km: FloatArray
    pictures: tuple[Sighting, ...]
    overlaps: tuple[Sighting, ...]
    limbs: tuple[Sighting, ...]

    def __post_init__(self) -> None:
        self._freeze(landmark_km=(3,), axes=(3, 3), sigma_landmark_km=(3,))


@dataclass(frozen=True, eq=False)
class PictureFile(Record):
    """One SUM file.

    Attributes
    ----------
    name, time_utc
        As written.
    shape_vu, threshold
        Lines and pixels; lowest and highest number of light.
    focal_length_mm, centre
        MMFL; CTR as (pixel, line), 1-based.
    object_km
        (3,) SCOBJ: from the spacecraft to the body's centre, body-fixed.
    camera_from_body
        (3, 3) rows CX, CY, CZ.
    sun
        (3,) SZ: from the body to the Sun, body-fixed.
    k
        (2, 3) K matrix, px/mm; the third column multiplies x y.
    distortion
        (4,).
    sigma_position_km, sigma_pointing_rad
        (3,), (3,).
    landmarks, limbs
        Lists of what was measured.
    """

    name: str
    time_utc: str
    shape_vu: tuple[int, int]
    threshold: tuple[int, int]
    focal_length_mm: float
    centre: FloatArray
    object_km: FloatArray
    camera_from_body: FloatArray
    sun: FloatArray
    k: FloatArray
    distortion: FloatArray
    sigma_position_km: FloatArray
    sigma_pointing_rad: FloatArray
    landmarks: tuple[Sighting, ...]
    limbs: tuple[Sighting, ...]

    def __post_init__(self) -> None:
        self._freeze(
            centre=(2,), object_km=(3,), camera_from_body=(3, 3), sun=(3,), k=(2, 3), distortion=(4,),
            sigma_position_km=(3,), sigma_pointing_rad=(3,),
        )  # fmt: skip


class _Rows:
    """Rows of a file, taken one after the other."""

    def __init__(self, data: bytes, name: str) -> None:
        self.name = name
        try:
            self.rows = data.decode("ascii").splitlines()
        except UnicodeDecodeError as error:
            raise SpcProblem(f"{name}: byte {error.start + 1} is no text") from error
        self.at = 0

    def problem(self, text: str) -> SpcProblem:
        return SpcProblem(f"{self.name}: row {self.at}: {text}")

    def take(self) -> str:
        self.at += 1
        if self.at > len(self.rows):
            raise self.problem("the file ends here, before END FILE")
        return self.rows[self.at - 1]

    def numbers(self, count: int, least: int | None = None) -> FloatArray:
        """Leading numbers of the next row; zeros stand for those that may be missing."""
        tokens = self.take().split()[:count]
        values = []
        for token in tokens:
            value = _number(token)
            if value is None:
                break
            values.append(value)
        if len(values) < (count if least is None else least):
            raise self.problem(f"{len(values)} numbers where {count} belong")
        return np.array(values + [0.0] * (count - len(values)))

    def integers(self, count: int) -> tuple[int, ...]:
        values = self.numbers(count)
        if (values != np.rint(values)).any():
            raise self.problem("whole numbers belong here")
        return tuple(int(value) for value in values)

    def heading(self, text: str) -> None:
        if self.take().strip() != text:
            raise self.problem(f"{text} belongs here")

    def sightings(self, end: str, widths: tuple[int, ...]) -> tuple[Sighting, ...]:
        """Rows up to the heading that ends their list."""
        found = []
        while (row := self.take()).strip() != end:
            tokens = row.split()
            flagged = len(tokens) > 1 and tokens[-1] == "*"
            values = [_number(token) for token in tokens[1 : len(tokens) - flagged]]
            known = tuple(value for value in values if value is not None)
            if len(known) not in widths or len(known) != len(values):
                raise self.problem(f"{row.strip()[:40]!r} is no name with {' or '.join(map(str, widths))} numbers")
            found.append(Sighting(tokens[0], known, flagged))
        return tuple(found)


def _number(token: str) -> float | None:
    try:
        value = float(re.sub("[dD]", "E", token))
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def read_landmark(data: bytes, name: str) -> LandmarkFile:
    """Read an LMK file.

    Parameters
    ----------
    data
        The file's bytes.
    name
        For messages.

    Returns
    -------
    LandmarkFile
        Its content.

    Raises
    ------
    SpcProblem
        If it is malformed or truncated, with the row.
    """
    rows = _Rows(data, name)
    first = rows.take().split(None, 2)
    if len(first) < 2:
        raise rows.problem("the landmark's name and flag belong here")
    size = rows.numbers(2)
    if size[0] != np.rint(size[0]) or min(size) <= 0:
        raise rows.problem("a whole half size and a scale in km belong here")
    horizon, sigmas = rows.integers(4), rows.numbers(2)
    place, *axes = (rows.numbers(3) for _ in range(4))
    _orthonormal(rows, np.array(axes))
    sigma = rows.numbers(3)
    rows.heading("PICTURES")
    pictures, overlaps = rows.sightings("MAP OVERLAPS", (2,)), rows.sightings("LIMB FITS", (3,))
    limbs = rows.sightings("END FILE", (2, 3))
    return LandmarkFile(
        first[0], first[1], first[2] if len(first) > 2 else "", int(size[0]), float(size[1]), horizon,
        float(sigmas[0]), float(sigmas[1]), place, np.array(axes), sigma, pictures, overlaps, limbs,
    )  # fmt: skip


def _orthonormal(rows: _Rows, axes: FloatArray) -> None:
    # Ten digits are written; anything worse is a wrong file.
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-6) or np.linalg.det(axes) < 0:
        raise rows.problem("the three rows up to here are no rotation")


def read_picture(data: bytes, name: str) -> PictureFile:
    """Read a SUM file.

    Parameters
    ----------
    data
        The file's bytes.
    name
        For messages.

    Returns
    -------
    PictureFile
        Its content.

    Raises
    ------
    SpcProblem
        If it is malformed or truncated, with the row; also for a line scanner, which no camera model here describes.
    """
    rows = _Rows(data, name)
    first = rows.take()
    if first[_LINE_SCANNER_COLUMN : _LINE_SCANNER_COLUMN + 1] == "L":
        raise rows.problem("pictures of line scanners are not supported")
    time = rows.take().strip()
    size, optics, place = rows.integers(4), rows.numbers(3), rows.numbers(3)
    if not (min(size[:2]) > 0 and optics[0] > 0):
        raise rows.problem("an array and a focal length above zero belong in the two rows before")
    axes = np.array([rows.numbers(3) for _ in range(3)])
    _orthonormal(rows, axes)
    sun, k, distortion = rows.numbers(3), rows.numbers(6).reshape(2, 3), rows.numbers(4)
    sigma_position, sigma_pointing = rows.numbers(3), rows.numbers(3)
    rows.heading("LANDMARKS")
    landmarks, limbs = rows.sightings("LIMB FITS", (2,)), rows.sightings("END FILE", (2, 3))
    return PictureFile(
        first.strip(), time, (size[1], size[0]), (size[2], size[3]), float(optics[0]), optics[1:], place, axes, sun, k,
        distortion, sigma_position, sigma_pointing, landmarks, limbs,
    )  # fmt: skip


def camera_of(picture: PictureFile) -> CameraModel:
    """Camera model of a picture: its 1-based centre becomes 0-based, its third column of K stays with x y.

    Parameters
    ----------
    picture
        SUM file.

    Returns
    -------
    CameraModel
        Owen's model.

    Raises
    ------
    SpcProblem
        If the picture has distortion terms, whose meaning the format leaves to each mission.
    """
    if picture.distortion.any():
        raise SpcProblem(f"{picture.name}: DISTORTION other than zero is not described by the format")
    return CameraModel(
        picture.shape_vu, picture.focal_length_mm, picture.k[:, :2], picture.centre[::-1] - 1.0,
        k_xy_px_per_mm2=picture.k[:, 2],
    )  # fmt: skip


def write_landmark(file: LandmarkFile) -> bytes:
    """Text of an LMK file, in SPC's columns.

    Parameters
    ----------
    file
        Content.

    Returns
    -------
    bytes
        What :func:`read_landmark` reads back.
    """
    first = f"{file.name:<8} {file.flag}" + (f"{file.extra:>20}" if file.extra else "")
    lines = [
        first,
        _labelled(f"{file.half:8d}{file.scale_km:12.7f}", "SIZE, SCALE(KM)"),
        _labelled("".join(f"{value:10d}" for value in file.horizon), "HORIZON"),
        _labelled(_fortran([file.sigma_km, file.residual]), "SIGKM, RMSLMK"),
        _labelled(_fortran(file.landmark_km), "VLM"),
        *(_labelled(_fortran(axis), label) for axis, label in zip(file.axes, ("UX", "UY", "UZ"), strict=True)),
        _labelled(_fortran(file.sigma_landmark_km), "SIGMA_LMK"),
        *_section("PICTURES", file.pictures, lambda s: f"{s.name:<12}", 2),
        *_section("MAP OVERLAPS", file.overlaps, lambda s: f"{s.name:<6}", 3),
        *_section("LIMB FITS", file.limbs, lambda s: f"{s.name:<12}", 2),
        "END FILE",
    ]
    return ("\n".join(lines) + "\n").encode()


def write_picture(file: PictureFile) -> bytes:
    """Text of a SUM file, in SPC's columns.

    Parameters
    ----------
    file
        Content.

    Returns
    -------
    bytes
        What :func:`read_picture` reads back.
    """
    size = (file.shape_vu[1], file.shape_vu[0], *file.threshold)
    lines = [
        file.name,
        file.time_utc,
        _labelled("".join(f"{value:6d}" for value in size), "NPX, NLN, THRSH"),
        _labelled(_fortran([file.focal_length_mm, *file.centre]), "MMFL, CTR"),
        _labelled(_fortran(file.object_km), "SCOBJ"),
        *(_labelled(_fortran(row), f"C{axis}") for row, axis in zip(file.camera_from_body, "XYZ", strict=True)),
        _labelled(_fortran(file.sun), "SZ"),
        _labelled("".join(f"{value:10.5f}" for value in file.k.ravel()), "K-MATRIX"),
        _labelled(_fortran(file.distortion, 15, 5), "DISTORTION"),
        _labelled(_fortran(file.sigma_position_km), "SIGMA_VSO"),
        _labelled(_fortran(file.sigma_pointing_rad), "SIGMA_PTG"),
        *_section("LANDMARKS", file.landmarks, lambda s: f"{s.name:<6}", 2),
        *_section("LIMB FITS", file.limbs, lambda s: f"{s.name:<6}", 2),
        "END FILE",
    ]
    return ("\n".join(lines) + "\n").encode()


def _labelled(text: str, label: str) -> str:
    return f"{text:<{_LABEL_COLUMN - 1}} {label}"


def _section(heading: str, entries: Sequence[Sighting], named: Callable[[Sighting], str], decimals: int) -> list[str]:
    rows = [
        named(entry) + "".join(f"{value:10.{decimals}f}" for value in entry.values) + (" *" if entry.flagged else "")
        for entry in entries
    ]
    return [heading, *rows]


def _fortran(values: Sequence[float] | FloatArray, width: int = 20, digits: int = 10) -> str:
    """Numbers as Fortran's D format writes them: a mantissa below one."""
    return "".join(f"{_mantissa_below_one(float(value), digits):>{width}}" for value in values)


def _mantissa_below_one(value: float, digits: int) -> str:
    mantissa, exponent = f"{value:.{digits - 1}E}".split("E")
    sign = "-" if mantissa.startswith("-") else ""
    power = int(exponent) + (1 if value else 0)
    return f"{sign}0.{mantissa.lstrip('-').replace('.', '')}D{power:+03d}"
