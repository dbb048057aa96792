"""Points that several images of an arc see, as variables of its graph: their errors are common to those images."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from pipeline.pose.graph import point_key, pose_key, resection_factor
from pipeline.pose.normalise import to_plane
from pipeline.pose.records import CameraCalibration, MatchError, MatchResult, Pose, PoseEstimate
from pipeline.pose.refine import with_point_errors
from pipeline.records import BoolArray, FloatArray, Record

_IDEAL = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)
# Of a point's own sigma: places that images state further apart belong to different points.
_SAME_PLACE_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class PointSightings(Record):
    """Points that one image sees, wrong matches left out.

    Attributes
    ----------
    point_id
        (n,) the same number is the same point in all images of an arc.
    xy
        (n, 2) on the ideal plane.
    covariance
        (n, 2, 2) there.
    places_km
        (n, 3) body-fixed.
    place_covariance_km2
        (n, 3, 3).
    """

    point_id: NDArray[np.int64]
    xy: FloatArray
    covariance: FloatArray
    places_km: FloatArray
    place_covariance_km2: FloatArray

    def __post_init__(self) -> None:
        n = len(self.point_id)
        self._freeze(point_id=(n,), xy=(n, 2), covariance=(n, 2, 2), places_km=(n, 3), place_covariance_km2=(n, 3, 3))
        if len(np.unique(self.point_id)) < n:
            raise MatchError("an image that sees a point twice")


def sightings_of(
    matches: MatchResult, answer: PoseEstimate, calibration: CameraCalibration, assumed_sigma_px: float
) -> PointSightings | None:
    """What an image's pose rests on.

    Parameters
    ----------
    matches
        The image's matches.
    answer
        The pose that was found from them.
    calibration
        Its camera.
    assumed_sigma_px
        1 sigma per axis where the matches state none.

    Returns
    -------
    PointSightings or None
        None where the points are exact, so that nothing is to be learned of them.
    """
    spread, stated = matches.point_covariance_km2, matches.pixel_covariance_px2
    if spread is None:
        return None
    used = answer.inlier
    known = np.broadcast_to(np.eye(2) * assumed_sigma_px**2, (len(matches), 2, 2)) if stated is None else stated
    plane = to_plane(calibration.camera, matches.pixels_vu[used], answer.sigma_scale**2 * known[used])
    return PointSightings(matches.point_id[used], plane.xy, plane.covariance, matches.points_km[used], spread[used])


class SightingImage(Protocol):
    """What this module has to know of an image."""

    @property
    def sightings(self) -> PointSightings | None:
        """Its points."""


@dataclass(frozen=True, eq=False)
class ArcLandmarks(Record):
    """Points that are variables, each of them seen by two images at least.

    Attributes
    ----------
    point_id
        (m,) ascending; a point's key is its position here.
    places_km
        (m, 3) where they are believed to be.
    covariance_km2
        (m, 3, 3).
    first, last
        (m,) images between which they are seen.
    sightings
        (m,) images that see them.
    """

    point_id: NDArray[np.int64]
    places_km: FloatArray
    covariance_km2: FloatArray
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    sightings: NDArray[np.int64]

    def __post_init__(self) -> None:
        m = len(self.point_id)
        self._freeze(point_id=(m,), places_km=(m, 3), covariance_km2=(m, 3, 3), first=(m,), last=(m,), sightings=(m,))

    def crossing(self, boundary: int) -> NDArray[np.int64]:
        """Points that images on both sides of the start of an image see: what the two sides have in common."""
        return np.flatnonzero((self.first < boundary) & (self.last >= boundary))

    def seen_within(self, start: int, stop: int) -> NDArray[np.int64]:
        """Points whose images begin before stop and end at or after start."""
        return np.flatnonzero((self.first < stop) & (self.last >= start))

    def begun_within(self, start: int, stop: int) -> NDArray[np.int64]:
        """Points whose first image is in a segment, which is where their prior belongs."""
        return np.flatnonzero((self.first >= start) & (self.first < stop))

    def prior_factors(self, points: Iterable[int]) -> gtsam.NonlinearFactorGraph:
        """What is believed of the points before any image."""
        graph = gtsam.NonlinearFactorGraph()
        for k in points:
            noise = gtsam.noiseModel.Gaussian.Covariance(self.covariance_km2[k])
            graph.add(gtsam.PriorFactorPoint3(point_key(int(k)), self.places_km[k], noise))
        return graph

    def image_factors(self, index: int, seen: PointSightings, pose: Pose) -> gtsam.NonlinearFactorGraph:
        """Sightings of one image; points that are no variables count with their errors in the image.

        Parameters
        ----------
        index
            Position of the image in the arc.
        seen
            Its sightings.
        pose
            Near its pose, where the errors of the other points are projected.

        Returns
        -------
        gtsam.NonlinearFactorGraph
            A factor per variable point, and one for all others.
        """
        graph, key = gtsam.NonlinearFactorGraph(), pose_key(index)
        rank, solved = self._ranked(seen)
        for i in np.flatnonzero(solved):
            noise = gtsam.noiseModel.Gaussian.Covariance(seen.covariance[i])
            keys = key, point_key(int(rank[i]))
            graph.add(gtsam.GenericProjectionFactorCal3_S2(seen.xy[i], noise, *keys, _IDEAL))
        rest = ~solved
        if rest.any():
            places = seen.places_km[rest]
            full = with_point_errors(pose, places, seen.covariance[rest], seen.place_covariance_km2[rest])
            graph.add(resection_factor(key, places, seen.xy[rest], full))
        return graph

    def _ranked(self, seen: PointSightings) -> tuple[NDArray[np.int64], BoolArray]:
        """Positions of an image's points here, and which of them are here, at the place that the image states."""
        if not len(self.point_id):
            return np.zeros(len(seen.point_id), dtype=np.int64), np.zeros(len(seen.point_id), dtype=bool)
        rank = np.minimum(np.searchsorted(self.point_id, seen.point_id), len(self.point_id) - 1)
        sigma = np.sqrt(np.trace(self.covariance_km2[rank], axis1=1, axis2=2) / 3.0)
        away = np.linalg.norm(self.places_km[rank] - seen.places_km, axis=1)
        return rank, np.asarray((self.point_id[rank] == seen.point_id) & (away <= _SAME_PLACE_SIGMA * sigma))


