"""What an image file holds, whatever its format."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from catalogs.instruments import CardValue
from pipeline.records import Image


@dataclass(frozen=True)
class RawImage:
    """What a file holds.

    Attributes
    ----------
    pixels
        (rows, cols) as stored, native byte order, floats no longer than 32 bits; not-a-number where the label says that
        a pixel is missing.
    header
        Cards of the image's header, and keywords of its label.
    extensions
        Readers of the file's further two-dimensional images, by name in upper case; they raise ImageError.
    """

    pixels: Image
    header: Mapping[str, CardValue]
    extensions: Mapping[str, Callable[[], Image]]


def native(array: Image) -> Image:
    """Pixels in this machine's byte order, floats in 32 bits.

    Parameters
    ----------
    array
        Any order and length.

    Returns
    -------
    numpy.ndarray
        C-contiguous.
    """
    if array.dtype.kind == "f" and array.dtype.itemsize > 4:
        # Nothing downstream is finer; what is too large for it becomes infinite, and that is looked for.
        with np.errstate(over="ignore"):
            return array.astype(np.float32)
    if not array.dtype.isnative:
        return array.astype(array.dtype.newbyteorder("="))
    return np.ascontiguousarray(array)
