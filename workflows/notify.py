"""What is told to the outside when a run has ended."""

import logging
import shlex
import subprocess

from workflows.store import RunFolder

_LOG = logging.getLogger("pilotage")
PATIENCE_S = 60.0


def notify(command: str, folder: RunFolder) -> bool:
    """Run a command with the run's summary, ``run.json``, as its input.

    Parameters
    ----------
    command
        Words as a shell splits them; no shell takes part.
    folder
        The run.

    Returns
    -------
    bool
        Whether it went well; if not, that is a warning and never harms the run.
    """
    try:
        words = shlex.split(command)
        if not words:
            raise ValueError("no command")
        summary = (folder.root / "run.json").read_bytes()
        ended = subprocess.run(words, input=summary, timeout=PATIENCE_S, check=False)
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        _LOG.warning("notification failed: %s", error)
        return False
    if ended.returncode:
        _LOG.warning("notification failed: %s ended with %d", command, ended.returncode)
    return ended.returncode == 0
