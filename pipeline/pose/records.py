"""What goes into a pose and what comes out (seed 002 section 2).

"Body" is the planet whose frame landmarks are in, never the vehicle. A pose is ``x_camera = camera_from_body (X - p)``.
Its errors are ``dp = p_estimated - p_true`` (km, body-fixed) and r (rad, body-fixed) with
``body_from_camera_true = Exp(r) body_from_camera_estimated``; covariances are in the order (x, y, z, rx, ry, rz).
"""

from dataclasses import dataclass
from enum import StrEnum
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PilotageError
from pipeline.geometry.wgs84 import Datum, Geoid
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

_UNIT = np.eye(3)
# Pixels or kilometres that no instrument has and no body is at.
_BEYOND = 1e15
_FRAME_NAMESPACE = uuid5(NAMESPACE_URL, "pilotage/frame")


class CovarianceMode(StrEnum):
    """How a posterior covariance was made."""

    MARGINALS = "marginals"
    JACOBIAN = "jacobian"


class SourceLabel(StrEnum):
    """What holds a pose in place.

    ``satellite_anchored``: points on the body, in this image. ``visual_propagated``: neighbours in the same arc.
    ``dead_reckoned``: the trajectory's prior alone.
    """

    SATELLITE_ANCHORED = "satellite_anchored"
    VISUAL_PROPAGATED = "visual_propagated"
    DEAD_RECKONED = "dead_reckoned"


class PnpFailure(StrEnum):
    """Why no pose came out."""

    BAD_INPUT = "bad_input"
    TOO_FEW = "too_few"
    NO_CONSENSUS = "no_consensus"
    DEGENERATE = "degenerate"
    AMBIGUOUS = "ambiguous"
    ILL_CONDITIONED = "ill_conditioned"


