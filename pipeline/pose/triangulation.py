"""Where straight lines of sight meet: a camera from many points, a point from many cameras (seed 004).

Every line of sight says ``x cross C (p - r) = 0`` with x = K^-1 u on the ideal plane. ``linear`` solves that as it
stands (Henry and Christian 2023, eq. 20); ``lost`` weights it by the covariance that the pixels' errors give it, which
is optimal to first order (their eq. 30 ff.); ``midpoint`` makes every line count by its distance.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.options import Options
from pipeline.pose.normalise import to_plane
from pipeline.pose.records import MatchError
from pipeline.pose.se3 import SE3Utils
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

# Least over largest eigenvalue of the normal matrix of unit rays: below it, lines are parallel to three microradians.
_PARALLEL = 1e-11
_LOST_ROUNDS = 2
# Wrong lines looked for in one place: tracks are rarely longer than a few dozen views, and mostly right.
_MOST_OUTLIERS = 10
# Squared residual of a line whose place was refused.
_REFUSED = 1e12


class TriangulationMethod(StrEnum):
    """Weights of the lines of sight."""

    LINEAR = "linear"
    LOST = "lost"
    MIDPOINT = "midpoint"


class TriangulationOptions(Options):
    """Settings of :class:`CameraTriangulation`."""

    uncertaintyImageMeasurement: float = Field(
        0.0, ge=0, description="1 sigma of a key point per axis, pixels; 0 means unknown: no covariance is made"
    )
    method: TriangulationMethod = Field(TriangulationMethod.LINEAR, description="weights of the lines of sight")


@dataclass(frozen=True, eq=False)
class CameraLocation(Record):
    """A camera's position.

    Attributes
    ----------
    position_km
        (3,) in the frame of the points.
    covariance_km2
        (3, 3); None where the sigma of the pixels is unknown.
    """

    position_km: FloatArray
    covariance_km2: FloatArray | None

    def __post_init__(self) -> None:
        self._freeze(position_km=(3,), covariance_km2=(3, 3))


class CameraTriangulation:
    """Position of a camera of known attitude from points of known place (seed 004).

    Parameters
    ----------
    options
        Method and uncertainty.
    """

    def __init__(self, options: TriangulationOptions | None = None) -> None:
        self.options = options or TriangulationOptions()

    def estimate(
        self, points_km: FloatArray, pixels_vu: FloatArray, camera: CameraModel, camera_from_body: FloatArray
    ) -> CameraLocation:
        """Where the lines of sight from the points meet.

        Parameters
        ----------
        points_km
            (n, 3) point cloud.
        pixels_vu
            (n, 2) key points, in the same order.
        camera
            Model, with distortion.
        camera_from_body
            (3, 3) attitude, taken as exact.

        Returns
        -------
        CameraLocation
            Position, and its covariance where the uncertainty is known.

        Raises
        ------
        MatchError
            If lengths differ, a value is not finite, fewer than two points are given, the lines do not meet, or the
            points come out behind the camera.
        """
        points, pixels = np.asarray(points_km, float), np.asarray(pixels_vu, float)
        _check(points, pixels)
        sigma = self.options.uncertaintyImageMeasurement
        pixel_covariance = np.tile(np.eye(2) * (sigma or 1.0) ** 2, (len(points), 1, 1))
        plane = to_plane(camera, pixels, pixel_covariance)
        if not plane.ok.all():
            raise MatchError(f"{int((~plane.ok).sum())} key points lie where the camera model has no inverse")
        turns = np.broadcast_to(camera_from_body, (len(points), 3, 3))
        one: NDArray[np.int64] = np.zeros(len(points), dtype=np.int64)
        # Seen from the camera's position the points are where the cameras are seen from a point: r and p change places.
        lines = LinesOfSight(one, plane.xy, plane.covariance, turns, points)
        found = intersect_lines(lines, 1, self.options.method, sign=-1.0)
        if not found.ok[0]:
            raise MatchError(_REFUSALS[int(found.refusal[0])])
        return CameraLocation(found.places_km[0], found.covariance_km2[0] if sigma else None)


_REFUSALS = ("", "fewer than two lines of sight", "the lines of sight are parallel", "points behind the camera")


def _check(points: FloatArray, pixels: FloatArray) -> None:
    if points.ndim != 2 or points.shape[1:] != (3,) or pixels.ndim != 2 or pixels.shape[1:] != (2,):
        raise MatchError(f"points of shape {points.shape} and key points of shape {pixels.shape}")
    if len(points) != len(pixels):
        raise MatchError(f"{len(points)} points but {len(pixels)} key points")
    if not (np.isfinite(points).all() and np.isfinite(pixels).all()):
        raise MatchError("a point or a key point is not finite")
    if len(points) < 2:
        raise MatchError("two points at least are needed")


@dataclass(frozen=True, eq=False)
class LinesOfSight(Record):
    """Lines of sight, each belonging to one unknown place.

    Attributes
    ----------
    index
        (n,) of the place.
    xy
        (n, 2) on the ideal plane of its camera.
    covariance
        (n, 2, 2) there.
    camera_from_body
        (n, 3, 3).
    known_km
        (n, 3) the known end: the camera, or the point.
    """

    index: NDArray[np.int64]
    xy: FloatArray
    covariance: FloatArray
    camera_from_body: FloatArray
    known_km: FloatArray

    def __post_init__(self) -> None:
        n = len(self.index)
        self._freeze(index=(n,), xy=(n, 2), covariance=(n, 2, 2), camera_from_body=(n, 3, 3), known_km=(n, 3))

    def take(self, rows: NDArray[np.generic]) -> "LinesOfSight":
        """Lines of an index or mask."""
        return LinesOfSight(
            self.index[rows], self.xy[rows], self.covariance[rows], self.camera_from_body[rows], self.known_km[rows]
        )


@dataclass(frozen=True, eq=False)
class Intersections(Record):
    """Places where lines meet.

    Attributes
    ----------
    places_km
        (m, 3), NaN where refused.
    covariance_km2
        (m, 3, 3), NaN where refused.
    refusal
        (m,) 0 good, 1 fewer than two lines, 2 parallel lines, 3 behind a camera.
    """

    places_km: FloatArray
    covariance_km2: FloatArray
    refusal: NDArray[np.int64]

    def __post_init__(self) -> None:
        m = len(self.refusal)
        self._freeze(places_km=(m, 3), covariance_km2=(m, 3, 3), refusal=(m,))

    @property
    def ok(self) -> BoolArray:
        """(m,) True where lines meet."""
        return np.asarray(self.refusal == 0)


def _sums(index: NDArray[np.int64], values: FloatArray, count: int) -> FloatArray:
    """Sums of (n, ...) values by index."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    total = np.stack([np.bincount(index, flat[:, k], minlength=count) for k in range(flat.shape[1])], axis=1)
    return np.asarray(total.reshape(count, *values.shape[1:]))


