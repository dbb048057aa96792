"""One image as one task: read, navigate, write. The only place where an image's errors are caught."""

import hashlib
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from catalogs.archive import SIDECAR_SUFFIX, STARS_SUFFIX, ImageRef, stem
from catalogs.geometry import identify, state_from_header, state_from_sidecar
from catalogs.images import RawImage, read_image
from catalogs.instruments import InstrumentBlock
from catalogs.star_sources import TableProblem, read_table
from catalogs.stars import open_index, seen_from
from pipeline.camera import field_of_view
from pipeline.curate import Json, Provenance, build_metadata_dict, error_document
from pipeline.errors import CatalogError, GeometryError, ImageError, ImageFailure
from pipeline.navigate import Navigation, navigate
from pipeline.predict.stars import reach_px
from pipeline.records import BoolArray, StarTable, State
from pipeline.status import StatusReason
from workflows.plan import Setup, input_marks
from workflows.store import to_json, write_atomically

# What a bug in the science can raise. Trouble with the output (OSError) is not among them: a full disk stops the run.
_BUGS = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, NameError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
_PACKAGES = ("pipeline", "catalogs", "workflows")


@dataclass(frozen=True)
class Outcome:
    """What the main process needs to know of a finished image."""

    image_id: str
    status: str
    reason: str
    seconds: float


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
        self._setup = setup
        self._indexes = [open_index(path) for path in setup.star_indexes]
        self._options = setup.configuration.navigation()
        self._config_digest = setup.configuration.digest()

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
        digests: dict[str, str | None] = dict.fromkeys(self._setup.inputs_of(ref))
        lasting = True
        try:
            document = self._document(ref, digests, watch)
        except ImageFailure as failure:
            document = self._error(ref, digests, failure.reason, failure.detail)
        except OSError as error:
            # The network or disk may answer tomorrow: without a mark the next run tries again.
            lasting = False
            document = self._error(ref, digests, StatusReason.IMAGE_UNREADABLE, f"{ref.path}: {error}")
        except _BUGS as error:
            document = self._error(ref, digests, StatusReason.INTERNAL_ERROR, _where(error))
        watch.lap("curate")
        write_atomically(self._setup.run_folder.document(ref.image_id), to_json(document))
        watch.lap("write")
        if lasting:
            self._mark(ref, digests, watch)
        return Outcome(ref.image_id, str(document["status"]), str(document["status_reason"]), watch.total())

    def _document(self, ref: ImageRef, digests: dict[str, str | None], watch: Stopwatch) -> dict[str, Json]:
        data = self._read(ref.path, digests)
        if data is None:
            raise ImageError(StatusReason.IMAGE_NOT_FOUND, f"{ref.path} is not there")
        raw = read_image(data, ref.path)
        watch.lap("read")
        state, block, source = self._state(ref, raw, digests)
        watch.lap("geometry")
        stars = self._stars(ref, state, digests)
        watch.lap("catalog")
        navigation: Navigation = navigate(raw.pixels, _flags(raw, block), state, stars, self._options, watch.lap)
        rank = self._setup.configuration.orchestrator.rank
        return build_metadata_dict(navigation, rank, self._provenance(ref, digests, source))

    def _read(self, path: str, digests: dict[str, str | None]) -> bytes | None:
        try:
            data = self._setup.archive.read(path)
        except FileNotFoundError:
            return None
        digests[path] = hashlib.sha256(data).hexdigest()
        return data

    def _state(
        self, ref: ImageRef, raw: RawImage, digests: dict[str, str | None]
    ) -> tuple[State, InstrumentBlock | None, str]:
        """Geometry from the sidecar where there is one (and it is allowed), else from the header."""
        description, blocks = self._setup.archive.description, self._setup.configuration.instruments
        block = blocks[description.instrument] if description.instrument else identify(raw.header, blocks)
        path = stem(ref.path) + SIDECAR_SUFFIX
        sidecar = None if description.geometry == "header" else self._read(path, digests)
        if sidecar is not None:
            return state_from_sidecar(sidecar, ref.image_id, block, description.settings), block, "sidecar"
        if description.geometry == "sidecar":
            raise GeometryError(StatusReason.GEOMETRY_MISSING, f"{path} is not there")
        if block is None:
            raise GeometryError(
                StatusReason.CAMERA_UNKNOWN, "there is no sidecar, and no camera block claims the header"
            )
        return state_from_header(raw, ref.image_id, block, description.settings), block, "header"

    def _stars(self, ref: ImageRef, state: State, digests: dict[str, str | None]) -> StarTable:
        axis, half = field_of_view(state.camera_model, reach_px(state))
        direction = state.attitude.camera_from_j2000.T @ axis
        tables = [seen_from(self._indexes, direction, half, state.et, state.spacecraft)]
        path = stem(ref.path) + STARS_SUFFIX
        data = self._read(path, digests) if self._setup.per_image_stars else None
        if data is not None:
            try:
                tables.append(read_table(data, path, apparent=False))
            except TableProblem as error:
                raise CatalogError(StatusReason.CATALOG_INVALID, str(error)) from error
        return StarTable.concatenate(tables)

    def _provenance(self, ref: ImageRef, digests: Mapping[str, str | None], source: str | None) -> Provenance:
        sidecar = digests.get(stem(ref.path) + SIDECAR_SUFFIX)
        table = digests.get(stem(ref.path) + STARS_SUFFIX)
        catalogs = (*self._setup.star_digests, *((("per-image", table),) if table else ()))
        image = digests[ref.path]
        return Provenance(
            self._setup.software, self._config_digest, ref.path, image, source,
            sidecar if source == "sidecar" else image, catalogs,
        )  # fmt: skip

    def _error(
        self, ref: ImageRef, digests: Mapping[str, str | None], reason: StatusReason, detail: str
    ) -> dict[str, Json]:
        return error_document(ref.image_id, reason, detail, self._provenance(ref, digests, None))

    def _mark(self, ref: ImageRef, digests: Mapping[str, str | None], watch: Stopwatch) -> None:
        """The mark comes after the document: a kill in between only makes the image be done again."""
        mark: dict[str, Json] = {
            "task_id": self._setup.task_id(ref.image_id, digests), "inputs": input_marks(self._setup.archive, digests),
            "timings": {**watch.seconds, "total": watch.total()},
        }  # fmt: skip
        write_atomically(self._setup.run_folder.mark(ref.image_id), to_json(mark))


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
