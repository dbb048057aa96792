"""An archive: its description, and the list of its images."""

import fnmatch
import posixpath
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import fsspec
import yaml
from fsspec.spec import AbstractFileSystem
from pydantic import Field, ValidationError

from catalogs.geometry import first_problem, sidecar_image_id
from catalogs.instruments import InstrumentBlock
from pipeline.errors import ConfigurationError
from pipeline.options import Options

DESCRIPTION = "archive.yaml"
SIDECAR_SUFFIX = ".geometry.json"
STARS_SUFFIX = ".stars.parquet"


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
    fs, root = _filesystem(path if "://" in path else posixpath.join(url, path))
    return bytes(fs.cat_file(root))


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
    fs, full = _filesystem(posixpath.join(url, path))
    try:
        info = fs.info(full)
    except FileNotFoundError:
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
        fs, root = _filesystem(url)
        content = yaml.safe_load(fs.cat_file(f"{root}/{name}")) if fs.exists(f"{root}/{name}") else None
        is_folder = fs.isdir(root)
    except (ValueError, ImportError) as error:
        raise ConfigurationError(f"archive {url}: {error}") from error
    except yaml.YAMLError as error:
        text = " ".join(str(error).split())
        raise ConfigurationError(f"{url}/{name} is not YAML: {text}") from error
    if content is None:
        if not is_folder:
            raise ConfigurationError(f"archive {url} is not a folder")
        if "images" not in overrides:
            raise ConfigurationError(f"{url} has no {name}; write one, or say --set archive.images='*.fits'")
        content = {}
    if not isinstance(content, dict):
        raise ConfigurationError(f"{url}/{name} must hold keys and values, images: at least")
    return Archive(url, _description({**content, **overrides}, f"{url}/{name}"))


def _description(content: dict[str, object], source: str) -> ArchiveDescription:
    try:
        return ArchiveDescription.model_validate(content)
    except ValidationError as error:
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
        If nothing matches, or two images share an id.
    """
    patterns = archive.description.images
    patterns = [patterns] if isinstance(patterns, str) else patterns
    fs, root = _filesystem(archive.url)
    every = sorted(path[len(root) + 1 :] for path in fs.find(root))
    known = set(every)
    found: dict[str, bool] = {}
    for pattern in patterns:
        if any(c in pattern for c in "*?["):
            matched = [path for path in every if _matches(path, pattern)]
            found.update(dict.fromkeys(matched, True))
        else:
            found[posixpath.normpath(pattern)] = posixpath.normpath(pattern) in known
    if not found:
        raise ConfigurationError(f"{archive.url}: no file matches images: {', '.join(patterns)}")
    refs = [ImageRef(_image_id(path, archive, known, blocks), path, exists) for path, exists in found.items()]
    _refuse_collisions(refs)
    return sorted(refs, key=lambda ref: ref.image_id)


def _matches(path: str, pattern: str) -> bool:
    """Shell pattern where ``*`` stays inside a folder and ``**`` does not."""
    if "**" in pattern:
        expression = re.escape(pattern).replace(r"\*\*/", "(?:.*/)?").replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
        return re.fullmatch(expression.replace(r"\?", "[^/]"), path) is not None
    return path.count("/") == pattern.count("/") and fnmatch.fnmatchcase(path, pattern)


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
        claimed = sidecar_image_id(archive.read(sidecar))
        if claimed is not None:
            return _safe(claimed)
    name = posixpath.basename(stem(path))
    if any(b.product_id_pattern and re.fullmatch(b.product_id_pattern, name) for b in blocks.values()):
        return name
    return _safe(stem(path))


def _safe(text: str) -> str:
    """Id that is a file name everywhere."""
    return re.sub(r"[^\w.+=-]", "_", text.replace("/", "__"))


def _refuse_collisions(refs: Sequence[ImageRef]) -> None:
    # Some file systems cannot tell ids apart that differ in case only.
    counts = Counter(ref.image_id.lower() for ref in refs)
    shared = [ref for ref in refs if counts[ref.image_id.lower()] > 1]
    if shared:
        a, b = sorted(shared, key=lambda ref: (ref.image_id.lower(), ref.path))[:2]
        raise ConfigurationError(f"{a.path} and {b.path} share the image id {a.image_id}")