def intersect_lines(
    lines: LinesOfSight, count: int, method: TriangulationMethod = TriangulationMethod.LOST, sign: float = 1.0
) -> Intersections:
    """Places where lines of sight meet.

    Parameters
    ----------
    lines
        All lines of all places.
    count
        Places.
    method
        Weights.
    sign
        +1 where the unknown is seen, -1 where the unknown sees.

    Returns
    -------
    Intersections
        Places with the covariance that the pixels' errors give them, ranges taken from the solution (their A5).
    """
    ray = np.concatenate([lines.xy, np.ones((len(lines.xy), 1))], axis=1)
    length = np.linalg.norm(ray, axis=1)
    cross = SE3Utils.skew(ray)
    rows = cross @ lines.camera_from_body
    unit = rows / length[:, None, None]
    refusal = _refuse(lines.index, unit, count)
    if method is TriangulationMethod.MIDPOINT:
        rows = unit
    full = np.zeros((len(ray), 3, 3))
    full[:, :2, :2] = lines.covariance
    places = _solve(lines, rows, rows, refusal)
    depth = _depth(lines, places, sign)
    if method is TriangulationMethod.LOST:
        # The first two rows of the cross product hold all three, and have a covariance that can be inverted.
        two = rows[:, :2]
        for _ in range(_LOST_ROUNDS):
            noise = cross[:, :2] @ full @ cross[:, :2].transpose(0, 2, 1)
            # A refused place may lie in the plane of a camera; it has to have some weight only.
            squared = np.where((refusal[lines.index] == 0) & (depth != 0), depth, 1.0) ** 2
            weighted = _inverse_2x2(noise * squared[:, None, None]) @ two
            places = _solve(lines, two, weighted, refusal)
            depth = _depth(lines, places, sign)
        covariance = _inverse(_sums(lines.index, two.transpose(0, 2, 1) @ weighted, count), refusal)
    else:
        scale = depth / (length if method is TriangulationMethod.MIDPOINT else 1.0)
        noise = cross @ full @ cross.transpose(0, 2, 1) * (scale**2)[:, None, None]
        inverse = _inverse(_sums(lines.index, rows.transpose(0, 2, 1) @ rows, count), refusal)
        covariance = inverse @ _sums(lines.index, rows.transpose(0, 2, 1) @ noise @ rows, count) @ inverse
    behind = _sums(lines.index, (_depth(lines, places, sign) <= 0).astype(float), count) > 0
    refusal = np.where((refusal == 0) & behind, 3, refusal)
    places[refusal > 0], covariance[refusal > 0] = np.nan, np.nan
    return Intersections(places, covariance, refusal)


