"""PDS3 images, their label in front of the pixels or in a file of its own.

The pixels are taken by numpy: GDAL (3.10) misreads PC_UNSIGNED_INTEGER and every 32-bit integer, and refuses labels
that begin with an SFDU line, as Galileo's do; what it reads, it reads the same (tests hold both against each other).
"""

from dataclasses import dataclass

import numpy as np

from catalogs.instruments import Header
from catalogs.raw_images import native
from pipeline.errors import ImageError
from pipeline.records import Image
from pipeline.status import StatusReason

# Data types of PDS3 (Standards Reference, appendix C): byte order and numpy kind.
_MSB_PREFIXES = ("", "MSB_", "SUN_", "MAC_", "IEEE_")
_LSB_PREFIXES = ("LSB_", "PC_", "VAX_")
_KINDS = {
    **{f"{p}UNSIGNED_INTEGER": ">u" for p in _MSB_PREFIXES}, **{f"{p}INTEGER": ">i" for p in _MSB_PREFIXES},
    **{f"{p}UNSIGNED_INTEGER": "<u" for p in _LSB_PREFIXES}, **{f"{p}INTEGER": "<i" for p in _LSB_PREFIXES},
    "IEEE_REAL": ">f", "REAL": ">f", "FLOAT": ">f", "SUN_REAL": ">f", "MAC_REAL": ">f", "PC_REAL": "<f",
}  # fmt: skip
_SIZES = {"u": (1, 2, 4, 8), "i": (1, 2, 4, 8), "f": (4, 8)}
# A byte has no order and, in SUN_INTEGER images of 8 bits (Cassini's), no sign either.
_UNSIGNED_BYTES = ("SUN_INTEGER", "INTEGER", "UNSIGNED_INTEGER")


@dataclass(frozen=True)
class Pointer:
    """Where a label says that an object lies.

    Attributes
    ----------
    file
        Name of the file, None for the label's own.
    offset
        First byte, from zero.
    """

    file: str | None
    offset: int


def pointer_of(header: Header, name: str = "IMAGE") -> Pointer | None:
    """Where an object of a label lies.

    Parameters
    ----------
    header
        Keywords of the label.
    name
        Of the object.

    Returns
    -------
    Pointer or None
        None where the label does not point to such an object.
    """
    value = header.get(f"^{name}")
    if value is None or isinstance(value, bool):
        return None
    parts = str(value).split(",")
    in_bytes = "<BYTES>" in parts or str(header.get(f"^{name}.unit", "")).upper() == "BYTES"
    numbers = [int(part) for part in parts if part.isdecimal()]
    file = next((part for part in parts if part and not part.isdecimal() and part != "<BYTES>"), None)
    start = max(numbers[0] - 1, 0) if numbers else 0
    record = header.get("RECORD_BYTES", 1)
    return Pointer(file, start if in_bytes or not isinstance(record, int) else start * record)


def pds3_pixels(data: bytes, header: Header, offset: int, name: str) -> Image:
    """Pixels of a PDS3 image.

    Parameters
    ----------
    data
        The file that holds them.
    header
        Keywords of the label.
    offset
        First byte of the image.
    name
        For messages.

    Returns
    -------
    numpy.ndarray
        (rows, cols), or (bands, rows, cols); line prefixes and suffixes are left out.

    Raises
    ------
    ImageError
        If the file ends before the image does, or the label describes no image that can be read.
    """
    rows, columns = _count(header, "LINES", name), _count(header, "LINE_SAMPLES", name)
    bands = _count(header, "BANDS", name, 1)
    if str(header.get("IMAGE.ENCODING_TYPE", "N/A")).upper() not in ("N/A", "NONE", ""):
        raise _unreadable(name, f"its pixels are packed: {header['IMAGE.ENCODING_TYPE']}")
    dtype = _dtype(header, name)
    before, after = (_count(header, f"LINE_{side}_BYTES", name, 0) for side in ("PREFIX", "SUFFIX"))
    line = before + columns * dtype.itemsize + after
    storage = str(header.get("IMAGE.BAND_STORAGE_TYPE", "BAND_SEQUENTIAL")).upper()
    if bands > 1 and storage != "BAND_SEQUENTIAL":
        raise _unreadable(name, f"its {bands} bands are stored as {storage}")
    end = offset + rows * bands * line
    if end > len(data):
        share = len(data) / end
        raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} has {len(data)} bytes of {end} ({share:.0%})")
    lines: Image = np.ndarray((bands, rows, columns), dtype, data, offset + before,
                              (rows * line, line, dtype.itemsize))  # fmt: skip
    return native(lines if bands > 1 else lines[0])


def _unreadable(name: str, problem: str) -> ImageError:
    return ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {problem}")


def _count(header: Header, key: str, name: str, default: int | None = None) -> int:
    value = header.get(f"IMAGE.{key}", default)
    least = 1 if default != 0 else 0
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise _unreadable(name, f"its label says IMAGE.{key} = {value}")
    return value


def _dtype(header: Header, name: str) -> "np.dtype[np.generic]":
    kind = str(header.get("IMAGE.SAMPLE_TYPE", "")).upper()
    bits = header.get("IMAGE.SAMPLE_BITS")
    if bits == 8 and kind in _UNSIGNED_BYTES:
        return np.dtype("u1")
    code = _KINDS.get(kind)
    size = bits // 8 if isinstance(bits, int) and bits % 8 == 0 else 0
    if code is None or size not in _SIZES[code[1]]:
        raise _unreadable(name, f"its samples are {bits} bits of {kind or 'no type'}")
    return np.dtype(f"{code}{size}")
