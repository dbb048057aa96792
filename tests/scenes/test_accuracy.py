"""Sigmas are promises: pulls over hundreds of frames of the sample archive, per technique and fused."""

import json
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pytest

from pipeline.records import FloatArray
from tests.scenes.runs import run_archive
from workflows.report import compare, read_truth
from workflows.samples.camera_table import sample_cameras
from workflows.samples.cameras import SampleCamera
from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample

FRAMES = 420


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, pd.DataFrame]:
    root = tmp_path_factory.mktemp("accuracy")
    archive = make_star_sample(root / "archive", StarSampleOptions(frames=FRAMES, seed=5, processes=1))
    return archive, root / "run", run_archive(archive, root / "run")


def _holds(pulls: FloatArray) -> None:
    assert 0.8 <= np.sqrt(np.mean(pulls**2)) <= 1.25
    assert 0.90 <= np.mean(np.abs(pulls) <= 2.0) <= 0.99


@pytest.mark.slow
def test_fused_answers(sample: tuple[Path, Path, pd.DataFrame]) -> None:
    archive, _, table = sample
    joined, agreement = compare(table.reset_index(), read_truth(archive.parent / "truth.json"))
    assert agreement.images == FRAMES
    assert agreement.answered >= 300
    assert agreement.false_successes == ()
    good = joined[joined["status"] == "success"]
    _holds(good[["pull_dv", "pull_du"]].to_numpy())
    turned = good.dropna(subset=["rotation_deg"])
    _holds((turned["error_rotation_deg"] / turned["sigma_rotation_deg"]).to_numpy())


@pytest.mark.slow
@pytest.mark.parametrize("technique", ["StarFieldFromCatalogNav", "StarUniqueMatchNav", "StarRefineNav"])
def test_each_technique(technique: str, sample: tuple[Path, Path, pd.DataFrame]) -> None:
    archive, run, _ = sample
    frames = json.loads((archive.parent / "truth.json").read_text())["frames"]
    truth = pd.DataFrame.from_dict(frames, orient="index")
    query = f"select * from read_parquet('{run}/techniques/**/*.parquet', hive_partitioning = true)"
    with duckdb.connect() as database:
        table = database.sql(query).df()
    mine = table[(table["technique"] == technique) & (table["status_reason"] == "navigated")]
    assert len(mine) >= 300
    joined = mine.merge(truth.add_prefix("planted_"), left_on="image_id", right_index=True)
    pulls = [
        pull
        for record in joined.to_dict("records")
        for pull in _pulls({str(k): v for k, v in record.items()}, sample_cameras()[str(record["planted_camera"])])
    ]
    _holds(np.array(pulls))


def _pulls(row: dict[str, float], camera: SampleCamera) -> FloatArray:
    """Errors over sigmas about the technique's own pivot, to which the planted truth is moved."""
    theta = np.radians(row["planted_rotation_deg"])
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    arm = np.array([row["pivot_v_px"], row["pivot_u_px"]]) - camera.centre_vu
    planted = np.array([row["planted_offset_dv_px"], row["planted_offset_du_px"]]) - (np.eye(2) - turn) @ arm
    error = np.array([row["offset_dv_px"], row["offset_du_px"]]) - planted
    return np.asarray(error / [row["sigma_dv_px"], row["sigma_du_px"]])
