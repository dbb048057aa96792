"""One image as one task: read, navigate, write. The only place where an image's errors are caught."""

import gc
import hashlib
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from posixpath import basename, dirname
from typing import TypeVar

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from catalogs.archive import SIDECAR_SUFFIX, STARS_SUFFIX, Archive, ImageRef, file_stamp, stem
from catalogs.bodies import BodyModels
from catalogs.header import state_from_header
from catalogs.images import RawImage, read_image
from catalogs.instruments import InstrumentBlock
from catalogs.labels import Label, read_label
from catalogs.shapes import read_shape
from catalogs.sidecar import state_from_sidecar
from catalogs.spice import load_bodies, state_from_spice
from catalogs.star_sources import TableProblem, read_table
from catalogs.stars import open_index, seen_from
from pipeline.camera import field_of_view
from pipeline.curate import Json, Provenance, build_metadata_dict, error_document
from pipeline.errors import CatalogError, GeometryError, ImageError, ImageFailure
from pipeline.navigate import Navigation, navigate
from pipeline.predict.stars import reach_px
from pipeline.records import BoolArray, StarTable, State, TriangleMesh
from pipeline.status import StatusReason
from workflows.maplet_sources import Maplets
from workflows.plan import Setup
from workflows.run_log import Line
from workflows.store import to_json, write_atomically

# What a bug in the science can raise. Trouble with the output (OSError) is not among them: a full disk stops the run.
_BUGS = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, NameError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
_PACKAGES = ("pipeline", "catalogs", "workflows")
_MESHES_KEPT = 16
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Outcome:
    """What the main process needs to know of a finished image.

    ``notes`` are lines for its log, at INFO; ``lines`` what a worker process logged meanwhile.
    """

    image_id: str
    status: str
    reason: str
    seconds: float
    notes: tuple[str, ...] = ()
    lines: tuple[Line, ...] = ()


class Stopwatch:
    """Seconds per stage of one image."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Book the time since the last lap on a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now

    def total(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._start


@dataclass(frozen=True)
class Readiness:
    """Whether an image can be navigated at all.

    Attributes
    ----------
    image_id
        The image.
    reason
        Why not, a status reason; empty where it can.
    detail
        In one line.
    """

    image_id: str
    reason: str
    detail: str


@dataclass(frozen=True)
class _Fault:
    """Why an image has no answer.

    ``lasting`` is false where the network or disk may answer tomorrow: without a mark the next run tries again.
    """

    reason: StatusReason
    detail: str
    lasting: bool = True


@dataclass(frozen=True, eq=False)
class _Prepared:
    """All that navigating one image needs."""

    raw: RawImage
    label: Label
    state: State
    block: InstrumentBlock | None
    source: str
    stars: StarTable


class Inputs:
    """Files that decide one image's answer, as they were when they were read.

    Parameters
    ----------
    archive
        Where they lie.
    """

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._stamps: dict[str, tuple[int, str] | None] = {}
        self.data: dict[str, bytes | None] = {}
        self.digests: dict[str, str | None] = {}
        self.label: Label | None = None

    def read(self, path: str) -> None:
        """Read a file, or note that it is not there.

        The stamp comes before the bytes: a file that is changed meanwhile is then read again by the next run.
        """
        self._stamps[path] = file_stamp(self._archive.url, path)
        try:
            data = self._archive.read(path)
        except (FileNotFoundError, NotADirectoryError):
            self.data[path] = self.digests[path] = None
            return
        self.data[path], self.digests[path] = data, hashlib.sha256(data).hexdigest()

    def took(self, path: str, stamp: tuple[int, str] | None, sha256: str) -> None:
        """Note a file that was read for an earlier image and is as it was."""
        self._stamps[path], self.digests[path] = stamp, sha256

    def marks(self) -> dict[str, Json]:
        """Digest, size and modification mark of each, as JSON values."""
        marks: dict[str, Json] = {}
        for path, sha256 in self.digests.items():
            stamp = self._stamps[path] if sha256 is not None else None
            marks[path] = {"sha256": sha256, "size": stamp[0] if stamp else None, "mark": stamp[1] if stamp else None}
        return marks


class Meshes:
    """Shape files of the bodies, each parsed once per process as long as it does not change.

    Parameters
    ----------
    archive
        To whose root paths are relative.
    """

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._known: dict[str, tuple[tuple[int, str], str, TriangleMesh]] = {}

    def read(self, path: str, inputs: Inputs) -> TriangleMesh:
        """Mesh of a file, which becomes an input of the image.

        Raises
        ------
        GeometryError
            If there is no such file, or it is damaged.
        """
        stamp = file_stamp(self._archive.url, path)
        if stamp is not None and path in self._known and self._known[path][0] == stamp:
            _, sha256, mesh = self._known[path]
            inputs.took(path, stamp, sha256)
            return mesh
        try:
            inputs.read(path)
        except IsADirectoryError as error:
            raise GeometryError(StatusReason.GEOMETRY_INVALID, f"shape {path} is a folder") from error
        data, digest = inputs.data.pop(path), inputs.digests[path]
        if data is None or digest is None:
            raise GeometryError(StatusReason.GEOMETRY_MISSING, f"shape {path} is not there")
        mesh = read_shape(data, path)
        if stamp is not None:
            # The oldest goes first; few archives hold more bodies than this.
            if len(self._known) >= _MESHES_KEPT:
                del self._known[next(iter(self._known))]
            self._known[path] = (stamp, digest, mesh)
        return mesh


@contextmanager
def _garbage_kept_young() -> Iterator[None]:
    """Collect an image's garbage at its end, while all of it is young and that costs next to nothing.

    An opened FITS file is a circle of references with its bytes inside; once promoted to the oldest generation, tens of
    them pile up before anybody looks there.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.collect(0)


