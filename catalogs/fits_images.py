"""FITS images: pixels, cards and the product's own bad-pixel flags."""

import math
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from io import BytesIO

import numpy as np
from astropy.io import fits
from astropy.io.fits.hdu.compressed._compression import CfitsioException
from astropy.io.fits.verify import VerifyError, VerifyWarning
from astropy.utils.exceptions import AstropyUserWarning

from catalogs.instruments import CardValue
from catalogs.raw_images import RawImage, native
from pipeline.errors import ImageError
from pipeline.records import Image
from pipeline.status import StatusReason

_BLOCK = 2880
# What astropy lets through when a file is damaged.
_DAMAGE = (
    OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, VerifyError, MemoryError, EOFError,
    struct.error, zlib.error, CfitsioException,
)  # fmt: skip


class Cards(Mapping[str, CardValue]):
    """Cards of a header; one that cannot be parsed, or has no value, counts as not there.

    astropy parses a card when it is asked for, and it stays that way: a product has hundreds, a few are wanted.
    """

    def __init__(self, header: fits.Header) -> None:
        self._header = header

    def __getitem__(self, key: str) -> CardValue:
        try:
            value = self._header[key]
        except VerifyError as error:
            raise KeyError(key) from error
        if not isinstance(value, str | int | float | bool):
            raise KeyError(key)
        return value

    def __iter__(self) -> Iterator[str]:
        return iter(self._header)

    def __len__(self) -> int:
        return len(self._header)


def read_fits(data: bytes, name: str) -> RawImage:
    """Read an image from the bytes of a FITS file.

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
        If the file is truncated or damaged.
    """
    if len(data) < _BLOCK:
        raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} ends inside its header")
    with _forgiving(name):
        return _read(data, name)


@contextmanager
def _forgiving(name: str) -> Iterator[None]:
    """Silence for small breaches of the standard, an ImageError for damage."""
    with warnings.catch_warnings():
        # Old products break the standard in small ways (NEAR's cards do); what matters is checked below.
        warnings.simplefilter("ignore", VerifyWarning)
        warnings.simplefilter("ignore", AstropyUserWarning)
        try:
            yield
        except _DAMAGE as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {text}") from error


def _read(data: bytes, name: str) -> RawImage:
    hdus = fits.open(BytesIO(data), memmap=False, lazy_load_hdus=True)
    # What stands behind the first pixels (flags, errors) is never the image, even where these are none.
    first = next((hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) >= 1), None)
    if first is None or first.header["NAXIS"] < 2:
        if len(data) % _BLOCK or len(data) <= _BLOCK:
            raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} ends inside its header")
        raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name} holds no two-dimensional image")
    for hdu in hdus:
        _check_length(hdu, len(data), name)
    _check_rest(hdus, data, name)
    extensions = {
        hdu.name.upper(): partial(_pixels_of, hdu, name)
        for hdu in hdus
        if hdu is not first and hdu.is_image and hdu.name
    }
    return RawImage(_pixels_of(first, name), Cards(first.header), extensions)


def _pixels_of(hdu: fits.PrimaryHDU, name: str) -> Image:
    with _forgiving(name):
        if hdu.data is None:
            raise ImageError(StatusReason.IMAGE_UNREADABLE, f"{name}: {hdu.name} holds no pixels")
        pixels = native(np.squeeze(hdu.data))
        # HDUs refer to each other in circles: kept in one, the array would wait for the garbage collector.
        del hdu.data
        return pixels


def _check_length(hdu: fits.PrimaryHDU, length: int, name: str) -> None:
    """Data units must end before the file does; only the padding of the last block may be missing."""
    info = hdu.fileinfo()
    if isinstance(hdu, fits.CompImageHDU):
        # Its header tells the size of the image, not of the table that holds it.
        end = info["datLoc"] + info["datSpan"] - (_BLOCK - 1)
    else:
        end = info["datLoc"] + _data_bytes(hdu.header)
    if end > length:
        share = length / end
        raise ImageError(StatusReason.IMAGE_TRUNCATED, f"{name} has {length} bytes of {end} ({share:.0%})")


def _check_rest(hdus: fits.HDUList, data: bytes, name: str) -> None:
    """Bytes after the last unit may be anything, but not an extension that astropy has given up on."""
    info = hdus[-1].fileinfo()
    rest = data[info["datLoc"] + info["datSpan"] :]
    if rest.startswith(b"XTENSION"):
        whole = len(rest) >= _BLOCK and len(data) % _BLOCK == 0
        reason = StatusReason.IMAGE_UNREADABLE if whole else StatusReason.IMAGE_TRUNCATED
        raise ImageError(reason, f"{name}: the header of extension {len(hdus)} is damaged or cut off")


def _data_bytes(header: fits.Header) -> int:
    axes = [header[f"NAXIS{k + 1}"] for k in range(header.get("NAXIS", 0))]
    if not axes:
        return 0
    elements = math.prod(axes)
    return int(abs(header["BITPIX"]) // 8 * header.get("GCOUNT", 1) * (header.get("PCOUNT", 0) + elements))
