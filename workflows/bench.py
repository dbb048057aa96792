"""Benchmark: seconds and memory of one image on one core, from open file to record.

``python -m workflows.bench`` prints a table and writes ``outputs/bench.json``. Every case runs in a process of its own
so that its peak memory is its own; the floor, one real FFT of 1152 x 1344, is timed in the same run so that figures of
different machines (or of a machine whose speed drifts) can be compared.
"""

import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.fft
from astropy.io import fits
from rich.console import Console
from rich.table import Table

from catalogs.archive import open_archive
from pipeline.curate import Json
from workflows.config import load_configuration
from workflows.plan import make_plan
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample
from workflows.store import RunFolder, prepare, to_json, write_atomically
from workflows.task import ImageRunner

OUTPUT = Path("outputs/bench.json")
_FLOOR_SHAPE = (1152, 1344)
_WARM_UP = 3
_REPEATS = 25


@dataclass(frozen=True)
class Figures:
    """One case: median and quartiles of seconds, peak resident memory of its process."""

    median_s: float
    low_s: float
    high_s: float
    peak_rss_mb: float
    status: str


def make_stars_1024(folder: Path) -> Path:
    """Archive of one 1024 x 1024 frame with 40 catalogue stars and 300 detections, rotation searched too.

    Parameters
    ----------
    folder
        New folder.

    Returns
    -------
    pathlib.Path
        Its archive.yaml.
    """
    rng = np.random.default_rng(4)
    frames = folder / "frames"
    frames.mkdir(parents=True)
    sidecar = _sidecar_1024()
    scale = 1.0 / (2000.0 * 1000.0 / 12.0)
    catalogue = rng.uniform(20.0, 1003.0, (40, 2))
    planted = np.array([21.3, -77.6])
    flux = np.concatenate([10.0 ** rng.uniform(2.9, 4.5, 40), 10.0 ** rng.uniform(2.5, 4.2, 270)])
    places = np.concatenate([catalogue + planted, rng.uniform(5.0, 1018.0, (270, 2))])
    image = _draw(places, flux, rng)
    fits.PrimaryHDU(image).writeto(frames / "stars_1024.fits")
    (frames / "stars_1024.geometry.json").write_text(json.dumps(sidecar))
    x, y = (catalogue[:, 1] - 511.5) * scale, (catalogue[:, 0] - 511.5) * scale
    # The camera looks along +X of J2000 with its x axis toward +Y and its y axis toward +Z.
    table = pd.DataFrame(
        {
            "ra_deg": np.degrees(np.arctan2(x, 1.0)),
            "dec_deg": np.degrees(np.arctan(y / np.hypot(1.0, x))),
            "mag": -2.5 * np.log10(flux[:40] / 1.0e7),
        }
    )
    table.to_parquet(frames / "stars_1024.stars.parquet")
    path = folder / "archive.yaml"
    path.write_text("images: frames/*.fits\ngeometry: sidecar\nstars: per-image\n")
    return path


def _sidecar_1024() -> dict[str, object]:
    k = 1000.0 / 12.0
    return {
        "schema": "geometry/1", "image_id": "stars_1024", "mission": "SIM", "camera": "NAC",
        "mid_time_utc": "2010-01-01T00:00:00", "exposure_s": 1.0,
        "camera_model": {
            "shape_vu": [1024, 1024], "focal_length_mm": 2000.0, "k_px_per_mm": [[k, 0.0], [0.0, k]],
            "principal_point_vu": [511.5, 511.5], "distortion_eps": [0.0] * 6, "psf_sigma_px": 0.6,
            "read_noise_dn": 4.0, "saturation_dn": 4095.0, "missing_value": None, "star_dn_per_s_mag0": 1.0e7,
        },
        "gain_e_per_dn": 12.0, "fit_camera_rotation": True, "max_rotation_deg": 5.0,
        "search_margin_vu": [50.0, 140.0], "attitude": {"camera_from_j2000_wxyz": [0.5, -0.5, -0.5, -0.5]},
    }  # fmt: skip


def _draw(places_vu: np.ndarray, flux_dn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Frame of Gaussian stars with read and shot noise, 16-bit."""
    light = np.full((1024, 1024), 20.0)
    reach = np.arange(-6, 7)
    for (v, u), flux in zip(places_vu, flux_dn, strict=True):
        rows, cols = int(np.rint(v)) + reach, int(np.rint(u)) + reach
        rows, cols = rows[(rows >= 0) & (rows < 1024)], cols[(cols >= 0) & (cols < 1024)]
        fine = (np.arange(7) - 3.0) / 7.0
        profile_v = np.exp(-((rows[:, None] + fine - v) ** 2) / 0.72).mean(axis=1)
        profile_u = np.exp(-((cols[:, None] + fine - u) ** 2) / 0.72).mean(axis=1)
        light[np.ix_(rows, cols)] += flux * np.outer(profile_v, profile_u) / (0.72 * np.pi)
    noisy = rng.poisson(light * 12.0) / 12.0 + rng.normal(0.0, 4.0, light.shape)
    return np.clip(np.rint(noisy), -32768, 4095).astype(np.int16)


def make_lorri_256(folder: Path) -> Path:
    """Archive of LORRI-like 4x4-binned frames with 5 to 40 catalogue stars.

    Parameters
    ----------
    folder
        New folder.

    Returns
    -------
    pathlib.Path
        Its archive.yaml.
    """
    options = StarSampleOptions(frames=8, seed=11, cameras=("lorri_4x4",), min_stars=5, max_stars=40, processes=1)
    return make_star_sample(folder, options)


CASES: dict[str, Callable[[Path], Path]] = {"stars_1024": make_stars_1024, "lorri_256": make_lorri_256}


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
        for name, make in CASES.items():
            archive = make(Path(scratch) / name)
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
