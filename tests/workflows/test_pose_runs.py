"""``pilotage pose RUN``: poses and arcs of a run's documents, the same whoever solves them, and nothing lost."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from pipeline.camera import project
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.pose.records import Pose
from pipeline.pose.se3 import SE3Utils
from tests.workflows.pose_scenes import CAMERA, SETTINGS, PlantedRun, plant_run
from workflows.cli import app


def _run(run: PlantedRun, *more: str) -> tuple[int, str]:
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    result = CliRunner().invoke(app, ["pose", str(run.folder.root), *settings, *more])
    return result.exit_code, result.output + str(result.exception or "")


def _table(run: PlantedRun, name: str) -> pd.DataFrame:
    return pd.read_parquet(run.folder.root / name)


def _nees(run: PlantedRun, poses: pd.DataFrame, prefix: str = "") -> np.ndarray:
    found = []
    for row in poses.to_dict("records"):
        turn = matrix_from_quaternion(np.array([row[f"{prefix}q{part}"] for part in "wxyz"]))
        pose = Pose(turn, np.array([row[f"{prefix}{axis}_km"] for axis in "xyz"]))
        covariance = np.zeros((6, 6))
        for i in range(6):
            for j in range(i, 6):
                covariance[i, j] = covariance[j, i] = row[f"{prefix}cov_{i}{j}"]
        error = SE3Utils.error(pose, run.poses[row["image_id"]])
        found.append(error @ np.linalg.solve(covariance, error))
    return np.array(found)


def test_arcs_of_landmarks_stars_and_limbs_hold_their_covariances(tmp_path: Path) -> None:
    smoothed, alone = [], []
    for seed in range(6):
        run = plant_run(tmp_path / str(seed), count=25, seed=seed)
        code, text = _run(run, "--serial")
        assert code == 0, text
        poses, arcs = _table(run, "poses"), _table(run, "arcs")
        assert poses.image_id.tolist() == run.image_ids
        assert (poses.label == "satellite_anchored").sum() == 10 == poses.raw_x_km.notna().sum()
        assert poses.offset_used.sum() == 10
        assert poses.last_satellite_anchor_age_ms.tolist()[:4] == [0, 0, 60000, 120000]
        bias = arcs[["bias_x_rad", "bias_y_rad", "bias_twist_rad"]].to_numpy()[0] - run.bias_rad
        sigma = arcs[[f"sigma_bias_{name}_rad" for name in ("x", "y", "twist")]].to_numpy()[0]
        assert (np.abs(bias) < 4.5 * sigma).all()
        smoothed.append(_nees(run, poses).mean())
        alone.append(_nees(run, poses[poses.raw_x_km.notna()], "raw_").mean())
    # Images of an arc share errors: of 30 arcs the means scattered by 1.1 about 6.0.
    assert 4.2 < np.mean(smoothed) < 7.8
    assert 4.8 < np.mean(alone) < 7.2


@pytest.mark.slow
def test_the_same_bytes_from_one_process_and_from_workers(tmp_path: Path) -> None:
    run = plant_run(tmp_path, cameras=("NAC", "WAC", "X/Y"), count=8)
    digests = []
    for how in (["--serial"], ["--workers", "2"]):
        code, text = _run(run, *how, "--set", "solve_landmarks=true")
        assert code == 0, text
        assert (_table(run, "arcs").landmarks_solved > 30).all()
        files = sorted(p for name in ("poses", "arcs") for p in (run.folder.root / name).rglob("*.parquet"))
        assert len(files) == 6
        digests.append([hashlib.sha256(path.read_bytes()).hexdigest() for path in files])
    assert digests[0] == digests[1]
    timings = _table(run, "timings")
    mine = timings[timings.stage == "pose"]
    # Once per image although the stage has run twice; a clock for each pose.
    assert len(mine) == 24
    assert mine.emitted_at_ns.notna().sum() == _table(run, "poses").raw_x_km.notna().sum()


def test_gaps_cut_arcs_and_two_products_of_one_instant_lie_side_by_side(tmp_path: Path) -> None:
    run = plant_run(tmp_path, count=10, kinds="L")
    twin = json.loads(run.folder.document("NAC_003").read_text())
    twin["image_id"] = "NAC_003b"
    run.folder.document("NAC_003b").write_text(json.dumps(twin))
    late = json.loads(run.folder.document("NAC_009").read_text())
    run.folder.document("NAC_009").write_text(json.dumps(late | {"et": late["et"] + 5000.0}))
    lone = json.loads(run.folder.document("NAC_008").read_text())
    run.folder.document("NAC_008").write_text(json.dumps(lone | {"geometry": None}))
    run.folder.plan.write_text(json.dumps({"images": [*run.image_ids, "NAC_003b"], "digest": "x"}))
    code, text = _run(run, "--serial", "--gap-s", "600")
    assert code == 0, text
    assert "1 images in no arc" in text
    arcs = _table(run, "arcs").set_index("arc_id")
    assert arcs.images.to_dict() == {"NAC_000": 8, "NAC_003b": 1, "NAC_009": 1}
    assert sorted(_table(run, "poses").image_id) == sorted({*run.image_ids, "NAC_003b"} - {"NAC_008"})


def test_matches_of_another_program_take_the_place_of_landmarks(tmp_path: Path) -> None:
    run = plant_run(tmp_path / "run", count=6, kinds=".")
    rng, folder = np.random.default_rng(4), tmp_path / "theirs"
    folder.mkdir()
    for image_id in run.image_ids[:2]:
        points = rng.normal(size=(60, 3)) * 10.0
        pixels, _ = project(CAMERA, run.poses[image_id].to_camera(points))
        table = pd.DataFrame(points, columns=["x_km", "y_km", "z_km"]).assign(point_id=range(60))
        table[["v_px", "u_px"]] = pixels + rng.normal(size=(60, 2)) * 0.2
        table["cov_vv"], table["cov_vu"], table["cov_uu"] = 0.04, 0.0, 0.04
        table.to_parquet(folder / f"{image_id}.matches.parquet")
    table.drop(columns="z_km").to_parquet(folder / f"{run.image_ids[2]}.matches.parquet")
    table.assign(u_px=np.nan).to_parquet(folder / f"{run.image_ids[3]}.matches.parquet")
    code, text = _run(run, "--serial", "--matches", str(folder))
    assert code == 1
    assert text.count("matches.parquet: x_km, y_km without") == 1
    assert text.count(f"{run.image_ids[3]}: pixels_vu: row 0, 1, 2 and 57 more not finite") == 1
    poses = _table(run, "poses").set_index("image_id")
    assert poses.raw_x_km.notna().tolist() == [True, True, False, False, False, False]
    assert poses.failure.fillna("").tolist()[1:4] == ["", "bad_input", "bad_input"]
    assert poses.x_km.notna().all()
    assert (_nees(run, poses.reset_index().iloc[:2], "raw_") < 25).all()


def test_a_smoothed_run_can_be_asked(tmp_path: Path) -> None:
    run = plant_run(tmp_path, count=5)
    assert _run(run, "--serial")[0] == 0
    question = "select label, count(*) n, any_value(images) m from poses join arcs using (arc_id) group by 1 order by 1"
    asked = CliRunner().invoke(app, ["query", str(tmp_path), question, "--format", "csv"])
    assert asked.output.splitlines() == ["label,n,m", "satellite_anchored,2,5", "visual_propagated,3,5"]


def _spoil(run: PlantedRun, change: str) -> None:
    path = run.folder.document("NAC_001")
    content = json.loads(path.read_text())
    if change == "nan":
        content["landmarks"]["sigma_dv_px"][3] = -1.0
    elif change == "short":
        content["landmarks"]["x_km"].pop()
    elif change == "camera":
        del content["geometry"]["camera_model"]["k_px_per_mm"]
    elif change == "turn":
        content["geometry"]["bodies"][0]["body_from_j2000_wxyz"] = [0.0, 0.0, 0.0]
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(("change", "message", "rows"), [
    ("nan", "pixel covariance: row", 6), ("short", "no landmarks as the table has them", 6),
    ("camera", "NAC_001: its document is not one of this version", 5),
    ("turn", "NAC_001: its document is not one of this version", 5),
])  # fmt: skip
def test_a_spoilt_document_is_one_line_and_the_others_stay(
    tmp_path: Path, change: str, message: str, rows: int
) -> None:
    run = plant_run(tmp_path, count=6, kinds="L")
    _spoil(run, change)
    code, text = _run(run, "--serial")
    assert (code, text.count(message)) == (1, 1), text
    poses = _table(run, "poses")
    assert len(poses) == rows
    assert poses.raw_x_km.notna().sum() == 5


@pytest.mark.parametrize(("more", "message"), [
    (["--set", "walk=1"], "options.walk"), (["--set", "position_sigma_km=-1"], "options.position_sigma_km"),
    (["--body", "MOON"], "--body MOON: no image of this run"), (["--output", "x"], "--output makes no sense"),
    (["--matches", "/nowhere"], "no such folder"), (["--serial", "--scheduler", "tcp://a:1"], "exclude each other"),
])  # fmt: skip
def test_what_cannot_be_is_said_before_anything_is_written(tmp_path: Path, more: list[str], message: str) -> None:
    run = plant_run(tmp_path, count=2)
    before = (tmp_path / "arcs" / "mission=M" / "camera=NAC" / "arcs.parquet").stat().st_mtime_ns
    _, text = _run(run, *more)
    assert message in text
    assert (tmp_path / "arcs" / "mission=M" / "camera=NAC" / "arcs.parquet").stat().st_mtime_ns == before


def test_a_folder_that_is_no_run_and_a_run_without_bodies(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    result = CliRunner().invoke(app, ["pose", str(tmp_path / "empty")])
    assert "holds no finished run" in str(result.exception)
    run = plant_run(tmp_path / "run", count=2)
    for image_id in run.image_ids:
        content = json.loads(run.folder.document(image_id).read_text())
        content["geometry"]["bodies"] = []
        run.folder.document(image_id).write_text(json.dumps(content))
    assert "no image has a body" in _run(run, "--serial")[1]
    result = CliRunner().invoke(app, ["pose", str(run.folder.plan)])
    assert "need --cameras and --output" in str(result.exception)
