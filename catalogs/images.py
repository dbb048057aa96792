"""Image files: bytes to pixels, header and the product's own bad-pixel flags."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from io import BytesIO

import numpy as np
from astropy.io import fits
from astropy.io.fits.verify import VerifyError, VerifyWarning
from astropy.utils.exceptions import AstropyUserWarning

from pipeline.errors import ImageError
from pipeline.records import Image
from pipeline.status import StatusReason

CardValue = str | int | float | bool
_BLOCK = 2880


@dataclass(frozen=True)
class RawImage:
    """What a file holds.

    Attributes
    ----------
    pixels
        (rows, cols) as stored, native byte order.
    header
        Cards of the image's header.
    extensions
        Readers of the file's further two-dimensional images, by name in upper case.
    """

    pixels: Image
    header: Mapping[str, CardValue]
    extensions: Mapping[str, Callable[[], Image]]


def read_image(data: bytes, name: str) -> RawImage:
    """Read an image from the bytes of its file.

    Parameters
    ----------
    data
        The whole file.
    name
        For messages.

    Returns
    -------
    RawImage
        The first two-dimensional image of the file.

    Raises
    ------
    ImageError
        If the file is empty, truncated, of a format that is not read, or damaged.
    """
    if not data:
        raise ImageError(StatusReason.IMAGE_EMPTY, f"{name} has no bytes")
    if not data.startswith(b"SIMPLE  ="):
        start = data[:8]
        raise ImageError(StatusReason.IMAGE_FORMAT_UNKNOWN, f"{name} is not a FITS file: it starts with {start!r}")
    with warnings.catch_warnings():
        # Old products break the standard in small ways (NEAR's cards do); what matters is checked below.
        warnings.simplefilter("ignore", VerifyWarning)
        warnings.simplefilter("ignore", AstropyUserWarning)
        try:
            return _read_fits(data, name)
        except (OSError, ValueError, TypeError, KeyError, IndexError, VerifyError, MemoryError) as error:
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {text}") from error


def _read_fits(data: bytes, name: str) -> RawImage:
    hdus = fits.open(BytesIO(data), memmap=False, lazy_load_hdus=True)
    first = next((hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) >= 2), None)
    if first is None:
        if len(data) % _BLOCK or len(data) <= _BLOCK:
            raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} ends inside its header")
        raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name} holds no two-dimensional image")
    for hdu in hdus:
        _check_length(hdu, len(data), name)
    extensions = {
        hdu.name.upper(): partial(_pixels_of, hdu) for hdu in hdus if hdu is not first and hdu.is_image and hdu.name
    }
    # astropy parses a card when it is asked for; a product's few hundred others stay text.
    return RawImage(_pixels_of(first), first.header, extensions)


def _pixels_of(hdu: fits.PrimaryHDU) -> Image:
    return _native(np.squeeze(hdu.data))


def _check_length(hdu: fits.PrimaryHDU, length: int, name: str) -> None:
    """Data units must end before the file does; only the padding of the last block may be missing."""
    info = hdu.fileinfo()
    end = info["datLoc"] + _data_bytes(hdu.header)
    if end > length:
        share = length / end
        raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} has {length} bytes of {end} ({share:.0%})")


def _data_bytes(header: fits.Header) -> int:
    axes = [header[f"NAXIS{k + 1}"] for k in range(header.get("NAXIS", 0))]
    if not axes:
        return 0
    elements = int(np.prod(axes, dtype=np.int64))
    return int(abs(header["BITPIX"]) // 8 * header.get("GCOUNT", 1) * (header.get("PCOUNT", 0) + elements))


def _native(array: Image) -> Image:
    if array.dtype.byteorder == ">":
        return array.astype(array.dtype.newbyteorder("="))
    return np.ascontiguousarray(array)
