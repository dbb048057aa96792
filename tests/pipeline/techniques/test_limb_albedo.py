"""Shifts of limbs by albedo against discs with drawn albedo."""

import numpy as np
import pytest

from pipeline.records import FloatArray
from pipeline.techniques.limb_albedo import LimbEdge, limb_albedo
from pipeline.techniques.model_errors import ModelErrors
from tests.scenes.body_scene import random_field

RADIUS, SIGMA, HALF_WIDTH, SEGMENT = 24.0, 0.8, 5.0, 4.0
EDGE = LimbEdge(RADIUS, SIGMA, HALF_WIDTH, SEGMENT, 1.0)
DRAWS = 400
FINE = 0.2
# A second piece, as far from the first as this.
APART = 6.0


def _errors(rms: float, reach: float, wide_rms: float = 0.0, wide_reach: float = 1.0) -> ModelErrors:
    return ModelErrors(rms, reach, wide_rms, wide_reach, (), 0.0, 0.0, 1.0)


def _piece(start: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fine cells of a disc behind a piece: directions on the sphere, distance from the limb, place along it."""
    reach = HALF_WIDTH + 4.0 * SIGMA
    inward = np.arange(FINE / 2, reach, FINE)
    along = start + np.arange(FINE / 2, SEGMENT, FINE)
    depth, arc = (g.ravel() for g in np.meshgrid(inward, along / RADIUS, indexing="ij"))
    from_axis = 1.0 - depth / RADIUS
    directions = np.stack([from_axis * np.cos(arc), from_axis * np.sin(arc), np.sqrt(1.0 - from_axis**2)], axis=1)
    return directions, depth, along


def _shift(albedo: FloatArray, depth: FloatArray) -> float:
    """Least squares for shift, brightness and sky in the blurred profile of a piece, averaged along the limb."""
    count = round(SEGMENT / FINE)
    profile, behind = albedo.reshape(-1, count).mean(axis=1), depth.reshape(-1, count)[:, 0]
    across = np.arange(-HALF_WIDTH, HALF_WIDTH, 0.25)
    blur = np.hypot(SIGMA, 12.0**-0.5)
    kernel = np.exp(-0.5 * ((across[:, None] + behind) / blur) ** 2) / np.sqrt(2 * np.pi) / blur * FINE

    def edge(moved: float) -> FloatArray:
        cells = np.arange(-40 * FINE, 0, FINE / 8) + FINE / 16
        spread = np.exp(-0.5 * ((across[:, None] - moved - cells) / blur) ** 2) / np.sqrt(2 * np.pi) / blur
        return np.asarray(spread.sum(axis=1) * FINE / 8)

    design = np.stack([(edge(0.01) - edge(-0.01)) / 0.02, edge(0.0), np.ones(len(across))], axis=1)
    return float(np.linalg.lstsq(design, kernel @ profile, rcond=None)[0][0])


@pytest.mark.parametrize("reach", [0.15, 0.6], ids=["narrow", "wide"])
def test_shifts_are_those_of_discs_with_drawn_albedo(reach: float) -> None:
    rng = np.random.default_rng(3)
    pieces = [_piece(0.0), _piece(APART)]
    cells = np.concatenate([p[0] for p in pieces])
    half = len(pieces[0][0])
    shifts = np.empty((DRAWS, 2))
    for k in range(DRAWS):
        field = 0.1 * random_field(cells, reach, rng)
        shifts[k] = _shift(field[:half], pieces[0][1]), _shift(field[half:], pieces[1][1])
    lags, covariance = limb_albedo(_errors(0.1, reach * RADIUS), EDGE)
    # 800 draws, half of them alike, know a variance to 6 %; the drawn field is a sum of few waves.
    np.testing.assert_allclose((shifts**2).mean(), covariance[0], rtol=0.2)
    alike = float((shifts[:, 0] * shifts[:, 1]).mean())
    np.testing.assert_allclose(alike, np.interp(APART, lags, covariance), atol=0.12 * covariance[0])


def test_provinces_move_a_limb_too() -> None:
    # Foreshortened to a fraction of a pixel, what is as wide as half a radius still changes within the blur.
    near = limb_albedo(_errors(0.1, 0.15 * RADIUS), EDGE)[1]
    wide = limb_albedo(_errors(0.1, 0.6 * RADIUS), EDGE)[1]
    assert 0.3 < wide[0] / near[0] < 1.0
    both = limb_albedo(_errors(0.1, 0.15 * RADIUS, 0.1, 0.6 * RADIUS), EDGE)[1]
    np.testing.assert_allclose(both, near + wide)


def test_far_pieces_move_apart_and_no_albedo_moves_none() -> None:
    lags, covariance = limb_albedo(_errors(0.1, 0.15 * RADIUS), EDGE)
    assert lags[0] == 0.0
    assert covariance[0] > 0
    assert abs(covariance[-1]) < 1e-3 * covariance[0]
    assert not limb_albedo(_errors(0.0, 1.0), EDGE)[1].any()
