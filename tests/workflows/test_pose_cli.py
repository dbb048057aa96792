"""``pilotage pose`` on planted views: right, whole, and one clear error for each bad file."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipeline.camera import project
from pipeline.errors import ConfigurationError
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.pose.normalise import pinhole_camera
from pipeline.pose.records import Pose
from pipeline.pose.se3 import SE3Utils
from workflows.cli import app

K = np.array([[5000.0, 0.0, 511.5], [0.0, 5000.0, 511.5], [0.0, 0.0, 1.0]])
COLUMNS = ["view_id", "x_km", "y_km", "z_km", "qw", "qx", "qy", "qz"]
COLUMNS += [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)] + ["rms_px", "label"]


def _looking(place: np.ndarray) -> Pose:
    z = -place / np.linalg.norm(place)
    x = np.cross([0, 0, 1.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z]), place)


def _views(seed: int = 0) -> tuple[pd.DataFrame, list[Pose], np.ndarray]:
    """Nine views of a bumpy ball, tracks with a quarter of a pixel of noise and a few that are wrong."""
    rng = np.random.default_rng(seed)
    poses = [_looking(2000 * np.array([np.cos(a), np.sin(a), 0.3 * np.sin(3 * a)])) for a in np.linspace(0, 0.8, 9)]
    direction = rng.normal(size=(3000, 3))
    points = direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(140, 170, (3000, 1))
    camera, rows = pinhole_camera(K, (1024, 1024)), []
    for view, pose in enumerate(poses):
        pixels, _ = project(camera, pose.to_camera(points))
        seen = (points @ pose.position_km > 0) & (rng.random(3000) < 0.25)
        pixels = pixels + rng.normal(size=pixels.shape) * 0.25
        wrong = rng.random(3000) < 0.03
        pixels[wrong] = rng.uniform(0, 1023, (wrong.sum(), 2))
        index = np.flatnonzero(seen)
        v, u = pixels[index].T
        rows.append(pd.DataFrame({"point_id": index + 7, "view_id": view * 10, "v_px": v, "u_px": u}))
    return pd.concat(rows, ignore_index=True), poses, points


def _cameras(folder: Path, poses: list[Pose], given: list[int], sign: float = 1.0) -> Path:
    views = [
        {
            "view_id": k * 10, "position_km": (sign * poses[k].position_km).tolist(),
            "camera_from_body": poses[k].camera_from_body.tolist(),
        }
        for k in given
    ]  # fmt: skip
    path = folder / "cameras.json"
    path.write_text(json.dumps({"K": K.tolist(), "shape_vu": [1024, 1024], "views": views}))
    return path


def _run(matches: Path, cameras: Path, output: Path, *more: str) -> tuple[int, str, BaseException | None]:
    result = CliRunner().invoke(app, ["pose", str(matches), "--cameras", str(cameras), "--output", str(output), *more])
    return result.exit_code, result.output, result.exception


def _pose_of(row: pd.Series, sign: float = 1.0) -> tuple[Pose, np.ndarray]:
    turn = matrix_from_quaternion(row[["qw", "qx", "qy", "qz"]].to_numpy(float))
    covariance = np.zeros((6, 6))
    for i in range(6):
        for j in range(i, 6):
            covariance[i, j] = covariance[j, i] = row[f"cov_{i}{j}"]
    return Pose(turn, sign * row[["x_km", "y_km", "z_km"]].to_numpy(float)), covariance


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_views_without_poses_are_solved_from_the_others(tmp_path: Path, sign: float) -> None:
    table, poses, _ = _views()
    table.to_parquet(tmp_path / "m.parquet")
    cameras = _cameras(tmp_path, poses, [0, 1, 2, 3, 5, 6, 8], sign)
    code, text, _ = _run(tmp_path / "m.parquet", cameras, tmp_path / "p.parquet")
    assert code == 0, text
    answers = pd.read_parquet(tmp_path / "p.parquet")
    assert list(answers.columns) == COLUMNS
    assert answers.view_id.tolist() == [40, 70]
    assert (answers.label == "satellite_anchored").all()
    assert ("look away" in text) == (sign < 0)
    assert b"Exp(r)" in pq.read_schema(tmp_path / "p.parquet").metadata[b"frame"]
    for k, true in enumerate((poses[4], poses[7])):
        row = answers.iloc[k]
        pose, covariance = _pose_of(row, sign)
        error = SE3Utils.error(pose, true)
        if sign < 0:
            error[:3] *= -1
        assert error @ np.linalg.solve(covariance, error) < 30
        assert np.linalg.norm(error[:3]) < 3
        assert 0.2 < row.rms_px < 0.6


def test_every_view_and_cheap_covariances(tmp_path: Path) -> None:
    table, poses, _ = _views(1)
    table.to_parquet(tmp_path / "m.parquet")
    cameras = _cameras(tmp_path, poses, list(range(8)))
    code, text, _ = _run(tmp_path / "m.parquet", cameras, tmp_path / "a.parquet", "--every")
    assert code == 0
    assert "against 8 given poses" in text
    full = pd.read_parquet(tmp_path / "a.parquet")
    assert len(full) == 9
    _run(tmp_path / "m.parquet", cameras, tmp_path / "b.parquet", "--every", "--covariance", "jacobian")
    cheap = pd.read_parquet(tmp_path / "b.parquet")
    assert not np.array_equal(full.cov_00, cheap.cov_00)
    np.testing.assert_allclose(np.sqrt(cheap.cov_00 / full.cov_00), 1.0, atol=0.1)


def test_places_of_points_may_come_with_the_matches(tmp_path: Path) -> None:
    table, poses, points = _views(2)
    table[["x_km", "y_km", "z_km"]] = points[table.point_id - 7]
    table["cov_vv"], table["cov_vu"], table["cov_uu"] = 0.0625, 0.0, 0.0625
    table = table[(table.view_id != 30) | (np.arange(len(table)) % 200 == 0)]
    table.to_parquet(tmp_path / "m.parquet")
    code, text, _ = _run(tmp_path / "m.parquet", _cameras(tmp_path, poses, []), tmp_path / "p.parquet")
    answers = pd.read_parquet(tmp_path / "p.parquet").set_index("view_id")
    assert code == 1
    assert "view 30: " in text
    assert answers.x_km.isna().tolist() == [False] * 3 + [True] + [False] * 5
    assert answers.loc[30, "label"] == "dead_reckoned"
    nees = []
    for view in (0, 10, 20, 40, 50, 60, 70, 80):
        pose, covariance = _pose_of(answers.loc[[view]].iloc[0])
        error = SE3Utils.error(pose, poses[view // 10])
        nees.append(error @ np.linalg.solve(covariance, error))
    # Mean of eight chi2 of six: sigma 1.2.
    assert 2 < np.mean(nees) < 11


def test_a_bundle_is_better_than_views_alone(tmp_path: Path) -> None:
    table, poses, _ = _views(5)
    table.to_parquet(tmp_path / "m.parquet")
    cameras = _cameras(tmp_path, poses, [0, 2, 4, 6, 8])
    away = {}
    tight = ("--given-sigma-km", "0.001", "--given-sigma-mrad", "0.0001")
    for name, more in (("alone", ()), ("bundle", ("--bundle", *tight))):
        code, text, _ = _run(tmp_path / "m.parquet", cameras, tmp_path / name, *more)
        assert code == 0, text
        answers = pd.read_parquet(tmp_path / name)
        nees, lost = [], []
        for k in range(4):
            pose, covariance = _pose_of(answers.iloc[k])
            error = SE3Utils.error(pose, poses[int(answers.view_id[k]) // 10])
            nees.append(error @ np.linalg.solve(covariance, error))
            lost.append(np.linalg.norm(error[:3]))
        # Mean of four chi2 of six: sigma 1.7; the weight of wrong tracks, which are bounded, is in it.
        assert np.mean(nees) < 14
        away[name] = np.mean(lost)
    assert away["bundle"] < away["alone"]
    _, _, refused = _run(tmp_path / "m.parquet", _cameras(tmp_path, poses, []), tmp_path / "x", "--bundle")
    assert "fewer than two" in str(refused)


def test_a_place_that_is_not_finite_fails_its_own_view_alone(tmp_path: Path) -> None:
    table, poses, points = _views(2)
    table = table[table.view_id < 30].reset_index(drop=True)
    table[["x_km", "y_km", "z_km"]] = points[table.point_id - 7]
    table["cov_vv"], table["cov_vu"], table["cov_uu"] = 0.0625, 0.0, 0.0625
    table.loc[[3, 4], "y_km"] = [np.inf, np.nan]
    table.loc[table.index[table.view_id == 10][0], "u_px"] = 1e300
    table.to_parquet(tmp_path / "m.parquet")
    code, text, _ = _run(tmp_path / "m.parquet", _cameras(tmp_path, poses, []), tmp_path / "p.parquet")
    assert code == 1
    assert text.count("view 0: 2 of its points have a place that is not finite") == 1
    assert text.count("view 10: 10: pixels_vu: row 0 not finite") == 1
    assert pd.read_parquet(tmp_path / "p.parquet").x_km.notna().tolist() == [False, False, True]


def test_given_views_without_a_finite_sighting_place_no_point(tmp_path: Path) -> None:
    table, poses, _ = _views(4)
    table.loc[table.view_id != 40, "v_px"] = np.nan
    table.to_parquet(tmp_path / "m.parquet")
    cameras = _cameras(tmp_path, poses, [0, 1, 2, 3, 5, 6, 7, 8])
    code, text, _ = _run(tmp_path / "m.parquet", cameras, tmp_path / "p.parquet")
    assert code == 1
    assert "sightings of views with given poses are not finite, and left out" in text
    assert "view 40: 0 matches, 6 are needed" in text


def _broken(kind: str, table: pd.DataFrame) -> pd.DataFrame:
    if kind == "nan":
        table.loc[table.index[table.view_id == 40][5], "v_px"] = np.nan
    elif kind == "doubled":
        table = pd.concat([table, table[table.view_id == 40].iloc[:1]])
    elif kind == "sigma":
        table["cov_vv"], table["cov_vu"], table["cov_uu"] = 0.1, 0.0, 0.1
        table.loc[table.index[table.view_id == 40][3], "cov_vv"] = -0.1
    elif kind == "zero":
        table["cov_vv"], table["cov_vu"], table["cov_uu"] = 0.1, 0.0, 0.1
        table.loc[table.index[table.view_id == 30][3], ["cov_vv", "cov_uu"]] = 0.0
        table.loc[table.index[table.view_id == 40][3], ["cov_vv", "cov_uu"]] = 0.0
    return table


@pytest.mark.parametrize(("kind", "view"), [("nan", 40), ("doubled", 40), ("sigma", 40), ("zero", 40)])
def test_a_bad_view_is_one_line_and_the_others_stay(tmp_path: Path, kind: str, view: int) -> None:
    table, poses, _ = _views(3)
    _broken(kind, table).to_parquet(tmp_path / "m.parquet")
    cameras = _cameras(tmp_path, poses, [0, 1, 2, 3, 5, 6, 8])
    code, text, _ = _run(tmp_path / "m.parquet", cameras, tmp_path / "p.parquet")
    answers = pd.read_parquet(tmp_path / "p.parquet").set_index("view_id")
    assert code == 1
    assert text.count(f"view {view}: ") == 1
    assert answers.x_km.notna().tolist() == [False, True]


@pytest.mark.parametrize(("change", "message"), [
    (lambda t: t.drop(columns="u_px"), "no column u_px"), (lambda t: t.iloc[:0], "no rows"),
    (lambda t: t.assign(cov_vv=1.0), "cov_vv without the others"), (lambda t: t.assign(x_km=0.0), "x_km without"),
    (lambda t: t.assign(view_id=t.view_id + 0.5), "view_id of row 0 is no whole number"),
    (lambda t: t.assign(v_px="a"), "v_px hold no numbers"),
    (lambda t: t.assign(point_id=t.point_id * 1e18), "point_id of row 0 is no whole number"),
    (lambda t: t.assign(x_km=np.arange(len(t)) * 1.0, y_km=0.0, z_km=0.0), "has more than one place"),
])  # fmt: skip
def test_a_bad_table_is_one_error(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    table, poses, _ = _views(4)
    change(table).to_parquet(tmp_path / "m.parquet")
    _, _, error = _run(tmp_path / "m.parquet", _cameras(tmp_path, poses, [0, 1]), tmp_path / "p.parquet")
    assert message in str(error)
    assert not (tmp_path / "p.parquet").exists()


@pytest.mark.parametrize(("change", "message"), [
    (lambda c: c.pop("K"), "no 'K'"), (lambda c: c["K"][0].__setitem__(0, 0.0), "K is singular"),
    (lambda c: c["views"].append(c["views"][0]), "given twice"),
    (lambda c: c["views"][0]["camera_from_body"][0].__setitem__(0, 3.0), "view 0: camera_from_body is not a rotation"),
    (lambda c: c["views"][0]["position_km"].__setitem__(0, float("nan")), "view 0: position_km is not finite"),
    (lambda c: c["views"][0]["position_km"].pop(), "three numbers"),
    (lambda c: c["views"].clear(), "fewer than two views"),
    (lambda c: c.update(datum={"name": "x", "radii_km": [1, -1, 1]}), "must be positive"),
    (lambda c: c.update(geoid={"lat_deg": [1, 0], "lon_deg": [0, 1], "height_m": [[0, 0], [0, 0]]}), "ascending"),
    (lambda c: c.update(vehicle={"camera_from_vehicle": [[1, 0, 0]] * 3}), "camera_from_vehicle is not a rotation"),
    (lambda c: c.update(views=3), "not iterable"),
    (lambda c: c["views"][0].update(view_id=1.5), "view_id 1.5 is no whole number"),
    (lambda c: c.update(datum="x"), "cannot be read as cameras"),
    (lambda c: c.update(arcs=[{"arc_id": "a", "views": []}]), "arc a has no views"),
    (lambda c: c.update(arcs=[{"arc_id": "a", "views": [{**c["views"][0], "et": float("nan")}]}]), "has no time"),
    (lambda c: c.update(arcs=[{"arc_id": "a", "views": [{**c["views"][0], "et": 1.0}]}] * 2), "arc is given twice"),
])  # fmt: skip
def test_bad_cameras_are_one_error(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    table, poses, _ = _views(4)
    table.to_parquet(tmp_path / "m.parquet")
    path = _cameras(tmp_path, poses, [0, 1])
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    _, _, error = _run(tmp_path / "m.parquet", path, tmp_path / "p.parquet")
    assert message in str(error)


def test_what_is_not_there_or_no_table_is_one_error(tmp_path: Path) -> None:
    _, poses, _ = _views(4)
    cameras = _cameras(tmp_path, poses, [0, 1])
    assert "No such file" in str(_run(tmp_path / "none", cameras, tmp_path / "p")[2])
    (tmp_path / "text").write_text("hello")
    assert "no Parquet table" in str(_run(tmp_path / "text", cameras, tmp_path / "p")[2])


def test_an_arc_may_solve_its_points(tmp_path: Path) -> None:
    table, poses, points = _views()
    rng, sigma = np.random.default_rng(5), 0.05
    wrong = points + rng.normal(size=points.shape) * sigma
    table[["x_km", "y_km", "z_km"]] = wrong[table.point_id - 7]
    for axes in ("xx", "xy", "xz", "yy", "yz", "zz"):
        table[f"cov_{axes}_km2"] = sigma**2 if axes[0] == axes[1] else 0.0
    table["cov_vv"] = table["cov_uu"] = 0.25**2
    table["cov_vu"] = 0.0
    path, cameras = tmp_path / "m.parquet", _cameras(tmp_path, poses, [])
    table.to_parquet(path)
    told = json.loads(cameras.read_text())
    arc = [
        {"view_id": 10 * k, "et": 60.0 * k, "position_km": pose.position_km.tolist(),
         "camera_from_body": pose.camera_from_body.tolist()} for k, pose in enumerate(poses)
    ]  # fmt: skip
    told["arcs"] = [{"arc_id": "a", "options": {"solve_landmarks": True, "segment": 4}, "views": arc}]
    cameras.write_text(json.dumps(told))
    assert _run(path, cameras, tmp_path / "p.parquet", "--arcs", str(tmp_path / "arcs"))[0] == 0
    solved = pd.read_parquet(tmp_path / "arcs" / "points.parquet")
    assert len(solved) == pd.read_parquet(tmp_path / "arcs" / "arcs.parquet").landmarks_solved[0] > 300
    error = solved[["x_km", "y_km", "z_km"]].to_numpy() - points[solved.point_id - 7]
    before = wrong[solved.point_id - 7] - points[solved.point_id - 7]
    assert np.sqrt((error**2).mean()) < 0.9 * np.sqrt((before**2).mean())
    variance = solved[["cov_xx_km2", "cov_yy_km2", "cov_zz_km2"]].to_numpy()
    # About a thousand numbers, most of them independent.
    assert np.mean(error**2 / variance) == pytest.approx(1.0, abs=0.15)

    told["arcs"][0]["options"] = {"solve_landmarks": "perhaps"}
    cameras.write_text(json.dumps(told))
    _, _, error_told = _run(path, cameras, tmp_path / "p.parquet", "--arcs", str(tmp_path / "arcs"))
    assert isinstance(error_told, ConfigurationError)
    assert "arc a: options.solve_landmarks" in str(error_told)
