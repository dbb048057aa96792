"""Running a plan: in this process, on a local Dask cluster, or on one that is there. The only importer of Dask."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed, get_worker

from catalogs.archive import ImageRef
from pipeline.errors import ConfigurationError
from pipeline.status import Status, StatusReason
from workflows.plan import Plan, Setup
from workflows.store import to_json, write_atomically
from workflows.task import ImageRunner, Outcome, lost_document

Listener = Callable[[Outcome], None]
_PLUGIN = "pilotage-image-runner"
# Tasks waiting per worker: enough that none ever idles, few enough that a killed run wastes nothing.
_IN_FLIGHT_PER_WORKER = 6
_CONNECT_TIMEOUT_S = 20


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

    name = _PLUGIN

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.runner: ImageRunner | None = None

    def setup(self, worker: Worker) -> None:
        """Called by Dask on each worker."""
        self.runner = ImageRunner(self._setup)


def _on_worker(ref: ImageRef) -> Outcome:
    plugin = get_worker().plugins[_PLUGIN]
    outcome: Outcome = plugin.runner.run(ref)
    return outcome


def run_plan(plan: Plan, options: ClusterOptions, on_done: Listener, on_ready: Callable[[str], None]) -> None:
    """Do all that is still to be done.

    Parameters
    ----------
    plan
        The work.
    options
        Where.
    on_done
        Called in this process with every finished image.
    on_ready
        Called once with a description of the workers when they are up.
    """
    if not plan.todo:
        return
    if options.workers == 0 and options.scheduler is None:
        on_ready("this process")
        runner = ImageRunner(plan.setup)
        for ref in plan.todo:
            on_done(runner.run(ref))
        return
    with _client(options) as client:
        _await_workers(client)
        client.register_plugin(RunnerPlugin(plan.setup), name=_PLUGIN)
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        on_ready(f"{count} worker{'s' if count != 1 else ''}, dashboard {client.dashboard_link}")
        lost = _drain(client, plan.todo, max(count, 1) * _IN_FLIGHT_PER_WORKER, on_done)
        # An image may have died with its neighbour's worker. Alone, only its own death is counted.
        for ref in lost:
            for again in _drain(client, [ref], 1, on_done):
                on_done(_record_loss(plan.setup, again))


def _await_workers(client: Client) -> None:
    try:
        client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT_S * 3)
    except TimeoutError as error:
        raise ConfigurationError("the scheduler has no workers") from error


@contextmanager
def _client(options: ClusterOptions) -> Iterator[Client]:
    logging.getLogger("distributed").setLevel(logging.ERROR)
    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": 1,
            # A small queue on each worker hides the scheduler's latency; nothing is lost by it, tasks are short.
            "distributed.scheduler.worker-saturation": 2.0,
            "distributed.comm.timeouts.connect": _CONNECT_TIMEOUT_S,
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
                n_workers=options.workers, threads_per_worker=1, processes=True, memory_limit=options.memory_limit,
                dashboard_address="localhost:0", silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,
        ):  # fmt: skip
            yield client


def _drain(client: Client, refs: Sequence[ImageRef], in_flight: int, on_done: Listener) -> list[ImageRef]:
    """Run images with a bounded number in flight; returns those whose worker died."""
    waiting = iter(refs)
    ref_of: dict[str, ImageRef] = {}

    def submit_next() -> Future | None:
        ref = next(waiting, None)
        if ref is None:
            return None
        future = client.submit(_on_worker, ref, pure=False)
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
