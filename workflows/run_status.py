"""How far a run is, from its files alone: for a terminal beside it, or the morning after."""

import fcntl
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum

from pipeline.errors import ConfigurationError
from pipeline.json_values import Json
from workflows.store import RunFolder, read_json


class RunState(StrEnum):
    """What a run is at."""

    RUNNING = "running"
    FINISHED = "finished"
    STOPPED = "killed or interrupted"


@dataclass(frozen=True)
class RunStatus:
    """A run at one moment.

    Attributes
    ----------
    state
        Running, finished, or stopped before its end.
    planned
        Images of the latest run.
    statuses
        Images answered by status, those of earlier runs included.
    answered_now
        Images answered since the latest start.
    seconds
        From the first of these answers to the latest.
    last_outcome
        When the latest answer came; None if none has come since the start.
    """

    state: RunState
    planned: int
    statuses: Counter[str]
    answered_now: int
    seconds: float
    last_outcome: datetime | None

    @property
    def left(self) -> int:
        """Images without an answer."""
        return self.planned - sum(self.statuses.values())

    @property
    def rate_per_s(self) -> float | None:
        """Images per second since the first answer, which had to wait for workers; None before the second."""
        return (self.answered_now - 1) / self.seconds if self.answered_now > 1 and self.seconds > 0 else None

    def line(self) -> str:
        """One line for a person."""
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.statuses.items())) or "none yet"
        parts = [f"{self.planned - self.left} of {self.planned} images done ({counts})"]
        if self.last_outcome is not None:
            parts.append(f"last outcome {self.last_outcome.isoformat(timespec='seconds')}")
        parts.append("finished" if self.state is RunState.FINISHED else f"not finished: {self.state}")
        rate = self.rate_per_s
        if self.state is RunState.RUNNING and rate is not None:
            parts.append(f"{rate:.2g} images/s, {self.left / rate:.0f} s left")
        if self.state is RunState.STOPPED:
            parts.append("run the same command again to go on")
        return "; ".join(parts)


def status_of_run(folder: RunFolder) -> RunStatus:
    """State of a run, perhaps at work in another process or on another machine.

    Parameters
    ----------
    folder
        The run; nothing is written.

    Returns
    -------
    RunStatus
        As of now.

    Raises
    ------
    ConfigurationError
        If the folder holds no run.
    """
    # The lock first: a run that ends meanwhile then counts as finished, never as killed.
    at_work = _is_locked(folder)
    planned, statuses, finished = progress_of(folder)
    state = RunState.FINISHED if finished else RunState.RUNNING if at_work else RunState.STOPPED
    started = folder.plan.stat().st_mtime
    times = [entry.stat().st_mtime for entry in folder.state.glob("[!.]*.json")]
    now = [time for time in times if time >= started]
    first, last = min(now, default=started), max(now, default=started)
    outcome = datetime.fromtimestamp(last, UTC) if now else None
    return RunStatus(state, planned, statuses, len(now), last - first, outcome)


def _is_locked(folder: RunFolder) -> bool:
    """Whether a process holds a run's lock, which the system takes from the dead."""
    try:
        with folder.lock.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (FileNotFoundError, NotADirectoryError):
        return False
    return False


def progress_of(folder: RunFolder) -> tuple[int, Counter[str], bool]:
    """State of a run, from its files alone.

    Parameters
    ----------
    folder
        The run, perhaps at work elsewhere.

    Returns
    -------
    tuple
        Images planned; those done by status; whether the run has finished.

    Raises
    ------
    ConfigurationError
        If the folder holds no run.
    """
    plan = read_json(folder.plan)
    if plan is None or not isinstance(plan.get("images"), list):
        raise ConfigurationError(f"{folder.root} holds no run: it has no plan.json")
    ids: Sequence[Json] = plan["images"]  # type: ignore[assignment]
    statuses: Counter[str] = Counter()
    for image_id in ids:
        document = read_json(folder.document(str(image_id)))
        if document is not None and folder.mark(str(image_id)).exists():
            statuses[str(document["status"])] += 1
    summary = read_json(folder.root / "run.json")
    finished = summary is not None and summary.get("plan_digest") == plan.get("digest")
    return len(ids), statuses, finished
