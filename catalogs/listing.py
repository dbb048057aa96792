"""The list of an archive's images: by their names, or by an index table; each with the files that belong to it."""

import os
import posixpath
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from fsspec.implementations.local import LocalFileSystem
from fsspec.utils import glob_translate

from catalogs.archive import SIDECAR_SUFFIX, Archive, ImageRef, IndexRef, filesystem, stem
from catalogs.images import labelled_file
from catalogs.index_tables import Row, pds4_product, read_collection, read_pds3_index
from catalogs.instruments import InstrumentBlock
from catalogs.selection import check_selection, columns_of, is_chosen
from catalogs.sidecar import sidecar_image_id
from pipeline.errors import ConfigurationError

# File names may have 255 bytes on every common file system; ending and temporary mark take 39 of them.
_LONGEST_ID = 200
_LABELS = (".lbl", ".xml")
# What a label of the same stem describes where it describes an image.
_PIXELS = (".img", ".imq", ".dat", ".fit", ".fits", ".fts", ".qub", ".cub", ".vic", ".raw")
# Columns that name a row's file: alone, or after the folder.
_FILE_COLUMNS = ("FILE_SPECIFICATION_NAME", "FILE_NAME")
_FOLDER_COLUMN = "PATH_NAME"
_IDENTITY = frozenset((*_FILE_COLUMNS, _FOLDER_COLUMN, "VOLUME_ID", "PRODUCT_ID"))


@dataclass(frozen=True)
class _Files:
    """Names of an archive's files, relative to its root and in order."""

    every: tuple[str, ...]

    @cached_property
    def known(self) -> frozenset[str]:
        """All names."""
        return frozenset(self.every)

    @cached_property
    def by_stem(self) -> Mapping[str, list[str]]:
        """Names by their stem in lower case."""
        found: dict[str, list[str]] = defaultdict(list)
        for path in self.every:
            found[stem(path).lower()].append(path)
        return found

    def siblings(self, path: str, endings: tuple[str, ...]) -> list[str]:
        """Other files of a stem that end in one of several ways, in either case."""
        near = self.by_stem.get(stem(path).lower(), [])
        return [other for other in near if other != path and other.lower().endswith(endings)]

    def spelt(self, path: str) -> str | None:
        """A name as the archive spells it: labels and indexes often differ from it in case."""
        if path in self.known:
            return path
        near = self.by_stem.get(stem(path).lower(), [])
        return next((other for other in near if other.lower() == path.lower()), None)


