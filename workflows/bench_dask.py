"""Benchmark of the cluster: frames per second with one and two workers once they are up, and equality of bytes.

``python -m workflows.bench_dask [FRAMES]`` makes a sample archive, runs it in this process and on local clusters of one
and two workers, and prints seconds, speed-up and the overhead that a frame costs beyond its own work.
"""

import hashlib
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from catalogs.archive import open_archive
from workflows.config import load_configuration
from workflows.execute import ClusterOptions
from workflows.plan import make_plan
from workflows.run import RunListener, execute
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample
from workflows.store import RunFolder, read_json
from workflows.task import Outcome

_FRAMES = 400
_COMPARED = ("images", "offsets", "techniques", "features")


def timed_run(archive: Path, folder: Path, workers: int) -> tuple[float, float]:
    """Run an archive and time it from the moment the workers are up.

    Parameters
    ----------
    archive
        Its archive.yaml.
    folder
        New run folder.
    workers
        Zero for this process.

    Returns
    -------
    tuple
        Wall-clock seconds from workers up to last frame done; sum of the frames' own seconds.
    """
    run_folder = RunFolder(folder)
    plan = make_plan(open_archive(str(archive), {}), load_configuration(), run_folder)
    moments: list[float] = []
    last: list[float] = []

    def on_ready(text: str) -> None:
        moments.append(time.perf_counter())

    def on_done(outcome: Outcome) -> None:
        last[:] = [time.perf_counter()]

    execute(plan, ClusterOptions(workers=workers), RunListener(on_ready, on_done))
    busy = 0.0
    for ref in plan.every:
        mark = read_json(run_folder.mark(ref.image_id)) or {}
        timings = mark.get("timings")
        total = timings.get("total") if isinstance(timings, dict) else None
        busy += total if isinstance(total, float) else 0.0
    return last[0] - moments[0], busy


def digest_of(folder: Path) -> str:
    """Digest of everything in a run that must not depend on the number of workers.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    str
        sha256 of names and bytes.
    """
    digest = hashlib.sha256()
    for part in _COMPARED:
        for path in sorted((folder / part).rglob("*")):
            if path.is_file():
                digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Measure and print."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else _FRAMES
    table = Table(title=f"{frames} frames, from workers up to last frame done")
    for column in ("workers", "seconds", "speed-up over one", "own work ms/frame", "overhead ms/frame", "bytes"):
        table.add_column(column, justify="right")
    with tempfile.TemporaryDirectory() as scratch:
        options = StarSampleOptions(frames=frames, seed=17, cameras=("cassini_nac", "voyager_na"), processes=2)
        archive = make_star_sample(Path(scratch) / "archive", options)
        # The kernels are compiled and the file cache is filled before anything is timed.
        timed_run(archive, Path(scratch) / "warm-up", 0)
        seconds: dict[int, float] = {}
        digests: dict[int, str] = {}
        for workers in (0, 1, 2):
            seconds[workers], busy = timed_run(archive, Path(scratch) / f"run-{workers}", workers)
            digests[workers] = digest_of(Path(scratch) / f"run-{workers}")
            overhead = (seconds[workers] * max(workers, 1) - busy) / frames
            table.add_row(
                str(workers) if workers else "serial", f"{seconds[workers]:.2f}",
                f"{seconds[1] / seconds[workers]:.2f}" if workers else "", f"{busy / frames * 1e3:.1f}",
                f"{overhead * 1e3:.2f}", "same" if digests[workers] == digests[0] else "DIFFERENT",
            )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
