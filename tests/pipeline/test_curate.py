"""Documents and rows: which keys are there, what is null, and what rank looks at."""

import json
import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from numpy.testing import assert_allclose

from pipeline.curate import (
    Json,
    Provenance,
    RankOptions,
    build_metadata_dict,
    error_document,
    rank_of,
)
from pipeline.ensemble import EnsembleOptions, ensemble
from pipeline.geometry.pointing import offset_between
from pipeline.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, rotation_about
from pipeline.navigate import Navigation
from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, CameraModel, Detector, FloatArray, Spacecraft, State
from pipeline.status import Rank, Status, StatusReason
from pipeline.tables import SCHEMAS, feature_columns, offset_row, technique_rows
from pipeline.techniques.base import FeatureTable, NavContext, TechniqueFailure, TechniqueResult

CAMERA = CameraModel((400, 400), 500.0, np.diag([50.0, -50.0]), np.array([199.5, 199.5]))
PRIOR: FloatArray = rotation_about(np.array([1.0, 2.0, 3.0]), 0.7)
ORIGIN = Provenance("0", "digest", "a.fits", "00", "header", "11", (("gaia", "22"),))
ROTATION_KEYS = {"rotation_deg", "sigma_rotation_deg"}
OFFSET, THETA = np.array([4.0, -3.0]), 0.02


def _state(turns: bool) -> State:
    settings = InstrumentSettings(fit_camera_rotation=turns, max_rotation_deg=5.0)
    return State("i", "m", "c", 1.0, "2000", 1.0, CAMERA, Detector(), Attitude(PRIOR), Spacecraft(), settings)


def _features() -> FeatureTable:
    text, pair, one = np.array(["a", "b"]), np.array([[1.0, 2.0], [np.nan, np.nan]]), np.array([1.0, np.nan])
    used = np.array([True, False])
    return FeatureTable(text, np.array(["star", "star"]), pair, pair, pair, one, one, one, used, np.array(["", "lost"]))


def _navigation(turns: bool, information: FloatArray, confidence: float = 0.9999) -> Navigation:
    state = _state(turns)
    theta = THETA if turns and information[2, 2] > 0 else 0.0
    result = TechniqueResult("T", OFFSET, theta, information, CAMERA.centre_vu, confidence, features=_features())
    estimate = ensemble([result], NavContext.of(state), EnsembleOptions())
    assert estimate is not None
    failure = TechniqueFailure("F", StatusReason.NO_MATCH, "nothing")
    return Navigation(state, None, estimate, (result,), (failure,), estimate.reason, "fused")


def _document(navigation: Navigation) -> dict[str, Json]:
    document = build_metadata_dict(navigation, RankOptions(), ORIGIN)
    json.dumps(document, allow_nan=False)  # raises for what is no JSON
    return document


def _techniques(document: dict[str, Json]) -> list[dict[str, Json]]:
    entries = document["techniques"]
    assert isinstance(entries, list)
    return [entry for entry in entries if isinstance(entry, dict)]


FINE = np.diag([400.0, 100.0])
TURNED = np.diag([400.0, 100.0, 1e8])
BLIND = np.diag([400.0, 100.0, 0.0])


def test_without_a_fitted_rotation_its_keys_are_not_there() -> None:
    document = _document(_navigation(False, FINE))
    assert not ROTATION_KEYS & document.keys()
    assert not ROTATION_KEYS & _techniques(document)[0].keys()
    assert document["offset_px"] == pytest.approx([4.0, -3.0])
    assert document["sigma_px"] == pytest.approx([0.05, 0.1])


def test_a_fitted_rotation_is_in_degrees() -> None:
    for entry in (document := _document(_navigation(True, TURNED)), _techniques(document)[0]):
        assert entry["rotation_deg"] == pytest.approx(math.degrees(THETA))
        assert entry["sigma_rotation_deg"] == pytest.approx(math.degrees(1e-4))


def test_a_rotation_fitted_but_not_seen_is_null() -> None:
    document = _document(_navigation(True, BLIND))
    for entry in (document, _techniques(document)[0]):
        assert entry.keys() >= ROTATION_KEYS
        assert entry["rotation_deg"] is None
        assert entry["sigma_rotation_deg"] is None
    assert document["offset_px"] == pytest.approx([4.0, -3.0])


def _largest(value: Json) -> float:
    if isinstance(value, dict):
        return max((_largest(v) for v in value.values()), default=0.0)
    if isinstance(value, list):
        return max((_largest(v) for v in value), default=0.0)
    return abs(value) if isinstance(value, (int, float)) else 0.0


EDGE = np.outer([0.6, 0.8], [0.6, 0.8]) * 100.0
EDGE_WITH_ARM = np.outer([0.6, 0.8, 40.0], [0.6, 0.8, 40.0]) * 100.0


@pytest.mark.parametrize(
    ("turns", "information"),
    [(False, np.diag([100.0, 0.0])), (False, EDGE), (True, BLIND), (True, EDGE_WITH_ARM), (True, np.pad(EDGE, (0, 1)))],
)
def test_no_sentinel_is_ever_shown(turns: bool, information: FloatArray) -> None:
    document = _document(_navigation(turns, information))
    # The largest honest number here is a coordinate or a figure of the document, far below a thousand.
    assert _largest(document) < 1e3
    technique = _techniques(document)[0]
    if information[1, 1] == 0.0:
        assert technique["sigma_px"] == pytest.approx([0.1, None])
    elif information is not BLIND:
        assert technique["sigma_px"] == [None, None]


