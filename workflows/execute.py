"""Running a plan: in this process, on a local Dask cluster, or on one that is there. The only importer of Dask."""

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import TypeVar
from uuid import uuid4

import dask
from dask.utils import format_bytes, parse_bytes
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed, get_worker
from distributed.comm import CommClosedError

from catalogs.archive import ImageRef
from pipeline.errors import ConfigurationError, PilotageError
from pipeline.status import Status, StatusReason
from workflows.plan import Plan, Setup
from workflows.run_log import kept_lines
from workflows.store import to_json, write_atomically
from workflows.task import ImageRunner, Outcome, lost_document

Listener = Callable[[Outcome], None]
_Item = TypeVar("_Item")
_Answer = TypeVar("_Answer")
# Tasks waiting per worker: enough that none ever idles, few enough that a killed run wastes nothing.
_IN_FLIGHT_PER_WORKER = 6
_CONNECT_TIMEOUT_S = 10
# Freed memory that a worker may keep for its next image.
_KEPT_BYTES = 256 * 2**20
# Arrays up to this come from kept memory; glibc ignores a larger figure.
_LARGEST_KEPT_BYTES = 32 * 2**20
# An idle worker with catalogues and compiled kernels takes a third of this.
_LEAST_MEMORY = 2**29


@dataclass(frozen=True)
class ClusterOptions:
    """Where a plan runs.

    Attributes
    ----------
    workers
        Processes of a local cluster; zero runs everything in this process.
    scheduler
        Address of an existing scheduler, which wins over ``workers``.
    memory_limit
        Per local worker, as Dask writes it (``"4GiB"``); a worker beyond it is restarted.
    """

    workers: int = 1
    scheduler: str | None = None
    memory_limit: str = "4GiB"


class RunnerPlugin(WorkerPlugin):  # type: ignore[misc]
    """Opens catalogues and options once per worker, also on workers that start later."""

    def __init__(self, setup: Setup) -> None:
        # One name per run: two runs may share a scheduler.
        self.name = f"pilotage-{uuid4().hex}"
        self._setup = setup
        self.runner: ImageRunner | None = None

    def setup(self, worker: Worker) -> None:
        """Called by Dask on each worker."""
        # Python's own warnings then go where all lines of a worker go: into the log of the run.
        logging.captureWarnings(True)
        self.runner = ImageRunner(self._setup)


def _on_worker(ref: ImageRef, plugin_name: str) -> Outcome:
    plugin = get_worker().plugins[plugin_name]
    with kept_lines() as lines:
        outcome: Outcome = plugin.runner.run(ref)
    return replace(outcome, lines=tuple(lines))


@contextmanager
def open_workers(plan: Plan, options: ClusterOptions) -> Iterator[Callable[[Listener, Callable[[str], None]], None]]:
    """Have workers ready for all that is still to be done; nothing is written before the result is called.

    Parameters
    ----------
    plan
        The work.
    options
        Where.

    Yields
    ------
    callable
        Takes a function called in this process with every finished image, and one called once with a description of
        the workers; returns when all images are done.

    Raises
    ------
    ConfigurationError
        If there is no such scheduler, it has no workers, or the memory limit is no size or too small.
    """
    if not plan.todo:
        yield lambda on_done, on_ready: None
    elif options.workers == 0 and options.scheduler is None:
        yield partial(_run_here, plan)
    else:
        with _client(options) as client:
            _await_workers(client)
            yield partial(_run_on, client, plan)


def _run_here(plan: Plan, on_done: Listener, on_ready: Callable[[str], None]) -> None:
    on_ready("this process")
    runner = ImageRunner(plan.setup)
    for ref in plan.todo:
        on_done(runner.run(ref))


def _run_on(client: Client, plan: Plan, on_done: Listener, on_ready: Callable[[str], None]) -> None:
    plugin = RunnerPlugin(plan.setup)
    client.register_plugin(plugin, name=plugin.name)
    count = len(client.scheduler_info(n_workers=-1)["workers"])
    on_ready(f"{count} worker{'s' if count != 1 else ''}, dashboard {client.dashboard_link}")
    try:
        lost = _drain(client, plugin.name, plan.todo, max(count, 1) * _IN_FLIGHT_PER_WORKER, on_done)
        # An image may have died with its neighbour's worker. Alone, only its own death is counted.
        for ref in lost:
            for again in _drain(client, plugin.name, [ref], 1, on_done):
                on_done(_record_loss(plan.setup, again))
        # All images are answered: a worker that dies now, and so does not hear of it, changes nothing.
        with suppress(CommClosedError):
            client.unregister_worker_plugin(plugin.name)
    except CommClosedError as error:
        raise PilotageError("the scheduler is gone; run the same command again to go on") from error


