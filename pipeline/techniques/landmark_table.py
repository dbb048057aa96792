"""Landmarks of one picture: what was predicted, what was found, and the 2-D to 3-D matches for the pose."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pipeline.records import BoolArray, FloatArray, Record


class LandmarkStatus(StrEnum):
    """What became of a landmark that was looked for."""

    FOUND = "found"
    NOT_FOUND = "not_found"
    REMOVED = "removed"


@dataclass(frozen=True, eq=False)
class LandmarkTable(Record):
    """One row per landmark that culling kept.

    Attributes
    ----------
    name
        (n,) text.
    landmark_km, landmark_covariance_km2
        (n, 3) body-fixed; (n, 3, 3).
    predicted_vu
        (n, 2) under the a-priori geometry.
    observed_vu
        (n, 2) not-a-number where not found.
    covariance_px2
        (n, 2, 2) of the observation alone, likewise.
    correlation
        (n,) at the peak, not-a-number where none was made.
    bin_size
        (n,) bin of the last correlation, 0 where none was made.
    incidence_deg, emission_deg
        (n,) of the maplet's mean surface.
    ratio
        (n,) cells per pixel.
    illuminated, removed
        (n,) lit share of the predicted image (seed 001 eq. 3.55) and removed share of the extracted one (eq. 3.53).
    used
        (n,) took part in the fit of the state, or where there is none in that of the pointing.
    status
        (n,) see :class:`LandmarkStatus`.
    reason
        (n,) how the correlation ended, or the criterion of removal; empty where found.
    """

    name: NDArray[np.str_]
    landmark_km: FloatArray
    landmark_covariance_km2: FloatArray
    predicted_vu: FloatArray
    observed_vu: FloatArray
    covariance_px2: FloatArray
    correlation: FloatArray
    bin_size: NDArray[np.int64]
    incidence_deg: FloatArray
    emission_deg: FloatArray
    ratio: FloatArray
    illuminated: FloatArray
    removed: FloatArray
    used: BoolArray
    status: NDArray[np.str_]
    reason: NDArray[np.str_]

    def __post_init__(self) -> None:
        n = len(self.name)
        shapes: dict[str, tuple[int | None, ...]] = {
            "landmark_km": (n, 3), "landmark_covariance_km2": (n, 3, 3), "predicted_vu": (n, 2),
            "observed_vu": (n, 2), "covariance_px2": (n, 2, 2),
        }  # fmt: skip
        self._freeze(**{key: shapes.get(key, (n,)) for key in self.__dataclass_fields__})

    def __len__(self) -> int:
        return len(self.name)

    @property
    def found(self) -> BoolArray:
        """(n,) True where a landmark was found."""
        return np.asarray(np.isfinite(self.observed_vu).all(axis=1))
