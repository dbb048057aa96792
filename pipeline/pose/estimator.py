"""``PoseEstimator`` and its one implementation: OpenCV finds, GTSAM refines and says how well (seed 002)."""

import json
import logging
import warnings
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydantic import Field

from pipeline.camera import project
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.geometry.wgs84 import WgsConverter
from pipeline.options import Options
from pipeline.pose.graph import SharedGraph, posterior, shared_posterior
from pipeline.pose.normalise import PlanePoints, to_plane
from pipeline.pose.pnp import refuse_degenerate, starting_poses
from pipeline.pose.ransac import Consensus, RansacFilter, RansacOptions, log10_false_alarms
from pipeline.pose.records import (
    CameraCalibration,
    CovarianceDegradedWarning,
    CovarianceMode,
    LatLonAlt,
    MatchResult,
    PnpFailure,
    PnpFailureError,
    Pose,
    PoseEstimate,
    SourceLabel,
    ThermalState,
    frame_id_of,
)
from pipeline.pose.refine import Fit, covariance_of, refine, squared_distances, with_point_errors
from pipeline.pose.se3 import SE3Utils
from pipeline.records import BoolArray, FloatArray

_LOG = logging.getLogger("pilotage.pose")
# Sets of inliers that follow from each other settle in two or three rounds, or swing between two.
_MAX_ROUNDS = 8
# Below this many sigmas, two minima are one answer.
_SAME_ANSWER_SIGMA = 3.0
# A second answer as good as the first has about as many inliers; one with fewer than this share of them is none.
_RIVAL_SHARE = 0.5


class PoseOptions(Options):
    """What counts as an answer."""

    ransac: RansacOptions = Field(RansacOptions(), description="search for a consensus")
    assumed_sigma_px: float = Field(1.0, gt=0, le=100, description="1 sigma per axis where matches state none, pixels")
    ambiguity_chi2: float = Field(20.0, ge=0, description="a second answer worse by less than this is as good")
    max_curvature: float = Field(
        0.5, gt=0, description="misfit of the quadratic approximation at two sigmas, of the chi2 there"
    )
    max_condition: float = Field(1e14, gt=1, description="condition of the scaled information, beyond it degenerate")


class PoseEstimator(Protocol):
    """Matches to poses."""

    def estimate(
        self, match_result: MatchResult, camera_calibration: CameraCalibration, thermal_state: ThermalState
    ) -> PoseEstimate:
        """Pose of one image; PnpFailureError where none can be vouched for."""

    def current_covariance_mode(self) -> CovarianceMode:
        """Mode of the latest frame."""


