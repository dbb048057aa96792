"""Matches that contradict themselves: one clear error each."""

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from pipeline.pose.records import MatchError, MatchResult, PnpFailure, PnpFailureError, frame_id_of

GOOD = {
    "point_id": np.arange(4), "pixels_vu": np.ones((4, 2)), "points_km": np.eye(4)[:, :3],
    "pixel_covariance_px2": np.tile(np.eye(2), (4, 1, 1)), "point_covariance_km2": np.tile(np.eye(3), (4, 1, 1)),
}  # fmt: skip


def _with(**change: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    return {name: change[name](value.copy()) if name in change else value for name, value in GOOD.items()}


def _set(index: tuple[int, ...], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def apply(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with(pixels_vu=_set((2, 0), np.nan)), "pixels_vu: row 2 not finite"),
        (_with(points_km=_set((1, 1), np.inf)), "points_km: row 1 not finite"),
        (_with(point_id=_set((3,), 0)), "point 0 is matched 2 times"),
        (_with(points_km=lambda x: x[:3]), "4 points, but points_km has 3"),
        (_with(pixel_covariance_px2=_set((0, 0, 0), 0.0)), "pixel covariance: row 0 with a sigma that is zero"),
        (_with(pixel_covariance_px2=_set((0, 1, 1), -1.0)), "zero or negative"),
        (_with(pixel_covariance_px2=_set((3, 0, 1), 0.5)), "not symmetric"),
        (_with(point_covariance_km2=_set((2, 2, 2), -1.0)), "point covariance: row 2"),
        (_with(point_covariance_km2=_set((2, 2, 2), np.nan)), "not finite"),
    ],
)  # fmt: skip
def test_each_contradiction_is_one_error(change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(MatchError, match=message):
        MatchResult("image", **change)  # type: ignore[arg-type]


def test_good_matches_pass_and_stay_as_they_are() -> None:
    matches = MatchResult("image", **GOOD)  # type: ignore[arg-type]
    assert len(matches) == 4
    assert not pickle.loads(pickle.dumps(matches)).points_km.flags.writeable
    assert len(MatchResult("none", np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3)))) == 0


def test_frames_keep_their_identity() -> None:
    assert frame_id_of("a") == frame_id_of("a") != frame_id_of("b")
    assert frame_id_of("a").version == 5


def test_a_failure_keeps_its_reason_through_pickling() -> None:
    error = pickle.loads(pickle.dumps(PnpFailureError(PnpFailure.AMBIGUOUS, "two answers")))
    assert (error.reason, str(error)) == (PnpFailure.AMBIGUOUS, "two answers")
