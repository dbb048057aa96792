"""What the report counts, against sums made otherwise."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.geometry.pointing import move_pivot
from pipeline.tables import SCHEMAS
from workflows.html_report.rows import FIELD_CELLS, collect
from workflows.html_report.trend import spells, worse_than_usual
from workflows.query import ask
from workflows.store import RunFolder

_Rows = list[dict[str, object]]


def _write(folder: Path, name: str, rows: _Rows) -> None:
    schema = pa.schema([field for field in SCHEMAS[name] if field.name not in ("mission", "camera")])
    place = folder / name / "mission=M" / "camera=C"
    place.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), place / f"{name}.parquet")


def _technique(image: str, name: str, rng: np.random.Generator, turned: bool) -> dict[str, object]:
    return {
        "image_id": image, "technique": name, "offset_dv_px": rng.normal(), "offset_du_px": rng.normal(),
        "sigma_dv_px": rng.uniform(0.1, 1), "sigma_du_px": rng.uniform(0.1, 1),
        "rotation_deg": rng.normal() * 3 if turned else None, "pivot_v_px": 100 + rng.uniform(0, 0.7),
        "pivot_u_px": 200 + rng.uniform(0, 0.7), "at_edge": False,
    }  # fmt: skip


def test_pulls_are_those_about_one_pivot(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    rows = [_technique(f"i{k}", name, rng, k % 2 == 0) for k in range(20) for name in ("A", "B")]
    far = [_technique("far", name, rng, True) for name in ("A", "B")]
    far[1]["pivot_v_px"] = 110.0
    edge = [_technique("edge", name, rng, False) for name in ("A", "B")]
    edge[0]["at_edge"] = True
    _write(tmp_path, "techniques", rows + far + edge)
    _write(
        tmp_path, "offsets", [{"image_id": f"i{k}", "status": "conflicted" if k < 3 else "success"} for k in range(20)]
    )
    expected = {}
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        a, b = (pd.Series(row) for row in (first, second))
        pivots = (np.array([row["pivot_v_px"], row["pivot_u_px"]], float) for row in (b, a))
        turn = 0.0 if b["rotation_deg"] is None else np.radians(b["rotation_deg"])
        moved = move_pivot(np.array([b["offset_dv_px"], b["offset_du_px"]], float), turn, *pivots)[0]
        gap = np.array([a["offset_dv_px"], a["offset_du_px"]], float) - moved
        joint = np.hypot([a["sigma_dv_px"], a["sigma_du_px"]], [b["sigma_dv_px"], b["sigma_du_px"]])
        expected[str(a["image_id"])] = float(np.abs(gap / joint).max())
    found = collect(RunFolder(tmp_path))
    assert dict(zip(found.shown_pairs["image_id"], found.shown_pairs["pull"], strict=True)) == pytest.approx(expected)
    (row,) = found.by_pair.itertuples()
    assert (row.pair, row.images) == ("A and B", 20)
    assert (row.median, row.largest) == pytest.approx((np.median(list(expected.values())), max(expected.values())))
    assert row.apart == sum(pull > 4 for pull in expected.values())
    assert list(found.worst_pairs["image_id"]) == sorted(expected, key=lambda key: -expected[key])[:10]
    assert set(found.conflicts["image_id"]) == {"i0", "i1", "i2"}


def test_the_residual_map_keeps_what_a_camera_model_lacks(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    rows, columns, count = 400, 600, 5000
    v, u = rng.uniform(-0.5, rows - 0.5, count), rng.uniform(-0.5, columns - 0.5, count)
    lack = 0.2 * (v / rows - 0.5)
    _write(tmp_path, "offsets", [{"image_id": "i", "status": "success", "rows": rows, "columns": columns}])
    _write(tmp_path, "features", [
        {"image_id": "i", "used": k % 5 > 0, "measured_v_px": v[k], "measured_u_px": u[k], "sigma_px": 0.05,
         "residual_v_px": lack[k] + 0.05 * rng.normal() + (9 if k % 5 == 0 else 0), "residual_u_px": 0.0}
        for k in range(count)
    ])  # fmt: skip
    field = collect(RunFolder(tmp_path)).field
    assert len(field) == FIELD_CELLS**2
    assert field["features"].sum() == count - count // 5
    planted = 0.2 * ((field["row_cell"] + 0.5) / FIELD_CELLS - 0.5)
    assert np.sqrt(np.mean(((field["dv_px"] - planted) / field["sigma_px"]) ** 2)) == pytest.approx(1.0, abs=0.2)


def _answers(count: int, rng: np.random.Generator) -> pd.DataFrame:
    times = pd.date_range("2005-01-01", periods=count, freq="1h").strftime("%Y-%m-%dT%H:%M:%S")
    status = np.where(rng.uniform(size=count) < 0.05, "failed", "success")
    return pd.DataFrame(
        {"camera": "M C", "time_utc": times, "status": status, "sigma_px": rng.uniform(0.08, 0.12, count)}
    )


def test_a_bad_spell_is_told_and_a_usual_one_is_not() -> None:
    answers = _answers(600, np.random.default_rng(6))
    assert worse_than_usual(spells(answers)) == []
    answers.loc[300:319, "status"] = "failed"
    answers.loc[400:419, "sigma_px"] *= 3
    # The order of the rows is not that of the times.
    said = worse_than_usual(spells(answers.sample(frac=1, random_state=1)))
    assert [text.split(":")[0] for text in said] == ["worse than usual", "less sharp than usual"]
    assert "20 of 20 M C images from 2005-01-13 12:00 to 2005-01-14 07:00" in said[0]
    assert "from 2005-01-17 16:00" in said[1]


def test_chance_is_no_bad_spell() -> None:
    rng = np.random.default_rng(7)
    alarms = sum(len(worse_than_usual(spells(_answers(600, rng)))) for _ in range(30))
    assert alarms <= 1


def test_few_images_or_none_have_no_trend() -> None:
    answers = _answers(3, np.random.default_rng(8))
    assert worse_than_usual(spells(answers)) == []
    assert len(spells(answers.assign(time_utc=None))) == 0


def test_tables_that_a_run_lacks_are_empty_in_a_query(tmp_path: Path) -> None:
    _write(tmp_path, "offsets", [{"image_id": "i", "status": "failed"}])
    for name in SCHEMAS:
        answer = ask(RunFolder(tmp_path), f"select * from {name}")
        assert answer.column_names == SCHEMAS[name].names
        assert len(answer) == (name == "offsets")
