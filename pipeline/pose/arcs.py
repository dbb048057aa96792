"""Arcs: all images of one orbit or flyby in one graph, smoothed.

An arc is a chain with one state in common, the camera's bias. It is solved segment by segment: what lies to the left
of a segment is known to it as one Gaussian on its first pose and the bias, what lies to the right as one on its last,
each left over when all other unknowns there are eliminated. So memory is that of one segment, and the answer is that of
the whole graph.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from pydantic import Field
from scipy.stats import chi2

from pipeline.options import Options
from pipeline.pose.arc_factors import (
    BIAS_KEY,
    ArcImage,
    ArcNoise,
    first_factors,
    image_factors,
    offset_covariance,
    offset_residual,
    step_factor,
)
from pipeline.pose.arc_landmarks import ArcLandmarks, common_landmarks
from pipeline.pose.graph import covariances_of, point_key, pose_key
from pipeline.pose.records import MatchError, Pose, PosePrior, SourceLabel
from pipeline.pose.se3 import SE3Utils
from pipeline.records import BoolArray, FloatArray, Record

_FIX_ROWS = 6
# Median of the size of a normal variable.
_MEDIAN_OF_NORMAL = 0.6745
_ENOUGH_FIXES = 5
_LEAST_OF_NOISE = 0.1
_BISECTIONS = 40
# Columns of what holds an image: its landmark fix, its offset.
_FIX, _OFFSET = 0, 1
# Fixes taken back settle at once or in two or three rounds.
_MOST_ROUNDS = 5
# What a segment hands on is linear: from where the first round ends, two leave a hundredth of a sigma.
_LANDMARK_ROUNDS = 2
# Kilometres and radians: a stale linearisation by an angle a misplaces a range by half its square.
_RELINEARIZE = 1e-5


class ArcOptions(Options):
    """Uncertainties of trajectory and attitudes, and how an arc is cut."""

    position_sigma_km: float = Field(10.0, gt=0, description="1 sigma of the trajectory's position at the start, km")
    walk_km_per_sqrt_s: float = Field(0.01, gt=0, description="random walk of the trajectory's error, km per sqrt(s)")
    attitude_sigma_rad: float = Field(1e-4, gt=0, description="1 sigma of one believed attitude per axis, rad")
    boresight_sigma_rad: float = Field(1e-3, gt=0, description="1 sigma of the boresight's common offset, rad")
    twist_sigma_rad: float = Field(1e-3, gt=0, description="1 sigma of the camera's common twist, rad")
    segment: int = Field(250, ge=2, le=100_000, description="images solved at once")
    outlier_chance: float = Field(1e-4, gt=0, lt=0.5, description="of a good fix to be left out")
    solve_landmarks: bool = Field(False, description="solve places of points that several images see with the poses")
    most_common_landmarks: int = Field(300, ge=0, le=3000, description="of them, between two segments")

    def noise(self) -> ArcNoise:
        """The uncertainties alone."""
        return ArcNoise(
            self.position_sigma_km, self.walk_km_per_sqrt_s, self.attitude_sigma_rad, self.boresight_sigma_rad,
            self.twist_sigma_rad,
        )  # fmt: skip


def fitted_options(images: Sequence[ArcImage], options: ArcOptions) -> ArcOptions:
    """Uncertainties that nobody has told, as large as an arc's own fixes show them to be.

    Medians bear with fixes that are wrong.

    Parameters
    ----------
    images
        In the order of time.
    options
        Fields that were set stay.

    Returns
    -------
    ArcOptions
        The same where fewer than five images have a fix.
    """
    fixed = [(image, image.fix) for image in images if image.fix is not None]
    if len(fixed) < _ENOUGH_FIXES:
        return options
    away = np.array([image.prior.position_km - fix.pose.position_km for image, fix in fixed])
    turns = np.array([
        SE3Utils.log(image.prior.camera_from_body @ fix.pose.camera_from_body.T) for image, fix in fixed
    ])  # fmt: skip
    errors = np.array([np.diag(fix.covariance) for _, fix in fixed])
    # Rotations of fixes are body-fixed; their mean variance holds in any axes.
    turn_noise = np.broadcast_to(errors[:, 3:].mean(axis=1, keepdims=True), turns.shape)
    bias = np.median(turns, axis=0)
    root = np.sqrt(np.diff([image.et for image, _ in fixed]))[:, None]
    steps, step_noise = np.diff(away, axis=0) / root, (errors[1:, :3] + errors[:-1, :3]) / root**2
    found = {
        "position_sigma_km": _spread(away, errors[:, :3]), "walk_km_per_sqrt_s": _spread(steps, step_noise),
        "attitude_sigma_rad": _spread(turns - bias, turn_noise),
        "boresight_sigma_rad": max(options.boresight_sigma_rad, float(np.abs(bias[:2]).max())),
        "twist_sigma_rad": max(options.twist_sigma_rad, abs(float(bias[2]))),
    }  # fmt: skip
    return options.model_copy(update={k: v for k, v in found.items() if k not in options.model_fields_set})


def _spread(values: FloatArray, noise2: FloatArray) -> float:
    """1 sigma of values about zero beside the variance of their noise, by the median of their sizes.

    Never less than a tenth of the noise, of which no median can tell anything.
    """
    low = np.log(_LEAST_OF_NOISE * np.sqrt(np.median(noise2)))
    high = max(np.log(np.abs(values).max() + 1e-300), low) + 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        sizes = np.abs(values) / np.sqrt(np.exp(2.0 * middle) + noise2)
        low, high = (middle, high) if np.median(sizes) > _MEDIAN_OF_NORMAL else (low, middle)
    return float(np.exp(high))


@dataclass(frozen=True, eq=False)
class ArcResult(Record):
    """Smoothed poses of an arc.

    Attributes
    ----------
    image_id
        Images in the order of time.
    camera_from_body
        (n, 3, 3).
    position_km
        (n, 3).
    covariance
        (n, 6, 6) of errors (x, y, z, rx, ry, rz), km and rad, body-fixed.
    used
        (n,) True where the image's own landmark fix holds it.
    offset_used
        (n,) True where the image's own offset does.
    label
        What holds each pose.
    anchor_age_ms
        Time since the last anchored image; None before the first.
    bias_rad
        (3,) boresight about x and y, twist about z.
    bias_covariance_rad2
        (3, 3).
    landmarks
        Points that were solved with the poses, with their places afterwards; None where none were.
    """

    image_id: tuple[str, ...]
    camera_from_body: FloatArray
    position_km: FloatArray
    covariance: FloatArray
    used: BoolArray
    offset_used: BoolArray
    label: tuple[SourceLabel, ...]
    anchor_age_ms: tuple[int | None, ...]
    bias_rad: FloatArray
    bias_covariance_rad2: FloatArray
    landmarks: ArcLandmarks | None = None

    def __post_init__(self) -> None:
        n = len(self.image_id)
        self._freeze(
            camera_from_body=(n, 3, 3), position_km=(n, 3), covariance=(n, 6, 6), used=(n,), offset_used=(n,),
            bias_rad=(3,), bias_covariance_rad2=(3, 3),
        )  # fmt: skip

    def pose(self, index: int) -> Pose:
        """Pose of one image."""
        return Pose(self.camera_from_body[index], self.position_km[index])


def check_arc(images: Sequence[ArcImage]) -> None:
    """Refuse arcs that are none.

    Parameters
    ----------
    images
        In the order of time.

    Raises
    ------
    MatchError
        If there are no images, one comes twice, or times do not ascend.
    """
    if not images:
        raise MatchError("an arc without images")
    if len({image.image_id for image in images}) < len(images):
        raise MatchError("an arc with an image twice")
    for one, other in pairwise(images):
        if not other.et > one.et:
            raise MatchError(f"{other.image_id} is not later than {one.image_id}")


def smooth_arc(images: Sequence[ArcImage], options: ArcOptions | None = None) -> ArcResult:
    """Smooth an arc in segments.

    Parameters
    ----------
    images
        In the order of time.
    options
        Uncertainties.

    Returns
    -------
    ArcResult
        Poses of all images, those without a fix of their own among them.

    Raises
    ------
    MatchError
        If the arc is none.
    """
    check_arc(images)
    o = options or ArcOptions()
    starts = list(range(0, len(images), o.segment))
    segments = [_Segment(k, min(k + o.segment, len(images)), images, o) for k in starts]
    used = np.zeros((len(images), 2), dtype=bool)
    result = _sweep(segments, used)
    if not o.solve_landmarks:
        return result
    # Which fixes hold is known now, and where the poses are: now with the points, linearised at what was found before.
    landmarks = common_landmarks(images, used[:, _FIX], o.segment, o.most_common_landmarks)
    if not len(landmarks.point_id):
        return result
    for _ in range(_LANDMARK_ROUNDS if len(segments) > 1 else 1):
        result = _sweep([replace(s, landmarks=landmarks, near=result) for s in segments], used)
    return result


def _sweep(segments: "list[_Segment]", used: BoolArray) -> ArcResult:
    """Forward and back through an arc; sets ``used`` unless an earlier result says where the poses are."""
    images, noise = segments[0].images, segments[0].options.noise()
    # Forward: which fixes hold, and what each segment hands on to its right.
    lefts = [_Handed(first_factors(images[0], noise), gtsam.Values())]
    points: list[gtsam.Values] = []
    for segment in segments:
        values = segment.settle(lefts[-1], used) if segment.near is None else segment.values_near(segment.near)
        points.append(values)
        if segment.stop < len(images):
            lefts.append(segment.hand_on(lefts[-1], values, used, segment.stop - 1))
    # Backward: what each segment hands on to its left, and its own answer between the two.
    right = _Handed(gtsam.NonlinearFactorGraph(), gtsam.Values())
    parts = []
    for segment, left, values in zip(segments[::-1], lefts[::-1], points[::-1], strict=True):
        parts.append(segment.answer(left, right, values, used))
        if segment.start:
            right = segment.hand_on(right, values, used, segment.start - 1, leftward=True)
    return _result(images, parts[::-1], used, segments[0].landmarks)


@dataclass(frozen=True)
class _Handed:
    """What is known beyond a segment: factors, and the values at which they were linearised (none: a prior)."""

    graph: gtsam.NonlinearFactorGraph
    at: gtsam.Values


@dataclass(frozen=True)
class _Part:
    """Poses of one segment."""

    turns: list[FloatArray]
    places: list[FloatArray]
    covariances: list[FloatArray]
    bias: FloatArray
    bias_covariance: FloatArray
    points: dict[int, tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class _Segment:
    """Images start to stop of an arc; with the last of the segment before, where the step into it begins.

    With landmarks, sightings take the place of the fixes that were made from them, and ``near`` is an earlier result.
    """

    start: int
    stop: int
    images: Sequence[ArcImage]
    options: ArcOptions
    landmarks: ArcLandmarks | None = None
    near: ArcResult | None = None

    def graph(self, used: BoolArray, robust: gtsam.noiseModel.mEstimator.Base | None) -> gtsam.NonlinearFactorGraph:
        """Factors of the images and of the steps into them; without a weight function, only fixes that are used."""
        noise, graph = self.options.noise(), gtsam.NonlinearFactorGraph()
        for k in range(self.start, self.stop):
            image, seen = self.images[k], None
            if robust is None:
                seen = image.sightings if self.landmarks is not None and used[k, _FIX] else None
                image = replace(
                    image, fix=image.fix if used[k, _FIX] and seen is None else None,
                    offset=image.offset if used[k, _OFFSET] else None,
                )  # fmt: skip
            graph.push_back(image_factors(k, image, noise, robust))
            if self.landmarks is not None and self.near is not None and seen is not None:
                graph.push_back(self.landmarks.image_factors(k, seen, self.near.pose(k)))
            if k:
                graph.add(step_factor(k - 1, self.images[k - 1], self.images[k], noise))
        if self.landmarks is not None:
            graph.push_back(self.landmarks.prior_factors(self.landmarks.begun_within(self.start, self.stop)))
        return graph

    def values_near(self, near: ArcResult) -> gtsam.Values:
        """Values of an earlier result."""
        values = gtsam.Values()
        values.insert(BIAS_KEY, near.bias_rad)
        for k in range(max(self.start - 1, 0), self.stop):
            values.insert(pose_key(k), SE3Utils.to_gtsam(near.pose(k)))
        if self.landmarks is not None:
            at = self.landmarks if near.landmarks is None else near.landmarks
            for point in self.landmarks.seen_within(self.start, self.stop):
                values.insert(point_key(int(point)), at.places_km[point])
        return values

    def settle(self, left: _Handed, used: BoolArray) -> gtsam.Values:
        """Solve with what lies to the left, robustly; sets ``used`` (fix, offset) for the segment's images."""
        values = gtsam.Values()
        values.insert(BIAS_KEY, np.zeros(3))
        for k in range(max(self.start - 1, 0), self.stop):
            values.insert(pose_key(k), SE3Utils.to_gtsam(self.images[k].prior))
        values.update(left.at)
        gate = float(np.sqrt(chi2.isf(self.options.outlier_chance, _FIX_ROWS)))
        # A convex weight first, so that all measurements speak; then those within the gate alone.
        weights = gtsam.noiseModel.mEstimator
        for weight in (weights.Huber.Create(gate / 2.0), weights.TruncatedLeastSquares.Create(gate)):
            graph = self.graph(used, weight)
            graph.push_back(left.graph)
            values = _optimize(graph, values)
        for k in range(self.start, self.stop):
            for kind in (_FIX, _OFFSET):
                used[k, kind] = self._within(k, kind, values.atPose3(pose_key(k)))
        return self._call_back(left, values, used)

    def _within(self, k: int, kind: int, pose: gtsam.Pose3, covariance: FloatArray | None = None) -> bool:
        """Whether an image's fix or offset is within the gate of a pose, with the errors of one that is free of it."""
        image, chance = self.images[k], self.options.outlier_chance
        if kind == _FIX:
            return image.fix is not None and _fix_distance2(image.fix, pose, covariance) <= chi2.isf(chance, _FIX_ROWS)
        if image.offset is None:
            return False
        residual, slope = offset_residual(image.offset, SE3Utils.from_gtsam(pose))
        total = offset_covariance(image.offset)
        if covariance is not None:
            total = total + slope @ covariance @ slope.T
        return bool(residual @ np.linalg.solve(total, residual) <= chi2.isf(chance, len(residual)))

    def _call_back(self, left: _Handed, values: gtsam.Values, used: BoolArray) -> gtsam.Values:
        """Solve with the fixes that are used, and take back those that neighbours of a wrong one were left out with."""
        for _ in range(_MOST_ROUNDS):
            graph = self.graph(used, None)
            graph.push_back(left.graph)
            values = _optimize(graph, values)
            out = [
                (k, kind) for k in range(self.start, self.stop) for kind in (_FIX, _OFFSET)
                if (self.images[k].fix, self.images[k].offset)[kind] is not None and not used[k, kind]
            ]  # fmt: skip
            if not out:
                break
            marginals = gtsam.Marginals(graph, values)
            # A pose that a fix does not hold has an error of its own.
            back = [
                (k, kind) for k, kind in out
                if self._within(k, kind, values.atPose3(pose_key(k)), marginals.marginalCovariance(pose_key(k)))
            ]  # fmt: skip
            if not back:
                break
            used[tuple(np.transpose(back))] = True
        return values

    def hand_on(
        self, beyond: _Handed, values: gtsam.Values, used: BoolArray, keep: int, leftward: bool = False
    ) -> _Handed:
        """One Gaussian on a pose and the bias that says what this segment and what lies beyond it know."""
        graph = self.graph(used, None)
        graph.push_back(beyond.graph)
        linear = graph.linearize(values)
        common, within = self._landmarks_at(self.start if leftward else self.stop)
        kept = {pose_key(keep), BIAS_KEY, *common}
        order = range(self.stop - 1, self.start - 1, -1) if leftward else range(max(self.start - 1, 0), self.stop)
        ordering = gtsam.Ordering()
        for key in [*(pose_key(k) for k in order), *within]:
            if key not in kept:
                ordering.push_back(key)
        _, rest = linear.eliminatePartialSequential(ordering)
        at = gtsam.Values()
        at.insert(BIAS_KEY, values.atVector(BIAS_KEY))
        at.insert(pose_key(keep), values.atPose3(pose_key(keep)))
        for key in common:
            at.insert(key, values.atPoint3(key))
        handed = gtsam.NonlinearFactorGraph()
        for i in range(rest.size()):
            handed.add(gtsam.LinearContainerFactor(rest.at(i), at))
        return _Handed(handed, at)

    def _landmarks_at(self, boundary: int) -> tuple[list[int], list[int]]:
        """Keys of the points that both sides of a boundary see, and of all that play a part in this segment."""
        if self.landmarks is None:
            return [], []
        common, within = self.landmarks.crossing(boundary), self.landmarks.seen_within(self.start, self.stop)
        return [point_key(int(k)) for k in common], [point_key(int(k)) for k in within]

    def answer(self, left: _Handed, right: _Handed, values: gtsam.Values, used: BoolArray) -> _Part:
        """Poses and covariances between what lies to the left and to the right."""
        graph = self.graph(used, None)
        graph.push_back(left.graph)
        graph.push_back(right.graph)
        values = _optimize(graph, values)
        spread = self._covariances(graph, values)
        part = _Part([], [], [], values.atVector(BIAS_KEY), spread[BIAS_KEY], {})
        for k in range(self.start, self.stop):
            pose = SE3Utils.from_gtsam(values.atPose3(pose_key(k)))
            part.turns.append(pose.camera_from_body)
            part.places.append(pose.position_km)
            part.covariances.append(SE3Utils.error_from_gtsam(spread[pose_key(k)], pose.camera_from_body))
        if self.landmarks is not None:
            for k in self.landmarks.begun_within(self.start, self.stop):
                key = point_key(int(k))
                part.points[int(k)] = values.atPoint3(key), spread[key]
        return part

    def _covariances(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[int, FloatArray]:
        """Of all variables of a segment, in GTSAM's tangent."""
        poses = [pose_key(k) for k in range(max(self.start - 1, 0), self.stop)]
        if self.landmarks is None:
            marginals = gtsam.Marginals(graph, values)
            return {key: marginals.marginalCovariance(key) for key in [BIAS_KEY, *poses]}
        within = self._landmarks_at(self.start)[1]
        common = {*self._landmarks_at(self.start)[0], *self._landmarks_at(self.stop)[0]}
        leaves = [key for key in within if key not in common]
        return covariances_of(graph, values, leaves, [*poses, BIAS_KEY, *sorted(common)])


def _optimize(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-8)
    params.setMaxIterations(30)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _fix_distance2(fix: PosePrior, pose: gtsam.Pose3, covariance: FloatArray | None = None) -> float:
    """Squared sigmas between a fix and a pose, with those of a pose that is free of it."""
    away = SE3Utils.to_gtsam(fix.pose).localCoordinates(pose)
    total = SE3Utils.gtsam_from_error(fix.covariance, fix.pose.camera_from_body)
    if covariance is not None:
        total = total + covariance
    return float(away @ np.linalg.solve(total, away))


def _result(
    images: Sequence[ArcImage], parts: list[_Part], used: BoolArray, landmarks: ArcLandmarks | None
) -> ArcResult:
    label, age = labels_of([image.et for image in images], used[:, _FIX])
    if landmarks is not None:
        points = {k: point for part in parts for k, point in part.points.items()}
        order = range(len(landmarks.point_id))
        landmarks = replace(
            landmarks, places_km=np.array([points[k][0] for k in order]),
            covariance_km2=np.array([points[k][1] for k in order]),
        )  # fmt: skip
    return ArcResult(
        tuple(image.image_id for image in images), np.array([t for p in parts for t in p.turns]),
        np.array([x for p in parts for x in p.places]), np.array([c for p in parts for c in p.covariances]),
        used[:, _FIX], used[:, _OFFSET], label, age, parts[0].bias, parts[0].bias_covariance, landmarks,
    )  # fmt: skip


def labels_of(et: Sequence[float], used: BoolArray) -> tuple[tuple[SourceLabel, ...], tuple[int | None, ...]]:
    """What holds each image of an arc, and since when it was last held by its own points.

    Parameters
    ----------
    et
        (n,) seconds, ascending.
    used
        (n,) True where an image is anchored.

    Returns
    -------
    tuple
        Labels; ages in milliseconds, None before the first anchored image.
    """
    unfixed = SourceLabel.VISUAL_PROPAGATED if used.any() else SourceLabel.DEAD_RECKONED
    labels, ages, last = [], [], None
    for time, anchored in zip(et, used, strict=True):
        last = time if anchored else last
        labels.append(SourceLabel.SATELLITE_ANCHORED if anchored else unfixed)
        ages.append(None if last is None else round((time - last) * 1e3))
    return tuple(labels), tuple(ages)


class GrowingArc:
    """An arc that grows by one image at a time, on iSAM2: filtered now, smoothed as far as it goes.

    Parameters
    ----------
    options
        Uncertainties; ``segment`` plays no part.
    """

    def __init__(self, options: ArcOptions | None = None) -> None:
        self.options = options or ArcOptions()
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        self.isam = gtsam.ISAM2(parameters)
        self._images: list[ArcImage] = []

    def add(self, image: ArcImage) -> None:
        """Append an image, later than all before.

        Parameters
        ----------
        image
            The image.

        Raises
        ------
        MatchError
            If it is not later.
        """
        check_arc([*self._images[-1:], image])
        index, noise = len(self._images), self.options.noise()
        gate = float(np.sqrt(chi2.isf(self.options.outlier_chance, _FIX_ROWS)))
        huber = gtsam.noiseModel.mEstimator.Huber.Create(gate / 2.0)
        graph, values = image_factors(index, image, noise, huber), gtsam.Values()
        start = image.prior
        if index:
            graph.add(step_factor(index - 1, self._images[-1], image, noise))
            before = self.pose(index - 1).position_km - self._images[-1].prior.position_km
            start = Pose(start.camera_from_body, start.position_km + before)
        else:
            graph.push_back(first_factors(image, noise))
            values.insert(BIAS_KEY, np.zeros(3))
        values.insert(pose_key(index), SE3Utils.to_gtsam(start))
        self.isam.update(graph, values)
        self.isam.update()
        self._images.append(image)

    def key_of(self, image_id: str) -> int:
        """Key of an image's pose in the graph.

        Parameters
        ----------
        image_id
            An image of the arc.

        Returns
        -------
        int
            GTSAM key.

        Raises
        ------
        MatchError
            If the arc has no such image.
        """
        for index in range(len(self._images) - 1, -1, -1):
            if self._images[index].image_id == image_id:
                return pose_key(index)
        raise MatchError(f"{image_id} is no image of this arc")

    def pose(self, index: int) -> Pose:
        """Present pose of one image."""
        return SE3Utils.from_gtsam(self.isam.calculateEstimatePose3(pose_key(index)))

    def covariance(self, index: int) -> FloatArray:
        """(6, 6) covariance of its errors."""
        marginal = self.isam.marginalCovariance(pose_key(index))
        return SE3Utils.error_from_gtsam(marginal, self.pose(index).camera_from_body)

    def bias(self) -> FloatArray:
        """(3,) common bias, rad."""
        return np.asarray(self.isam.calculateEstimateVector(BIAS_KEY))

    def images(self) -> Iterator[ArcImage]:
        """Images so far."""
        return iter(self._images)
