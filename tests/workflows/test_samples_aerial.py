"""The sample flight: the same seed gives the same bytes, and `pilotage pose` finds what was planted."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.geometry.wgs84 import WgsConverter
from pipeline.pose.records import Pose
from pipeline.pose.se3 import SE3Utils
from workflows.cli import app
from workflows.samples.aerial import AerialOptions, make_aerial_sample


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight") / "sample"
    make_aerial_sample(folder, AerialOptions(frames=90, seed=3))
    return folder


@pytest.fixture(scope="module")
def solved(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[pd.DataFrame, pd.DataFrame]:
    out = tmp_path_factory.mktemp("solved")
    arguments = [
        str(flight / "matches.parquet"),
        "--cameras",
        str(flight / "cameras.json"),
        "-o",
        str(out / "p.parquet"),
    ]
    result = CliRunner().invoke(app, ["pose", *arguments, "--arcs", str(out)])
    assert result.exit_code == 1, result.output
    for name in ("poses", "arcs"):
        schema = pq.read_schema(out / f"{name}.parquet")
        assert all(set(field.metadata) == {b"unit", b"meaning"} for field in schema)
    clocks = pd.read_parquet(out / "timings.parquet")
    assert (clocks.seconds > 0).any()
    assert clocks.emitted_at_ns.dropna().is_monotonic_increasing
    return pd.read_parquet(out / "poses.parquet"), pd.read_parquet(out / "arcs.parquet")


def test_same_seed_same_bytes(flight: Path, tmp_path: Path) -> None:
    make_aerial_sample(tmp_path / "again", AerialOptions(frames=90, seed=3))
    for path in sorted(flight.iterdir()):
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def _nees(poses: pd.DataFrame, truth: dict[str, dict[str, list[float]]], prefix: str = "") -> list[float]:
    nees = []
    for k in range(len(poses)):
        row = poses.iloc[k]
        turn = matrix_from_quaternion(np.array([row[f"{prefix}q{part}"] for part in "wxyz"]))
        covariance = np.zeros((6, 6))
        for i in range(6):
            for j in range(i, 6):
                covariance[i, j] = covariance[j, i] = row[f"{prefix}cov_{i}{j}"]
        planted = truth[str(row.view_id)]
        true = Pose(np.array(planted["camera_from_body"]), np.array(planted["position_km"]))
        error = SE3Utils.error(Pose(turn, np.array([row[f"{prefix}{axis}_km"] for axis in "xyz"])), true)
        nees.append(float(error @ np.linalg.solve(covariance, error)))
    return nees


def test_poses_hold_with_and_without_matches(flight: Path, solved: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    poses, _ = solved
    truth = json.loads((flight / "truth.json").read_text())["views"]
    assert len(poses) == len(truth) == 90
    kind = np.array([truth[str(view)]["kind"] for view in poses.view_id])
    plain = poses[kind == "plain"]
    assert (plain.label == "satellite_anchored").mean() > 0.97
    assert (poses[kind != "plain"].label == "visual_propagated").all()
    assert poses[kind == "misplaced"].outlier.all()
    # Means of about seventy and ten chi2 of six; neighbours share errors.
    assert 4.5 < np.mean(_nees(plain, truth)) < 7.5
    assert 4.5 < np.mean(_nees(plain, truth, "raw_")) < 7.5
    assert 1.5 < np.mean(_nees(poses[kind == "gap"], truth)) < 14
    converter = WgsConverter()
    places = converter.geodetic(np.array([truth[str(view)]["position_km"] for view in poses.view_id]))
    assert np.abs(places[:, 2] - poses.ellipsoidal_m).max() < 10
    assert poses.alt_m.isna().all()
    assert (poses.datum == "WGS84").all()


def test_gaps_age_and_throttled_frames_are_cheap(flight: Path, solved: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    poses, _ = solved
    truth = json.loads((flight / "truth.json").read_text())["views"]
    throttled = np.array([truth[str(view)]["throttled"] for view in poses.view_id])
    with_pose = poses.failure.isna()
    assert (poses.covariance_mode[throttled & with_pose] == "jacobian").all()
    assert (poses.covariance_mode[~throttled & with_pose] == "marginals").all()
    age = poses.last_satellite_anchor_age_ms
    anchored = poses.label == "satellite_anchored"
    assert (age[anchored] == 0).all()
    later = ~anchored & age.notna()
    previous = age.shift(1)
    assert (age[later] == previous[later] + 1000).all()


def test_the_bias_is_found(flight: Path, solved: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    bias = json.loads((flight / "truth.json").read_text())["bias_rad"]
    row = solved[1].iloc[0]
    assert row.images == row.anchored + row.propagated + row.dead_reckoned == 90
    for name, true in zip(("x", "y", "twist"), bias, strict=True):
        assert abs(row[f"bias_{name}_rad"] - true) < 4 * row[f"sigma_bias_{name}_rad"]
        assert row[f"sigma_bias_{name}_rad"] < 3e-4


@pytest.mark.parametrize(("options", "message"), [
    (AerialOptions(frames=1), "frames"), (AerialOptions(outliers=0.9), "outliers"),
])  # fmt: skip
def test_absurd_choices_are_refused(tmp_path: Path, options: AerialOptions, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_aerial_sample(tmp_path / "x", options)


def test_mounting_and_geoid_of_the_file_reach_the_table(
    flight: Path, solved: tuple[pd.DataFrame, pd.DataFrame], tmp_path: Path
) -> None:
    content = json.loads((flight / "cameras.json").read_text())
    content["vehicle"] = {"camera_from_vehicle": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "camera_in_vehicle_m": [0, 0, 3.0]}
    content["geoid"] = {"lat_deg": [40, 50], "lon_deg": [30, 40], "height_m": [[20, 20], [20, 20]]}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    arguments = [str(flight / "matches.parquet"), "--cameras", str(tmp_path / "cameras.json")]
    CliRunner().invoke(app, ["pose", *arguments, "-o", str(tmp_path / "p"), "--arcs", str(tmp_path)])
    poses, plain = pd.read_parquet(tmp_path / "poses.parquet"), solved[0]
    np.testing.assert_allclose(poses.ellipsoidal_m - poses.alt_m, 20.0, atol=1e-9)
    # The camera hangs three metres below, within the wobble of the airframe.
    np.testing.assert_allclose(poses.ellipsoidal_m - plain.ellipsoidal_m, 3.0, atol=0.1)
    camera = matrix_from_quaternion(poses.loc[0, ["qw", "qx", "qy", "qz"]].to_numpy(float))
    vehicle = matrix_from_quaternion(poses.loc[0, [f"vehicle_q{part}" for part in "wxyz"]].to_numpy(float))
    np.testing.assert_allclose(camera @ vehicle, content["vehicle"]["camera_from_vehicle"], atol=1e-12)


def test_bad_arcs_are_one_error(flight: Path, tmp_path: Path) -> None:
    content = json.loads((flight / "cameras.json").read_text())
    for change, message in (
        (lambda arc: arc["options"].update(walk_km_per_sqrt_s=-1.0), "options.walk_km_per_sqrt_s"),
        (lambda arc: arc["views"].reverse(), "not later"), (lambda arc: arc["views"].clear(), "has no views"),
        (lambda arc: arc.pop("arc_id"), "no 'arc_id'"),
    ):  # fmt: skip
        broken = json.loads(json.dumps(content))
        change(broken["arcs"][0])  # type: ignore[no-untyped-call]
        (tmp_path / "cameras.json").write_text(json.dumps(broken))
        arguments = [str(flight / "matches.parquet"), "--cameras", str(tmp_path / "cameras.json")]
        result = CliRunner().invoke(app, ["pose", *arguments, "-o", str(tmp_path / "p"), "--arcs", str(tmp_path / "a")])
        assert message in str(result.exception)
    broken = content | {"arcs": []}
    (tmp_path / "cameras.json").write_text(json.dumps(broken))
    result = CliRunner().invoke(app, ["pose", *arguments, "-o", str(tmp_path / "p"), "--arcs", str(tmp_path / "a")])
    assert "no arcs" in str(result.exception)