@dataclass(frozen=True)
class _Matches:
    """One image's matches on the ideal plane."""

    result: MatchResult
    plane: PlanePoints
    stated: bool

    def take(self, which: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
        spread = self.result.point_covariance_km2
        return (
            self.result.points_km[which], self.plane.xy[which], self.plane.covariance[which],
            None if spread is None else spread[which],
        )  # fmt: skip


@dataclass(frozen=True)
class _Solution:
    """Refined pose with the matches that it holds."""

    method: str
    fit: Fit
    inlier: BoolArray
    scale: float


class OpenCVGtsamPoseEstimator:
    """Consensus and start by OpenCV, refinement and posterior by GTSAM.

    Parameters
    ----------
    options
        Bounds.
    shared
        Growing graph of the arc; matches go into it, and poses come out of it, except on throttled frames. Without one
        every image is a graph of its own.
    """

    def __init__(self, options: PoseOptions | None = None, shared: SharedGraph | None = None) -> None:
        self.options = options or PoseOptions()
        self._shared = shared
        self._ransac = RansacFilter(self.options.ransac)
        self._mode = CovarianceMode.MARGINALS
        text = f"C4 ready: estimator=opencv_gtsam, default_covariance={self._mode.name}"
        _log(logging.INFO, text, estimator="opencv_gtsam", default_covariance=self._mode.name)

    def current_covariance_mode(self) -> CovarianceMode:
        """Mode of the latest frame.

        Returns
        -------
        CovarianceMode
            ``MARGINALS`` unless that frame was throttled.
        """
        return self._mode

    def estimate(
        self, match_result: MatchResult, camera_calibration: CameraCalibration, thermal_state: ThermalState
    ) -> PoseEstimate:
        """Pose of one image.

        Parameters
        ----------
        match_result
            Its matches.
        camera_calibration
            Camera, mounting and datum.
        thermal_state
            Compute budget at this frame.

        Returns
        -------
        PoseEstimate
            Pose, covariance, and what they rest on.

        Raises
        ------
        PnpFailureError
            If no pose can be vouched for.

        Warns
        -----
        CovarianceDegradedWarning
            If the covariance comes from the Jacobian.
        """
        throttled = thermal_state.thermal_throttle
        self._mode = CovarianceMode.JACOBIAN if throttled else CovarianceMode.MARGINALS
        if throttled:
            clock = thermal_state.clock_mhz
            text = f"C4 covariance degraded to JACOBIAN on frame={match_result.image_id}; thermal_throttle=true"
            text += "" if clock is None else f"; clock_mhz={clock:g}"
            _log(logging.WARNING, text, frame=match_result.image_id, thermal_throttle=True, clock_mhz=clock)
            warnings.warn(text, CovarianceDegradedWarning, stacklevel=2)
        try:
            matches = self._on_plane(match_result, camera_calibration)
            best = self._solve(matches)
        except PnpFailureError as error:
            _log(
                logging.ERROR,
                f"C4 PnP failure on frame={match_result.image_id}; mode={self._mode.value}; falling back to "
                "visual_propagated",
                frame=match_result.image_id, mode=self._mode.value, reason=error.reason.value, detail=error.detail,
            )  # fmt: skip
            raise
        return self._report(matches, best, camera_calibration)

    def _on_plane(self, result: MatchResult, calibration: CameraCalibration) -> _Matches:
        stated = result.pixel_covariance_px2
        assumed = np.broadcast_to(np.eye(2) * self.options.assumed_sigma_px**2, (len(result), 2, 2))
        plane = to_plane(calibration.camera, result.pixels_vu, assumed if stated is None else stated)
        return _Matches(result, plane, stated is not None)

    def _solve(self, matches: _Matches) -> _Solution:
        usable = matches.plane.ok
        points, xy, covariance, _ = matches.take(usable)
        sigma = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2.0)
        middle = float(np.median(sigma)) if len(sigma) else 0.0
        if len(points) >= self.options.ransac.min_inliers:
            refuse_degenerate(points, xy, middle)
        # Most scenes need few samples, since what they miss is found by refining; the rest are searched thoroughly.
        for confidence in (self.options.ransac.first_confidence, self.options.ransac.confidence):
            try:
                return self._attempt(matches, self._ransac.filter(points, xy, sigma, confidence), middle)
            except PnpFailureError as failure:
                last = failure
        raise last

    def _attempt(self, matches: _Matches, consensus: Consensus, sigma: float) -> _Solution:
        """Solution from one consensus, or the reason why it is none."""
        usable = matches.plane.ok
        first = np.flatnonzero(usable)[consensus.inlier]
        start = np.zeros(len(usable), dtype=bool)
        start[first] = True
        points, xy, _, _ = matches.take(start)
        shape = refuse_degenerate(points, xy, sigma)
        found = self._settle_all(matches, start, starting_poses(points, xy, shape))
        found = found or self._settle_all(matches, start, [("ransac", consensus.pose)])
        if not found:
            raise PnpFailureError(PnpFailure.NO_CONSENSUS, "no start leads to a pose that enough matches agree on")
        best = self._choose(matches, found)
        self._doubt(matches, best)
        return best

    def _settle_all(self, matches: _Matches, start: BoolArray, candidates: list[tuple[str, Pose]]) -> list[_Solution]:
        found: list[_Solution] = []
        for name, pose in candidates:
            least = _RIVAL_SHARE * max((int(s.inlier.sum()) for s in found), default=0)
            solution = self._settle(matches, start, (name, pose), least)
            if solution is not None:
                found.append(solution)
        return found

    def _settle(
        self, matches: _Matches, start: BoolArray, candidate: tuple[str, Pose], least: float
    ) -> _Solution | None:
        """Refine and choose inliers again until they stay; None where they run out, or are too few for a rival."""
        method, pose = candidate
        inlier, scale = start, 1.0
        every = matches.take(np.ones(len(start), dtype=bool))
        seen: set[bytes] = set()
        fit: Fit | None = None
        for _ in range(_MAX_ROUNDS):
            if inlier.sum() < self.options.ransac.min_inliers:
                return None
            points, xy, covariance, spread = matches.take(inlier)
            fit = refine(pose, points, xy, with_point_errors(pose, points, scale**2 * covariance, spread))
            if not np.isfinite(fit.chi2):
                return None
            # The points' errors are projected at the pose before; a few sigmas further they are the same.
            near = spread is None or _moved2(fit, pose) < _SAME_ANSWER_SIGMA**2
            pose = fit.pose
            if not matches.stated:
                scale *= self._scatter(fit, int(inlier.sum()))
            full = with_point_errors(pose, every[0], scale**2 * every[2], every[3])
            following = self._ransac.gate(pose, every[0], every[1], full) & matches.plane.ok
            if following.tobytes() == inlier.tobytes() and matches.stated and near:
                return _Solution(method, fit, inlier, scale)
            if following.tobytes() == inlier.tobytes() or inlier.tobytes() in seen:
                break
            if seen and following.sum() < least:
                return None
            seen.add(inlier.tobytes())
            inlier = following
        return None if fit is None else self._final(matches, method, fit, inlier, scale)

    def _final(self, matches: _Matches, method: str, fit: Fit, inlier: BoolArray, scale: float) -> _Solution | None:
        if inlier.sum() < self.options.ransac.min_inliers:
            return None
        points, xy, covariance, spread = matches.take(inlier)
        full = with_point_errors(fit.pose, points, scale**2 * covariance, spread)
        return _Solution(method, refine(fit.pose, points, xy, full), inlier, scale)

    @staticmethod
    def _scatter(fit: Fit, count: int) -> float:
        """Factor on the assumed sigma that makes chi2 per degree of freedom one."""
        return float(np.sqrt(max(fit.chi2, 1e-12) / max(2 * count - 6, 1)))

    def _choose(self, matches: _Matches, found: list[_Solution]) -> _Solution:
        """Best of the minima; refused where another, different one is about as good."""
        best = min(found, key=lambda s: (-int(s.inlier.sum()), s.fit.chi2))
        # Starts that meet differ by rounding only: the first of them gives the name.
        best = next(s for s in found if s.inlier.sum() == best.inlier.sum() and _same(best.fit, s.fit))
        gate2 = self.options.ransac.gate_sigma**2
        for other in found:
            lost = int(best.inlier.sum() - other.inlier.sum())
            worse = other.fit.chi2 * (other.scale / best.scale) ** 2 - best.fit.chi2 + lost * gate2
            if worse < self.options.ambiguity_chi2 and not _same(best.fit, other.fit):
                best = self._ask_prior(matches, best, other, worse)
        return best

    def _ask_prior(self, matches: _Matches, best: _Solution, other: _Solution, worse: float) -> _Solution:
        prior = matches.result.prior
        if prior is not None:
            away = [SE3Utils.error(prior.pose, s.fit.pose) for s in (best, other)]
            cost = [float(a @ np.linalg.solve(prior.covariance, a)) for a in away]
            gain = cost[0] - cost[1] - worse
            if abs(gain) >= self.options.ambiguity_chi2:
                return other if gain > 0 else best
        raise PnpFailureError(
            PnpFailure.AMBIGUOUS, f"a second pose fits as well: chi2 {best.fit.chi2:.1f} and {worse:.1f} more"
        )

    def _doubt(self, matches: _Matches, best: _Solution) -> None:
        """Refuse agreements that chance makes, and information that no covariance describes."""
        count, usable = int(best.inlier.sum()), int(matches.plane.ok.sum())
        points, xy, covariance, spread = matches.take(best.inlier)
        full = with_point_errors(best.fit.pose, points, best.scale**2 * covariance, spread)
        sizes = np.sqrt(full[:, 0, 0] * full[:, 1, 1] - full[:, 0, 1] * full[:, 1, 0])
        area = np.pi * self.options.ransac.gate_sigma**2 * float(np.median(sizes))
        seen = matches.plane.xy[matches.plane.ok]
        share = area / float(np.prod(np.maximum(np.ptp(seen, axis=0), np.sqrt(area))))
        chance = log10_false_alarms(usable, count, share)
        if chance > self.options.ransac.max_log10_chance:
            raise PnpFailureError(
                PnpFailure.NO_CONSENSUS, f"{count} of {usable} agree, as would 10^{chance:.1f} sets of random matches"
            )
        unit = 1.0 / np.sqrt(np.diag(best.fit.information))
        condition = float(np.linalg.cond(best.fit.information * np.outer(unit, unit)))
        if not condition < self.options.max_condition:
            raise PnpFailureError(PnpFailure.DEGENERATE, f"condition of the information {condition:.1e}")
        misfit = curvature(best.fit, points, xy, full)
        if misfit > self.options.max_curvature:
            raise PnpFailureError(
                PnpFailure.ILL_CONDITIONED,
                f"chi2 is off its quadratic form by {misfit:.0%} at two sigmas: no covariance describes this pose",
            )

    def _report(self, matches: _Matches, best: _Solution, calibration: CameraCalibration) -> PoseEstimate:
        points, xy, covariance, spread = matches.take(best.inlier)
        if self._mode is CovarianceMode.MARGINALS and self._shared is not None:
            full = with_point_errors(best.fit.pose, points, best.scale**2 * covariance, spread)
            pose, errors = shared_posterior(self._shared, matches.result.image_id, points, xy, full)
        elif self._mode is CovarianceMode.MARGINALS:
            pose, errors = posterior(best.fit.pose, points, xy, best.scale**2 * covariance, spread)
        else:
            pose, errors = best.fit.pose, covariance_of(best.fit.information)
        pixels, _ = project(calibration.camera, pose.to_camera(points))
        rms = np.sqrt(((matches.result.pixels_vu[best.inlier] - pixels) ** 2).mean(axis=0))
        count, residual, name = int(best.inlier.sum()), round(float(np.hypot(*rms)), 3), matches.result.image_id
        _log(
            logging.DEBUG, f"C4 frame={name} inliers={count} residual={residual}px mode={self._mode.name}",
            frame=name, inliers=count, residual_px=residual, mode=self._mode.name, method=best.method,
        )  # fmt: skip
        return PoseEstimate(
            frame_id_of(matches.result.image_id), matches.result.image_id, pose, place_of(pose, calibration),
            vehicle_orientation(pose, calibration), errors, self._mode, SourceLabel.SATELLITE_ANCHORED, 0,
            best.method, best.inlier, rms, best.fit.chi2, best.scale,
        )  # fmt: skip


