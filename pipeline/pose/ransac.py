"""``RansacFilter``: which matches agree on one pose."""

from dataclasses import dataclass
from math import lgamma, log

import cv2
import numpy as np
from pydantic import Field

from pipeline.options import Options
from pipeline.pose.records import MatchError, PnpFailure, PnpFailureError, Pose
from pipeline.pose.refine import scene_scale, squared_distances
from pipeline.records import BoolArray, FloatArray, Record

# OpenCV draws one point beyond the three of its kernel, to choose among the kernel's four answers.
_KERNEL_POINTS = 4


class RansacOptions(Options):
    """Search for a consensus."""

    confidence: float = Field(0.999, gt=0, lt=1, description="that one sample is free of outliers")
    first_confidence: float = Field(0.9, gt=0, lt=1, description="the same for a first, quick attempt")
    iterations: int = Field(2000, ge=1, le=1_000_000, description="most samples drawn")
    gate_sigma: float = Field(4.3, gt=0, le=20, description="residual still an inlier, sigmas (1e-4 of a 2-D normal)")
    widen: float = Field(
        1.5, ge=1, le=10, description="gate of the search over that of the answer: a minimal sample is noisy"
    )
    min_inliers: int = Field(6, ge=4, le=1000, description="fewest matches of a pose")
    max_log10_chance: float = Field(
        -3.0, le=0, description="log10 of the expected number of equally large agreements among random matches"
    )


@dataclass(frozen=True, eq=False)
class Consensus(Record):
    """What agrees.

    Attributes
    ----------
    inlier
        (n,).
    pose
        Rough pose of the best sample.
    """

    inlier: BoolArray
    pose: Pose

    def __post_init__(self) -> None:
        self._freeze(inlier=(None,))


def log10_false_alarms(count: int, inliers: int, share: float) -> float:
    """Expected number of agreements as large among matches at random (Moisan and Stival 2004, eq. 3, in logarithms).

    Parameters
    ----------
    count
        Matches.
    inliers
        Those that agree.
    share
        Chance of a random match to fall inside the gate.

    Returns
    -------
    float
        log10 of the number of subsets times the chance of all but a sample's three to agree.
    """

    def choose(n: int, k: int) -> float:
        return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

    free = inliers - (_KERNEL_POINTS - 1)
    numbers = choose(count, inliers) + choose(inliers, _KERNEL_POINTS - 1) + log(max(count - 3, 1))
    return (numbers + free * log(min(max(share, 1e-300), 1.0))) / log(10.0)


class RansacFilter:
    """Consensus by minimal samples, and reprojection residuals (seed 002 section 6).

    Parameters
    ----------
    options
        Bounds of the search.
    """

    def __init__(self, options: RansacOptions | None = None) -> None:
        self.options = options or RansacOptions()

    def filter(
        self, points_km: FloatArray, xy: FloatArray, sigma: FloatArray, confidence: float | None = None
    ) -> Consensus:
        """Largest set of matches that one pose explains.

        Parameters
        ----------
        points_km
            (n, 3) body-fixed.
        xy
            (n, 2) on the ideal plane.
        sigma
            (n,) 1 sigma there.
        confidence
            That one sample is free of outliers; that of the options by default.

        Returns
        -------
        Consensus
            Matches inside the widened gate, and the pose of the sample.

        Raises
        ------
        PnpFailureError
            If no set of ``min_inliers`` agrees.
        """
        o = self.options
        if len(points_km) < o.min_inliers:
            raise PnpFailureError(PnpFailure.TOO_FEW, f"{len(points_km)} matches, {o.min_inliers} are needed")
        if not (np.isfinite(points_km).all() and np.isfinite(xy).all() and (sigma > 0).all()):
            raise MatchError("matches that are not finite or have no sigma")
        # OpenCV works in single precision: the scene is centred and of unit size. Its gate is one for all points, so
        # it is that of the widest; the exact gates follow.
        centre, scale = scene_scale(points_km)
        gate = o.gate_sigma * o.widen * float(np.sort(sigma)[int(0.9 * (len(sigma) - 1))])
        found, turn, shift, index = cv2.solvePnPRansac(
            (points_km - centre) / scale, xy, np.eye(3), None, iterationsCount=o.iterations, reprojectionError=gate,
            confidence=confidence or o.confidence, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        count = 0 if index is None else len(index)
        if not found or count < min(o.min_inliers, _KERNEL_POINTS + 1) or not np.isfinite(shift).all():
            raise PnpFailureError(PnpFailure.NO_CONSENSUS, f"{count} of {len(xy)} matches agree on a pose")
        matrix = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        inlier = np.zeros(len(xy), dtype=bool)
        inlier[np.ravel(index)] = True
        return Consensus(inlier, Pose(matrix, centre - scale * matrix.T @ shift[:, 0]))

    def gate(self, pose: Pose, points_km: FloatArray, xy: FloatArray, covariance: FloatArray) -> BoolArray:
        """Matches within the gate of a pose.

        Parameters
        ----------
        pose
            The pose.
        points_km
            (n, 3) body-fixed.
        xy
            (n, 2) on the ideal plane.
        covariance
            (n, 2, 2) of the residuals.

        Returns
        -------
        numpy.ndarray
            (n,) True inside the gate and before the camera.
        """
        return np.asarray(squared_distances(pose, points_km, xy, covariance) <= self.options.gate_sigma**2)
