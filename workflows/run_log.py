"""The log of a run: one JSON object per line in its folder, every start appended; and the same lines for a terminal.

Clocks stand here and in ``timings`` only, never in a result.
"""

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from pipeline.json_values import Json

LOG = logging.getLogger("pilotage")
FILE = "log.jsonl"
_FIELDS = "pilotage_fields"
_OURS = ("pilotage", "pipeline", "catalogs", "workflows")
# What a terminal shows in its own way.
_TOLD = ("start", "workers", "image", "end", "interrupted")
# A library that complains at every pixel must not fill the disk.
_MOST_LINES = 50
_LONGEST_LINE = 2000


class LogFormat(StrEnum):
    """How a terminal is told."""

    TEXT = "text"
    JSON = "json"


@dataclass(frozen=True)
class Line:
    """What was logged while an image was worked on, maybe in another process.

    Attributes
    ----------
    level
        Of :mod:`logging`.
    logger
        Name of who said it.
    text
        The message.
    """

    level: int
    logger: str
    text: str


def _wanted(record: logging.LogRecord) -> bool:
    """Ours from INFO on, others' warnings."""
    ours = record.name.split(".")[0] in _OURS
    return record.levelno >= (logging.INFO if ours else logging.WARNING)


class _Keeper(logging.Handler):
    """Keeps the first lines, cut to a bearable length."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[Line] = []

    def emit(self, record: logging.LogRecord) -> None:
        if len(self.lines) < _MOST_LINES:
            self.lines.append(Line(record.levelno, record.name, record.getMessage()[:_LONGEST_LINE]))


@contextmanager
def _attached(handler: logging.Handler) -> Iterator[None]:
    """Lead what is wanted to a handler while the context lasts."""
    root, level = logging.getLogger(), LOG.level
    handler.addFilter(_wanted)
    root.addHandler(handler)
    LOG.setLevel(min(LOG.getEffectiveLevel(), logging.INFO))
    try:
        yield
    finally:
        LOG.setLevel(level)
        root.removeHandler(handler)
        handler.close()


@contextmanager
def kept_lines() -> Iterator[list[Line]]:
    """Keep what this process logs: ours from INFO on, others' warnings.

    Yields
    ------
    list of Line
        Grows while the context lasts.
    """
    keeper = _Keeper()
    with _attached(keeper):
        yield keeper.lines


class JsonLines(logging.Formatter):
    """One JSON object per record: ``emitted_at`` (UTC), ``level``, ``event``, ``message`` and the event's own keys."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without its end."""
        fields: dict[str, Json] = {"event": "message", **getattr(record, _FIELDS, {})}
        emitted = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line = {"emitted_at": emitted, "level": record.levelname, **fields, "message": record.getMessage()}
        return json.dumps(line, ensure_ascii=False, default=str)


class _File(logging.FileHandler):
    """Appends JSON lines; trouble with the disk is raised."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, mode="a", encoding="utf-8")
        self.setFormatter(JsonLines())

    def handleError(self, record: logging.LogRecord) -> None:
        """A full disk stops a run, here as everywhere."""
        error = sys.exc_info()[1]
        if isinstance(error, OSError):
            raise error
        super().handleError(record)


def _end_last_line(path: Path) -> None:
    """Where a killed process left a line without its end, end it."""
    with path.open("ab+") as file:
        if file.tell() > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")


@contextmanager
def logged_to(folder: Path) -> Iterator[None]:
    """Append all that is logged to a run's file while the context lasts.

    Parameters
    ----------
    folder
        Of the run, existing.
    """
    _end_last_line(folder / FILE)
    with _attached(_File(folder / FILE)):
        yield


@contextmanager
def terminal(form: LogFormat, verbose: bool) -> Iterator[None]:
    """Show on the error stream what is logged while the context lasts.

    Parameters
    ----------
    form
        As JSON lines everything; as text what no progress bar tells.
    verbose
        Whether text begins at INFO and not at WARNING.
    """
    handler = logging.StreamHandler(sys.stderr)
    if form is LogFormat.JSON:
        handler.setFormatter(JsonLines())
    else:
        handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
        handler.setLevel(logging.INFO if verbose else logging.WARNING)
        handler.addFilter(lambda record: getattr(record, _FIELDS, {}).get("event") not in _TOLD)
    with _attached(handler):
        yield


def say(event: str, message: str, level: int = logging.INFO, **fields: Json) -> None:
    """Log an event with values of its own.

    Parameters
    ----------
    event
        Its kind: ``start``, ``workers``, ``image``, ``line``, ``end``, ``interrupted``.
    message
        For a person.
    level
        Of :mod:`logging`.
    fields
        For a program.
    """
    LOG.log(level, "%s", message, extra={_FIELDS: {"event": event, **fields}})


def read_log(folder: Path) -> list[dict[str, Json]]:
    """Lines of a run's log, oldest first; one that a kill cut short is left out.

    Parameters
    ----------
    folder
        Of the run.

    Returns
    -------
    list of dict
        None of them where there is no log.
    """
    path = folder / FILE
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    found = []
    for text in lines:
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if isinstance(line, dict):
            found.append(line)
    return found
