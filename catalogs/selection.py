"""Which images of an archive are wanted, by what its index says of them."""

import re
from collections.abc import Mapping
from datetime import date, datetime
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field

from catalogs.instruments import CardValue, InstrumentBlock, identify
from catalogs.labels import in_pds3_words, utc_of
from pipeline.errors import ConfigurationError
from pipeline.options import Options

Row = Mapping[str, CardValue]

# Columns that answer a key, in the words of PDS3; the first that an index has is taken.
_COLUMNS = {
    "volume": ("VOLUME_ID",),
    "start": ("START_TIME", "IMAGE_TIME", "IMAGE_MID_TIME", "STOP_TIME"),
    "target": ("TARGET_NAME",),
    "filter": ("FILTER_NAME",),
    "camera": ("INSTRUMENT_ID", "INSTRUMENT_NAME"),
    "target_size_px": ("TARGET_SIZE_PX", "TARGET_SIZE_PIXELS", "APPARENT_DIAMETER_PX"),
}
# Keys that paths and product ids answer where there is no index.
_WITHOUT_INDEX = ("volume", "image_numbers")
_NUMBER = re.compile(r"\d{5,}")


def _listed(value: object) -> object:
    return [value] if isinstance(value, str | int) and not isinstance(value, bool) else value


def _texts(value: object) -> object:
    values = _listed(value)
    return [str(item) for item in values] if isinstance(values, list | tuple) else values


def _time(value: object) -> object:
    # YAML makes dates of what looks like one.
    return value.isoformat() if isinstance(value, date | datetime) else value


def _is_time(text: str) -> str:
    if utc_of(text) is None:
        raise ValueError(f"{text!r} is no ISO-8601 time")
    return text


Names = Annotated[tuple[str, ...], BeforeValidator(_texts), Field(min_length=1)]
Moment = Annotated[str, BeforeValidator(_time), AfterValidator(_is_time)]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] <= pair[1]:
        raise ValueError("the smaller figure comes first")
    return pair


class Selection(Options):
    """What is wanted; every key that is given must be met."""

    volume: Names | None = Field(None, description="volume, or several")
    start: Moment | None = Field(None, description="no image before this time, ISO-8601 UTC")
    stop: Moment | None = Field(None, description="no image after this time, ISO-8601 UTC")
    target: Names | None = Field(None, description="target's name, or several")
    filter: Names | None = Field(None, description="filter, or several; CL1+CB2 for two wheels")
    camera: Names | None = Field(None, description="camera block, camera or instrument id, or several")
    image_numbers: Annotated[tuple[int, ...], BeforeValidator(_listed), Field(min_length=1)] | None = Field(
        None, description="two numbers are the ends of a range; one, or more than two, are single images"
    )
    target_size_px: Annotated[tuple[float, float], AfterValidator(_ordered)] | None = Field(
        None, description="least and largest apparent diameter, pixels, where the index has such a column"
    )

    def given(self) -> tuple[str, ...]:
        """Keys that are given."""
        return tuple(name for name in type(self).model_fields if getattr(self, name) is not None)


def check_selection(selection: Selection, columns: Row | None, source: str) -> None:
    """Refuse a selection that this archive cannot honour.

    Parameters
    ----------
    selection
        What is wanted.
    columns
        A row of the index, None where images are listed without one.
    source
        Name of the index, for messages.

    Raises
    ------
    ConfigurationError
        One line with the key and what is missing.
    """
    if columns is None:
        bad = next((key for key in selection.given() if key not in _WITHOUT_INDEX), None)
        if bad is not None:
            can = " and ".join(_WITHOUT_INDEX)
            raise ConfigurationError(f"{source}: select.{bad} needs an index table; without one only {can} can be met")
        return
    words = {**in_pds3_words(columns), **columns}
    for key in selection.given():
        names = _COLUMNS["start"] if key == "stop" else _COLUMNS.get(key)
        if names is not None and key != "volume" and not any(name in words for name in names):
            raise ConfigurationError(f"{source}: select.{key} cannot be met: there is no column {' or '.join(names)}")


def columns_of(selection: Selection, blocks: Mapping[str, InstrumentBlock]) -> frozenset[str]:
    """Columns of an index that a selection looks at.

    Parameters
    ----------
    selection
        What is wanted.
    blocks
        Camera blocks, whose marks tell cameras.

    Returns
    -------
    frozenset of str
        Names in the words of PDS3.
    """
    keys = {"start" if key == "stop" else key for key in selection.given()}
    found = {name for key in keys for name in _COLUMNS.get(key, ())} | {"IMAGE_NUMBER"}
    if "camera" in keys:
        marks = [block.identify if isinstance(block.identify, list) else [block.identify] for block in blocks.values()]
        found |= {name for several in marks for one in several for names in one for name in names.split("|")}
    return frozenset(found)


def is_chosen(selection: Selection, row: Row, path: str, image_id: str, blocks: Mapping[str, InstrumentBlock]) -> bool:
    """Whether an image is wanted.

    Parameters
    ----------
    selection
        What is wanted, already checked.
    row
        What the index says of the image; empty without an index.
    path, image_id
        Of the image.
    blocks
        Camera blocks, by which cameras may be named.

    Returns
    -------
    bool
        True if it meets every key.
    """
    words = {**in_pds3_words(row), **row}
    return all(_MET[key](selection, words, path, image_id, blocks) for key in selection.given())


def _said(words: Row, key: str) -> CardValue | None:
    return next((words[name] for name in _COLUMNS[key] if name in words), None)


def _same(wanted: tuple[str, ...], *said: str) -> bool:
    """Names compared without case, '_' standing for a blank."""
    known = {_plain(text) for text in said}
    return any(_plain(text) in known for text in wanted)


def _plain(text: str) -> str:
    return " ".join(text.replace("_", " ").upper().split())


Blocks = Mapping[str, InstrumentBlock]


def _volume(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    return _same(selection.volume or (), str(words.get("VOLUME_ID", "")), *path.split("/")[:-1])


def _in_time(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    time = utc_of(str(_said(words, "start") or ""))
    first, last = (None if text is None else utc_of(text) for text in (selection.start, selection.stop))
    return time is not None and (first is None or time >= first) and (last is None or time <= last)


def _target(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    return _same(selection.target or (), str(_said(words, "target")))


def _filter(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    names = [name.strip() for name in str(_said(words, "filter") or "").split(",")]
    return _same(selection.filter or (), *names, "+".join(names))


def _camera(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    said = [str(words[name]) for name in _COLUMNS["camera"] if name in words]
    block = identify(words, blocks)
    if block is not None:
        said += [block.camera, *(name for name, candidate in blocks.items() if candidate is block)]
    return _same(selection.camera or (), *said)


def _number(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    said = re.sub(r"\D", "", str(words.get("IMAGE_NUMBER", "")))
    found = _NUMBER.search(image_id)
    number = int(said or (found[0] if found else -1))
    wanted = selection.image_numbers or ()
    return wanted[0] <= number <= wanted[1] if len(wanted) == 2 else number in wanted


def _size(selection: Selection, words: Row, path: str, image_id: str, blocks: Blocks) -> bool:
    size, limits = _said(words, "target_size_px"), selection.target_size_px
    return isinstance(size, int | float) and limits is not None and limits[0] <= size <= limits[1]


_MET = {
    "volume": _volume, "start": _in_time, "stop": _in_time, "target": _target, "filter": _filter, "camera": _camera,
    "image_numbers": _number, "target_size_px": _size,
}  # fmt: skip
