"""VICAR, PDS4 and ISIS images by GDAL, from memory.

GDAL fills what a cut-off file lacks with zeros, so lengths are checked here before it is asked.
"""

import logging
import math
import uuid
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import numpy as np

from catalogs.instruments import Header
from catalogs.label_text import Keywords
from catalogs.raw_images import native
from pipeline.errors import ImageError
from pipeline.records import Image
from pipeline.status import StatusReason

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_VICAR_BYTES = {"BYTE": 1, "HALF": 2, "WORD": 2, "FULL": 4, "LONG": 4, "REAL": 4, "DOUB": 8}
_ISIS_BYTES = {"UnsignedByte": 1, "SignedWord": 2, "UnsignedWord": 2, "Real": 4}
_PDS4_BYTES = {
    "UnsignedByte": 1, "SignedByte": 1, "IEEE754MSBSingle": 4, "IEEE754LSBSingle": 4, "IEEE754MSBDouble": 8,
    "IEEE754LSBDouble": 8,
    **{f"{s}{o}{n}": n for s in ("Signed", "Unsigned") for o in ("MSB", "LSB") for n in (2, 4, 8)},
}  # fmt: skip
_PDS4_FILE = "File_Area_Observational"


def vicar_pixels(data: bytes, label: Keywords, name: str) -> Image:
    """Pixels of a VICAR image, its binary prefixes left out.

    Parameters
    ----------
    data
        The file, which begins with its VICAR label.
    label
        That label.
    name
        For messages.

    Returns
    -------
    numpy.ndarray
        (rows, cols), or (bands, rows, cols).

    Raises
    ------
    ImageError
        If the file is truncated or damaged.
    """
    start, header_records, record = (_whole(label, key, name) for key in ("LBLSIZE", "NLB", "RECSIZE"))
    rows, bands = _whole(label, "NL", name), max(_whole(label, "NB", name), 1)
    if str(label.get("FORMAT")) not in _VICAR_BYTES:
        raise _unreadable(name, f"its samples are {label.get('FORMAT')}")
    _check_length(data, start + (header_records + rows * bands) * record, name)
    return _read({"image.img": data}, "VICAR", (rows, _whole(label, "NS", name)), name)


def isis_pixels(data: bytes, label: Header, name: str) -> Image:
    """Pixels of an ISIS cube with its label in front, in the cube's own unit; special pixels are not-a-number.

    Parameters
    ----------
    data
        The file.
    label
        Its keywords.
    name
        For messages.

    Returns
    -------
    numpy.ndarray
        (rows, cols), or (bands, rows, cols).

    Raises
    ------
    ImageError
        If the file is truncated or damaged.
    """
    core = "IsisCube.Core"
    columns, rows, bands = (_whole(label, f"{core}.Dimensions.{k}", name) for k in ("Samples", "Lines", "Bands"))
    kind = str(label.get(f"{core}.Pixels.Type"))
    if kind not in _ISIS_BYTES:
        raise _unreadable(name, f"its pixels are {kind}")
    stored = rows * columns
    if label.get(f"{core}.Format") == "Tile":
        tile_rows, tile_columns = (_whole(label, f"{core}.{k}", name) for k in ("TileLines", "TileSamples"))
        if not tile_rows or not tile_columns:
            raise _unreadable(name, "its tiles have no pixels")
        stored = math.ceil(rows / tile_rows) * math.ceil(columns / tile_columns) * tile_rows * tile_columns
    start = _whole(label, f"{core}.StartByte", name) - 1
    _check_length(data, start + stored * bands * _ISIS_BYTES[kind], name)
    pixels = _read({"image.cub": data}, "ISIS3", (rows, columns), name)
    special = _isis_special(pixels, kind)
    scale, offset = (float(label.get(f"{core}.Pixels.{k}", d)) for k, d in (("Multiplier", 1.0), ("Base", 0.0)))
    return scaled(pixels, scale, offset, special)


def _isis_special(pixels: Image, kind: str) -> Image | None:
    """Pixels that hold one of ISIS' marks (SpecialPixel.h) instead of a value."""
    if kind == "UnsignedByte":
        # NULL and the low marks are 0, the high ones 255: those are also what a raw image's bytes may be.
        return None
    if kind == "SignedWord":
        return np.asarray(pixels < -32751)
    if kind == "UnsignedWord":
        return np.asarray((pixels < 3) | (pixels > 65522))
    return np.asarray(pixels < -3.402822e38)


