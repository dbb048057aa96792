"""Summary picture of one navigated image: what was predicted, what was found, and the answer in words."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from pipeline.json_values import Json
from pipeline.records import Image
from workflows.picture_canvas import (
    GREEN,
    GREY,
    PAPER,
    PURPLE,
    SKY,
    VERMILION,
    WHITE,
    YELLOW,
    Canvas,
    Colour,
    encode_png,
    enlarged,
    stretched,
    text_width,
    wrapped,
)
from workflows.picture_marks import Key, RingLine, draw_marks

# Small images are enlarged to about the first, large ones shrunk below the second; text needs the third.
_LEAST_SIDE, _MOST_SIDE, _LEAST_WIDTH = 640, 1400, 720
_LEFT, _RIGHT, _PAD = 52, 16, 10
_BIG, _MEDIUM, _SMALL = 17, 14, 12
_AXIS = 34
_COLOUR_OF_RANK: dict[str, Colour] = {
    "high": GREEN, "medium": SKY, "low": YELLOW, "conflicted": PURPLE, "failed": VERMILION,
}  # fmt: skip


def draw_image(pixels: Image, document: Mapping[str, Json], expected_rings: Sequence[RingLine] = ()) -> bytes:
    """Draw an image with what was predicted, found and rejected.

    Parameters
    ----------
    pixels
        (rows, cols) as read.
    document
        The image's JSON document.
    expected_rings
        Edges as predicted, for an image whose document holds none that were found.

    Returns
    -------
    bytes
        PNG.
    """
    scale = _scale(pixels.shape)
    image = enlarged(stretched(pixels), scale)
    rows, columns = image.shape[:2]
    width = max(columns + _LEFT + _RIGHT, _LEAST_WIDTH)
    head = _head(document, width - 2 * _PAD)
    left, top = max(_LEFT, (width - columns) // 2), _PAD * 2 + sum(size + 6 for _, size, _ in head)
    # The key is laid out after the marks are counted: two lines of it always fit.
    foot = _AXIS + 2 * (_SMALL + 10) + _PAD
    picture = np.full((top + rows + foot, width, 3), PAPER, np.uint8)
    picture[top : top + rows, left : left + columns] = image
    # Marks end at the image's border.
    inside = Canvas(picture[top : top + rows, left : left + columns], (0, 0), scale)
    keys = draw_marks(inside, document, (pixels.shape[0], pixels.shape[1]), expected_rings)
    canvas = Canvas(picture, (left, top), scale)
    cv2.rectangle(picture, (left - 1, top - 1), (left + columns, top + rows), GREY, 1)
    _write_head(canvas, head)
    _axes(canvas, pixels.shape)
    _foot(canvas, keys, top + rows + _AXIS + _SMALL, pixels.shape)
    return encode_png(picture)


def _scale(shape: tuple[int, ...]) -> float:
    longest = max(shape)
    if longest > _MOST_SIDE:
        return _MOST_SIDE / longest
    return float(max(-(-_LEAST_SIDE // longest), 1))


def _head(document: Mapping[str, Json], width: int) -> list[tuple[str, int, Colour]]:
    """Lines with their sizes and colours."""
    rank = str(document["rank"])
    lines = [(line, _BIG, WHITE) for line in wrapped(str(document["image_id"]), _BIG, width)]
    time = f"   {document['time_utc']} UTC" if document["time_utc"] else ""
    lines.append((f"{document['mission']} {document['camera']}{time}", _SMALL, GREY))
    lines += [(line, _MEDIUM, WHITE) for line in wrapped(_answer(document), _MEDIUM, width)]
    outcome = f"{document['status']}, rank {rank}" if document["status"] == "success" else f"{document['status']}"
    said = f"{outcome} ({str(document['status_reason']).replace('_', ' ')}): {document['detail']}"
    lines += [(line, _SMALL, _COLOUR_OF_RANK.get(rank, WHITE)) for line in wrapped(said, _SMALL, width)][:3]
    return lines


def _answer(document: Mapping[str, Json]) -> str:
    """Offset, its sigma and the rotation in one line."""
    offset, sigma, observable = (document.get(key) for key in ("offset_px", "sigma_px", "observable"))
    text = "no offset"
    if isinstance(offset, list) and isinstance(sigma, list):
        text = f"offset  dv {offset[0]:+.3f} ± {sigma[0]:.3f} px,  du {offset[1]:+.3f} ± {sigma[1]:.3f} px"
    elif isinstance(observable, dict):
        v, u = (float(x) for x in observable["direction_vu"])  # type: ignore[arg-type, union-attr]
        along, spread = observable["offset_along_px"], observable["sigma_along_px"]
        text = f"offset  {along:+.3f} ± {spread:.3f} px along (v {v:+.2f}, u {u:+.2f}), the only direction seen"
    if document.get("rotation_deg") is not None:
        text += f",  rotation {document['rotation_deg']:+.4f} ± {document['sigma_rotation_deg']:.4f}°"
    return text


def _write_head(canvas: Canvas, head: list[tuple[str, int, Colour]]) -> None:
    y = _PAD
    for text, size, colour in head:
        y += size + 6
        canvas.text(_PAD, y - 4, text, size, colour)


def _step(length: float, most: int) -> int:
    """Round distance of which at most so many fit into a length."""
    for power in range(6):
        for factor in (1, 2, 5):
            step = factor * 10**power
            if length / step <= most:
                return int(step)
    return int(length)


def _axes(canvas: Canvas, shape: tuple[int, ...]) -> None:
    """Ticks along columns and rows, and which way each of them counts."""
    rows, columns = shape[:2]
    left, top = canvas.origin
    bottom = top + round(rows * canvas.scale)
    for u in range(0, columns, _step(columns, max(round(columns * canvas.scale / 90), 1))):
        x = float(canvas.places(np.array([[0.0, u]]))[0, 0])
        canvas.line(np.array([[x, bottom], [x, bottom + 5]]), GREY)
        canvas.text(x - text_width(str(u), _SMALL) / 2, bottom + 18, str(u), _SMALL, GREY)
    for v in range(0, rows, _step(rows, max(round(rows * canvas.scale / 60), 1))):
        y = float(canvas.places(np.array([[v, 0.0]]))[0, 1])
        canvas.line(np.array([[left - 6, y], [left - 1, y]]), GREY)
        canvas.text(left - 9 - text_width(str(v), _SMALL), y + 4, str(v), _SMALL, GREY)
    canvas.text(left, bottom + _AXIS - 2, "u → columns,  v ↓ rows,  px", _SMALL, GREY)


def _foot(canvas: Canvas, keys: list[Key], y: int, shape: tuple[int, ...]) -> None:
    """What the marks mean, and a scale bar at the right end."""
    width = canvas.pixels.shape[1]
    bar = _step(shape[1] * 0.3, 1)
    length = bar * canvas.scale
    right = width - _RIGHT
    label = f"{bar} px"
    canvas.line(np.array([[right - length, y - 18], [right, y - 18]]), WHITE, 2)
    for x in (right - length, right):
        canvas.line(np.array([[x, y - 23], [x, y - 13]]), WHITE)
    canvas.text(right - length - 8 - text_width(label, _SMALL), y - 14, label, _SMALL)
    x, row = float(_PAD), float(y + 6)
    for key in keys:
        taken = 24 + text_width(key.label, _SMALL) + 18
        if x + taken > width - _PAD and x > _PAD:
            x, row = float(_PAD), row + _SMALL + 8
        key.draw(canvas, np.array([[x + 9, row - 4]]))
        canvas.text(x + 24, row, key.label, _SMALL)
        x += taken
