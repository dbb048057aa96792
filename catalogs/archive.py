"""An archive: its description, and the bytes of its files."""

import os
import posixpath
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import fsspec
import yaml
from fsspec.implementations.local import LocalFileSystem
from fsspec.spec import AbstractFileSystem
from pydantic import Field, ValidationError

from catalogs.bodies import BodyBlock
from catalogs.geometry import first_problem
from catalogs.selection import Selection
from pipeline.errors import ConfigurationError
from pipeline.options import Options

DESCRIPTION = "archive.yaml"
SIDECAR_SUFFIX = ".geometry.json"
STARS_SUFFIX = ".stars.parquet"
_OVERRIDE = "--set archive."


class StarTableRef(Options):
    """A star table of the archive's own."""

    path: str = Field(min_length=1, description="Parquet, CSV or FITS, relative to the archive's root, or a URL")
    place: Literal["mean", "apparent"] = Field("mean", description="catalogue place, or place as seen")


class IndexRef(Options):
    """Images by a table of the archive instead of by their names."""

    index: str = Field(min_length=1, description="INDEX.TAB with its label beside it, or a PDS4 collection .csv")


class ArchiveDescription(Options):
    """Content of ``archive.yaml``; the command line can say the same with ``--set archive.KEY=VALUE``."""

    name: str = "archive"
    images: Annotated[str, Field(min_length=1)] | Annotated[list[str], Field(min_length=1)] | IndexRef = Field(
        description="glob relative to the root, a list of globs and paths, or an index table"
    )
    select: Selection = Field(default=Selection(), description="which of the images are wanted")
    geometry: Literal["auto", "header", "sidecar", "spice"] = Field(
        "auto", description="auto: a sidecar where there is one, else kernels where there are any, else the header"
    )
    kernels: str | list[str] = Field(
        default_factory=list, description="SPICE meta-kernels or kernels, relative to the root, local files only"
    )
    instrument: str | None = Field(None, description="a camera block; by default the header is recognised")
    stars: str | list[str | StarTableRef] = Field("per-image", description="built-in names, tables, or per-image")
    settings: dict[str, object] = Field(default_factory=dict, description="instrument settings that win")
    rings: str | None = Field(
        None, min_length=1, description="ring catalogue (YAML), relative to the root; wins for its planet"
    )
    maplets: dict[str, str] = Field(
        default_factory=dict, description="maplet catalogues by body, folders relative to the root, local files only"
    )
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
    companions
        Paths of files that belong to it: its detached label.
    """

    image_id: str
    path: str
    exists: bool = True
    companions: tuple[str, ...] = ()


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


def filesystem(url: str) -> tuple[AbstractFileSystem, str]:
    """File system of an archive, and its root in it without a slash at the end.

    Parameters
    ----------
    url
        Path or fsspec URL.

    Returns
    -------
    tuple
        As named.
    """
    fs, root = fsspec.core.url_to_fs(url)
    return fs, root.rstrip("/")


def _locate(url: str, path: str) -> tuple[AbstractFileSystem, str]:
    """File system and full name of a file; joining URLs as text would break chained ones (``zip://::a.zip``)."""
    if "://" in path:
        return filesystem(path)
    fs, root = filesystem(url)
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
    keys: dict[str, object] = {str(key): content[key] for key in content}
    chosen, wanted = keys.get("select"), overrides.get("select")
    if isinstance(chosen, dict) and isinstance(wanted, dict):
        # A selection on the command line narrows, or replaces key by key, that of the file.
        overrides = {**overrides, "select": {**chosen, **wanted}}
    try:
        return ArchiveDescription.model_validate({**keys, **overrides})
    except ValidationError as error:
        key = str(error.errors(include_url=False)[0]["loc"][0])
        source = f"{_OVERRIDE}{key}" if key in overrides else source
        allowed = ", ".join(ArchiveDescription.model_fields)
        raise ConfigurationError(f"{source}: {first_problem(error)} (keys: {allowed})") from error


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
