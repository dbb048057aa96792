"""An archive: its description, and the list of its images."""

import os
import posixpath
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import fsspec
import yaml
from fsspec.implementations.local import LocalFileSystem
from fsspec.spec import AbstractFileSystem
from fsspec.utils import glob_translate
from pydantic import Field, ValidationError

from catalogs.bodies import BodyBlock
from catalogs.geometry import first_problem
from catalogs.instruments import InstrumentBlock
from catalogs.sidecar import sidecar_image_id
from pipeline.errors import ConfigurationError
from pipeline.options import Options

DESCRIPTION = "archive.yaml"
SIDECAR_SUFFIX = ".geometry.json"
STARS_SUFFIX = ".stars.parquet"
_OVERRIDE = "--set archive."
# File names may have 255 bytes on every common file system; ending and temporary mark take 39 of them.
_LONGEST_ID = 200


class StarTableRef(Options):
    """A star table of the archive's own."""

    path: str = Field(min_length=1, description="Parquet, CSV or FITS, relative to the archive's root, or a URL")
    place: Literal["mean", "apparent"] = Field("mean", description="catalogue place, or place as seen")


class ArchiveDescription(Options):
    """Content of ``archive.yaml``; the command line can say the same with ``--set archive.KEY=VALUE``."""

    name: str = "archive"
    images: str | list[str] = Field(min_length=1, description="glob relative to the root, or a list of globs and paths")
    geometry: Literal["auto", "header", "sidecar"] = Field("auto", description="auto: a sidecar where there is one")
    instrument: str | None = Field(None, description="a camera block; by default the header is recognised")
    stars: str | list[str | StarTableRef] = Field("per-image", description="built-in names, tables, or per-image")
    settings: dict[str, object] = Field(default_factory=dict, description="instrument settings that win")
    bodies: dict[str, BodyBlock] = Field(
        default_factory=dict, description="what this archive knows of bodies, by name; wins key by key"
    )


@dataclass(frozen=True)
class ImageRef:
    """One image to be navigated.

    Attributes
    ----------
    image_id
        Unique in the archive.
    path
        Relative to the archive's root, '/'-separated.
    exists
        False for a listed file that is not there.
    """

    image_id: str
    path: str
    exists: bool = True


