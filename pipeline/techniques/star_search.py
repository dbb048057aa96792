"""Search of the whole volume of offsets and rotations by votes of all star-detection pairs."""

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.records import FloatArray
from pipeline.techniques.star_match import CELL_PX, MatchProblem, StarMatchOptions

# A pattern with so many fewer votes (natural log of odds), or so small a share of them, is no rival of the best.
_HOPELESS_VOTES = 25.0
_RIVAL_SHARE = 0.4


@numba.njit(cache=True, nogil=True)
def _cast_votes(predicted, centre, angles, measured, weight, margin_v, margin_u, cell, votes):  # type: ignore[no-untyped-def]
    for k in range(len(angles)):
        c, s = np.cos(angles[k]), np.sin(angles[k])
        for i in range(len(predicted)):
            dv, du = predicted[i, 0] - centre[0], predicted[i, 1] - centre[1]
            v = centre[0] + c * dv + s * du
            u = centre[1] - s * dv + c * du
            for j in range(len(measured)):
                off_v, off_u = measured[j, 0] - v, measured[j, 1] - u
                if weight[i, j] > 0 and abs(off_v) <= margin_v and abs(off_u) <= margin_u:
                    votes[k, int((off_v + margin_v) / cell), int((off_u + margin_u) / cell)] += weight[i, j]


def search(problem: MatchProblem, ratio: FloatArray, options: StarMatchOptions) -> list[tuple[FloatArray, float]]:
    """Most promising offsets and rotations, by votes of all star-detection pairs over the whole search volume.

    Parameters
    ----------
    problem
        Stars and detections.
    ratio
        (n, m) of :func:`magnitude_log_ratio`.
    options
        How many.

    Returns
    -------
    list
        (offset at the array centre, rotation), best first.
    """
    context = problem.context
    rows, cols = problem.shape_vu
    margin = np.asarray(context.search_margin_vu) + CELL_PX
    half_diagonal = np.hypot(rows, cols) / 2
    # Between two angles the outermost star moves by one and a half cells, at most half of that from the nearer one.
    count = int(np.ceil(2 * context.max_rotation_rad * half_diagonal / (1.5 * CELL_PX))) | 1
    angles = np.linspace(-context.max_rotation_rad, context.max_rotation_rad, count)
    # A pair's vote is its log-odds inside one window, so rare bright pairs outweigh common faint ones.
    window_area = (2 * CELL_PX) ** 2
    chance = np.log(problem.chance_detected)[:, None] + ratio - np.log(window_area / (rows * cols))
    weight = np.clip(chance, 0.0, 12.0).astype(np.float32)
    cells = (2 * margin / CELL_PX).astype(int) + 1
    votes = np.zeros((count, cells[0], cells[1]), np.float32)
    centre = context.camera_model.centre_vu
    _cast_votes(problem.predicted_vu, centre, angles, problem.measured_vu, weight, margin[0], margin[1], CELL_PX, votes)
    best: list[tuple[FloatArray, float]] = []
    for k, v, u in _window_maxima(votes, options.hypotheses):
        offset = (np.array([v, u]) + 1.0) * CELL_PX - margin
        best.append((offset, float(angles[k])))
    return best


def _window_maxima(votes: NDArray[np.float32], count: int) -> list[tuple[int, int, int]]:
    """Highest sums over 2x2 cells (first cell's index), none within two cells and three angles of a higher one."""
    sums = np.stack([
        cv2.boxFilter(layer, -1, (2, 2), anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for layer in votes
    ])  # fmt: skip
    flat = sums.ravel()
    # Nearly all cells are empty, so a threshold leaves few to sort; those below it are no rivals of the highest.
    highest = float(flat.max())
    top = np.flatnonzero(flat > max(highest - _HOPELESS_VOTES, _RIVAL_SHARE * highest, 0.0))
    top = top[np.lexsort((top, -flat[top]))]
    found: list[tuple[int, int, int]] = []
    for k, v, u in zip(*np.unravel_index(top, sums.shape), strict=True):
        if all(abs(k - a) > 3 or abs(v - b) > 2 or abs(u - c) > 2 for a, b, c in found):
            found.append((int(k), int(v), int(u)))
            if len(found) == count:
                break
    return found
