"""SPICE kernels of an archive: which, whether they can be used, their digests, and loading them.

CSPICE keeps one pool per process and resolves relative names against the working directory; here they are resolved
against the meta-kernel's folder, so that an archive can be moved, and the files of a meta-kernel are loaded one by one.
"""

import contextlib
import hashlib
import json
import os
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import spiceypy
from spiceypy.utils.exceptions import NotFoundError, SpiceyError

from pipeline.errors import ConfigurationError

# Longest file name of CSPICE (keeper subsystem, FILSIZ).
_LONGEST_PATH = 255
_META = b"KERNELS_TO_LOAD"
_BEGIN_DATA = b"\\begindata"
# The words of a meta-kernel that furnish others; everything else in it is data of its own.
_META_WORDS = {"KERNELS_TO_LOAD", "PATH_VALUES", "PATH_SYMBOLS"}
_TOKEN = re.compile(r"'(?:[^'\n]|'')*'|\+=|[=(),]|[^\s=(),']+|'")
# Where a DAF's file record keeps the first free address and the binary format (NAIF's required reading on DAF).
_DAF_FREE, _DAF_FORMAT = 84, slice(88, 96)
_DOUBLE_BYTES = 8
_BYTE_ORDERS = {b"LTL-IEEE": "<i", b"BIG-IEEE": ">i"}
_DIGESTS = "kernels.json"


@dataclass(frozen=True)
class Kernel:
    """One kernel file.

    Attributes
    ----------
    name
        File name, without the folders of this machine.
    path
        Where it is.
    sha256
        Of its bytes.
    is_meta
        Whether it lists others, which follow it; only its own data are loaded.
    """

    name: str
    path: str
    sha256: str
    is_meta: bool = False


def check_kernels(root: str, listed: str | Sequence[str], folder: Path, verify: bool = False) -> tuple[Kernel, ...]:
    """Find an archive's kernels and make sure that all of them can be loaded.

    Parameters
    ----------
    root
        The archive's folder, local.
    listed
        Meta-kernels or kernels, relative to the root or absolute.
    folder
        Where digests are remembered.
    verify
        Read every kernel again instead of trusting size and modification time.

    Returns
    -------
    tuple of Kernel
        In the order of loading. They stay loaded in this process.

    Raises
    ------
    ConfigurationError
        One line that names the file and what is wrong with it.
    """
    entries = [listed] if isinstance(listed, str) else list(listed)
    if not entries or "://" in root or any("://" in entry for entry in entries):
        raise ConfigurationError(f"{root}: kernels: local files are needed, for CSPICE reads nothing else")
    digests = _Digests(folder, verify)
    kernels = [
        kernel for entry in entries for kernel in _kernels_of(os.path.join(os.path.abspath(root), entry), digests)
    ]
    digests.save()
    load(kernels)
    try:
        spiceypy.dtpool("DELTET/DELTA_AT")
    except NotFoundError as error:
        raise ConfigurationError(f"{root}: kernels: there is no leap seconds kernel (LSK) among them") from error
    return tuple(kernels)


def load(kernels: Sequence[Kernel]) -> None:
    """Load kernels into this process in place of whatever was loaded.

    Parameters
    ----------
    kernels
        In order: what comes later wins.

    Raises
    ------
    ConfigurationError
        If CSPICE refuses one.
    """
    spiceypy.kclear()
    for kernel in kernels:
        try:
            if kernel.is_meta:
                spiceypy.ldpool(kernel.path)
            else:
                spiceypy.furnsh(kernel.path)
        except SpiceyError as error:
            spiceypy.kclear()
            raise ConfigurationError(f"kernel {kernel.name}: {reason_of(error)}") from error


def reason_of(error: SpiceyError) -> str:
    """One line of a CSPICE error, without the paths that its long message may hold.

    Parameters
    ----------
    error
        From spiceypy.

    Returns
    -------
    str
        Short message, and its explanation where there is one.
    """
    parts = (" ".join(str(part or "").split()) for part in (error.short, error.explain))
    return ", ".join(part for part in parts if part) or type(error).__name__


def _kernels_of(path: str, digests: "_Digests") -> Iterator[Kernel]:
    """A kernel, or a meta-kernel and what it lists."""
    data = _head(path)
    name = os.path.basename(path)
    if data.startswith((b"DAF/", b"NAIF/DAF", b"DAS/")):
        _refuse_truncated(path, data)
        yield Kernel(name, path, digests.of(path))
        return
    text = _text(path)
    if _BEGIN_DATA not in text:
        raise ConfigurationError(f"kernel {name}: neither a text nor a binary SPICE kernel")
    if _META not in text:
        yield Kernel(name, path, digests.of(path))
        return
    words = parse_text_kernel(text, name)
    yield Kernel(name, path, digests.of(path), is_meta=True)
    for listed in _listed(words, name):
        inside = os.path.normpath(os.path.join(os.path.dirname(path), listed))
        for kernel in _kernels_of(inside, digests):
            if kernel.is_meta:
                raise ConfigurationError(f"meta-kernel {name} lists another one, {listed}, which SPICE does not allow")
            yield kernel