@dataclass(frozen=True)
class Archive:
    """An opened archive.

    Attributes
    ----------
    url
        Root, as given (path or fsspec URL).
    description
        What it says of itself.
    """

    url: str
    description: ArchiveDescription

    def read(self, path: str) -> bytes:
        """Bytes of a file, by its path relative to the root.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return read_bytes(self.url, path)


def _filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    fs, root = fsspec.core.url_to_fs(url)
    return fs, root.rstrip("/")


def _locate(url: str, path: str) -> tuple[AbstractFileSystem, str]:
    """File system and full name of a file; joining URLs as text would break chained ones (``zip://::a.zip``)."""
    if "://" in path:
        return _filesystem(path)
    fs, root = _filesystem(url)
    return fs, f"{root}/{path}"


def read_bytes(url: str, path: str) -> bytes:
    """Bytes of a file of an archive.

    Parameters
    ----------
    url
        Archive root.
    path
        Relative to it, or a URL of its own.

    Returns
    -------
    bytes
        The file.
    """
    if "://" not in url and "://" not in path:
        with open(posixpath.join(url, path), "rb") as file:
            return file.read()
    fs, full = _locate(url, path)
    try:
        return bytes(fs.cat_file(full))
    except KeyError as error:
        # What a zip file says of a name that it does not hold.
        raise FileNotFoundError(path) from error


def file_stamp(url: str, path: str) -> tuple[int, str] | None:
    """Size and modification mark of a file, which stand in for a digest already known.

    Parameters
    ----------
    url
        Archive root.
    path
        Relative to it.

    Returns
    -------
    tuple or None
        Size in bytes; modification time or ETag as text. None where there is no such file.
    """
    fs, full = _locate(url, path)
    try:
        if isinstance(fs, LocalFileSystem):
            # fsspec tells a link's own time, not that of the file behind it.
            status = os.stat(full)
            return status.st_size, str(status.st_mtime_ns)
        info = fs.info(full)
    except (FileNotFoundError, NotADirectoryError):
        return None
    mark = next(
        (info[key] for key in ("ETag", "etag", "mtime", "last_modified", "LastModified", "created") if info.get(key)),
        "",
    )
    return int(info.get("size") or 0), str(mark)


def open_archive(url: str, overrides: Mapping[str, object]) -> Archive:
    """Read an archive's description.

    Parameters
    ----------
    url
        Folder (local or fsspec URL), or the path of its ``archive.yaml``.
    overrides
        Keys of the description that replace what the file says.

    Returns
    -------
    Archive
        Description checked; nothing listed yet.

    Raises
    ------
    ConfigurationError
        If there is nothing there, or the description is not valid.
    """
    if url.endswith((".yaml", ".yml")):
        url, name = posixpath.split(url)
        url = url or "."
    else:
        name = DESCRIPTION
    try:
        text = _description_text(url, name)
    except (OSError, ValueError, ImportError, zipfile.BadZipFile) as error:
        raise ConfigurationError(f"archive {url}: {error}") from error
    try:
        content = None if text is None else yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{url}/{name} is not YAML: {' '.join(str(error).split())}") from error
    if text is None and "images" not in overrides:
        raise ConfigurationError(f"{url} has no {name}; write one, or say {_OVERRIDE}images='*.fits'")
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise ConfigurationError(f"{url}/{name} must hold keys and values, images: at least")
    return Archive(url, _description(content, overrides, f"{url}/{name}"))


def _description_text(url: str, name: str) -> bytes | None:
    """Bytes of the description, None where a folder has none."""
    fs, full = _locate(url, name)
    if fs.exists(full):
        return bytes(fs.cat_file(full))
    if not fs.isdir(posixpath.dirname(full)):
        raise NotADirectoryError("there is no such folder")
    return None


def _description(content: dict[object, object], overrides: Mapping[str, object], source: str) -> ArchiveDescription:
    try:
        return ArchiveDescription.model_validate({**{str(key): content[key] for key in content}, **overrides})
    except ValidationError as error:
        key = str(error.errors(include_url=False)[0]["loc"][0])
        source = f"{_OVERRIDE}{key}" if key in overrides else source
        allowed = ", ".join(ArchiveDescription.model_fields)
        raise ConfigurationError(f"{source}: {first_problem(error)} (keys: {allowed})") from error


def list_images(archive: Archive, blocks: Mapping[str, InstrumentBlock]) -> list[ImageRef]:
    """Images of an archive in the order of their ids.

    Parameters
    ----------
    archive
        The archive.
    blocks
        Camera blocks, which know what a product id looks like.

    Returns
    -------
    list of ImageRef
        Sorted by image id.

    Raises
    ------
    ConfigurationError
        If nothing matches, a name cannot be inside the archive, or two images share an id.
    """
    patterns = archive.description.images
    patterns = [_inside(pattern) for pattern in ([patterns] if isinstance(patterns, str) else patterns)]
    fs, root = _filesystem(archive.url)
    # Some file systems list names with a leading slash below an empty root, some without.
    files = _walk(root or "/", frozenset()) if isinstance(fs, LocalFileSystem) else fs.find(root)
    every = sorted(path.removeprefix(root).lstrip("/") for path in files)
    known = set(every)
    found: dict[str, bool] = {}
    for pattern in patterns:
        if pattern in known or not any(c in pattern for c in "*?["):
            found[pattern] = pattern in known
        else:
            matches = _matcher(pattern)
            found.update({path: True for path in every if matches(path)})
    if not found:
        raise ConfigurationError(f"{archive.url}: no file matches images: {', '.join(patterns)}")
    refs = [ImageRef(_image_id(path, archive, known, blocks), path, exists) for path, exists in found.items()]
    _refuse_ids(refs)
    return sorted(refs, key=lambda ref: ref.image_id)


def _walk(folder: str, above: frozenset[str]) -> Iterator[str]:
    """Files of a local folder; linked folders are entered, which fsspec does not do, but no circle is."""
    real = os.path.realpath(folder)
    if real in above:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _walk(entry.path, above | {real})
            else:
                yield entry.path


def _inside(pattern: str) -> str:
    """Pattern in its shortest form, refused where it cannot name files of the archive."""
    short = posixpath.normpath(pattern)
    if not pattern or "://" in pattern or short in (".", "..") or short.startswith(("/", "../")) or "\0" in pattern:
        raise ConfigurationError(f"images: {pattern!r} is no path inside the archive")
    return short


def _matcher(pattern: str) -> Callable[[str], object]:
    """Shell pattern where ``*`` stays inside a folder and ``**`` does not."""
    try:
        return re.compile(glob_translate(pattern)).match
    except (ValueError, re.error) as error:
        raise ConfigurationError(f"images: {pattern!r} is no pattern: {error}") from error


def stem(path: str) -> str:
    """Path without the ending of its file name.

    Parameters
    ----------
    path
        '/'-separated.

    Returns
    -------
    str
        For example ``frames/a`` for ``frames/a.fits``.
    """
    return posixpath.splitext(path)[0]


def _image_id(path: str, archive: Archive, known: set[str], blocks: Mapping[str, InstrumentBlock]) -> str:
    """The sidecar's claim, else a product id that the file's name is, else the relative path."""
    sidecar = stem(path) + SIDECAR_SUFFIX
    if archive.description.geometry != "header" and sidecar in known:
        claimed = _claimed_id(archive, sidecar)
        if claimed is not None:
            return _safe(claimed)
    name = posixpath.basename(stem(path))
    if any(b.product_id_pattern and re.fullmatch(b.product_id_pattern, name) for b in blocks.values()):
        return _safe(name)
    return _safe(stem(path))


def _claimed_id(archive: Archive, sidecar: str) -> str | None:
    try:
        return sidecar_image_id(archive.read(sidecar))
    except OSError:
        # The image's own record will say that its sidecar cannot be read.
        return None


def _safe(text: str) -> str:
    """Id that is a file name everywhere."""
    return re.sub(r"[^\w.+=-]", "_", text.replace("/", "__"))


def _refuse_ids(refs: Sequence[ImageRef]) -> None:
    """Ids name files: they must be short enough, and differ."""
    long = next((ref for ref in refs if len(ref.image_id.encode()) > _LONGEST_ID), None)
    if long is not None:
        raise ConfigurationError(f"{long.path}: its image id is longer than {_LONGEST_ID} bytes: {long.image_id}")
    # Some file systems cannot tell ids apart that differ in case only.
    counts = Counter(ref.image_id.lower() for ref in refs)
    shared = [ref for ref in refs if counts[ref.image_id.lower()] > 1]
    if shared:
        a, b = sorted(shared, key=lambda ref: (ref.image_id.lower(), ref.path))[:2]
        raise ConfigurationError(f"{a.path} and {b.path} share the image id {a.image_id}")
