"""Star scenes drawn by another project's simulator."""

from pathlib import Path

import pytest

from tests.scenes.data import DATA, needs_data, truth_of
from tests.scenes.runs import run_archive

pytestmark = needs_data


def test_star_scenes(tmp_path: Path) -> None:
    table = run_archive(DATA / "planted", tmp_path / "run")
    truth = {key: value for key, value in truth_of("planted").items() if value["n_stars"] > 0}
    assert len(truth) >= 6
    for image_id, answer in truth.items():
        row = table.loc[image_id]
        turned = answer["rotation_deg"] != 0.0
        limit = 0.03 if turned else 0.02
        assert row["status"] == "success", image_id
        assert abs(row["offset_dv_px"] - answer["offset_dv_px"]) < limit, image_id
        assert abs(row["offset_du_px"] - answer["offset_du_px"]) < limit, image_id
        if turned:
            assert row["rotation_deg"] == pytest.approx(answer["rotation_deg"], abs=0.02)


def test_scenes_without_stars_fail_honestly(tmp_path: Path) -> None:
    table = run_archive(DATA / "planted", tmp_path / "run")
    empty = [key for key, value in truth_of("planted").items() if value["n_stars"] == 0]
    assert set(table.loc[empty, "status"]) == {"failed"}
    assert set(table.loc[empty, "status_reason"]) == {"no_features_predicted"}
