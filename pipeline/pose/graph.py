"""Factors of GTSAM: one image's matches on its pose, with the points' own uncertainty."""

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pipeline.pose.records import Pose
from pipeline.pose.refine import scene_scale, whitening
from pipeline.pose.se3 import SE3Utils
from pipeline.records import FloatArray

# The ideal plane is seen by a camera of unit focal length.
_IDEAL = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)
# iSAM2 makes one step of Gauss and Newton per update; from a trajectory's prior three are enough.
_SETTLING_UPDATES = 3
# A point at or behind the camera has no projection; so large a residual turns every step back.
_BEHIND = 1e6


class SharedGraph(Protocol):
    """An arc's growing graph, which owns its iSAM2."""

    isam: gtsam.ISAM2

    def key_of(self, image_id: str) -> int:
        """Key of an image's pose."""


def pose_key(index: int) -> int:
    """Key of an image's pose."""
    return int(gtsam.symbol("x", index))


def point_key(index: int) -> int:
    """Key of a point."""
    return int(gtsam.symbol("l", index))


def resection_factor(key: int, points: FloatArray, xy: FloatArray, covariance: FloatArray) -> gtsam.CustomFactor:
    """One factor for all matches of an image with exact points.

    Parameters
    ----------
    key
        Of the pose, body_from_camera.
    points
        (n, 3) in the graph's frame and unit.
    xy
        (n, 2) on the ideal plane.
    covariance
        (n, 2, 2) there.

    Returns
    -------
    gtsam.CustomFactor
        2 n whitened rows with analytic derivatives along GTSAM's tangent (rotation, translation).
    """
    white = whitening(covariance)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        pose = values.atPose3(this.keys()[0])
        camera = (points - pose.translation()) @ pose.rotation().matrix()
        ahead = camera[:, 2] > 0
        depth = np.where(ahead, camera[:, 2], 1.0)
        x, y = (camera[:, :2] / depth[:, None]).T
        if jacobians is not None:
            jacobians[0] = np.asfortranarray((white @ _plane_jacobian(x, y, depth)).reshape(-1, 6))
        residual = np.where(ahead[:, None], np.stack([x, y], axis=1) - xy, _BEHIND)
        return np.asarray((white @ residual[:, :, None]).ravel())

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(2 * len(points)), [key], error)


def _plane_jacobian(x: FloatArray, y: FloatArray, depth: FloatArray) -> FloatArray:
    """(n, 2, 6), d(x, y)/d(rotation, translation) of the camera in its own frame."""
    jacobian = np.zeros((len(x), 2, 6))
    near = 1.0 / depth
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = x * y, -1.0 - x * x, y
    jacobian[:, 0, 3], jacobian[:, 0, 5] = -near, near * x
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = 1.0 + y * y, -x * y, -x
    jacobian[:, 1, 4], jacobian[:, 1, 5] = -near, near * y
    return jacobian


def match_graph(
    key: int, points: FloatArray, xy: FloatArray, covariance: FloatArray, point_covariance: FloatArray | None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Factors of one image's matches.

    Parameters
    ----------
    key
        Of the pose.
    points
        (n, 3) in the graph's frame and unit.
    xy
        (n, 2) on the ideal plane.
    covariance
        (n, 2, 2) there.
    point_covariance
        (n, 3, 3) in the graph's unit; then every point is a variable with a prior. None for exact points.

    Returns
    -------
    tuple
        The factors, and start values of the points (none if exact).
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    if point_covariance is None:
        graph.add(resection_factor(key, points, xy, covariance))
        return graph, values
    for i, point in enumerate(points):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[i])
        graph.add(gtsam.GenericProjectionFactorCal3_S2(xy[i], noise, key, point_key(i), _IDEAL))
        prior = gtsam.noiseModel.Gaussian.Covariance(point_covariance[i])
        graph.add(gtsam.PriorFactorPoint3(point_key(i), point, prior))
        values.insert(point_key(i), point)
    return graph, values


