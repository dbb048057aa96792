"""From matches and cameras to a table of poses."""

import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from catalogs.matches import Cameras, MatchTable
from pipeline.camera import project
from pipeline.errors import ConfigurationError
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.pose.arc_landmarks import PointSightings, sightings_of
from pipeline.pose.bundle import Bundle, adjust
from pipeline.pose.estimator import OpenCVGtsamPoseEstimator, PoseOptions, place_of, vehicle_orientation
from pipeline.pose.records import (
    CameraCalibration,
    CovarianceDegradedWarning,
    PnpFailure,
    PnpFailureError,
    Pose,
    PoseEstimate,
    PosePrior,
    SourceLabel,
    ThermalState,
)
from pipeline.pose.schemas import UPPER
from pipeline.pose.se3 import SE3Utils
from pipeline.pose.triangulation import Intersections
from pipeline.pose.views import (
    Sightings,
    looks_away,
    matches_of,
    sigma_of,
    solve_view,
    triangulate_views,
    turned,
)
from pipeline.records import BoolArray, FloatArray

_FRAME = (
    "x_cam = camera_from_body (X - position), quaternion of camera_from_body scalar first; cov: upper triangle by rows "
    "of the errors (x, y, z, rx, ry, rz), km and rad, body-fixed, position estimated minus true and "
    "body_from_camera_true = Exp(r) body_from_camera_estimated"
)
# A place written twice, in whatever precision.
_SAME_PLACE_KM = 1e-3
_TO_BODY = (
    "; positions as in the cameras' file: vectors from the camera to the body, x_cam = camera_from_body (X + position)"
)


class CovarianceChoice(StrEnum):
    """How covariances are made: always one way, or cheaply once the run's time is used up."""

    MARGINALS = "marginals"
    JACOBIAN = "jacobian"
    AUTO = "auto"


@dataclass(frozen=True)
class Budget:
    """Compute budget of a run.

    Attributes
    ----------
    choice
        What was asked for.
    seconds
        After which ``auto`` turns cheap; None for never.
    """

    choice: CovarianceChoice
    seconds: float | None = None

    def state(self, started: float, throttled: bool) -> ThermalState:
        """State of the budget now, for a run that started at a time of the monotonic clock and a view's own budget."""
        spent = self.seconds is not None and time.monotonic() - started > self.seconds
        return ThermalState(
            self.choice is CovarianceChoice.JACOBIAN or (self.choice is CovarianceChoice.AUTO and (spent or throttled))
        )


@dataclass(frozen=True)
class PoseRow:
    """Answer for one view; ``answer`` is the failure where there is no pose. Clocks are for the table of timings.

    ``sightings`` are what a pose rests on, by the points' numbers in the file; None where nobody asked for them.
    """

    view_id: int
    answer: PoseEstimate | PnpFailureError
    seconds: float = 0.0
    emitted_at_ns: int | None = None
    sightings: PointSightings | None = None


@dataclass(frozen=True)
class Views:
    """All views of a file, in the order of their ids."""

    ids: NDArray[np.int64]
    points: NDArray[np.int64]
    sightings: Sightings
    given: dict[int, Pose]
    turned: bool
    calibration: CameraCalibration
    options: PoseOptions
    table: MatchTable
    throttled: frozenset[int] = frozenset()

    def places(self, without: int | None = None, robust: bool = True) -> Intersections:
        """Places of all points: those of the file, else from the given views but one, wrong lines of sight left out."""
        if self.table.points_km is not None:
            return _given_places(self)
        poses = {view: pose for view, pose in self.given.items() if view != without}
        sigma = self.options.assumed_sigma_px
        return triangulate_views(self.calibration.camera, self.sightings, poses, len(self.points), sigma, robust)


def unusable_sightings(views: Views) -> int:
    """Sightings in views with given poses that cannot help to place points, since they are not finite.

    Parameters
    ----------
    views
        Of :func:`prepare`.

    Returns
    -------
    int
        Their number.
    """
    theirs = np.isin(views.sightings.view, list(views.given))
    return int((theirs & ~np.isfinite(views.sightings.pixels_vu).all(axis=1)).sum())


def _given_places(views: Views) -> Intersections:
    table, count = views.table, len(views.points)
    assert table.points_km is not None
    # The file repeats a point's place in every row; one that is not finite fails its own view alone.
    whole: BoolArray = np.asarray(np.isfinite(table.points_km).all(axis=1))
    order = np.lexsort((np.arange(len(whole)), ~whole, table.point_id))
    first = order[np.unique(table.point_id[order], return_index=True)[1]]
    places = table.points_km[first]
    rows = np.flatnonzero(whole)
    away = np.abs(table.points_km[rows] - places[views.sightings.point[rows]]).max(axis=1) > _SAME_PLACE_KM
    if away.any():
        raise ConfigurationError(f"point {table.point_id[rows[away][0]]} has more than one place")
    spread = np.zeros((count, 3, 3)) if table.point_covariance_km2 is None else table.point_covariance_km2[first]
    return Intersections(places, spread, np.zeros(count, dtype=np.int64))


