"""Summary pictures of a run's images, kept in ``RUN/pictures``."""

import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from posixpath import basename, dirname

import numpy as np

from catalogs.archive import SIDECAR_SUFFIX, STARS_SUFFIX, Archive
from catalogs.images import read_image
from catalogs.ring_catalog import RingCatalog
from pipeline.errors import ConfigurationError, ImageError, PilotageError
from pipeline.json_values import Json
from pipeline.status import StatusReason
from workflows.picture import draw_image
from workflows.picture_marks import RingLine
from workflows.picture_rings import expected_edges
from workflows.plan import open_rings
from workflows.store import RunFolder, read_json, write_atomically

_LOG = logging.getLogger("pilotage")


def chosen(folder: RunFolder, image_ids: Sequence[str], which: str) -> list[str]:
    """Images of which pictures are wanted.

    Parameters
    ----------
    folder
        The run.
    image_ids
        All of its images.
    which
        ``all``, ``failed`` (all without an answer), ``sample:N`` (evenly over the sorted ids) or ``none``.

    Returns
    -------
    list of str
        Sorted ids.

    Raises
    ------
    ConfigurationError
        If it is none of these.
    """
    ids = sorted(image_ids)
    count = which.removeprefix("sample:")
    if which == "none":
        return []
    if which == "all":
        return ids
    if which == "failed":
        documents = {image_id: read_json(folder.document(image_id)) for image_id in ids}
        return [image_id for image_id, said in documents.items() if said is not None and said["status"] != "success"]
    if which.startswith("sample:") and count.isdecimal() and int(count) > 0:
        return [ids[k] for k in np.unique(np.linspace(0, len(ids) - 1, int(count)).astype(int))] if ids else []
    raise ConfigurationError(f"pictures: {which!r} is none of all, failed, sample:N, none")


class RingSource:
    """Ring catalogues of an archive, read when a picture first needs them.

    Parameters
    ----------
    archive
        The archive.
    """

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    @cached_property
    def _catalogs(self) -> tuple[RingCatalog, ...]:
        try:
            return open_rings(self._archive)
        except ConfigurationError as error:
            # The picture is worth having without them.
            _LOG.warning("pictures show no predicted rings: %s", error)
            return ()

    def expected(self, document: dict[str, Json]) -> list[RingLine]:
        """Edges as predicted, where the document holds none that were found."""
        if document["ring_edges"] is not None or not document["rings"]:
            return []
        return expected_edges(document, self._catalogs)


def draw(archive: Archive, folder: RunFolder, document: dict[str, Json], rings: RingSource) -> bytes:
    """Picture of one image.

    Parameters
    ----------
    archive
        Where the image is.
    folder
        The run, whose marks tell which files belong to the image.
    document
        Of the image.
    rings
        Of the same archive.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    ImageError
        If the image cannot be read.
    """
    path = str(document["provenance"]["image_path"])  # type: ignore[call-overload, index]
    try:
        beside = {basename(name): archive.read(name) for name in _beside(folder, str(document["image_id"]), path)}
        data = archive.read(path)
    except OSError as error:
        detail = f"{path}: {error.strerror or type(error).__name__}"
        raise ImageError(StatusReason.IMAGE_UNREADABLE, detail) from error
    return draw_image(read_image(data, path, beside).pixels, document, rings.expected(document))


def _beside(folder: RunFolder, image_id: str, path: str) -> list[str]:
    """Files that make one image together with a path: a detached label, or the pixels of a label."""
    mark = read_json(folder.mark(image_id))
    inputs = mark.get("inputs") if mark else None
    others = (SIDECAR_SUFFIX, STARS_SUFFIX)
    return [
        name for name, entry in (inputs.items() if isinstance(inputs, dict) else ())
        if name != path and dirname(name) == dirname(path) and not name.endswith(others)
        and isinstance(entry, dict) and entry["sha256"] is not None
    ]  # fmt: skip


def draw_all(archive: Archive, folder: RunFolder, image_ids: Sequence[str]) -> list[Path]:
    """Draw pictures that are missing or older than their image's document.

    Parameters
    ----------
    archive
        Where the images are.
    folder
        The run.
    image_ids
        Which.

    Returns
    -------
    list of pathlib.Path
        All pictures; one that cannot be drawn is a warning, never the end of a run.
    """
    place = folder.root / "pictures"
    place.mkdir(exist_ok=True)
    drawn, rings = [], RingSource(archive)
    for image_id in image_ids:
        target, source = place / f"{image_id}.png", folder.document(image_id)
        if not (target.exists() and target.stat().st_mtime_ns >= source.stat().st_mtime_ns):
            document = read_json(source)
            if document is None:
                continue
            try:
                write_atomically(target, draw(archive, folder, document, rings))
            except PilotageError as error:
                _LOG.warning("no picture of %s: %s", image_id, error)
                continue
        drawn.append(target)
    return drawn