def shared_posterior(
    shared: SharedGraph, image_id: str, points_km: FloatArray, xy: FloatArray, covariance: FloatArray
) -> tuple[Pose, FloatArray]:
    """Add an image's matches to an arc's graph, and read its pose there: what else the graph knows is in it.

    Parameters
    ----------
    shared
        The arc, which has the image's pose already.
    image_id
        The image.
    points_km
        (n, 3) body-fixed.
    xy
        (n, 2) on the ideal plane.
    covariance
        (n, 2, 2) there, the points' own projected into it.

    Returns
    -------
    tuple
        Pose; (6, 6) covariance of errors (x, y, z, rx, ry, rz), km and rad.
    """
    key = shared.key_of(image_id)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(resection_factor(key, points_km, xy, covariance))
    shared.isam.update(graph, gtsam.Values())
    for _ in range(_SETTLING_UPDATES):
        shared.isam.update()
    pose = SE3Utils.from_gtsam(shared.isam.calculateEstimatePose3(key))
    return pose, SE3Utils.error_from_gtsam(shared.isam.marginalCovariance(key), pose.camera_from_body)


def posterior(
    start: Pose, points_km: FloatArray, xy: FloatArray, covariance: FloatArray, point_covariance_km2: FloatArray | None
) -> tuple[Pose, FloatArray]:
    """Maximum a posteriori pose and its marginal covariance.

    Parameters
    ----------
    start
        A pose near the answer.
    points_km
        (n, 3) body-fixed.
    xy
        (n, 2) on the ideal plane.
    covariance
        (n, 2, 2) there.
    point_covariance_km2
        (n, 3, 3), or None.

    Returns
    -------
    tuple
        Pose; (6, 6) covariance of errors (x, y, z, rx, ry, rz), km and rad.
    """
    centre, scale = scene_scale(points_km)
    key = pose_key(0)
    spread = None if point_covariance_km2 is None else point_covariance_km2 / scale**2
    graph, values = match_graph(key, (points_km - centre) / scale, xy, covariance, spread)
    values.insert(key, SE3Utils.to_gtsam(Pose(start.camera_from_body, (start.position_km - centre) / scale)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    marginal = gtsam.Marginals(graph, result).marginalCovariance(key)
    found = SE3Utils.from_gtsam(result.atPose3(key))
    unit = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
    errors = SE3Utils.error_from_gtsam(marginal, found.camera_from_body) * np.outer(unit, unit)
    return Pose(found.camera_from_body, found.position_km * scale + centre), errors


def covariances_of(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaves: Sequence[int], others: Sequence[int]
) -> dict[int, FloatArray]:
    """Marginal covariances of all variables, where many are leaves: points that see nothing but poses.

    ``Marginals`` asks its tree once per variable, which takes long where a tree's root is large.

    Parameters
    ----------
    graph
        Factors.
    values
        Where they are linearised; variables of six, three and three numbers: poses, points, the bias.
    leaves
        Keys of variables no two of which share a factor.
    others
        All other keys.

    Returns
    -------
    dict
        (k, k) of each key, in GTSAM's tangent.
    """
    ordering, rest_order = gtsam.Ordering(), gtsam.Ordering()
    for key in leaves:
        ordering.push_back(key)
    for key in others:
        rest_order.push_back(key)
    linear = graph.linearize(values)
    net, rest = linear.eliminatePartialSequential(ordering) if leaves else (gtsam.GaussianBayesNet(), linear)
    information = rest.hessian(rest_order)[0]
    unit = 1.0 / np.sqrt(np.diag(information))
    factor = cho_factor(information * np.outer(unit, unit), lower=True, overwrite_a=True)
    joint = cho_solve(factor, np.diag(unit), overwrite_b=True) * unit[:, None]
    sizes = [_size(key) for key in others]
    starts = dict(zip(others, np.cumsum([0, *sizes[:-1]]), strict=True))
    rows = {key: np.arange(starts[key], starts[key] + size) for key, size in zip(others, sizes, strict=True)}
    found = {key: joint[np.ix_(rows[key], rows[key])] for key in others}
    for k in range(net.size()):
        conditional = net.at(k)
        key, *parents = conditional.keys()
        inverse = np.linalg.inv(conditional.R())
        found[key] = inverse @ inverse.T
        if parents:
            slope = inverse @ conditional.S()
            index = np.concatenate([rows[parent] for parent in parents])
            found[key] = found[key] + slope @ joint[np.ix_(index, index)] @ slope.T
    return found


def _size(key: int) -> int:
    """Numbers of a variable's tangent, by the letter of its key."""
    return 6 if gtsam.symbolChr(key) == ord("x") else 3