def intersect_agreeing(lines: LinesOfSight, count: int, gate_sigma: float = 4.3) -> Intersections:
    """Places where lines of sight meet, weighted best, wrong lines left out so that they bend none.

    While a place has a line off by more than the gate, it is solved without each of its lines in turn, and the line
    without which the others agree best is left out if their chi2 falls by more than the gate's square. Of two lines
    nobody knows which is wrong: both stay.

    Parameters
    ----------
    lines
        All lines of all places.
    count
        Places.
    gate_sigma
        Residual of a line that is still good, sigmas.

    Returns
    -------
    Intersections
        As of :func:`intersect_lines`.
    """
    found = intersect_lines(lines, count)
    keep = _agreeing(lines, _squared_residuals(lines, found), count, gate_sigma)
    bent = np.unique(lines.index[~keep])
    if not len(bent):
        return found
    rows = np.flatnonzero(keep & np.isin(lines.index, bent))
    mended = intersect_lines(replace(lines.take(rows), index=np.searchsorted(bent, lines.index[rows])), len(bent))
    places, covariance = found.places_km.copy(), found.covariance_km2.copy()
    refusal = found.refusal.copy()
    places[bent], covariance[bent], refusal[bent] = mended.places_km, mended.covariance_km2, mended.refusal
    return Intersections(places, covariance, refusal)


def _agreeing(lines: LinesOfSight, squared: FloatArray, count: int, gate_sigma: float) -> BoolArray:
    """(n,) True for lines that stay, with what all lines leave at first."""
    keep = np.ones(len(lines.index), dtype=bool)
    suspect = np.ones(count, dtype=bool)
    for number in range(_MOST_OUTLIERS):
        mine = np.flatnonzero(keep & suspect[lines.index])
        place = lines.index[mine]
        squared = _residuals_of(lines.take(mine), place) if number else squared
        worst, total = np.zeros(count), np.bincount(place, squared, minlength=count)
        np.maximum.at(worst, place, squared)
        suspect &= (worst > gate_sigma**2) & (np.bincount(place, minlength=count) > 2)
        if not suspect.any():
            break
        left_out, rest = _without_each(lines, np.flatnonzero(keep & suspect[lines.index]))
        best = np.lexsort((left_out, rest, lines.index[left_out]))
        first = best[np.unique(lines.index[left_out[best]], return_index=True)[1]]
        better = total[lines.index[left_out[first]]] - rest[first] > gate_sigma**2
        keep[left_out[first[better]]] = False
        suspect[:] = False
        suspect[lines.index[left_out[first[better]]]] = True
    return keep