class PnpFailureError(PilotageError):
    """No pose can be vouched for: no consensus, or matches that do not determine one; no PoseEstimate is made.

    Parameters
    ----------
    reason
        The enumerated cause.
    detail
        One line for a person.
    """

    def __init__(self, reason: PnpFailure, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail

    def __reduce__(self) -> tuple[type["PnpFailureError"], tuple[PnpFailure, str]]:
        """Pickle by both arguments: the default would lose the reason."""
        return (type(self), (self.reason, self.detail))


class MatchError(PilotageError):
    """Matches or cameras that contradict themselves: not finite, doubled, of unequal lengths, without a sigma."""


class CovarianceDegradedWarning(UserWarning):
    """A covariance comes from the Jacobian because the compute budget is throttled; not an error."""


def frame_id_of(image_id: str) -> UUID:
    """Identity of a frame: the same image always gets the same one.

    Parameters
    ----------
    image_id
        The image.

    Returns
    -------
    uuid.UUID
        Version 5.
    """
    return uuid5(_FRAME_NAMESPACE, image_id)


def check_covariances(name: str, values: FloatArray | None) -> None:
    """Refuse covariances that are none.

    Parameters
    ----------
    name
        What they belong to, for the message.
    values
        (n, k, k), or None.

    Raises
    ------
    MatchError
        If one is not finite, not symmetric or not positive definite.
    """
    if values is None or not len(values):
        return
    if not np.isfinite(values).all():
        raise MatchError(f"{name}: {_rows(~np.isfinite(values).all(axis=(1, 2)))} not finite")
    size = np.abs(values).max(axis=(1, 2))
    skew = np.abs(values - values.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9 * size
    if skew.any():
        raise MatchError(f"{name}: {_rows(skew)} not symmetric")
    bad = np.linalg.eigvalsh(values)[:, 0] <= 0
    if bad.any():
        raise MatchError(f"{name}: {_rows(bad)} with a sigma that is zero or negative, or not positive definite")


def _rows(bad: ArrayLike) -> str:
    """The first rows of a mask, in words."""
    index = np.flatnonzero(np.asarray(bad))
    more = f" and {len(index) - 3} more" if len(index) > 3 else ""
    return f"row {', '.join(map(str, index[:3]))}{more}"


@dataclass(frozen=True, eq=False)
class Pose(Record):
    """Where a camera is and how it is turned.

    Attributes
    ----------
    camera_from_body
        (3, 3) rotation; rows are the camera's axes in the body-fixed frame.
    position_km
        (3,) body-fixed.
    """

    camera_from_body: FloatArray
    position_km: FloatArray

    def __post_init__(self) -> None:
        self._freeze(camera_from_body=(3, 3), position_km=(3,))
        matrix = self.camera_from_body
        if not (np.abs(matrix @ matrix.T - _UNIT) <= 1e-9).all() or np.linalg.det(matrix) < 0:
            raise MatchError("camera_from_body is not a rotation")
        if not np.isfinite(self.position_km).all():
            raise MatchError("position_km is not finite")

    def to_camera(self, points_km: FloatArray) -> FloatArray:
        """(n, 3) body-fixed points in the camera frame, km."""
        return np.asarray((points_km - self.position_km) @ self.camera_from_body.T)


@dataclass(frozen=True, eq=False)
class PosePrior(Record):
    """What is known of a pose beforehand.

    Attributes
    ----------
    pose
        Expectation.
    covariance
        (6, 6) in the order of this module.
    """

    pose: Pose
    covariance: FloatArray

    def __post_init__(self) -> None:
        self._freeze(covariance=(6, 6))
        check_covariances("prior covariance", self.covariance[None])


@dataclass(frozen=True, eq=False)
class MatchResult(Record):
    """Correspondences of one image between pixels and points on the body.

    Attributes
    ----------
    image_id
        The image.
    point_id
        (n,) identity of each point, each once.
    pixels_vu
        (n, 2) where the points are seen.
    points_km
        (n, 3) where they are, body-fixed.
    pixel_covariance_px2
        (n, 2, 2) in the order (v, u), or None where nobody knows; it is then estimated from the residuals.
    point_covariance_km2
        (n, 3, 3), or None where the points are exact.
    prior
        Prior pose; it chooses between two answers that the matches cannot tell apart, and does not pull.
    since_anchor_ms
        Time since the last image that was anchored, if known.

    Raises
    ------
    MatchError
        If a value is not finite, an id doubled, a sigma not positive, or lengths differ.
    """

    image_id: str
    point_id: NDArray[np.int64]
    pixels_vu: FloatArray
    points_km: FloatArray
    pixel_covariance_px2: FloatArray | None = None
    point_covariance_km2: FloatArray | None = None
    prior: PosePrior | None = None
    since_anchor_ms: int | None = None

    def __post_init__(self) -> None:
        names = ("pixels_vu", "points_km", "pixel_covariance_px2", "point_covariance_km2")
        n = len(self.point_id)
        wrong = [f"{k} has {len(v)}" for k in names if (v := getattr(self, k)) is not None and len(v) != n]
        if wrong:
            raise MatchError(f"{self.image_id}: {n} points, but {', '.join(wrong)}")
        self._freeze(
            point_id=(n,), pixels_vu=(n, 2), points_km=(n, 3), pixel_covariance_px2=(n, 2, 2),
            point_covariance_km2=(n, 3, 3),
        )  # fmt: skip
        for name in names[:2]:
            bad = ~(np.abs(getattr(self, name)) < _BEYOND).all(axis=1)
            if bad.any():
                raise MatchError(f"{self.image_id}: {name}: {_rows(bad)} not finite")
        if len(np.unique(self.point_id)) != n:
            ids, counts = np.unique(self.point_id, return_counts=True)
            raise MatchError(f"{self.image_id}: point {ids[counts > 1][0]} is matched {counts.max()} times")
        check_covariances(f"{self.image_id}: pixel covariance", self.pixel_covariance_px2)
        check_covariances(f"{self.image_id}: point covariance", self.point_covariance_km2)

    def __len__(self) -> int:
        return len(self.point_id)


@dataclass(frozen=True, eq=False)
class CameraCalibration(Record):
    """A camera, how it is mounted and on what datum it reports.

    Attributes
    ----------
    camera
        Model with its distortion.
    datum
        Ellipsoid of the body.
    camera_from_vehicle
        (3, 3) rotation of the mounting.
    camera_in_vehicle_m
        (3,) where the camera sits, vehicle axes, from the vehicle's reference point.
    geoid
        Mean sea level, where the user has a table of it.
    """

    camera: CameraModel
    datum: Datum
    camera_from_vehicle: FloatArray
    camera_in_vehicle_m: FloatArray
    geoid: Geoid | None = None

    def __post_init__(self) -> None:
        self._freeze(camera_from_vehicle=(3, 3), camera_in_vehicle_m=(3,))
        if not np.allclose(self.camera_from_vehicle @ self.camera_from_vehicle.T, np.eye(3), atol=1e-9):
            raise MatchError("camera_from_vehicle is not a rotation")

    @staticmethod
    def of(camera: CameraModel, datum: Datum) -> "CameraCalibration":
        """A camera that is its own vehicle."""
        return CameraCalibration(camera, datum, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class ThermalState:
    """Compute budget at this frame.

    Attributes
    ----------
    thermal_throttle
        Whether covariances are to be cheap.
    clock_mhz
        Clock of the processor, for the log.
    """

    thermal_throttle: bool = False
    clock_mhz: float | None = None


@dataclass(frozen=True)
class LatLonAlt:
    """Place on a body.

    Attributes
    ----------
    lat_deg, lon_deg
        Planetodetic, longitude positive east.
    alt_m
        Above mean sea level; None without a geoid.
    ellipsoidal_m
        Above the datum's ellipsoid.
    datum
        Its name.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float | None
    ellipsoidal_m: float
    datum: str


@dataclass(frozen=True, eq=False)
class PoseEstimate(Record):
    """Pose of one image with its honest covariance (seed 002).

    Attributes
    ----------
    frame_id
        uuid5 of the image's id.
    image_id
        The image.
    pose
        The camera's.
    position_wgs84
        Place of the camera on the datum of its body; WGS 84 for the Earth.
    orientation_world_T_body
        (4,) quaternion (w, x, y, z) that turns vehicle axes onto body-fixed axes. (The seed's "body" is the vehicle.)
    covariance_6x6
        (6, 6) of (x, y, z, rx, ry, rz), km and rad, body-fixed.
    covariance_mode
        How it was made.
    source_label
        What holds the pose.
    last_satellite_anchor_age_ms
        Zero for an anchored image; None where no image of the arc was anchored before.
    method
        Which solution started the refinement.
    inlier
        (n,) matches that took part.
    rms_px
        (2,) of the inliers' residuals along v and u.
    chi2
        Sum of squared residuals over their sigmas.
    sigma_scale
        Factor between the stated sigmas and those used: one where they were stated.
    """

    frame_id: UUID
    image_id: str
    pose: Pose
    position_wgs84: LatLonAlt
    orientation_world_T_body: FloatArray
    covariance_6x6: FloatArray
    covariance_mode: CovarianceMode
    source_label: SourceLabel
    last_satellite_anchor_age_ms: int | None
    method: str
    inlier: BoolArray
    rms_px: FloatArray
    chi2: float
    sigma_scale: float

    def __post_init__(self) -> None:
        self._freeze(orientation_world_T_body=(4,), covariance_6x6=(6, 6), inlier=(None,), rms_px=(2,))
