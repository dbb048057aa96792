"""All views of one set of points together: poses and places in one graph."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.options import Options
from pipeline.pose.graph import point_key, pose_key
from pipeline.pose.normalise import PlanePoints, to_plane
from pipeline.pose.records import MatchError, Pose, PosePrior
from pipeline.pose.refine import plane_residuals
from pipeline.pose.se3 import SE3Utils
from pipeline.pose.triangulation import Intersections
from pipeline.pose.views import Sightings
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

_IDEAL = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)


class BundleOptions(Options):
    """Settings of the common adjustment."""

    huber_sigma: float = Field(3.0, gt=0, description="residual beyond which a sighting counts less, sigmas")
    gate_sigma: float = Field(8.0, gt=0, description="residual beyond which a sighting is wrong, sigmas")
    rounds: int = Field(2, ge=0, le=20, description="most times wrong sightings are left out")
    max_iterations: int = Field(15, ge=1, le=1000, description="steps of Levenberg-Marquardt")
    relative_tolerance: float = Field(1e-5, gt=0, description="change of the cost that ends it")


@dataclass(frozen=True, eq=False)
class Bundle(Record):
    """Adjusted poses and places.

    Attributes
    ----------
    poses
        By position in the list of views.
    covariances
        (6, 6) of errors (x, y, z, rx, ry, rz) of each pose.
    places_km
        (m, 3), NaN for points that took no part.
    used
        (n,) sightings that took part.
    """

    poses: dict[int, Pose]
    covariances: dict[int, FloatArray]
    places_km: FloatArray
    used: BoolArray

    def __post_init__(self) -> None:
        self._freeze(places_km=(None, 3), used=(None,))


def adjust(
    camera: CameraModel,
    sightings: Sightings,
    starts: dict[int, Pose],
    places: Intersections,
    priors: dict[int, PosePrior],
    sigma_px: float,
    options: BundleOptions | None = None,
) -> Bundle:
    """Adjust poses and places to all sightings at once.

    Parameters
    ----------
    camera
        The model.
    sightings
        All sightings.
    starts
        Pose of every view that takes part.
    places
        Start places; points that are refused take no part.
    priors
        At least one view's prior pose, which fixes frame and scale.
    sigma_px
        Where the sightings state none.
    options
        Settings.

    Returns
    -------
    Bundle
        The maximum a posteriori of all, with marginal covariances of the poses.

    Raises
    ------
    MatchError
        If there is no prior, so that frame and scale are free.
    """
    o = options or BundleOptions()
    if not priors:
        raise MatchError("nothing fixes frame and scale: at least one view needs a prior pose")
    plane = to_plane(camera, sightings.pixels_vu, sightings.covariance(sigma_px))
    problem = _Problem(sightings, plane, priors, o)
    rows = np.flatnonzero(plane.ok & np.isin(sightings.view, list(starts)) & places.ok[sightings.point])
    state = problem.solve(_placed(sightings, rows), starts, places.places_km)
    # Wrong tracks first lose weight, then their place: what is far off once the others agree takes no part.
    for _ in range(o.rounds):
        kept = _placed(sightings, state.rows[problem.near(state)])
        if len(kept) == len(state.rows):
            break
        state = problem.solve(kept, state.poses, state.places_km)
    marginals = gtsam.Marginals(state.graph, state.values)
    covariances = {
        view: SE3Utils.error_from_gtsam(marginals.marginalCovariance(pose_key(view)), pose.camera_from_body)
        for view, pose in state.poses.items()
    }
    used = np.zeros(len(sightings.view), dtype=bool)
    used[state.rows] = True
    return Bundle(state.poses, covariances, state.places_km, used)


def _placed(sightings: Sightings, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of points that two views see: one alone gives no place."""
    count = np.bincount(sightings.point[rows])
    return np.asarray(rows[count[sightings.point[rows]] >= 2])


@dataclass(frozen=True)
class _State:
    """A solution with the sightings it rests on."""

    rows: NDArray[np.int64]
    poses: dict[int, Pose]
    places_km: FloatArray
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values


@dataclass(frozen=True)
class _Problem:
    """What stays the same from round to round."""

    sightings: Sightings
    plane: PlanePoints
    priors: dict[int, PosePrior]
    options: BundleOptions

    def solve(self, rows: NDArray[np.int64], poses: dict[int, Pose], places_km: FloatArray) -> _State:
        """Levenberg-Marquardt over all poses and the points of the rows."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for view, pose in poses.items():
            values.insert(pose_key(view), SE3Utils.to_gtsam(pose))
        for view, prior in self.priors.items():
            covariance = SE3Utils.gtsam_from_error(prior.covariance, prior.pose.camera_from_body)
            model = gtsam.noiseModel.Gaussian.Covariance(covariance)
            graph.add(gtsam.PriorFactorPose3(pose_key(view), SE3Utils.to_gtsam(prior.pose), model))
        points = np.unique(self.sightings.point[rows])
        for point in points:
            values.insert(point_key(int(point)), places_km[point])
        self._add_sightings(graph, rows)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self.options.max_iterations)
        params.setRelativeErrorTol(self.options.relative_tolerance)
        params.setOrdering(_points_first(points, poses))
        try:
            result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
        except RuntimeError as error:
            # GTSAM's own: a point or a view that its sightings leave free.
            raise MatchError(f"the views do not determine each other: {str(error).strip().splitlines()[0]}") from error
        found = {view: SE3Utils.from_gtsam(result.atPose3(pose_key(view))) for view in poses}
        places = np.full(places_km.shape, np.nan)
        if len(points):
            places[points] = [result.atPoint3(point_key(int(point))) for point in points]
        return _State(rows, found, places, graph, result)

    def _add_sightings(self, graph: gtsam.NonlinearFactorGraph, rows: NDArray[np.int64]) -> None:
        """One factor per sighting."""
        huber = gtsam.noiseModel.mEstimator.Huber.Create(self.options.huber_sigma)
        # Sightings of one pinhole share their noise, which a factor then only refers to.
        shared: dict[bytes, gtsam.noiseModel.Base] = {}
        for row in rows:
            name = self.plane.covariance[row].tobytes()
            if name not in shared:
                gaussian = gtsam.noiseModel.Gaussian.Covariance(self.plane.covariance[row])
                shared[name] = gtsam.noiseModel.Robust.Create(huber, gaussian)
            keys = pose_key(int(self.sightings.view[row])), point_key(int(self.sightings.point[row]))
            graph.add(gtsam.GenericProjectionFactorCal3_S2(self.plane.xy[row], shared[name], *keys, _IDEAL))

    def near(self, state: _State) -> BoolArray:
        """Which of a solution's sightings lie within the gate."""
        near = np.zeros(len(state.rows), dtype=bool)
        views = self.sightings.view[state.rows]
        for view, pose in state.poses.items():
            mine = np.flatnonzero(views == view)
            rows = state.rows[mine]
            residual = plane_residuals(pose, state.places_km[self.sightings.point[rows]], self.plane.xy[rows])
            inverse = np.linalg.inv(self.plane.covariance[rows])
            with np.errstate(invalid="ignore"):
                squared = np.einsum("ni,nij,nj->n", residual, inverse, residual)
            near[mine] = squared <= self.options.gate_sigma**2
        return near


def _points_first(points: NDArray[np.int64], starts: dict[int, Pose]) -> gtsam.Ordering:
    """Points see poses only: eliminating them first leaves one small dense system."""
    ordering = gtsam.Ordering()
    for point in points:
        ordering.push_back(point_key(int(point)))
    for view in starts:
        ordering.push_back(pose_key(view))
    return ordering