def _ranked(values: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct values in order, and the rank of each."""
    distinct, rank = np.unique(values, return_inverse=True)
    return distinct, rank.astype(np.int64)


def prepare(table: MatchTable, cameras: Cameras) -> Views:
    """Order views and points, and read the sense in which positions are written.

    Parameters
    ----------
    table
        All matches.
    cameras
        Camera, datum and given poses.

    Returns
    -------
    Views
        Ready to be solved.

    Raises
    ------
    ConfigurationError
        If points have no places and fewer than two poses are given.
    """
    told = [*cameras.poses, *(view.view_id for arc in cameras.arcs for view in arc.views)]
    named = np.concatenate([table.view_id, np.array(told, dtype=np.int64)])
    ids, view = _ranked(named)
    points, point = _ranked(table.point_id)
    sightings = Sightings(view[: len(table.view_id)], point, table.pixels_vu, table.pixel_covariance_px2)
    given = {int(np.searchsorted(ids, key)): pose for key, pose in cameras.poses.items()}
    calibration = cameras.calibration
    throttled = frozenset(view.view_id for arc in cameras.arcs for view in arc.views if view.throttled)
    plain = Views(ids, points, sightings, given, False, calibration, PoseOptions(), table, throttled)
    if table.points_km is not None:
        return plain
    if len(given) < 2:
        raise ConfigurationError("points have no places (x_km, y_km, z_km), and fewer than two views have poses")
    away = looks_away(plain.places(robust=False))
    given = {key: turned(pose) for key, pose in given.items()} if away else given
    options = PoseOptions()
    if table.pixel_covariance_px2 is None:
        first = options.assumed_sigma_px
        places = triangulate_views(calibration.camera, sightings, given, len(points), first, robust=False)
        if places.ok.any():
            sigma = sigma_of(calibration.camera, sightings, given, places.places_km)
            options = PoseOptions(assumed_sigma_px=max(sigma, 1e-6))
    return Views(ids, points, sightings, given, away, calibration, options, table, throttled)


def solve_views(views: Views, budget: Budget, every: bool, with_sightings: bool = False) -> Iterable[PoseRow]:
    """Solve the views without poses, each alone.

    Parameters
    ----------
    views
        Of :func:`prepare`.
    budget
        For covariances.
    every
        Also solve the views whose poses are given, each with points from the others.
    with_sightings
        Keep what each pose rests on, for arcs that solve their points.

    Yields
    ------
    PoseRow
        In the order of their ids; position in the sense of the cameras' file.
    """
    estimator = OpenCVGtsamPoseEstimator(views.options)
    places, started = views.places(), time.monotonic()
    exact = views.table.points_km is not None and views.table.point_covariance_km2 is None
    for view, view_id in enumerate(views.ids):
        if view in views.given and not every:
            continue
        mine = places if view not in views.given or views.table.points_km is not None else views.places(view)
        rows = views.sightings.view == view
        matches = _refused(views, rows) or matches_of(str(view_id), views.sightings, rows, mine, exact)
        if isinstance(matches, PnpFailureError):
            yield PoseRow(int(view_id), matches)
            continue
        with warnings.catch_warnings():
            # The log has a line per throttled frame; Python's own warnings would say the first one only.
            warnings.simplefilter("ignore", CovarianceDegradedWarning)
            state = budget.state(started, int(view_id) in views.throttled)
            begun = time.monotonic()
            answer = solve_view(estimator, views.calibration, matches, state)
        emitted = time.monotonic_ns() if isinstance(answer, PoseEstimate) else None
        spent, seen = time.monotonic() - begun, None
        if with_sightings and isinstance(answer, PoseEstimate):
            seen = sightings_of(matches, answer, views.calibration, views.options.assumed_sigma_px)
            seen = None if seen is None else replace(seen, point_id=views.points[seen.point_id])
        yield PoseRow(int(view_id), answer, spent, emitted, seen)


def _refused(views: Views, rows: BoolArray) -> PnpFailureError | None:
    """What is wrong with the places that a view's own rows give its points."""
    if views.table.points_km is None:
        return None
    bad = np.flatnonzero(~np.isfinite(views.table.points_km[rows]).all(axis=1))
    if not len(bad):
        return None
    return PnpFailureError(PnpFailure.BAD_INPUT, f"{len(bad)} of its points have a place that is not finite")


def bundle_views(views: Views, rows: list[PoseRow], sigma_km: float, sigma_rad: float) -> list[PoseRow]:
    """All views and points adjusted together.

    Parameters
    ----------
    views
        With their given poses, which hold frame and scale.
    rows
        Views solved alone, from which the adjustment starts; failures stay failures.
    sigma_km, sigma_rad
        1 sigma per axis of the given poses.

    Returns
    -------
    list of PoseRow
        The same views with adjusted poses.
    """
    alone = {int(np.searchsorted(views.ids, row.view_id)): row.answer for row in rows}
    starts = {view: answer.pose for view, answer in alone.items() if isinstance(answer, PoseEstimate)} | views.given
    camera, sigma = views.calibration.camera, views.options.assumed_sigma_px
    places = triangulate_views(camera, views.sightings, starts, len(views.points), sigma)
    spread = np.diag([sigma_km**2] * 3 + [sigma_rad**2] * 3)
    priors = {view: PosePrior(pose, spread) for view, pose in views.given.items()}
    bundle = adjust(camera, views.sightings, starts, places, priors, sigma)
    return [replace(row, answer=_adjusted(views, bundle, row)) for row in rows]


def _adjusted(views: Views, bundle: Bundle, row: PoseRow) -> PoseEstimate | PnpFailureError:
    view = int(np.searchsorted(views.ids, row.view_id))
    if isinstance(row.answer, PnpFailureError):
        return row.answer
    pose = bundle.poses[view]
    mine = (views.sightings.view == view) & np.isfinite(bundle.places_km[views.sightings.point, 0])
    pixels, ahead = project(views.calibration.camera, pose.to_camera(bundle.places_km[views.sightings.point[mine]]))
    rms = np.sqrt(((views.sightings.pixels_vu[mine] - pixels)[ahead] ** 2).mean(axis=0))
    return replace(
        row.answer, pose=pose, covariance_6x6=bundle.covariances[view], rms_px=rms, method="bundle",
        position_wgs84=place_of(pose, views.calibration),
        orientation_world_T_body=vehicle_orientation(pose, views.calibration),
    )  # fmt: skip


def compare_given(views: Views, rows: list[PoseRow]) -> FloatArray:
    """Differences to the given poses.

    Parameters
    ----------
    views
        With their given poses.
    rows
        Answers.

    Returns
    -------
    numpy.ndarray
        (n, 5): distance in km, angle in rad, rms along v and u in px, NEES; one row per given view with an answer.
    """
    found = []
    for row in rows:
        view = int(np.searchsorted(views.ids, row.view_id))
        if view in views.given and isinstance(row.answer, PoseEstimate):
            error = SE3Utils.error(row.answer.pose, views.given[view])
            nees = float(error @ np.linalg.solve(row.answer.covariance_6x6, error))
            found.append([np.linalg.norm(error[:3]), np.linalg.norm(error[3:]), *row.answer.rms_px, nees])
    return np.array(found).reshape(-1, 5)


def pose_table(views: Views, rows: list[PoseRow]) -> pa.Table:
    """Arrow table of the answers.

    Parameters
    ----------
    views
        For the sense of positions.
    rows
        Answers.

    Returns
    -------
    pyarrow.Table
        ``view_id, x_km, y_km, z_km, qw, qx, qy, qz, cov_00 ... cov_55, rms_px, label``; null where there is no pose.
    """
    names = ["view_id", "x_km", "y_km", "z_km", "qw", "qx", "qy", "qz"]
    names += [f"cov_{i}{j}" for i, j in UPPER] + ["rms_px", "label"]
    kinds = [pa.int64(), *[pa.float64()] * (len(names) - 2), pa.string()]
    meta = {"frame": _FRAME + (_TO_BODY if views.turned else "")}
    schema = pa.schema(list(zip(names, kinds, strict=True)), metadata=meta)
    content = [dict(zip(names, _values(row, views.turned), strict=True)) for row in rows]
    return pa.Table.from_pylist(content, schema=schema)


def _values(row: PoseRow, turn: bool) -> list[int | float | str | None]:
    answer = row.answer
    if isinstance(answer, PnpFailureError):
        return [row.view_id, *[None] * (7 + len(UPPER) + 1), SourceLabel.DEAD_RECKONED.value]
    pose, covariance = answer.pose, answer.covariance_6x6
    if turn:
        pose, covariance = turned(pose), SE3Utils.error_from_correction(covariance)
    # Per axis: the mean of both axes' squares.
    rms = float(np.sqrt((answer.rms_px**2).mean()))
    numbers = [
        *pose.position_km,
        *quaternion_from_matrix(pose.camera_from_body),
        *(covariance[i, j] for i, j in UPPER),
    ]
    return [row.view_id, *map(float, numbers), rms, answer.source_label.value]