def test_one_direction_leaves_the_marginals_null() -> None:
    document = _document(_navigation(False, EDGE))
    assert document["status_reason"] == "navigated_one_direction"
    assert (document["offset_px"], document["sigma_px"], document["covariance_px2"]) == (None, None, None)
    row = offset_row(document)
    assert (row["offset_dv_px"], row["sigma_du_px"], row.get("qw")) == (None, None, None)
    assert [row["observable_dv"], row["observable_du"]] == pytest.approx([0.6, 0.8])
    assert row["offset_along_px"] == pytest.approx(0.6 * 4 - 0.8 * 3)
    assert row["sigma_along_px"] == pytest.approx(0.1)
    assert document["rank"] == "low"


@pytest.mark.parametrize("turns", [False, True])
def test_the_corrected_pointing_is_the_offsets(turns: bool) -> None:
    document = _document(_navigation(turns, TURNED if turns else FINE))
    pointing = document["pointing"]
    assert isinstance(pointing, dict)
    before, after = (np.array(pointing[f"{key}camera_from_j2000_wxyz"]) for key in ("a_priori_", ""))
    assert_allclose(before, quaternion_from_matrix(PRIOR))
    offset, theta = offset_between(CAMERA, PRIOR, matrix_from_quaternion(after))
    assert_allclose(offset, OFFSET, atol=1e-7)  # 1e-15 of a quaternion at 25,000 px per radian, and the inverse's 1e-8
    assert theta == pytest.approx(THETA if turns else 0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("sigmas", "confidence", "rank"),
    [
        ((0.1, 0.29), 0.9999, Rank.HIGH), ((0.31, 0.1), 0.9999, Rank.MEDIUM), ((0.1, 1.1), 0.9999, Rank.LOW),
        ((0.1, 0.1), 0.99, Rank.MEDIUM), ((0.1, 0.1), 0.94, Rank.LOW),
    ],
)  # fmt: skip
def test_rank_is_of_the_translation_and_the_confidence(
    sigmas: tuple[float, float], confidence: float, rank: Rank
) -> None:
    plain = np.diag(1.0 / np.square(sigmas))
    assert rank_of(_navigation(False, plain, confidence), RankOptions()) is rank
    # However well or badly the rotation is known.
    for sigma_theta in (1e-7, 1.0):
        with_rotation = np.diag([*(1.0 / np.square(sigmas)), sigma_theta**-2])
        assert rank_of(_navigation(True, with_rotation, confidence), RankOptions()) is rank


def test_rank_of_what_is_no_success() -> None:
    navigation = _navigation(False, FINE)
    conflict = replace(navigation, reason=StatusReason.TECHNIQUES_DISAGREE)
    assert rank_of(conflict, RankOptions()) is Rank.CONFLICTED
    assert rank_of(replace(navigation, reason=StatusReason.LOW_CONFIDENCE), RankOptions()) is Rank.FAILED
    assert rank_of(replace(navigation, estimate=None), RankOptions()) is Rank.FAILED
    pointing = _document(conflict)["pointing"]
    assert isinstance(pointing, dict)
    assert pointing["camera_from_j2000_wxyz"] is None  # no pointing out of a conflict


def test_every_reason_has_the_status_that_documents_say() -> None:
    document = error_document("i", StatusReason.IMAGE_TRUNCATED, "short", ORIGIN)
    json.dumps(document, allow_nan=False)
    assert (document["status"], document["rank"]) == (Status.ERROR.value, Rank.FAILED.value)
    assert document.keys() == _document(_navigation(False, FINE)).keys()


def test_an_image_without_an_answer_keeps_all_keys() -> None:
    full = _navigation(True, TURNED)
    empty = replace(full, estimate=None, results=(), reason=StatusReason.NO_MATCH)
    document = _document(empty)
    assert document.keys() == _document(full).keys()
    assert (document["offset_px"], document["rotation_deg"], document["confidence"]) == (None, None, None)
    assert offset_row(document)["features_used"] is None


@pytest.mark.parametrize("turns", [False, True])
def test_rows_fit_their_schemas(turns: bool) -> None:
    document = _document(_navigation(turns, TURNED if turns else FINE))
    rows = {"offsets": [offset_row(document)], "techniques": technique_rows(document)}
    for name, content in rows.items():
        assert all(set(row) <= set(SCHEMAS[name].names) for row in content)
        pa.Table.from_pylist(content, schema=SCHEMAS[name])
    row = rows["offsets"][0]
    assert row["offset_dv_px"] == pytest.approx(4.0)
    assert row["cov_dv_du_px2"] == pytest.approx(0.0, abs=1e-12)
    assert (row["techniques"], row["features_used"]) == ("T", 1)
    assert row["rotation_deg"] == (pytest.approx(math.degrees(THETA)) if turns else None)
    assert [r["status_reason"] for r in rows["techniques"]] == ["navigated", "no_match"]


def test_features_become_columns() -> None:
    columns = feature_columns([_document(_navigation(False, FINE))] * 2)
    table = pa.Table.from_pydict(columns, schema=SCHEMAS["features"])
    assert table.num_rows == 4
    assert columns["measured_v_px"] == [1.0, None, 1.0, None]
    assert columns["used"] == [True, False, True, False]
    assert columns["technique"] == ["T"] * 4


def test_units_stand_in_the_schemas() -> None:
    for schema in SCHEMAS.values():
        for field in schema:
            assert {b"unit", b"meaning"} <= field.metadata.keys()
            for suffix, unit in (("_px", b"px"), ("_px2", b"px2"), ("_deg", b"deg")):
                assert not field.name.endswith(suffix) or field.metadata[b"unit"] == unit
