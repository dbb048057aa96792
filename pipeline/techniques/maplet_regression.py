"""Shift between two images of a maplet by regression, its covariance, and what a maplet's cells leave unresolved.

Residuals may be correlated within blocks (sandwich estimate of White 1980, clustered).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.maplet import Maplet
from pipeline.imaging.maplet_images import MapletImageOptions, PreparedMaplet, predict_image
from pipeline.records import BoolArray, FloatArray

Masked = tuple[FloatArray, BoolArray]
_LEAST_CELLS = 20
# Residuals of predicted light are alike over about as many cells.
_BLOCK_CELLS = 6


def regressed_shift(
    predicted: Masked, extracted: Masked, start: NDArray[np.int64], block: int = _BLOCK_CELLS
) -> tuple[FloatArray, FloatArray, int]:
    """Shift beyond a whole one.

    The extracted image is regressed on light, level and both derivatives of the predicted one: predicted(x - s) has
    -s times the derivatives. Scores are summed over blocks of cells before they are squared.

    Parameters
    ----------
    predicted, extracted
        (n, n) and (m, m) light and flags.
    start
        (2,) cell of the extracted image on which the predicted one begins.
    block
        Side of a block of cells whose residuals may be alike.

    Returns
    -------
    tuple
        (2,) cells; (2, 2) covariance, cells^2; cells that both rest on. Not-a-number where these are too few.
    """
    (p, mp), (e, me) = predicted, extracted
    n, m = len(p), len(e)
    here, there = overlap(n, m, start)
    p, mp, e, me = p[here], mp[here], e[there], me[there]
    valid = mp & me
    # A derivative needs both neighbours.
    valid[1:-1, 1:-1] &= mp[2:, 1:-1] & mp[:-2, 1:-1] & mp[1:-1, 2:] & mp[1:-1, :-2]
    valid[[0, -1]] = valid[:, [0, -1]] = False
    i, j = np.nonzero(valid)
    if len(i) < _LEAST_CELLS:
        return np.full(2, np.nan), np.full((2, 2), np.nan), len(i)
    dx, dy = 0.5 * (p[i + 1, j] - p[i - 1, j]), 0.5 * (p[i, j + 1] - p[i, j - 1])
    columns = np.stack([p[i, j] - p[i, j].mean(), np.ones(len(i)), dx, dy], axis=1)
    normal = columns.T @ columns
    answer = np.linalg.lstsq(normal, columns.T @ e[i, j], rcond=None)[0]
    residual = e[i, j] - columns @ answer
    label = (i // block) * (n // block + 1) + j // block
    scores = np.stack([np.bincount(label, column * residual) for column in columns.T], axis=1)
    blocks = int((np.bincount(label) > 0).sum())
    bread = np.linalg.pinv(normal)
    sandwich = bread @ (scores.T @ scores) @ bread * blocks / max(blocks - 4, 1)
    plain = bread * float(residual @ residual) / max(len(i) - 4, 1)
    scale = max(abs(float(answer[0])), 1e-30)
    # Blocks are few: a direction in which their scores happen to cancel keeps what independent cells would give.
    return -answer[2:] / float(answer[0] or 1e-30), _larger(sandwich[2:, 2:], plain[2:, 2:]) / scale**2, len(i)


def _larger(first: FloatArray, second: FloatArray) -> FloatArray:
    """Smallest matrix that is not less than either of two covariances along the second one's own axes."""
    root = np.linalg.cholesky(second + np.eye(2) * 1e-30)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ first @ inverse.T)
    axes = root @ vectors
    return np.asarray((axes * np.maximum(values, 1.0)) @ axes.T)


def overlap(n: int, m: int, start: NDArray[np.int64]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Parts of an (n, n) and an (m, m) image that cover each other.

    Parameters
    ----------
    n, m
        Sides.
    start
        (2,) cell of the second on which the first begins.

    Returns
    -------
    tuple
        Slices of the first and of the second.
    """
    low, high = np.maximum(0, -start), np.minimum(n, m - start)
    here = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return here, tuple(slice(int(a + s), int(b + s)) for a, b, s in zip(low, high, start, strict=True))


def unresolved_shift(maplet: Maplet, prepared: PreparedMaplet, options: MapletImageOptions) -> FloatArray:
    """Estimate how far light that a maplet's cells do not resolve moves it.

    The light of a cell's mean slope is not the mean of the light within the cell. Cells twice as wide tell how much
    that matters: light predicted from their mean heights is displaced against the mean of the light predicted from
    the maplet's own. An error of first order in the width of the cells is half as large for the maplet itself.

    Parameters
    ----------
    maplet
        Maplet.
    prepared
        Its predicted image.
    options
        Law and shadows.

    Returns
    -------
    numpy.ndarray
        (2,) cells: one draw of an error of unknown sign; zero where too few cells are lit to tell.
    """
    # A maplet has a middle cell.
    side = (len(maplet.heights) // 2 - 1) // 2 * 2 + 1
    cut = slice(2 * side)
    coarse = replace(
        maplet, scale_km=2.0 * maplet.scale_km, heights=_halved(maplet.heights[cut, cut]) / 2.0,
        albedo=_halved(maplet.albedo[cut, cut]),
    )  # fmt: skip
    lit = np.asarray(prepared.lit[cut, cut].reshape(side, 2, side, 2).all(axis=(1, 3)), bool)
    fine = np.where(lit, _halved(prepared.predicted[cut, cut]), 0.0)
    predicted = predict_image(coarse, prepared.sun, prepared.ray, options)
    shift, _, cells = regressed_shift(predicted, (fine, lit), np.zeros(2, np.int64))
    # Twice as wide cells, half of the error.
    return shift if cells >= _LEAST_CELLS else np.zeros(2)


def _halved(values: FloatArray) -> FloatArray:
    side = len(values) // 2
    return np.asarray(values.reshape(side, 2, side, 2).mean(axis=(1, 3)))