def _without_each(lines: LinesOfSight, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], FloatArray]:
    """Lines, and the chi2 of the others of the same place without each."""
    order = rows[np.argsort(lines.index[rows], kind="stable")]
    _, start, number = np.unique(lines.index[order], return_index=True, return_counts=True)
    trial, line = [], []
    base = 0
    for first, size in zip(start, number, strict=True):
        one, other = np.nonzero(~np.eye(size, dtype=bool))
        trial.append(base + one)
        line.append(order[first + other])
        base += size
    trials, members = np.concatenate(trial), np.concatenate(line)
    rest: FloatArray = np.bincount(trials, _residuals_of(lines.take(members), trials), minlength=base).astype(float)
    return order, rest


def _residuals_of(lines: LinesOfSight, place: NDArray[np.int64]) -> FloatArray:
    """(n,) squared residuals of lines from where those of the same place meet, in time that few places need."""
    distinct, rank = np.unique(place, return_inverse=True)
    alone = replace(lines, index=rank.astype(np.int64))
    return _squared_residuals(alone, intersect_lines(alone, len(distinct)))


def _squared_residuals(lines: LinesOfSight, found: Intersections) -> FloatArray:
    """(n,) squared distance of each line from its place over the measurement's covariance; infinite if refused."""
    away = found.places_km[lines.index] - lines.known_km
    camera = (lines.camera_from_body @ np.nan_to_num(away)[:, :, None])[:, :, 0]
    ahead = found.ok[lines.index] & (camera[:, 2] > 0)
    residual = lines.xy - camera[:, :2] / np.where(ahead, camera[:, 2], 1.0)[:, None]
    whole = np.einsum("ni,nij,nj->n", residual, _inverse_2x2(lines.covariance), residual)
    # Large and finite, so that differences stay numbers.
    return np.where(ahead, whole, _REFUSED)


def _refuse(index: NDArray[np.int64], unit: FloatArray, count: int) -> NDArray[np.int64]:
    lines = np.bincount(index, minlength=count)
    values = np.linalg.eigvalsh(_sums(index, unit.transpose(0, 2, 1) @ unit, count))
    parallel = ~(values[:, 0] > _PARALLEL * values[:, 2])
    return np.asarray(np.where(lines < 2, 1, np.where(parallel, 2, 0)))


def _inverse(normal: FloatArray, refusal: NDArray[np.int64]) -> FloatArray:
    """Inverses of (m, 3, 3) by cofactors, which for so small a matrix take a third of a decomposition's time."""
    safe = np.where((refusal > 0)[:, None, None], np.eye(3), normal)
    a, b, c = (safe[:, k] for k in range(3))
    adjugate = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    return np.asarray(adjugate / (a * adjugate[:, :, 0]).sum(axis=1)[:, None, None])


def _inverse_2x2(matrix: FloatArray) -> FloatArray:
    (a, b), (c, d) = np.moveaxis(matrix, 0, 2)
    return np.asarray(np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), 2, 0))


def _solve(lines: LinesOfSight, rows: FloatArray, weighted: FloatArray, refusal: NDArray[np.int64]) -> FloatArray:
    count = len(refusal)
    # Relative to the mean known end, so that places far from the origin lose no digits.
    number = np.maximum(np.bincount(lines.index, minlength=count), 1)[:, None]
    origin = _sums(lines.index, lines.known_km, count) / number
    known = lines.known_km - origin[lines.index]
    normal = _sums(lines.index, weighted.transpose(0, 2, 1) @ rows, count)
    right = _sums(lines.index, (weighted.transpose(0, 2, 1) @ (rows @ known[:, :, None]))[:, :, 0], count)
    return np.asarray(origin + (_inverse(normal, refusal) @ right[:, :, None])[:, :, 0])


def _depth(lines: LinesOfSight, places: FloatArray, sign: float) -> FloatArray:
    """(n,) distance along the optical axis."""
    away = sign * (places[lines.index] - lines.known_km)
    return np.asarray((lines.camera_from_body[:, 2] * away).sum(axis=1))
