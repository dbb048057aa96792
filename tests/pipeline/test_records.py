"""Records: frozen, checked on construction, arrays read-only wherever they have been."""

import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from pipeline.errors import ContractError, ImageError
from pipeline.imaging.psf import PointSources
from pipeline.records import Attitude, CameraModel, Record, Spacecraft, StarTable, read_only
from pipeline.status import StatusReason
from pipeline.techniques.base import NavContext, TechniqueResult


def _camera() -> CameraModel:
    return CameraModel((100, 200), 50.0, np.diag([80.0, 80.0]), np.array([50.0, 100.0]))


def _table(count: int) -> StarTable:
    one = np.arange(count, dtype=float)
    return StarTable(np.array([f"s{k}" for k in range(count)]), one, one, one, one, one, one, one, one > 0)


def _records() -> list[Record]:
    context = NavContext(_camera(), np.eye(3), True, 5.0, (10.0, 20.0))
    result = TechniqueResult("t", np.zeros(2), 0.0, np.eye(3), np.ones(2), 0.5)
    sources = PointSources(
        np.zeros((2, 2)), np.zeros((2, 2, 2)), np.ones(2), np.ones(2), np.ones(2), np.ones(2, np.int64),
        np.zeros(2, np.int64), np.ones(2, bool),
    )  # fmt: skip
    return [_camera(), Attitude(np.eye(3), np.ones(3)), Spacecraft(np.ones(3)), _table(3), context, result, sources]


@pytest.mark.parametrize("record", _records(), ids=lambda record: type(record).__name__)
def test_arrays_are_read_only_also_after_pickling(record: Record) -> None:
    for copy in (record, pickle.loads(pickle.dumps(record))):
        columns = copy.columns()
        assert columns
        for values in columns.values():
            assert not values.flags.writeable
            with pytest.raises(ValueError, match="read-only"):
                values[...] = values


@pytest.mark.parametrize("record", _records(), ids=lambda record: type(record).__name__)
def test_fields_cannot_be_rebound(record: Record) -> None:
    name = next(iter(record.columns()))
    with pytest.raises(FrozenInstanceError):
        setattr(record, name, None)


def test_a_record_keeps_no_hold_on_the_callers_array() -> None:
    matrix = np.eye(3)
    attitude = Attitude(matrix)
    matrix[0, 0] = 5.0
    assert attitude.camera_from_j2000[0, 0] == 1.0


def test_types_survive_freezing() -> None:
    table = _table(3)
    assert table.star_id.dtype.kind == "U"
    assert table.apparent.dtype == np.bool_
    assert read_only([1, 2], (2,)).dtype == np.float64


@pytest.mark.parametrize(
    ("matrix", "wrong"),
    [(2.0 * np.eye(3), "not a rotation"), (np.diag([1.0, 1.0, -1.0]), "reflection"), (np.eye(2), "shape")],
)
def test_an_attitude_is_a_proper_rotation(matrix: np.ndarray, wrong: str) -> None:
    with pytest.raises(ContractError, match=wrong):
        Attitude(matrix)


def test_camera_models_that_cannot_be_are_refused() -> None:
    pivot = np.zeros(2)
    with pytest.raises(ContractError, match="singular"):
        CameraModel((10, 10), 1.0, np.ones((2, 2)), pivot)
    with pytest.raises(ContractError, match="positive"):
        CameraModel((10, 10), -1.0, np.eye(2), pivot)
    with pytest.raises(ContractError, match="pixels"):
        CameraModel((1, 10), 1.0, np.eye(2), pivot)
    with pytest.raises(ContractError, match="declared"):
        CameraModel((10, 10), 1.0, np.eye(2), pivot, np.zeros(5))


def test_centre_and_handedness() -> None:
    assert _camera().centre_vu.tolist() == [49.5, 99.5]  # centre of the first pixel is (0, 0)
    assert _camera().handedness == 1.0
    assert CameraModel((10, 10), 1.0, np.diag([1.0, -1.0]), np.zeros(2)).handedness == -1.0
    assert CameraModel((10, 10), 1.0, np.diag([-1.0, -1.0]), np.zeros(2)).handedness == 1.0


def test_star_tables_take_and_join_rows() -> None:
    table = _table(4)
    joined = StarTable.concatenate([table.take(np.array([3, 0])), StarTable.empty(), table.take(table.apparent)])
    assert joined.star_id.tolist() == ["s3", "s0", "s1", "s2", "s3"]
    assert joined.parallax_mas.tolist() == [3.0, 0.0, 1.0, 2.0, 3.0]
    with pytest.raises(ContractError):
        replace(table, mag=np.zeros(3))


def test_an_image_failure_keeps_its_reason_on_the_way_back_from_a_worker() -> None:
    error = pickle.loads(pickle.dumps(ImageError(StatusReason.IMAGE_BLANK, "flat")))
    assert (error.reason, error.detail, str(error)) == (StatusReason.IMAGE_BLANK, "flat", "flat")