def _head(path: str) -> bytes:
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise ConfigurationError(f"kernel {path}: its path is longer than the {_LONGEST_PATH} bytes that CSPICE takes")
    try:
        with open(path, "rb") as file:
            return file.read(1024)
    except FileNotFoundError as error:
        raise ConfigurationError(f"kernel {path} is not there") from error
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"kernel {path} cannot be read: {error}") from error


def _text(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


def _refuse_truncated(path: str, head: bytes) -> None:
    """CSPICE notices a cut file only when it comes to read behind the end."""
    order = _BYTE_ORDERS.get(head[_DAF_FORMAT])
    if order is None or not head.startswith(b"DAF/"):
        return
    (free,) = struct.unpack_from(order, head, _DAF_FREE)
    if os.path.getsize(path) < (free - 1) * _DOUBLE_BYTES:
        raise ConfigurationError(f"kernel {os.path.basename(path)} is truncated")


def parse_text_kernel(text: bytes, name: str) -> dict[str, list[str]]:
    """Assignments of a text kernel, values as text without their quotes.

    Parameters
    ----------
    text
        The file's bytes.
    name
        For messages.

    Returns
    -------
    dict
        Values by variable; ``+=`` appends.

    Raises
    ------
    ConfigurationError
        If the text is not ``NAME = values``.
    """
    tokens = [token for token in _tokens(text) if token != ","]
    words: dict[str, list[str]] = {}
    at = 0
    while at < len(tokens):
        word, sign = tokens[at], tokens[at + 1] if at + 1 < len(tokens) else ""
        if sign not in ("=", "+=") or not re.match(r"[^'()=]", word):
            raise ConfigurationError(f"kernel {name}: {word[:40]} is followed by no value")
        values, at = _values(tokens, at + 2, name)
        words[word] = [*words.get(word, []), *values] if sign == "+=" else values
    return words


def _tokens(text: bytes) -> Iterator[str]:
    """Tokens of the data blocks; the marks stand alone on their lines."""
    inside = False
    for line in text.decode("latin-1").splitlines():
        mark = line.strip()
        if mark in (r"\begindata", r"\begintext"):
            inside = mark == r"\begindata"
        elif inside:
            yield from _TOKEN.findall(line)


def _values(tokens: Sequence[str], at: int, name: str) -> tuple[list[str], int]:
    """Values from a place on, one or a parenthesised list, and the place behind them."""
    if at < len(tokens) and tokens[at] == "(":
        try:
            end = tokens.index(")", at)
        except ValueError as error:
            raise ConfigurationError(f"kernel {name}: a parenthesis is not closed") from error
        values, at = tokens[at + 1 : end], end + 1
    else:
        values, at = tokens[at : at + 1], at + 1
    if not values or any(value in ("'", "(", ")", "=", "+=") for value in values):
        raise ConfigurationError(f"kernel {name}: a value is missing or a quotation mark is not closed")
    return [value[1:-1].replace("''", "'") if value.startswith("'") else value for value in values], at


def _listed(words: dict[str, list[str]], name: str) -> list[str]:
    """Files of a meta-kernel: pieces ending in '+' joined to the next, path symbols replaced."""
    symbols, values = _joined(words.get("PATH_SYMBOLS", [])), _joined(words.get("PATH_VALUES", []))
    if len(symbols) != len(values):
        raise ConfigurationError(f"meta-kernel {name}: {len(symbols)} PATH_SYMBOLS for {len(values)} PATH_VALUES")
    # Longest first: $MK must not take the beginning of $MKS.
    pairs = sorted(zip(symbols, values, strict=True), key=lambda pair: -len(pair[0]))
    files = []
    for file in _joined(words.get("KERNELS_TO_LOAD", [])):
        for symbol, value in pairs:
            file = file.replace(f"${symbol}", value)
        if "$" in file:
            raise ConfigurationError(f"meta-kernel {name}: {file} has a symbol that PATH_SYMBOLS does not name")
        files.append(file)
    return files


def _joined(pieces: Sequence[str]) -> list[str]:
    joined: list[str] = []
    open_end = False
    for piece in (piece.rstrip() for piece in pieces):
        text = piece.removesuffix("+")
        joined[-1:] = [joined[-1] + text] if open_end else [*joined[-1:], text]
        open_end = piece.endswith("+")
    return joined


class _Digests:
    """sha256 of files, remembered by path, size and modification time: a mission's kernels are gigabytes."""

    def __init__(self, folder: Path, verify: bool) -> None:
        self._path = folder / _DIGESTS
        self._known: dict[str, list[object]] = {}
        self._changed = False
        if not verify:
            with contextlib.suppress(OSError, ValueError):
                content = json.loads(self._path.read_bytes())
                self._known = content if isinstance(content, dict) else {}

    def of(self, path: str) -> str:
        """Digest of a file."""
        status = os.stat(path)
        entry = self._known.get(path)
        if isinstance(entry, list) and entry[:2] == [status.st_size, status.st_mtime_ns] and isinstance(entry[-1], str):
            return entry[-1]
        with open(path, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        self._known[path] = [status.st_size, status.st_mtime_ns, sha256]
        self._changed = True
        return sha256

    def save(self) -> None:
        """Remember what was read; where nothing can be written, the next run reads again."""
        if not self._changed:
            return
        temporary = self._path.with_name(f".{_DIGESTS}.{uuid4().hex}")
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps(self._known), encoding="utf-8")
            os.replace(temporary, self._path)
