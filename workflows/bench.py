"""Benchmark: seconds and memory of one image on one core, from open file to record.

``python -m workflows.bench`` prints a table and writes ``outputs/bench.json``. Every case runs in a process of its own
so that its peak memory is its own; the floor, one real FFT of 1152 x 1344, is timed in the same run so that figures of
different machines (or of a machine whose speed drifts) can be compared.
"""

import multiprocessing
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.fft
from rich.console import Console
from rich.table import Table

from catalogs.archive import open_archive
from pipeline.json_values import Json
from workflows.bench_scenes import SCENES, make_scene
from workflows.config import load_configuration
from workflows.plan import make_plan
from workflows.store import RunFolder, prepare, to_json, write_atomically
from workflows.task import ImageRunner

OUTPUT = Path("outputs/bench.json")
_FLOOR_SHAPE = (1152, 1344)
_WARM_UP = 3
_REPEATS = 4


@dataclass(frozen=True)
class Figures:
    """One case: median and quartiles of seconds, peak resident memory of its process."""

    median_s: float
    low_s: float
    high_s: float
    peak_rss_mb: float
    status: str


def time_case(archive: Path, run_folder: Path) -> Figures:
    """Time every image of an archive again and again, in this process.

    Parameters
    ----------
    archive
        Its archive.yaml.
    run_folder
        New folder for the records.

    Returns
    -------
    Figures
        Of opening, navigating and writing one image.
    """
    folder = RunFolder(run_folder)
    folder.root.mkdir(parents=True)
    prepare(folder)
    plan = make_plan(open_archive(str(archive), {}), load_configuration(), folder)
    runner = ImageRunner(plan.setup)
    outcomes = [runner.run(ref) for _ in range(_WARM_UP) for ref in plan.every]
    seconds = []
    for turn in range(_REPEATS * max(1, 8 // len(plan.every))):
        ref = plan.every[turn % len(plan.every)]
        start = time.perf_counter()
        runner.run(ref)
        seconds.append(time.perf_counter() - start)
    low, middle, high = np.quantile(seconds, (0.25, 0.5, 0.75))
    statuses = sorted({outcome.status for outcome in outcomes})
    return Figures(float(middle), float(low), float(high), peak_memory_mb(), "+".join(statuses))


def peak_memory_mb() -> float:
    """Peak resident memory of this process, MB.

    Returns
    -------
    float
        VmHWM; ``getrusage`` would count the parent's memory at the moment of the fork.
    """
    text = Path("/proc/self/status").read_text()
    line = next(line for line in text.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1024.0


def floor_seconds() -> float:
    """Median seconds of one float32 real FFT of 1152 x 1344 on one thread.

    Returns
    -------
    float
        Seconds.
    """
    image = np.random.default_rng(0).normal(size=_FLOOR_SHAPE).astype(np.float32)
    seconds = []
    for _ in range(15):
        start = time.perf_counter()
        scipy.fft.rfft2(image, workers=1)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def main() -> None:
    """Run all cases, print the table, write ``outputs/bench.json``."""
    # One image is one core's work: no library may bring helpers.
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    context = multiprocessing.get_context("spawn")
    figures: dict[str, Figures] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name in SCENES:
            archive = make_scene(name, Path(scratch) / name)
            with context.Pool(1) as pool:
                figures[name] = pool.apply(time_case, (archive, Path(scratch) / f"{name}-run"))
    floor = floor_seconds()
    _print(figures, floor)
    cases: dict[str, Json] = {
        name: {"median_s": f.median_s, "q25_s": f.low_s, "q75_s": f.high_s, "peak_rss_mb": f.peak_rss_mb}
        for name, f in figures.items()
    }
    OUTPUT.parent.mkdir(exist_ok=True)
    write_atomically(OUTPUT, to_json({"floor_rfft2_s": floor, "cases": cases}))


def _print(figures: dict[str, Figures], floor: float) -> None:
    table = Table(title=f"open file to record, one core (floor: one real FFT {floor * 1e3:.1f} ms)")
    for column in ("case", "median ms", "quartiles ms", "floors", "peak MB", "outcome"):
        table.add_column(column, justify="left" if column in ("case", "outcome") else "right")
    for name, f in figures.items():
        table.add_row(
            name, f"{f.median_s * 1e3:.1f}", f"{f.low_s * 1e3:.1f}-{f.high_s * 1e3:.1f}", f"{f.median_s / floor:.1f}",
            f"{f.peak_rss_mb:.0f}", f.status,
        )  # fmt: skip
    Console().print(table)


if __name__ == "__main__":
    main()
