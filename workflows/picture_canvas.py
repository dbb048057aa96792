"""A picture to draw on: stretched grey values, marks at subpixel places, and text that needs no font of the system."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.ft2font import FT2Font
from numpy.typing import NDArray

from pipeline.records import FloatArray, Image

Colour = tuple[int, int, int]
Pixels = NDArray[np.uint8]

# Okabe and Ito's colours, told apart by every kind of colour vision, as (blue, green, red).
SKY: Colour = (0xE9, 0xB4, 0x56)
ORANGE: Colour = (0x00, 0x9F, 0xE6)
PURPLE: Colour = (0xA7, 0x79, 0xCC)
YELLOW: Colour = (0x42, 0xE4, 0xF0)
GREEN: Colour = (0x73, 0x9E, 0x00)
VERMILION: Colour = (0x00, 0x5E, 0xD5)
WHITE: Colour = (245, 245, 245)
GREY: Colour = (165, 165, 165)
PAPER: Colour = (24, 22, 20)

# OpenCV takes places in sixteenths of a pixel.
_SHIFT = 4
_LEVELS = 4096
# Of pixels, between which the stretch starts and is as bright as an inverse hyperbolic sine lets it be.
_PERCENTILES = (2.0, 99.7)
_BRIGHTEST = 8.0
_SOFTENING = 6.0
_FLAT_GREY = 48
_DPI = 72


@dataclass(frozen=True)
class Canvas:
    """A colour picture with an image in it.

    Attributes
    ----------
    pixels
        (rows, columns, 3) blue, green, red; drawn on.
    origin
        Column and row of the image's upper left corner in the picture.
    scale
        Picture's pixels per image's pixel.
    """

    pixels: Pixels
    origin: tuple[int, int]
    scale: float

    def places(self, vu: FloatArray) -> FloatArray:
        """Columns and rows of the picture.

        Parameters
        ----------
        vu
            (n, 2) places in the image.

        Returns
        -------
        numpy.ndarray
            (n, 2) x and y.
        """
        return np.asarray((vu[:, ::-1] + 0.5) * self.scale - 0.5 + np.array(self.origin))

    def line(self, xy: FloatArray, colour: Colour, width: int = 1) -> None:
        """Draw a line through places of the picture."""
        cv2.polylines(self.pixels, [_fixed(xy)], False, colour, width, cv2.LINE_AA, _SHIFT)

    def boxes(self, xy: FloatArray, half: float, colour: Colour) -> None:
        """Draw squares about places of the picture."""
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
        shapes = [_fixed(place + corners) for place in xy]
        cv2.polylines(self.pixels, shapes, True, colour, 2, cv2.LINE_AA, _SHIFT)

    def diamonds(self, xy: FloatArray, half: float, colour: Colour) -> None:
        """Draw squares on their corners about places of the picture."""
        corners = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)]) * half
        shapes = [_fixed(place + corners) for place in xy]
        cv2.polylines(self.pixels, shapes, True, colour, 1, cv2.LINE_AA, _SHIFT)

    def crosses(self, xy: FloatArray, half: float, colour: Colour) -> None:
        """Draw thin crosses at places of the picture."""
        arms = half * np.array([[(-1, 0), (1, 0)], [(0, -1), (0, 1)]])
        shapes = [_fixed(place + arm) for place in xy for arm in arms]
        cv2.polylines(self.pixels, shapes, False, colour, 1, cv2.LINE_AA, _SHIFT)

    def circles(self, xy: FloatArray, radius: float, colour: Colour, width: int = 1) -> None:
        """Draw circles about places of the picture; a negative width fills them."""
        for x, y in _fixed(xy):
            cv2.circle(self.pixels, (int(x), int(y)), round(radius * 2**_SHIFT), colour, width, cv2.LINE_AA, _SHIFT)

    def arrow(self, start: FloatArray, end: FloatArray, colour: Colour) -> None:
        """Draw an arrow of the picture's places; its head has one size whatever its length."""
        direction = end - start
        length = float(np.hypot(*direction))
        if length < 1e-6:
            return
        along = direction / length
        across = np.array([-along[1], along[0]])
        back = end - along * 6
        self.line(np.stack([start, end]), colour)
        self.line(np.stack([back + across * 3, end, back - across * 3]), colour)

    def text(self, x: float, y: float, text: str, size: int, colour: Colour = WHITE, shade: bool = False) -> None:
        """Write a line whose baseline starts at a place; ``shade`` darkens what lies behind it.

        Near the border the line moves inward as far as it has to.
        """
        mask, descent = rendered(text, size)
        rows, columns = mask.shape
        left, top = round(x), round(y) - rows + descent
        height, width = self.pixels.shape[:2]
        if 0 <= x < width and 0 <= y < height:
            left, top = max(min(left, width - columns), 0), max(min(top, height - rows), 0)
        from_row, from_column = max(-top, 0), max(-left, 0)
        part = self.pixels[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
        if not part.size:
            return
        cover = mask[from_row : from_row + part.shape[0], from_column : from_column + part.shape[1], None] / 255.0
        behind = part * 0.35 if shade else part
        part[:] = behind * (1 - cover) + np.array(colour) * cover


def _fixed(xy: FloatArray) -> NDArray[np.int32]:
    # Beyond this OpenCV's arithmetic overflows; nothing out there can be seen.
    return np.asarray(np.rint(np.clip(xy, -30000, 30000) * 2**_SHIFT), np.int32)


@lru_cache(maxsize=8)
def _font(size: int) -> FT2Font:
    font = FT2Font(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"))
    font.set_size(size, _DPI)
    return font


@lru_cache(maxsize=512)
def rendered(text: str, size: int) -> tuple[Pixels, int]:
    """One line of text as coverage of pixels.

    Parameters
    ----------
    text
        The line.
    size
        Of the font, in pixels.

    Returns
    -------
    tuple
        (rows, columns) 0 to 255, and the rows below the baseline.
    """
    if not text.strip():
        return np.zeros((1, 1 + size // 3 * len(text)), np.uint8), 0
    font = _font(size)
    font.set_text(text, 0.0)
    font.draw_glyphs_to_bitmap(antialiased=True)
    return np.array(font.get_image(), np.uint8), int(np.ceil(font.get_descent() / 64))


def text_width(text: str, size: int) -> int:
    """Columns that a line takes.

    Parameters
    ----------
    text
        The line.
    size
        Of the font, in pixels.

    Returns
    -------
    int
        Pixels.
    """
    return int(rendered(text, size)[0].shape[1])


def wrapped(text: str, size: int, width: int) -> list[str]:
    """Break a text into lines that fit.

    Parameters
    ----------
    text
        Words separated by blanks.
    size
        Of the font, in pixels.
    width
        Pixels.

    Returns
    -------
    list of str
        At least one line.
    """
    lines, words = [""], text.split()
    for word in words:
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width(longer, size) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def stretched(pixels: Image) -> Pixels:
    """Grey values in which faint and bright things show: linear in the background, logarithmic above.

    Parameters
    ----------
    pixels
        (rows, columns) as read; values that are not finite become black.

    Returns
    -------
    numpy.ndarray
        (rows, columns) 0 to 255.
    """
    some = np.asarray(pixels[::4, ::4] if min(pixels.shape) > 256 else pixels, np.float64)
    some = some[np.isfinite(some)]
    low, high = np.percentile(some, _PERCENTILES) if some.size else (0.0, 0.0)
    # Of a picture that is nearly all sky both percentiles are the sky.
    if high <= low and some.size:
        high = float(some.max())
    if not high > low:
        return np.full(pixels.shape, _FLAT_GREY, np.uint8)
    curve = np.arcsinh(np.linspace(0, _BRIGHTEST, _LEVELS) * _SOFTENING)
    table = np.asarray(np.rint(curve / curve[-1] * 255), np.uint8)
    step = (_LEVELS - 1) / _BRIGHTEST / (high - low)
    level = np.nan_to_num((np.asarray(pixels, np.float32) - np.float32(low)) * np.float32(step), nan=0.0)
    return np.asarray(table[np.clip(level, 0, _LEVELS - 1).astype(np.uint16)])


def enlarged(grey: Pixels, scale: float) -> Pixels:
    """Grey values at another scale, as blue, green and red.

    Parameters
    ----------
    grey
        (rows, columns).
    scale
        New pixels per old one; above 1 whole, so that pixels stay squares.

    Returns
    -------
    numpy.ndarray
        (rows, columns, 3).
    """
    if scale != 1:
        size = (max(round(grey.shape[1] * scale), 1), max(round(grey.shape[0] * scale), 1))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST))
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))


def encode_png(pixels: Pixels) -> bytes:
    """PNG of a picture: noise hardly shrinks, so little time is spent on it.

    Parameters
    ----------
    pixels
        (rows, columns, 3) blue, green, red.

    Returns
    -------
    bytes
        The file.
    """
    # Filters in front of the compression take half as long again and make a noisy picture no smaller (measured).
    options: Sequence[int] = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
    _, data = cv2.imencode(".png", pixels, options)
    return bytes(data)