def map_in_order(
    function: Callable[[_Item], _Answer], items: Sequence[_Item], options: ClusterOptions
) -> Iterator[_Answer | None]:
    """Apply a function to items on workers, answers in the order of the items and no more of them held than in flight.

    Parameters
    ----------
    function
        Of a module, so that workers can import it.
    items
        Small: they travel.
    options
        Where.

    Yields
    ------
    object or None
        Answers; None for an item whose worker died, and died again when it was tried alone.

    Raises
    ------
    ConfigurationError
        If there is no such scheduler, it has no workers, or the memory limit is no size or too small.
    """
    if options.workers == 0 and options.scheduler is None:
        yield from map(function, items)
        return
    with _client(options) as client:
        _await_workers(client)
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        waiting, flying = iter(items), deque[tuple[_Item, Future]]()
        for item in islice(waiting, 2 * max(count, 1)):
            flying.append((item, client.submit(function, item, pure=False)))
        while flying:
            item, future = flying.popleft()
            answer = _answer_of(future)
            if answer is None:
                answer = _answer_of(client.submit(function, item, pure=False))
            future.release()
            for following in islice(waiting, 1):
                flying.append((following, client.submit(function, following, pure=False)))
            yield answer


def _answer_of(future: Future) -> _Answer | None:
    """Result of a task, None if its worker died."""
    try:
        answer: _Answer = future.result()
    except (KilledWorker, CancelledError):
        return None
    except CommClosedError as error:
        raise PilotageError("the scheduler is gone; run the same command again") from error
    return answer


def _await_workers(client: Client) -> None:
    try:
        client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT_S * 3)
    except TimeoutError as error:
        raise ConfigurationError("the scheduler has no workers") from error


@contextmanager
def _client(options: ClusterOptions) -> Iterator[Client]:
    # The client's logger has a level of its own.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    memory = _memory(options.memory_limit)
    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": 1,
            # A small queue on each worker hides the scheduler's latency; nothing is lost by it, tasks are short.
            "distributed.scheduler.worker-saturation": 2.0,
            "distributed.comm.timeouts.connect": _CONNECT_TIMEOUT_S,
            # A worker that waits for memory which only it holds would wait for ever: it is ended instead.
            "distributed.worker.memory.target": False,
            "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
            # Dask has workers hand freed memory back at once; images of megabytes then cost a page fault per 4 KiB each
            # time one is made, half as much again as the work itself (measured). A worker's arrays are all short-lived.
            "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
            "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": _LARGEST_KEPT_BYTES,
            "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
            # Samples the stack of the thread that works a hundred times a second, for a dashboard page.
            "distributed.worker.profile.enabled": False,
        }
    ):
        if options.scheduler is not None:
            try:
                client = Client(options.scheduler, timeout=_CONNECT_TIMEOUT_S)
            except (OSError, ValueError) as error:
                raise ConfigurationError(f"no scheduler answers at {options.scheduler}: {error}") from error
            with client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=options.workers, threads_per_worker=1, processes=True, memory_limit=memory,
                dashboard_address="localhost:0", silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,
        ):  # fmt: skip
            yield client


def _memory(text: str) -> int:
    try:
        size = int(parse_bytes(text))
    except ValueError as error:
        raise ConfigurationError(f"--memory-limit {text}: say a size such as 4GiB") from error
    if size < _LEAST_MEMORY:
        raise ConfigurationError(f"--memory-limit {text}: a worker needs {format_bytes(_LEAST_MEMORY)} at least")
    return size


def _drain(
    client: Client, plugin_name: str, refs: Sequence[ImageRef], in_flight: int, on_done: Listener
) -> list[ImageRef]:
    """Run images with a bounded number in flight; returns those whose worker died."""
    waiting = iter(refs)
    ref_of: dict[str, ImageRef] = {}

    def submit_next() -> Future | None:
        ref = next(waiting, None)
        if ref is None:
            return None
        future = client.submit(_on_worker, ref, plugin_name, pure=False)
        ref_of[future.key] = ref
        return future

    first = [future for future in (submit_next() for _ in range(in_flight)) if future is not None]
    lost: list[ImageRef] = []
    completed = as_completed(first)
    for future in completed:
        ref = ref_of.pop(future.key)
        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker) or future.status == "cancelled":
            lost.append(ref)
        elif error is not None:
            raise error
        else:
            on_done(future.result())
        future.release()
        following = submit_next()
        if following is not None:
            completed.add(following)
    return lost


def _record_loss(setup: Setup, ref: ImageRef) -> Outcome:
    """Document without a mark: the next run tries the image again."""
    detail = "the worker died on this image, alone, twice: out of memory, or killed from outside"
    write_atomically(setup.run_folder.document(ref.image_id), to_json(lost_document(setup, ref, detail)))
    return Outcome(ref.image_id, Status.ERROR.value, StatusReason.WORKER_LOST.value, 0.0)
