"""A run from its plan to its tables and run.json."""

import hashlib
import json
import logging
import platform
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from pipeline.errors import PilotageError
from pipeline.json_values import Json
from pipeline.status import Status
from workflows.execute import ClusterOptions, open_workers
from workflows.exits import EXIT_ALL_NAVIGATED, EXIT_SOME_FAILED, EXIT_SOME_IN_ERROR
from workflows.plan import Plan, ids_of
from workflows.run_log import logged_to, say
from workflows.store import RunFolder, exclusive, read_json, sweep, to_json, write_atomically, write_tables
from workflows.task import Outcome

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
        with logged_to(folder.root), _told_start_and_end(plan, digest):
            run_images(*_logging(listener))
            # A worker may die while it writes.
            sweep(folder)
            write_tables(folder, ids)
            statuses = _statuses(folder, ids)
            write_atomically(folder.root / "run.json", to_json(_summary(plan, started, statuses, digest)))
            counts: dict[str, Json] = dict(sorted(statuses.items()))
            said = ", ".join(f"{count} {status}" for status, count in counts.items())
            say("end", f"finished: {said}", statuses=counts)
    return statuses


@contextmanager
def _told_start_and_end(plan: Plan, digest: str) -> Iterator[None]:
    """Log the start, and whatever but a kill ends the run before its time."""
    count, todo = len(plan.every), len(plan.todo)
    say(
        "start", f"{count} images, {count - todo} answered before, {todo} to do", images=count, to_do=todo,
        archive=plan.setup.archive.url, software=plan.setup.software, plan_digest=digest,
        config_digest=plan.setup.configuration.digest(),
    )  # fmt: skip
    try:
        yield
    except KeyboardInterrupt:
        say("interrupted", "interrupted", logging.WARNING)
        raise
    except PilotageError as error:
        say("stopped", str(error), logging.ERROR)
        raise


def _logging(listener: RunListener) -> tuple[Callable[[Outcome], None], Callable[[str], None]]:
    """A listener's functions, each call logged too."""

    def on_done(outcome: Outcome) -> None:
        bad = outcome.status == Status.ERROR.value
        say(
            "image", f"{outcome.image_id} {outcome.status} {outcome.reason}", logging.WARNING if bad else logging.INFO,
            image_id=outcome.image_id, status=outcome.status, reason=outcome.reason, seconds=round(outcome.seconds, 6),
        )  # fmt: skip
        for line in outcome.lines:
            say("line", line.text, line.level, image_id=outcome.image_id, logger=line.logger)
        for note in outcome.notes:
            say("note", note, image_id=outcome.image_id)
        listener.on_done(outcome)

    def on_ready(workers: str) -> None:
        say("workers", workers)
        listener.on_ready(workers)

    return on_done, on_ready


def _statuses(folder: RunFolder, ids: list[str]) -> Counter[str]:
    documents = (read_json(folder.document(image_id)) for image_id in ids)
    return Counter(str(document["status"]) for document in documents if document is not None)


def _summary(plan: Plan, started: datetime, statuses: Counter[str], digest: str) -> dict[str, Json]:
    setup = plan.setup
    return {
        "schema": "pilotage-run/1", "archive": setup.archive.description.name,
        "archive_url": absolute(setup.archive.url), "software": setup.software,
        "python": platform.python_version(), "libraries": {name: version(name) for name in _LIBRARIES},
        "config_digest": setup.configuration.digest(), "configuration": setup.configuration.model_dump(mode="json"),
        "archive_description": setup.archive.description.model_dump(mode="json"),
        "catalogs": [{"name": name, "sha256": sha256} for name, sha256 in setup.star_digests],
        "images": len(plan.every), "done_in_this_run": len(plan.todo), "statuses": dict(sorted(statuses.items())),
        "plan_digest": digest, "started_utc": started.isoformat(timespec="seconds"),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def absolute(url: str) -> str:
    """An archive's address that holds from any folder.

    Parameters
    ----------
    url
        Folder, maybe relative, or URL.

    Returns
    -------
    str
        The same, from the root where it is a folder.
    """
    return url if "://" in url else str(Path(url).resolve())


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
