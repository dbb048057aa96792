"""A run from its plan to its tables and run.json."""

import hashlib
import json
import platform
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version

from pipeline.curate import Json
from pipeline.status import Status
from workflows.execute import ClusterOptions, open_workers
from workflows.plan import Plan, ids_of
from workflows.store import RunFolder, exclusive, read_json, sweep, to_json, write_atomically, write_tables
from workflows.task import Outcome

EXIT_ALL_NAVIGATED = 0
EXIT_SOME_FAILED = 1
EXIT_SOME_IN_ERROR = 2
EXIT_NOT_STARTED = 3
EXIT_INTERRUPTED = 130

_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "astropy", "dask", "distributed", "pyarrow")


@dataclass(frozen=True)
class RunListener:
    """Callbacks by which a terminal follows a run.

    Attributes
    ----------
    on_ready
        Called with a description of the workers.
    on_done
        Called with every finished image.
    on_start
        Called when nothing can refuse the run any more.
    """

    on_ready: Callable[[str], None]
    on_done: Callable[[Outcome], None]
    on_start: Callable[[], None] = lambda: None


def execute(plan: Plan, options: ClusterOptions, listener: RunListener) -> Counter[str]:
    """Run a plan, rebuild the tables, write ``run.json``.

    Parameters
    ----------
    plan
        The work.
    options
        Where it runs.
    listener
        Terminal.

    Returns
    -------
    collections.Counter
        Images by status, over the whole plan.
    """
    folder = plan.setup.run_folder
    started = datetime.now(UTC)
    ids = ids_of(plan.every)
    with open_workers(plan, options) as run_images, exclusive(folder):
        listener.on_start()
        digest = hashlib.sha256(json.dumps(ids).encode() + plan.setup.configuration.digest().encode()).hexdigest()
        (folder.root / "run.json").unlink(missing_ok=True)
        write_atomically(folder.plan, to_json({"images": list(ids), "digest": digest}))
        run_images(listener.on_done, listener.on_ready)
        # A worker may die while it writes.
        sweep(folder)
        write_tables(folder, ids)
        statuses = _statuses(folder, ids)
        write_atomically(folder.root / "run.json", to_json(_summary(plan, started, statuses, digest)))
    return statuses


def _statuses(folder: RunFolder, ids: list[str]) -> Counter[str]:
    documents = (read_json(folder.document(image_id)) for image_id in ids)
    return Counter(str(document["status"]) for document in documents if document is not None)


def _summary(plan: Plan, started: datetime, statuses: Counter[str], digest: str) -> dict[str, Json]:
    setup = plan.setup
    return {
        "schema": "pilotage-run/1", "archive": setup.archive.description.name, "software": setup.software,
        "python": platform.python_version(), "libraries": {name: version(name) for name in _LIBRARIES},
        "config_digest": setup.configuration.digest(), "configuration": setup.configuration.model_dump(mode="json"),
        "archive_description": setup.archive.description.model_dump(mode="json"),
        "catalogs": [{"name": name, "sha256": sha256} for name, sha256 in setup.star_digests],
        "images": len(plan.every), "done_in_this_run": len(plan.todo), "statuses": dict(sorted(statuses.items())),
        "plan_digest": digest, "started_utc": started.isoformat(timespec="seconds"),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def exit_code(statuses: Counter[str]) -> int:
    """Exit code of a run: the worst that happened to any image.

    Parameters
    ----------
    statuses
        Images by status.

    Returns
    -------
    int
        0 all navigated, 1 some failed or conflicted, 2 some in error.
    """
    if statuses[Status.ERROR.value]:
        return EXIT_SOME_IN_ERROR
    if statuses[Status.FAILED.value] or statuses[Status.CONFLICTED.value]:
        return EXIT_SOME_FAILED
    return EXIT_ALL_NAVIGATED