class ImageRunner:
    """Everything a process needs to work on images, opened once.

    Parameters
    ----------
    setup
        From the plan.
    """

    def __init__(self, setup: Setup) -> None:
        # Workers are processes of one thread each; OpenCV would otherwise start one per core in every worker.
        cv2.setNumThreads(1)
        # The same for linear algebra, whose sums also come out differently with more threads.
        threadpool_limits(1)
        self._setup = setup
        self._indexes = [open_index(path) for path in setup.star_indexes]
        self._options = setup.configuration.navigation()
        self._config_digest = setup.configuration.digest()
        self._meshes = Meshes(setup.archive)
        self._maplets = Maplets(setup.maplets)
        self._known_bodies = load_bodies(setup.kernels) if setup.kernels else ()

    def run(self, ref: ImageRef) -> Outcome:
        """Navigate one image and write its document, then its mark.

        Parameters
        ----------
        ref
            The image.

        Returns
        -------
        Outcome
            Whatever happened.
        """
        watch = Stopwatch()
        inputs = Inputs(self._setup.archive)
        with _garbage_kept_young():
            document, data, lasting = self._answer(ref, inputs, watch)
        watch.lap("curate")
        write_atomically(self._setup.run_folder.document(ref.image_id), data)
        watch.lap("write")
        if lasting:
            self._mark(ref, inputs, hashlib.sha256(data).hexdigest(), watch)
        status, reason = str(document["status"]), str(document["status_reason"])
        return Outcome(ref.image_id, status, reason, watch.total(), rotation_notes(document))

    def _answer(self, ref: ImageRef, inputs: Inputs, watch: Stopwatch) -> tuple[dict[str, Json], bytes, bool]:
        """Document of an image whatever happens, its bytes, and whether the same inputs would give it again."""

        def work() -> tuple[dict[str, Json], bytes]:
            document = self._document(ref, inputs, watch)
            return document, to_json(document)

        made = self._attempt(ref, inputs, work)
        if isinstance(made, _Fault):
            document = self._error(ref, inputs, made.reason, made.detail)
            return document, to_json(document), made.lasting
        return *made, True

    def examine(self, ref: ImageRef) -> Readiness:
        """Read an image's pixels, label, geometry and stars, as :meth:`run` would, and navigate nothing.

        Parameters
        ----------
        ref
            The image.

        Returns
        -------
        Readiness
            Why it could not be navigated, if it could not.
        """
        inputs = Inputs(self._setup.archive)
        made = self._attempt(ref, inputs, lambda: self._prepared(ref, inputs, Stopwatch()))
        if isinstance(made, _Fault):
            return Readiness(ref.image_id, made.reason.value, made.detail)
        state = made.state
        return Readiness(ref.image_id, "", f"{state.mission} {state.camera}, geometry by {made.source}")

    def _attempt(self, ref: ImageRef, inputs: Inputs, work: Callable[[], _Made]) -> _Made | _Fault:
        """Read an image's files and work on them: the one place where what goes wrong becomes a reason."""
        try:
            # All of them, also where the first one fails: the mark is to know what was there.
            for path in self._setup.inputs_of(ref):
                inputs.read(path)
            return work()
        except ImageFailure as failure:
            return _Fault(failure.reason, failure.detail)
        except OSError as error:
            detail = f"{ref.path}: {error.strerror or type(error).__name__}"
            return _Fault(StatusReason.IMAGE_UNREADABLE, detail, lasting=False)
        except _BUGS as error:
            return _Fault(StatusReason.INTERNAL_ERROR, _where(error))

    def _prepared(self, ref: ImageRef, inputs: Inputs, watch: Stopwatch) -> _Prepared:
        data = inputs.data[ref.path]
        if data is None:
            raise ImageError(StatusReason.IMAGE_NOT_FOUND, f"{ref.path} is not there")
        beside = {basename(path): found for path in ref.companions if (found := inputs.data[path]) is not None}
        raw = read_image(data, ref.path, beside)
        description, blocks = self._setup.archive.description, self._setup.configuration.instruments
        label = inputs.label = read_label(raw, blocks, description.instrument)
        watch.lap("read")
        state, block, source = self._state(ref, raw, label, inputs)
        watch.lap("geometry")
        stars = self._stars(ref, state, inputs)
        watch.lap("catalog")
        return _Prepared(raw, label, state, block, source, stars)

    def _document(self, ref: ImageRef, inputs: Inputs, watch: Stopwatch) -> dict[str, Json]:
        made = self._prepared(ref, inputs, watch)
        navigation: Navigation = navigate(
            made.raw.pixels, _flags(made.raw, made.block), made.state, made.stars, self._options, watch.lap,
            self._maplets.sources(made.state),
        )  # fmt: skip
        rank = self._setup.configuration.orchestrator.rank
        return build_metadata_dict(
            navigation, rank, self._provenance(ref, inputs, made.source), made.label.document()
        )  # fmt: skip

    def _state(
        self, ref: ImageRef, raw: RawImage, label: Label, inputs: Inputs
    ) -> tuple[State, InstrumentBlock | None, str]:
        """Geometry from the sidecar where there is one, else from kernels, else from the header, as far as allowed."""
        description = self._setup.archive.description
        block = self._setup.configuration.instruments[label.block] if label.block is not None else None
        path = stem(ref.path) + SIDECAR_SUFFIX
        sidecar = inputs.data.get(path)
        models = BodyModels(self._setup.bodies, lambda shape: self._meshes.read(shape, inputs), dirname(path))
        if sidecar is not None:
            state = state_from_sidecar(
                sidecar, ref.image_id, block, description.settings, raw.pixels.shape, models
            )  # fmt: skip
            return state, block, "sidecar"
        if description.geometry == "sidecar":
            raise GeometryError(StatusReason.GEOMETRY_MISSING, f"{path} is not there")
        if block is None:
            raise GeometryError(
                StatusReason.CAMERA_UNKNOWN, "there is no sidecar, and no camera block claims the header"
            )
        if description.geometry == "spice" or (self._setup.kernels and block.spice is not None):
            camera = (block, label.mode)
            known = self._known_bodies
            state = state_from_spice(
                label, ref.image_id, camera, description.settings, known, models, self._setup.rings
            )
            return state, block, "spice"
        return state_from_header(raw, ref.image_id, block, description.settings), block, "header"

    def _stars(self, ref: ImageRef, state: State, inputs: Inputs) -> StarTable:
        axis, half = field_of_view(state.camera_model, reach_px(state))
        direction = state.attitude.camera_from_j2000.T @ axis
        tables = [seen_from(self._indexes, direction, half, state.et, state.spacecraft)]
        path = stem(ref.path) + STARS_SUFFIX
        data = inputs.data.get(path)
        if data is not None:
            try:
                # An image's own table says where its stars are seen in it.
                tables.append(read_table(data, path, apparent=True))
            except TableProblem as error:
                raise CatalogError(StatusReason.CATALOG_INVALID, str(error)) from error
        return StarTable.concatenate(tables)

    def _provenance(self, ref: ImageRef, inputs: Inputs, source: str | None) -> Provenance:
        sidecar = inputs.digests.get(stem(ref.path) + SIDECAR_SUFFIX)
        table = inputs.digests.get(stem(ref.path) + STARS_SUFFIX)
        maplets = ((f"maplets of {folder.body}", folder.sha256) for folder in self._setup.maplets)
        catalogs = (*self._setup.star_digests, *((("per-image", table),) if table else ()), *maplets)
        image = inputs.digests.get(ref.path)
        listed = set(self._setup.inputs_of(ref))
        shapes = ((name, sha256) for name, sha256 in sorted(inputs.digests.items()) if name not in listed and sha256)
        kernels = () if source in ("sidecar", "header") else self._setup.kernels
        return Provenance(
            self._setup.software, self._config_digest, ref.path, image, source,
            {"sidecar": sidecar, "header": image}.get(source or ""), catalogs, tuple(shapes),
            tuple((kernel.name, kernel.sha256) for kernel in kernels),
        )  # fmt: skip

    def _error(self, ref: ImageRef, inputs: Inputs, reason: StatusReason, detail: str) -> dict[str, Json]:
        label = None if inputs.label is None else inputs.label.document()
        return error_document(ref.image_id, reason, detail, self._provenance(ref, inputs, None), label)

    def _mark(self, ref: ImageRef, inputs: Inputs, document_sha256: str, watch: Stopwatch) -> None:
        """The mark comes after the document: a kill in between only makes the image be done again."""
        mark: dict[str, Json] = {
            "task_id": self._setup.task_id(ref.image_id, inputs.digests), "document_sha256": document_sha256,
            "inputs": inputs.marks(), "timings": {**watch.seconds, "total": watch.total()},
        }  # fmt: skip
        write_atomically(self._setup.run_folder.mark(ref.image_id), to_json(mark))