def curvature(fit: Fit, points_km: FloatArray, xy: FloatArray, covariance: FloatArray) -> float:
    """How far chi2 is from its quadratic form, two sigmas along the least known direction.

    Parameters
    ----------
    fit
        A minimum.
    points_km, xy, covariance
        What it was fitted to.

    Returns
    -------
    float
        Largest relative difference to the expected rise of four, over both signs.
    """
    unit = 1.0 / np.sqrt(np.diag(fit.information))
    values, vectors = np.linalg.eigh(fit.information * np.outer(unit, unit))
    step = 2.0 / np.sqrt(values[0]) * vectors[:, 0] * unit
    worst = 0.0
    for sign in (-1.0, 1.0):
        chi2 = float(squared_distances(SE3Utils.corrected(fit.pose, sign * step), points_km, xy, covariance).sum())
        worst = max(worst, abs(chi2 - fit.chi2 - 4.0) / 4.0)
    return worst


def _same(one: Fit, other: Fit) -> bool:
    """Whether two minima are one answer."""
    return _moved2(one, other.pose) < _SAME_ANSWER_SIGMA**2


def _moved2(fit: Fit, pose: Pose) -> float:
    """Squared sigmas of a minimum by which another pose is away."""
    away = SE3Utils.error(fit.pose, pose)
    return float(away @ SE3Utils.error_from_correction(fit.information) @ away)


