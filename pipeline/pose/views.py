"""Many views of the same points: places of points from the poses that are known, and each view solved from points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.pose.estimator import PoseEstimator
from pipeline.pose.normalise import to_plane
from pipeline.pose.records import (
    CameraCalibration,
    MatchError,
    MatchResult,
    PnpFailure,
    PnpFailureError,
    Pose,
    PoseEstimate,
    ThermalState,
)
from pipeline.pose.triangulation import (
    Intersections,
    LinesOfSight,
    TriangulationMethod,
    intersect_agreeing,
    intersect_lines,
)
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

# No array is so large.
_BEYOND_PX = 1e9
# Share of the places behind the cameras at which it is the positions that are written the other way round.
_LOOKING_AWAY = 0.9


@dataclass(frozen=True, eq=False)
class Sightings(Record):
    """Which view sees which point where.

    Attributes
    ----------
    view, point
        (n,) positions in lists of views and points.
    pixels_vu
        (n, 2).
    covariance_px2
        (n, 2, 2), None where nobody knows.
    """

    view: NDArray[np.int64]
    point: NDArray[np.int64]
    pixels_vu: FloatArray
    covariance_px2: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.view)
        self._freeze(view=(n,), point=(n,), pixels_vu=(n, 2), covariance_px2=(n, 2, 2))

    def covariance(self, sigma_px: float) -> FloatArray:
        """(n, 2, 2), with one sigma where none is stated."""
        if self.covariance_px2 is not None:
            return self.covariance_px2
        return np.tile(np.eye(2) * sigma_px**2, (len(self.view), 1, 1))


def triangulate_views(
    camera: CameraModel, sightings: Sightings, poses: dict[int, Pose], count: int, sigma_px: float, robust: bool = True
) -> Intersections:
    """Places of points from all views whose poses are known.

    Parameters
    ----------
    camera
        The model.
    sightings
        All sightings; those of views without a pose are left out.
    poses
        Known poses by position in the list of views.
    count
        Points.
    sigma_px
        Where the sightings state none.
    robust
        Leave out lines of sight that the others of a point contradict; only where sigmas can be believed.

    Returns
    -------
    Intersections
        One place per point; those seen by fewer than two known views are refused.
    """
    known = np.isin(sightings.view, list(poses))
    view, point = sightings.view[known], sightings.point[known]
    # A sighting without an honest place or sigma fails its own view, and no other.
    pixels = np.where(np.abs(sightings.pixels_vu[known]) < _BEYOND_PX, sightings.pixels_vu[known], np.nan)
    plane = to_plane(camera, pixels, sightings.covariance(sigma_px)[known])
    spread = sightings.covariance(sigma_px)[known]
    good = plane.ok & np.isfinite(spread).all(axis=(1, 2)) & (spread[:, 0, 0] > 0) & (np.linalg.det(spread) > 0)
    order = np.array(sorted(poses))
    row = np.searchsorted(order, view[good])
    turns = np.stack([poses[int(k)].camera_from_body for k in order])[row]
    centres = np.stack([poses[int(k)].position_km for k in order])[row]
    lines = LinesOfSight(point[good], plane.xy[good], plane.covariance[good], turns, centres)
    return intersect_agreeing(lines, count) if robust else intersect_lines(lines, count, TriangulationMethod.LOST)


def sigma_of(camera: CameraModel, sightings: Sightings, poses: dict[int, Pose], places_km: FloatArray) -> float:
    """1 sigma per axis of sightings under known poses, by the median of what triangulation leaves.

    Parameters
    ----------
    camera
        The model.
    sightings
        All sightings.
    poses
        Known poses.
    places_km
        (m, 3) of the points, NaN where unknown.

    Returns
    -------
    float
        Pixels; corrected for the three unknowns of each point.
    """
    unit = np.tile(np.eye(2), (len(sightings.view), 1, 1))
    plane = to_plane(camera, sightings.pixels_vu, unit)
    squared: list[FloatArray] = []
    used = np.zeros(len(places_km), dtype=np.int64)
    for view, pose in poses.items():
        rows = np.flatnonzero((sightings.view == view) & np.isfinite(places_km[sightings.point, 0]) & plane.ok)
        seen = pose.to_camera(places_km[sightings.point[rows]])
        residual = plane.px_from_xy[rows] @ (plane.xy[rows] - seen[:, :2] / seen[:, 2:])[:, :, None]
        squared.append((residual[:, :, 0] ** 2).sum(axis=1))
        np.add.at(used, sightings.point[rows], 1)
    every = np.concatenate(squared)
    freedom = 1.0 - 3.0 * float((used >= 2).sum()) / (2.0 * float(used[used >= 2].sum()))
    # The squared length of two unit normal components has the median 2 ln 2.
    return float(np.sqrt(np.median(every) / (2.0 * np.log(2.0) * freedom)))


def looks_away(places: Intersections) -> bool:
    """Whether lines of sight meet behind the cameras throughout: positions then point from the camera to the body.

    Parameters
    ----------
    places
        Of :func:`triangulate_views`.

    Returns
    -------
    bool
        True if of the places where lines meet, nearly all are behind.
    """
    met = (places.refusal == 0) | (places.refusal == 3)
    return bool(met.any() and (places.refusal[met] == 3).mean() > _LOOKING_AWAY)


def turned(pose: Pose) -> Pose:
    """The same camera with its position written as the vector from the camera to the body's centre, or back.

    Parameters
    ----------
    pose
        Either way.

    Returns
    -------
    Pose
        The other way.
    """
    return Pose(pose.camera_from_body, -pose.position_km)


def solve_view(
    estimator: PoseEstimator,
    calibration: CameraCalibration,
    matches: MatchResult,
    thermal: ThermalState,
) -> PoseEstimate | PnpFailureError:
    """Pose of one view, or why there is none; this is the one place where failures are caught.

    Parameters
    ----------
    estimator
        What solves it.
    calibration
        Its camera.
    matches
        Its matches.
    thermal
        Compute budget.

    Returns
    -------
    PoseEstimate or PnpFailureError
        The answer.
    """
    try:
        return estimator.estimate(matches, calibration, thermal)
    except PnpFailureError as failure:
        return failure


def matches_of(
    name: str, sightings: Sightings, rows: BoolArray, places: Intersections, exact: bool = False
) -> MatchResult | PnpFailureError:
    """Matches of one view with points of known place.

    Parameters
    ----------
    name
        Of the view.
    sightings
        All sightings.
    rows
        (n,) those of the view.
    places
        Of all points.
    exact
        Whether the places have no error.

    Returns
    -------
    MatchResult or PnpFailureError
        The matches, or what is wrong with them.
    """
    index = np.flatnonzero(rows & places.ok[sightings.point])
    point = sightings.point[index]
    stated = None if sightings.covariance_px2 is None else sightings.covariance_px2[index]
    try:
        return MatchResult(
            name, point, sightings.pixels_vu[index], places.places_km[point], stated,
            None if exact else places.covariance_km2[point],
        )  # fmt: skip
    except MatchError as error:
        return PnpFailureError(PnpFailure.BAD_INPUT, str(error))