def rotation_notes(document: Mapping[str, Json]) -> tuple[str, ...]:
    """Lines with each technique's rotation, its sigma and whether its bound was reached (seed 000).

    Parameters
    ----------
    document
        An image's JSON document.

    Returns
    -------
    tuple of str
        One line per technique that observed a rotation.
    """
    answers = document["techniques"]
    return tuple(
        f"{document['image_id']} {answer['technique']}: rotation {answer['rotation_deg']:+.4f} deg, "
        f"sigma {answer['sigma_rotation_deg']:.4f} deg{' AT_EDGE' if answer.get('at_edge_rotation') else ''}"
        for answer in (answers if isinstance(answers, list) else [])
        if isinstance(answer, dict) and answer.get("rotation_deg") is not None
    )


def _flags(raw: RawImage, block: InstrumentBlock | None) -> BoolArray | None:
    """Bad pixels by the product's own quality extension."""
    if block is None or block.quality_extension is None:
        return None
    read = raw.extensions.get(block.quality_extension.upper())
    flags = read() if read is not None else None
    return None if flags is None or flags.shape != raw.pixels.shape else np.asarray(flags != 0)


def _where(error: BaseException) -> str:
    """One line for a bug: type, text, and the last line of ours that it passed through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if any(part in _PACKAGES for part in Path(f.filename).parts)]
    place = f" ({Path(ours[-1].filename).name}:{ours[-1].lineno})" if ours else ""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}{place}"


def lost_document(setup: Setup, ref: ImageRef, detail: str) -> dict[str, Json]:
    """Document of an image whose worker died on it.

    Parameters
    ----------
    setup
        Of the run.
    ref
        The image.
    detail
        What is known.

    Returns
    -------
    dict
        JSON values.
    """
    provenance = Provenance(setup.software, setup.configuration.digest(), ref.path)
    return error_document(ref.image_id, StatusReason.WORKER_LOST, detail, provenance)
