"""Real New Horizons LORRI frames of the Proxima Centauri field against their published pointing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits

from catalogs.header import state_from_header
from catalogs.images import read_image
from catalogs.star_sources import gaia_stars, read_table
from pipeline.camera import project
from pipeline.geometry.astrometry import apparent_directions
from pipeline.geometry.rotations import plane_rotation
from pipeline.navigate import NavigationOptions, navigate
from pipeline.records import FloatArray, Spacecraft, StarTable, State
from pipeline.status import Status, status_of
from tests.scenes.data import DATA, needs_data, truth_of
from tests.scenes.runs import run_archive
from workflows.config import load_configuration

pytestmark = needs_data

# Mean places with aberration against places as seen: how far the frames' offset changes, from the data's own note.
ABERRATION_SHIFT_VU = np.array([-0.067, 2.157])
# Gaia DR3, with proper motion and parallax.
PROXIMA = {
    "star_id": "Proxima", "ra_deg": 217.39232147200883, "dec_deg": -62.67607511676666, "mag": 8.984749,
    "pm_ra_masyr": -3781.741, "pm_dec_masyr": 769.465, "parallax_mas": 768.07, "epoch": 2016.0,
}  # fmt: skip


def _frames() -> list[Path]:
    return sorted((DATA / "lorri" / "frames").glob("*.fits"))


def _state(path: Path) -> tuple[np.ndarray, State]:
    raw = read_image(path.read_bytes(), path.name)
    block = load_configuration().instruments["nhlorri"]
    settings = {"fit_camera_rotation": True, "search_margin_vu": [30, 60]}
    return raw.pixels, state_from_header(raw, path.stem, block, settings)


def _table(rows: list[dict[str, object]], tmp_path: Path) -> StarTable:
    pd.DataFrame(rows).to_csv(tmp_path / "t.csv", index=False)
    return read_table((tmp_path / "t.csv").read_bytes(), "t.csv", apparent=False)


def _as_shown(predicted_vu: FloatArray, answer: dict[str, float]) -> FloatArray:
    """Pixels under the published pointing."""
    offset = np.array([answer["offset_dv_px"], answer["offset_du_px"]])
    turn = plane_rotation(np.radians(answer["rotation_deg"]))
    return np.asarray((predicted_vu - 127.5) @ turn.T + 127.5 + offset)


def test_given_star_table(tmp_path: Path) -> None:
    table = run_archive(DATA / "lorri", tmp_path / "run")
    assert list(table["status"]) == ["success"] * 6
    truth = truth_of("lorri")
    for image_id, row in table.iterrows():
        answer = truth[str(image_id)]
        assert abs(row["offset_dv_px"] - answer["offset_dv_px"]) < 0.10
        assert abs(row["offset_du_px"] - answer["offset_du_px"]) < 0.10
        assert abs(row["rotation_deg"] - answer["rotation_deg"]) < 0.05
    # Frames of a triple were taken within seconds of each other, and the camera does not turn.
    for triple in (table.iloc[:3], table.iloc[3:]):
        assert np.ptp(triple["rotation_deg"]) < 0.02


def test_proxima_is_predicted_where_the_frames_show_it(tmp_path: Path) -> None:
    seen = read_table((DATA / "lorri" / "stars.parquet").read_bytes(), "stars.parquet", apparent=True)
    brightest = seen.take(np.array([int(np.argmin(seen.mag))]))
    mine = _table([PROXIMA], tmp_path)
    for path in _frames():
        _, state = _state(path)
        attitude = state.attitude.camera_from_j2000.T
        # What the frames show carries no aberration, so neither may the prediction here.
        at_rest = Spacecraft(position_km=state.spacecraft.position_km)
        places = [
            project(state.camera_model, apparent_directions(star, state.et, at_rest) @ attitude)[0]
            for star in (mine, brightest)
        ]
        assert np.abs(places[0] - places[1]).max() < 0.1
        withheld = apparent_directions(mine, state.et, Spacecraft())
        assert np.linalg.norm(project(state.camera_model, withheld @ attitude)[0] - places[1]) > 7.0


@pytest.mark.parametrize("withhold", [False, True])
def test_proxima_is_used_or_rejected_by_name(withhold: bool, tmp_path: Path) -> None:
    """All stars at their places as seen but Proxima at its mean place."""
    seen = read_table((DATA / "lorri" / "stars.parquet").read_bytes(), "stars.parquet", apparent=True)
    others = seen.take(np.flatnonzero(seen.mag > seen.mag.min()))
    stars = StarTable.concatenate([others, _table([PROXIMA], tmp_path)])
    for path in _frames():
        pixels, state = _state(path)
        position = None if withhold else state.spacecraft.position_km
        navigation = navigate(
            pixels, None, replace(state, spacecraft=Spacecraft(position_km=position)), stars, NavigationOptions()
        )
        assert status_of(navigation.reason) is Status.SUCCESS
        answer = truth_of("lorri")[path.stem]
        assert navigation.estimate is not None
        planted = [answer["offset_dv_px"], answer["offset_du_px"]]
        assert np.abs(navigation.estimate.offset_vu - planted).max() < 0.10
        for result in navigation.results:
            if result.technique != "StarFieldFromCatalogNav" or result.features is None:
                continue
            row = result.features.name.tolist().index("Proxima")
            assert result.features.used[row] == (not withhold)
            assert result.features.reason[row] == ("place_disagrees" if withhold else "")


def test_gaia_alone(tmp_path: Path) -> None:
    """Two or three usable stars: right within three sigmas, or an honest failure."""
    table = run_archive(DATA / "lorri", tmp_path / "run", {"stars": ["gaia"]})
    truth = truth_of("lorri")
    for image_id, row in table.iterrows():
        if row["status"] != "success":
            assert row["status"] == "failed"
            continue
        answer = truth[str(image_id)]
        expected = np.array([answer["offset_dv_px"], answer["offset_du_px"]]) - ABERRATION_SHIFT_VU
        error = np.array([row["offset_dv_px"], row["offset_du_px"]]) - expected
        assert (np.abs(error) <= 3.0 * np.array([row["sigma_dv_px"], row["sigma_du_px"]])).all()
    assert (table["status"] == "success").sum() >= 3


def test_gaia_proxima_has_motion_and_parallax() -> None:
    stars = gaia_stars()
    row = stars.star_id.tolist().index("Gaia DR3 5853498713190525696")
    assert stars.pm_ra_masyr[row] == pytest.approx(-3775.75)
    assert stars.parallax_mas[row] == pytest.approx(771.64)


def test_published_wcs_is_never_read(tmp_path: Path) -> None:
    """The header's WCS is the truth: deleting it must not change a byte of the answer."""
    archive = tmp_path / "archive"
    (archive / "frames").mkdir(parents=True)
    for name in ("archive.yaml", "stars.parquet"):
        (archive / name).write_bytes((DATA / "lorri" / name).read_bytes())
    source = _frames()[0]
    with fits.open(source) as hdus:
        for key in [k for k in hdus[0].header if k[:2] in ("CD", "A_", "B_", "AP", "BP") or k.startswith("CR")]:
            del hdus[0].header[key]
        hdus.writeto(archive / "frames" / source.name)
    run_archive(archive, tmp_path / "without")
    run_archive(DATA / "lorri", tmp_path / "with", {"images": f"frames/{source.name}"})
    documents = [
        json.loads((tmp_path / run / "images" / f"{source.stem}.json").read_text()) for run in ("with", "without")
    ]
    for document in documents:
        document.pop("provenance")
    assert documents[0] == documents[1]
