"""Maplets from the command line to the table of landmarks, on the real picture of Eros."""

import json
from pathlib import Path

import duckdb
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.scenes.data import DATA, needs_data
from workflows.cli import app

RUN = CliRunner()
SOURCE = DATA / "eros_near"


def archive_with_maplets(root: Path) -> Path:
    root.mkdir()
    for path in SOURCE.glob("m*"):
        (root / path.name).symlink_to(path)
    (root.parent / "shapes").symlink_to(DATA / "shapes")
    made = RUN.invoke(
        app,
        ["catalog", "make-maplets", "--shape", str(DATA / "shapes" / "eros.obj"), "--size", "49", "--scale", "60",
         "--count", "400", "-o", str(root / "eros.maplets")],
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    text = 'name: eros\nimages: "*.fit"\ngeometry: sidecar\nmaplets: {EROS: eros.maplets}\n'
    (root / "archive.yaml").write_text(text)
    return root


@needs_data
def test_landmarks_are_found_fused_and_written(tmp_path: Path) -> None:
    archive = archive_with_maplets(tmp_path / "eros")
    run = RUN.invoke(app, ["run", str(archive), "--output", str(tmp_path / "run"), "--serial"])
    document = json.loads(next((tmp_path / "run" / "images").glob("*.json")).read_text())
    assert document["status"] == "success", run.output
    answers = {answer["technique"]: answer for answer in document["techniques"]}
    landmarks = answers["SurfaceFeatureNav"]
    assert landmarks["status_reason"] == "navigated"
    assert landmarks["diagnostics"]["landmarks_used"] >= 10
    # Another technique on the same mesh sees the same displacement.
    assert np.abs(np.subtract(landmarks["offset_px"], answers["BodyDiscCorrelateNav"]["offset_px"])).max() < 2.0
    state = document["landmark_state"]
    assert state["observable_directions"] == 6
    assert state["landmarks_used"] >= 10
    assert (np.linalg.eigvalsh(state["covariance"]) > 0).all()
    assert any(name == "maplets of EROS" for name, _ in map(tuple, _pairs(document["provenance"]["catalogs"])))
    rows = duckdb.sql(
        f"select status, used, offset_dv_px, observed_v_px - predicted_v_px, sigma_dv_px, correlation "
        f"from read_parquet('{tmp_path}/run/landmarks/**/*.parquet')"
    ).fetchall()
    assert len(rows) == landmarks["diagnostics"]["landmarks_looked_for"]
    found = [row for row in rows if row[0] == "found"]
    assert sum(row[1] for row in rows) == state["landmarks_used"]
    assert all(row[2] == pytest.approx(row[3], abs=1e-4) and row[4] > 0 and row[5] > 0.3 for row in found)
    assert all(row[2] is None for row in rows if row[0] != "found")
    table = f"read_parquet('{tmp_path}/run/poses/**/*.parquet')"
    poses = f"select method, raw_x_km, x_km, sqrt(raw_cov_00), body from {table}"
    ((method, x_km, smoothed, _, body),) = duckdb.sql(poses).fetchall()
    assert (method, smoothed, body) == ("landmark_state", None, "EROS")
    assert x_km == pytest.approx(state["position_km"][0])
    # From the matches alone, without what was believed beforehand.
    posed = RUN.invoke(app, ["pose", str(tmp_path / "run"), "--serial"])
    assert posed.exit_code == 0, posed.output
    ((method, again_km, smoothed, sigma, _),) = duckdb.sql(poses).fetchall()
    assert method in ("sqpnp", "sqpnp_mirrored", "ransac")
    assert abs(again_km - x_km) < 6.0 * sigma
    assert smoothed == pytest.approx(again_km, abs=sigma)
    # A second run has nothing to do.
    again = RUN.invoke(app, ["run", str(archive), "--output", str(tmp_path / "run"), "--serial"])
    assert json.loads((tmp_path / "run" / "run.json").read_text())
    assert again.exit_code == 0


def _pairs(value: object) -> list[list[str]]:
    """Names and digests, whether kept as a mapping or as rows."""
    if isinstance(value, dict):
        return [[str(k), str(v)] for k, v in value.items()]
    assert isinstance(value, list)
    return [[str(e.get("name")), str(e.get("sha256"))] if isinstance(e, dict) else list(map(str, e)) for e in value]


def test_a_catalogue_that_is_not_there_is_one_line_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "archive.yaml").write_text('images: "*.fits"\nmaplets: {EROS: nowhere}\n')
    (tmp_path / "a.fits").write_bytes(b"")
    run = RUN.invoke(app, ["run", str(tmp_path), "--output", str(tmp_path / "run")])
    assert run.exit_code != 0
    assert "maplets.EROS" in run.output + str(run.exception)
