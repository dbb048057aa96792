"""What is to be done: images, their inputs, and which of them an earlier run has already answered."""

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

from pydantic import ValidationError

from catalogs.archive import (
    SIDECAR_SUFFIX,
    STARS_SUFFIX,
    Archive,
    ImageRef,
    StarTableRef,
    file_stamp,
    stem,
)
from catalogs.bodies import BodyBlock, merged_blocks
from catalogs.geometry import first_problem
from catalogs.kernels import Kernel, check_kernels
from catalogs.listing import list_images
from catalogs.ring_catalog import RingCatalog, built_in_rings, parse_rings
from catalogs.spice import focal_length_notes
from catalogs.star_sources import TableProblem, read_table
from catalogs.stars import BUILT_IN_NAMES, StarIndex, added_index, build_index, built_in_index, cache_folder, open_index
from pipeline.errors import ConfigurationError
from pipeline.json_values import Json
from pipeline.options import InstrumentSettings
from workflows.config import Configuration
from workflows.maplet_sources import MapletFolder, find_maplets
from workflows.store import RunFolder, read_json

PER_IMAGE = "per-image"
_LOG = logging.getLogger("pilotage")


@dataclass(frozen=True)
class Setup:
    """What every worker needs, small enough to be sent to it.

    Attributes
    ----------
    archive
        Root and description.
    configuration
        All options.
    star_indexes
        Paths of memory-mapped catalogues.
    star_digests
        (name, sha256) of each.
    per_image_stars
        Whether images bring star tables of their own.
    run_folder
        Output.
    software
        Version and digest of the code.
    kernels
        SPICE kernels in the order of loading.
    rings
        Ring catalogues, the archive's own last.
    maplets
        Maplet catalogues.
    """

    archive: Archive
    configuration: Configuration
    star_indexes: tuple[Path, ...]
    star_digests: tuple[tuple[str, str], ...]
    per_image_stars: bool
    run_folder: RunFolder
    software: str
    kernels: tuple[Kernel, ...] = ()
    rings: tuple[RingCatalog, ...] = ()
    maplets: tuple[MapletFolder, ...] = ()

    def inputs_of(self, ref: ImageRef) -> tuple[str, ...]:
        """Paths, relative to the archive, whose bytes decide an image's answer."""
        paths = [ref.path, *ref.companions]
        if self.archive.description.geometry in ("auto", "sidecar"):
            paths.append(stem(ref.path) + SIDECAR_SUFFIX)
        if self.per_image_stars:
            paths.append(stem(ref.path) + STARS_SUFFIX)
        return tuple(paths)

    def task_id(self, image_id: str, digests: Mapping[str, str | None]) -> str:
        """Deterministic id of one image's work: identity, options, code, and digests of everything read."""
        parts: list[object] = [image_id, self._shared_digest, sorted(digests.items())]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    @cached_property
    def bodies(self) -> dict[str, BodyBlock]:
        """Blocks of bodies by name, the archive's word on top of the configuration's."""
        return merged_blocks(self.configuration.bodies, self.archive.description.bodies)

    @cached_property
    def _shared_digest(self) -> str:
        """Digest of what all images have in common: computed once, for it costs as much as a fast stage."""
        description = self.archive.description.model_dump(mode="json", exclude={"name", "images", "select"})
        # Which keys of a body's block are said decides what they hide, which their values alone do not tell.
        bodies = {name: block.model_dump(mode="json") for name, block in self.bodies.items()}
        kernels = [(kernel.name, kernel.sha256) for kernel in self.kernels]
        parts: list[object] = [
            self.configuration.digest(), self.software, description, bodies, list(self.star_digests), kernels,
            [catalog.model_dump(mode="json") for catalog in self.rings],
            [(folder.body, folder.sha256) for folder in self.maplets],
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Plan:
    """Work of one run.

    Attributes
    ----------
    setup
        For the workers.
    every
        All images, sorted by id.
    todo
        Those that have no answer yet, or whose inputs have changed.
    """

    setup: Setup
    every: tuple[ImageRef, ...]
    todo: tuple[ImageRef, ...]


def make_plan(archive: Archive, configuration: Configuration, run_folder: RunFolder, verify: bool = False) -> Plan:
    """List an archive's images and find out which are still to be done.

    Parameters
    ----------
    archive
        Opened archive.
    configuration
        All options.
    run_folder
        Output, which may hold an earlier run.
    verify
        Read every input again instead of trusting size and modification time.

    Returns
    -------
    Plan
        Nothing has been written.

    Raises
    ------
    ConfigurationError
        If the archive, one of its star tables or of its kernels cannot be used.
    """
    name = archive.description.instrument
    if name is not None and name not in configuration.instruments:
        known = ", ".join(configuration.instruments)
        raise ConfigurationError(f"{archive.url}: instrument: {name} is not configured; known: {known}")
    _check_settings(archive)
    indexes, per_image = open_star_tables(archive)
    setup = Setup(
        archive, configuration, tuple(index.path for index in indexes),
        tuple((index.name, index.sha256) for index in indexes), per_image, run_folder, software_id(),
        open_kernels(archive, configuration, verify), open_rings(archive), find_maplets(archive),
    )  # fmt: skip
    every = list_images(archive, configuration.instruments)
    todo = [ref for ref in every if not _is_done(ref, setup, verify)]
    return Plan(setup, tuple(every), tuple(todo))


def _check_settings(archive: Archive) -> None:
    try:
        InstrumentSettings.model_validate(archive.description.settings)
    except ValidationError as error:
        allowed = ", ".join(InstrumentSettings.model_fields)
        raise ConfigurationError(f"{archive.url}: settings.{first_problem(error)} (keys: {allowed})") from error


def open_rings(archive: Archive) -> tuple[RingCatalog, ...]:
    """Shipped ring catalogues and the archive's own.

    Parameters
    ----------
    archive
        The archive.

    Returns
    -------
    tuple of RingCatalog
        The archive's own last: it wins for its planet.

    Raises
    ------
    ConfigurationError
        If the archive names a catalogue that is not there or not valid.
    """
    path = archive.description.rings
    if path is None:
        return built_in_rings()
    try:
        data = archive.read(path)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise ConfigurationError(f"{archive.url}: rings: {path} is not there") from error
    return (*built_in_rings(), parse_rings(data, f"{archive.url}/{path}"))


def open_kernels(archive: Archive, configuration: Configuration, verify: bool = False) -> tuple[Kernel, ...]:
    """Check an archive's SPICE kernels, and say where an instrument kernel contradicts a camera's block.

    Parameters
    ----------
    archive
        The archive.
    configuration
        With the camera blocks, which win.
    verify
        Read every kernel again instead of trusting size and modification time.

    Returns
    -------
    tuple of Kernel
        In the order of loading; none where the geometry comes from elsewhere.

    Raises
    ------
    ConfigurationError
        If kernels are wanted and not named, or one of them cannot be used.
    """
    description = archive.description
    if description.geometry == "spice" and not description.kernels:
        raise ConfigurationError(f"{archive.url}: geometry: spice needs kernels: say which meta-kernel to load")
    if not description.kernels or description.geometry not in ("auto", "spice"):
        return ()
    kernels = check_kernels(archive.url, description.kernels, cache_folder(), verify)
    for note in focal_length_notes(configuration.instruments):
        _LOG.warning(note)
    return kernels


def open_star_tables(archive: Archive) -> tuple[list[StarIndex], bool]:
    """Indexes of an archive's star tables, made where they are not yet.

    Parameters
    ----------
    archive
        The archive.

    Returns
    -------
    tuple
        Indexes; whether per-image tables are wanted too.

    Raises
    ------
    ConfigurationError
        If a table is unknown, missing or not valid.
    """
    listed = archive.description.stars
    entries = [listed] if isinstance(listed, str) else listed
    tables = [_star_index(archive, entry) for entry in entries if entry != PER_IMAGE]
    return tables, PER_IMAGE in entries


def _star_index(archive: Archive, entry: str | StarTableRef) -> StarIndex:
    folder = cache_folder()
    try:
        if not isinstance(entry, str):
            return _table_index(archive, entry, folder)
        if entry in BUILT_IN_NAMES:
            return built_in_index(entry, folder)
        added = added_index(entry, folder)
        if added is None or not added.exists():
            known = ", ".join((*BUILT_IN_NAMES, PER_IMAGE))
            raise ConfigurationError(
                f"{archive.url}: stars: {entry} is neither {known} nor added by `pilotage catalog add`"
            )
        return open_index(added)
    except TableProblem as error:
        raise ConfigurationError(f"{archive.url}: stars: {error}") from error
    except OSError as error:
        raise ConfigurationError(f"cannot use the star cache {folder}: {error.strerror}") from error


def _table_index(archive: Archive, entry: StarTableRef, folder: Path) -> StarIndex:
    try:
        data = archive.read(entry.path)
    except (OSError, ValueError, ImportError) as error:
        raise ConfigurationError(f"{archive.url}: stars: {entry.path} cannot be read: {error}") from error
    digest = hashlib.sha256(data + entry.place.encode()).hexdigest()
    return build_index(read_table(data, entry.path, entry.place == "apparent"), entry.path, digest, folder)


def _is_done(ref: ImageRef, setup: Setup, verify: bool) -> bool:
    """Whether the run folder holds this image's answer to these very inputs."""
    mark = read_json(setup.run_folder.mark(ref.image_id))
    # The mark of one answer must not vouch for another: that of a run killed in between, or a damaged one.
    if mark is None or mark.get("document_sha256") != _digest_of_document(setup.run_folder, ref.image_id):
        return False
    recorded = mark.get("inputs")
    # Beside these an answer has inputs that others name: the shape file of a sidecar.
    if not isinstance(recorded, dict) or not set(recorded) >= set(setup.inputs_of(ref)):
        return False
    digests: dict[str, str | None] = {}
    for path, entry in recorded.items():
        digest = _known_digest(setup.archive, path, entry, verify)
        if digest is _CHANGED:
            return False
        digests[path] = digest
    return mark.get("task_id") == setup.task_id(ref.image_id, digests)


def _digest_of_document(folder: RunFolder, image_id: str) -> str | None:
    try:
        return hashlib.sha256(folder.document(image_id).read_bytes()).hexdigest()
    except (FileNotFoundError, IsADirectoryError):
        return ""


_CHANGED = "changed"


def _known_digest(archive: Archive, path: str, entry: Json, verify: bool) -> str | None:
    """Digest of an input: recorded if the file looks unchanged, else read; None where there is no file."""
    recorded = entry if isinstance(entry, dict) else {}
    sha256 = recorded.get("sha256")
    try:
        stamp = file_stamp(archive.url, path)
        if stamp is None:
            return None
        if recorded.get("size") != stamp[0]:
            return _CHANGED
        if verify or not isinstance(sha256, str) or recorded.get("mark") != stamp[1]:
            return hashlib.sha256(archive.read(path)).hexdigest()
    except OSError:
        # Whoever works on the image will say in its record what is wrong with the file.
        return _CHANGED
    return sha256


@lru_cache(maxsize=1)
def software_id() -> str:
    """Version of Pilotage and digest of its source, so that changed code does not pass for the old one.

    Returns
    -------
    str
        For example ``pilotage 0.1.0 (3f2a…)``.
    """
    digest = hashlib.sha256()
    for package in ("pipeline", "catalogs", "workflows"):
        root = Path(str(files(package)))
        for path in sorted(root.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(path.read_bytes())
    return f"pilotage {version('pilotage')} ({digest.hexdigest()[:12]})"


def ids_of(refs: Sequence[ImageRef]) -> list[str]:
    """Image ids, in order.

    Parameters
    ----------
    refs
        Images.

    Returns
    -------
    list of str
        Their ids.
    """
    return [ref.image_id for ref in refs]