def place_of(pose: Pose, calibration: CameraCalibration) -> LatLonAlt:
    """Planetodetic place of the vehicle that carries a camera.

    Parameters
    ----------
    pose
        The camera's.
    calibration
        Mounting, datum and geoid.

    Returns
    -------
    LatLonAlt
        With height above mean sea level where a geoid is known.
    """
    arm_km = pose.camera_from_body.T @ calibration.camera_from_vehicle @ calibration.camera_in_vehicle_m * 1e-3
    lat, lon, height = map(float, WgsConverter(calibration.datum).geodetic((pose.position_km - arm_km)[None])[0])
    sea = None if calibration.geoid is None else calibration.geoid.height_at(lat, lon)
    return LatLonAlt(lat, lon, None if sea is None else height - sea, height, calibration.datum.name)


def vehicle_orientation(pose: Pose, calibration: CameraCalibration) -> FloatArray:
    """Quaternion that turns vehicle axes onto body-fixed ones, through the mounting of the camera.

    Parameters
    ----------
    pose
        The camera's.
    calibration
        The mounting.

    Returns
    -------
    numpy.ndarray
        (4,) w, x, y, z.
    """
    return quaternion_from_matrix(pose.camera_from_body.T @ calibration.camera_from_vehicle)


def _log(level: int, text: str, **fields: str | int | float | bool | None) -> None:
    """One JSON object per line; no clock, so that logs of equal runs compare equal."""
    if _LOG.isEnabledFor(level):
        _LOG.log(level, json.dumps({"component": "c4_pose", "message": text, **fields}))
