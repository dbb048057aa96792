"""Make a sample archive of star fields with planted pointing errors.

The archive is the project's independent source of truth: nothing here is shared with the navigator, which sees only the
files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pandas as pd
import yaml

from workflows.samples.options import StarSampleOptions
from workflows.samples.plan import FramePlan, plan_frames
from workflows.samples.sky import read_real_sky
from workflows.samples.write import FrameTruth, refuse_used, write_frame

__all__ = ["StarSampleOptions", "make_star_sample"]

CONVENTION = (
    "actual = centre + R(theta)(predicted - centre) + (dv,du); (v,u) row,col of the stored array, first pixel centre "
    "(0,0); centre = array centre ((rows-1)/2, (cols-1)/2); positive theta turns +u toward +v: on (v,u) "
    "R = [[cos, sin], [-sin, cos]]. predicted: stars at their apparent place (proper motion, parallax, aberration) "
    "through the attitude in the file. n_stars: catalogue stars above five sigma on the array, lost lines excluded"
)
CHUNK = 4
"""Frames a worker takes at a time."""


def make_star_sample(directory: Path, options: StarSampleOptions) -> Path:
    """Write a sample archive of star fields and return the path of its archive.yaml.

    The same frames and seed give the same bytes, however many processes work: every frame has random generators of its
    own.

    Parameters
    ----------
    directory
        Where to write; made if it is not there.
    options
        What to write.

    Raises
    ------
    ValueError
        If an option makes no sense, or no place of the sky shows the wanted number of stars.
    FileExistsError
        If the directory holds anything, or is not a directory.
    """
    options.check()
    refuse_used(directory)
    plans, faint = plan_frames(options, read_real_sky())
    frames = directory / "frames"
    frames.mkdir(parents=True)
    tables: list[str | dict[str, str]] = ["gaia"]
    if faint is not None:
        faint.to_frame().to_parquet(directory / "faint.parquet", index=False)
        tables.append({"path": "faint.parquet", "place": "mean"})
    _write_truth(directory, _write_frames(plans, frames, options.processes))
    # The description comes last: an archive without it was interrupted.
    description = {"name": f"stars-{options.seed}", "images": "frames/*.fits", "stars": tables}
    path = directory / "archive.yaml"
    path.write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
    return path


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start worker processes afresh: forking a program that may run threads is not safe."""
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield pool


def _write_frames(plans: list[FramePlan], folder: Path, processes: int) -> list[FrameTruth]:
    """Write all frames and return their truth in order."""
    work = partial(write_frame, folder=folder)
    if processes == 1 or len(plans) == 1:
        return [work(plan) for plan in plans]
    with _workers(min(processes, len(plans))) as pool:
        return list(pool.map(work, plans, chunksize=CHUNK))


def _write_truth(directory: Path, truths: list[FrameTruth]) -> None:
    """Write truth.json and truth_stars.parquet."""
    entries = {truth.image_id: truth.entry for truth in truths}
    text = json.dumps({"convention": CONVENTION, "frames": entries}, indent=1)
    (directory / "truth.json").write_text(text + "\n", encoding="utf-8")
    rows = pd.concat([pd.DataFrame(truth.stars) for truth in truths if truth.stars["kind"]], ignore_index=True)
    rows.to_parquet(directory / "truth_stars.parquet", index=False)
