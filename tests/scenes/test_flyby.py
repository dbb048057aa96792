"""Sigmas of bodies are promises: pulls over frames of the flyby sample, with SPICE geometry from end to end."""

import json
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pytest

from pipeline.records import FloatArray
from tests.scenes.runs import run_archive
from workflows.report import compare, read_truth
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_options import FlybyOptions

FRAMES = 60
# A wrong shape, an untold haze, a ghost: what the kernels say is false there, and another test looks at them.
TRAPS = ("haze", "lumpy", "ghost", "twins")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, pd.DataFrame]:
    root = tmp_path_factory.mktemp("flyby")
    options = FlybyOptions(frames=FRAMES, seed=404, processes=1, diameter_px=(6.0, 600.0), trap_share=0.0)
    archive = make_flyby_sample(root / "archive", options)
    return archive, root / "run", run_archive(archive, root / "run")


def _pulls(table: pd.DataFrame) -> FloatArray:
    return table[["pull_dv", "pull_du"]].dropna().to_numpy()


@pytest.mark.slow
def test_fused_answers(run: tuple[Path, Path, pd.DataFrame]) -> None:
    archive, _, table = run
    joined, agreement = compare(table.reset_index(), read_truth(archive.parent / "truth.json"))
    frames = pd.DataFrame.from_dict(json.loads((archive.parent / "truth.json").read_text())["frames"], orient="index")
    knowable = frames[(frames[["cramer_rao_sigma_dv_px", "cramer_rao_sigma_du_px"]] < 0.5).all(axis=1)].index
    status = table.loc[table.index.isin(knowable), "status"]
    assert len(status) > FRAMES / 2
    assert (status == "success").mean() >= 0.93
    pulls = _pulls(joined[joined["status"] == "success"])
    # With about a hundred pulls the median is steady where an rms is not: one outlier in a hundred is looked for next.
    assert 0.5 < np.median(np.abs(pulls)) / 0.6745 < 1.6
    assert (np.abs(pulls) <= 2.0).mean() >= 0.85
    assert len(agreement.false_successes) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("technique", ["BodyLimbNav", "BodyDiscCorrelateNav", "BodyBlobNav"])
def test_techniques_answer(technique: str, run: tuple[Path, Path, pd.DataFrame]) -> None:
    query = f"select * from read_parquet('{run[1]}/techniques/**/*.parquet', hive_partitioning = true)"
    with duckdb.connect() as database:
        table = database.sql(query).df()
    mine = table[(table["technique"] == technique) & (table["status_reason"] == "navigated")]
    assert len(mine) >= (10 if technique == "BodyBlobNav" else 40)
    assert (mine["sigma_dv_px"].dropna() > 0).all()


@pytest.mark.slow
def test_traps_never_end_as_sure_lies(tmp_path: Path) -> None:
    options = FlybyOptions(frames=16, seed=405, processes=1, diameter_px=(20.0, 400.0), trap_share=1.0)
    archive = make_flyby_sample(tmp_path / "archive", options)
    table = run_archive(archive, tmp_path / "run")
    joined, _ = compare(table.reset_index(), read_truth(archive.parent / "truth.json"))
    good = joined[joined["status"] == "success"]
    worst = good[["pull_dv", "pull_du"]].abs().max(axis=1)
    # Most of them are covered by their sigma, failed or conflicted; how many are not is in the method's figures.
    assert (worst < 5.0).mean() >= 0.6