def pds4_pixels(data: bytes, xml: bytes, label: Header, name: str) -> Image:
    """Pixels of the first array of a PDS4 product, in the order in which they are stored.

    Parameters
    ----------
    data
        The file that holds them.
    xml
        The product's label.
    label
        Its keywords.
    name
        For messages.

    Returns
    -------
    numpy.ndarray
        (rows, cols), or (bands, rows, cols).

    Raises
    ------
    ImageError
        If the file is truncated or damaged, or the product is no image.
    """
    array = next((key.split(".")[1] for key in label if key.startswith(f"{_PDS4_FILE}.Array_")), None)
    if array is None:
        raise _unreadable(name, f"{label.get('product')} holds no array")
    prefix = f"{_PDS4_FILE}.{array}"
    kind = _first(label, f"{prefix}.Element_Array.data_type")
    if kind not in _PDS4_BYTES:
        raise _unreadable(name, f"its elements are {kind}")
    axes = int(_first(label, f"{prefix}.axes") or 0)
    sizes = [int(n) for n in str(label.get(f"{prefix}.Axis_Array.elements", "")).split(",")[:axes] if n.isdecimal()]
    if len(sizes) < 2 or len(sizes) != axes:
        raise _unreadable(name, f"its array has sizes {sizes}")
    offset = int(_first(label, f"{prefix}.offset") or 0)
    _check_length(data, offset + math.prod(sizes) * _PDS4_BYTES[kind], name)
    file = pds4_file(label) or "image.img"
    pixels = _read({"label.xml": xml, file: data}, "PDS4", (sizes[-2], sizes[-1]), name)
    directions = [str(value) for key, value in label.items() if key.endswith(".vertical_display_direction")]
    if directions and directions[0].startswith("Bottom to Top"):
        # GDAL turns the array for the screen.
        pixels = np.ascontiguousarray(pixels[..., ::-1, :])
    constants = (_first(label, f"{prefix}.Special_Constants.{key}_constant") for key in ("missing", "invalid"))
    special = special_pixels(pixels, [float(c) for c in constants if c and c.lstrip("+-").replace(".", "").isdecimal()])
    scale = _first(label, f"{prefix}.Element_Array.scaling_factor")
    base = _first(label, f"{prefix}.Element_Array.value_offset")
    return scaled(pixels, float(scale or 1.0), float(base or 0.0), special)


def pds4_file(label: Header) -> str | None:
    """Name of the file that a PDS4 label describes.

    Parameters
    ----------
    label
        Its keywords.

    Returns
    -------
    str or None
        None where it describes none.
    """
    return _first(label, f"{_PDS4_FILE}.File.file_name")


def _first(label: Header, key: str) -> str | None:
    value = label.get(key)
    return None if value is None else str(value).split(",")[0]


def special_pixels(pixels: Image, constants: list[float]) -> Image | None:
    """Pixels that hold one of some constants.

    Parameters
    ----------
    pixels
        As stored.
    constants
        What marks a missing pixel.

    Returns
    -------
    numpy.ndarray or None
        True where it is one of them; None where there are no constants.
    """
    if not constants:
        return None
    return np.asarray(np.logical_or.reduce([pixels == np.asarray(value).astype(pixels.dtype) for value in constants]))


def scaled(pixels: Image, scale: float, offset: float, special: Image | None) -> Image:
    """Real values of stored ones.

    Parameters
    ----------
    pixels
        As stored.
    scale, offset
        value = scale * stored + offset.
    special
        True where a pixel holds no value.

    Returns
    -------
    numpy.ndarray
        As stored where nothing is to be done, else 32-bit floats with not-a-number for special pixels.
    """
    plain = scale == 1.0 and offset == 0.0
    if plain and (special is None or not special.any()):
        return pixels
    values = pixels.astype(np.float32) if plain else (pixels * np.float64(scale) + offset).astype(np.float32)
    if special is not None:
        values[special] = np.nan
    return values


def _unreadable(name: str, problem: str) -> ImageError:
    return ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {problem}")


def _whole(label: Header, key: str, name: str) -> int:
    value = label.get(key, 0)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise _unreadable(name, f"its label says {key} = {value}")
    return value


def _check_length(data: bytes, end: int, name: str) -> None:
    if end > len(data):
        share = len(data) / end
        raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} has {len(data)} bytes of {end} ({share:.0%})")


def _read(files: Mapping[str, bytes], driver: str, shape_vu: tuple[int, int], name: str) -> Image:
    """All bands of the first of some files, which lie side by side."""
    with _dataset(files, driver, name) as dataset:
        if dataset.shape != shape_vu:
            raise _unreadable(name, f"its label and its pixels disagree: {shape_vu} and {dataset.shape}")
        pixels: Image = dataset.read()
    if pixels.dtype.kind == "c":
        raise _unreadable(name, "its samples are complex")
    return native(pixels[0] if len(pixels) == 1 else pixels)


@contextmanager
def _dataset(files: Mapping[str, bytes], driver: str, name: str) -> "Iterator[DatasetReader]":
    # Slow to import, and most archives are of one format.
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile

    # It writes what GDAL grumbles at to standard error; what matters arrives as an exception.
    logging.getLogger("rasterio").setLevel(logging.CRITICAL + 1)
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore")
        folder = str(uuid.uuid4())
        try:
            stack.enter_context(rasterio.Env(GDAL_PAM_ENABLED="NO"))
            memory = [
                stack.enter_context(MemoryFile(data, dirname=folder, filename=file)) for file, data in files.items()
            ]
            yield stack.enter_context(memory[0].open(driver=driver))
        except (RasterioError, OSError, ValueError, TypeError, MemoryError) as error:
            raise _unreadable(name, " ".join(str(error).split()) or type(error).__name__) from error