@dataclass(frozen=True)
class _Found:
    """An image before it has an id: its file, its label, and what the index says of it."""

    path: str
    exists: bool
    companions: tuple[str, ...] = ()
    row: Row = field(default_factory=dict)


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
        If nothing matches, a name cannot be inside the archive, two images share an id, or the index or the selection
        cannot be used.
    """
    images, select = archive.description.images, archive.description.select
    fs, root = filesystem(archive.url)
    # Some file systems list names with a leading slash below an empty root, some without.
    names = _walk(root or "/", frozenset()) if isinstance(fs, LocalFileSystem) else fs.find(root)
    files = _Files(tuple(sorted(path.removeprefix(root).lstrip("/") for path in names)))
    if isinstance(images, IndexRef):
        found = _by_index(archive, images.index, files, columns_of(select, blocks) | _IDENTITY)
    else:
        found = _by_name(archive, [images] if isinstance(images, str) else images, files)
    known = [(_image_id(entry, archive, files, blocks), entry) for entry in found]
    if select.given():
        # A collection's missing members have no row.
        columns = next((entry.row for entry in found if entry.row), {}) if isinstance(images, IndexRef) else None
        check_selection(select, columns, archive.url)
        known = [
            (name, entry) for name, entry in known if is_chosen(select, entry.row, entry.path, name, blocks)
        ]  # fmt: skip
        if not known:
            raise ConfigurationError(f"{archive.url}: select leaves none of {len(found)} images")
    refs = [ImageRef(name, entry.path, entry.exists, entry.companions) for name, entry in known]
    _refuse_ids(refs)
    return sorted(refs, key=lambda ref: ref.image_id)


def _by_name(archive: Archive, patterns: Sequence[str], files: _Files) -> list[_Found]:
    """Files that match patterns; an image and its label are one, whichever of them matches."""
    patterns = [_inside(pattern) for pattern in patterns]
    matched: dict[str, bool] = {}
    for pattern in patterns:
        if pattern in files.known or not any(c in pattern for c in "*?["):
            matched[pattern] = pattern in files.known
        else:
            matches = _matcher(pattern)
            matched.update({path: True for path in files.every if matches(path)})
    if not matched:
        raise ConfigurationError(f"{archive.url}: no file matches images: {', '.join(patterns)}")
    found = [_with_label(path, exists, archive, files) for path, exists in matched.items()]
    return list({entry.path: entry for entry in found}.values())


def _with_label(path: str, exists: bool, archive: Archive, files: _Files, row: Row | None = None) -> _Found:
    """Image that a path stands for: that of a label is what the label names."""
    if path.lower().endswith(_LABELS) and exists:
        pixels = _labelled(path, archive, files)
        if pixels is not None:
            return _Found(pixels, pixels in files.known, (path,), row or {})
    labels = tuple(files.siblings(path, _LABELS)) if not path.lower().endswith(_LABELS) else ()
    return _Found(path, exists, labels, row or {})


def _labelled(path: str, archive: Archive, files: _Files) -> str | None:
    """File that a label describes; it is opened only where its name does not say."""
    near = files.siblings(path, _PIXELS)
    if len(near) == 1:
        return near[0]
    try:
        named = labelled_file(archive.read(path))
    except OSError:
        # The image's own record will say that its label cannot be read.
        return None
    if named is None:
        return None
    beside = posixpath.join(posixpath.dirname(path), named)
    return files.spelt(beside) or beside


def _by_index(archive: Archive, index: str, files: _Files, columns: frozenset[str]) -> list[_Found]:
    """Images of an index table, whether their files are there or not."""
    path = files.spelt(_inside(index))
    if path is None:
        raise ConfigurationError(f"{archive.url}: images.index: {index} is not there")
    try:
        table = archive.read(path)
        if path.lower().endswith(".csv"):
            found = _collection(read_collection(table, path), archive, files)
        else:
            labels = files.siblings(path, (".lbl",))
            if not labels:
                raise ConfigurationError(f"{archive.url}: images.index: {path} has no label {stem(path)}.LBL beside it")
            rows = read_pds3_index(table, archive.read(labels[0]), path, columns)
            found = [_of_row(row, path, archive, files) for row in rows]
    except OSError as error:
        raise ConfigurationError(f"{archive.url}: images.index: {path}: {error.strerror or error}") from error
    if not found:
        raise ConfigurationError(f"{archive.url}: images.index: {path} lists no image")
    return list({entry.path: entry for entry in found}.values())


def _of_row(row: Row, index: str, archive: Archive, files: _Files) -> _Found:
    """Image of an index's row, looked for where volumes put it: below the folder above the index, or the volume."""
    file = next((str(row[key]) for key in _FILE_COLUMNS if str(row.get(key, "")).strip()), "")
    if not file:
        raise ConfigurationError(f"{index}: no column {' or '.join(_FILE_COLUMNS)} names the files")
    file = file.replace("\\", "/").lstrip("/")
    if "/" not in file and str(row.get(_FOLDER_COLUMN, "")).strip():
        file = posixpath.join(str(row[_FOLDER_COLUMN]).replace("\\", "/").strip("/"), file)
    above = posixpath.dirname(posixpath.dirname(index))
    volume = str(row.get("VOLUME_ID", "")).strip()
    places = (above, "", volume, posixpath.join(posixpath.dirname(above), volume))
    candidates = [posixpath.normpath(posixpath.join(place, file)) for place in dict.fromkeys(places)]
    there = next((found for path in candidates if (found := files.spelt(path)) is not None), None)
    return _with_label(there or _inside(candidates[0]), there is not None, archive, files, row)


def _collection(members: Sequence[str], archive: Archive, files: _Files) -> list[_Found]:
    """Images of a PDS4 collection: the archive's labels say which file is whose."""
    products: dict[str, tuple[str, Row]] = {}
    for path in files.every:
        if path.lower().endswith(".xml") and (product := pds4_product(archive.read(path))) is not None:
            products[product[0]] = (path, product[1])
    found = []
    for member in members:
        if member in products:
            path, row = products[member]
            found.append(_with_label(path, True, archive, files, row))
        else:
            # Browse images and documents of other archives stand in inventories too, but an id has to be an image's.
            found.append(_Found(f"{member.rpartition(':')[2]}.xml", False))
    return found


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


def _image_id(entry: _Found, archive: Archive, files: _Files, blocks: Mapping[str, InstrumentBlock]) -> str:
    """The sidecar's claim, else a product id that the file's name is, else the index's, else the relative path."""
    sidecar = stem(entry.path) + SIDECAR_SUFFIX
    if archive.description.geometry in ("auto", "sidecar") and sidecar in files.known:
        claimed = _claimed_id(archive, sidecar)
        if claimed is not None:
            return _safe(claimed)
    name = posixpath.basename(stem(entry.path))
    if any(b.product_id_pattern and re.fullmatch(b.product_id_pattern, name) for b in blocks.values()):
        return _safe(name)
    product = str(entry.row.get("PRODUCT_ID", "")).strip()
    if product:
        # Some archives call their products by the names of their files.
        return _safe(stem(product) if product.lower().endswith((*_PIXELS, *_LABELS)) else product)
    return _safe(stem(entry.path))


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