def common_landmarks(images: Sequence[SightingImage], used: BoolArray, segment: int, most_common: int) -> ArcLandmarks:
    """Choose the points that become variables.

    Parameters
    ----------
    images
        Of the arc, in the order of time.
    used
        (n,) whether an image's own points hold it.
    segment
        Images solved at once.
    most_common
        Points that two neighbouring segments may have in common, which bounds memory; those with most sightings stay.

    Returns
    -------
    ArcLandmarks
        Points with two sightings or more.
    """
    seen = [(k, s) for k, image in enumerate(images) if used[k] and (s := image.sightings) is not None]
    if not seen:
        none = np.zeros(0, dtype=np.int64)
        return ArcLandmarks(none, np.zeros((0, 3)), np.zeros((0, 3, 3)), none, none, none)
    every = np.concatenate([s.point_id for _, s in seen])
    image = np.concatenate([np.full(len(s.point_id), k) for k, s in seen])
    point, start, rank, count = np.unique(every, return_index=True, return_inverse=True, return_counts=True)
    last = np.zeros(len(point), dtype=np.int64)
    np.maximum.at(last, rank, image)
    first = image[start]
    kept = np.sort(_bounded(np.flatnonzero(count >= 2), (first // segment, last // segment, count), most_common))
    places = np.concatenate([s.places_km for _, s in seen])[start]
    spread = np.concatenate([s.place_covariance_km2 for _, s in seen])[start]
    return ArcLandmarks(point[kept], places[kept], spread[kept], first[kept], last[kept], count[kept])


def _bounded(
    points: NDArray[np.int64], spans: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]], most: int
) -> NDArray[np.int64]:
    """Points, those with most sightings first, as long as no boundary that they cross is full."""
    begins, ends, count = spans
    load = np.zeros(int(ends.max(initial=0)) + 1, dtype=np.int64)
    kept = []
    for point in points[np.lexsort((points, -count[points]))]:
        # Boundary b lies before segment b.
        crossed = slice(int(begins[point]) + 1, int(ends[point]) + 1)
        if (load[crossed] < most).all():
            load[crossed] += 1
            kept.append(point)
    return np.array(kept, dtype=np.int64)
