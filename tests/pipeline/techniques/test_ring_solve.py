"""Which feature of the rings is wrong."""

import numpy as np

from pipeline.records import FloatArray
from pipeline.techniques.ring_solve import System, without_outlier
from pipeline.techniques.ring_unknowns import Layout, Radii

_OFFSET = np.array([0.7, -1.2])


def _normals(count: int) -> FloatArray:
    angle = np.linspace(-0.6, 0.5, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _layout(count: int) -> Layout:
    return Layout(2, np.arange(count), np.arange(count), 0.5, 5.0, np.full(count, 0.1), np.array([20.0, 20.0]))


def _radii(count: int, sigma_km: float) -> Radii:
    sigma = np.concatenate([np.full(count, sigma_km), np.full(count, 0.01), np.full(count, 1e-4)])
    return Radii(np.zeros(3 * count), sigma, np.zeros(3 * count, bool), np.zeros(count), np.ones(count))


def _system(layout: Layout, shifts_px: FloatArray, sigma_px: float = 0.02) -> System:
    """Every feature's edge has been measured; offset, blur, radii and edges are unknown."""
    rows = np.zeros((len(shifts_px), layout.count))
    rows[:, :2] = _normals(len(shifts_px))
    for k in range(len(shifts_px)):
        rows[k, 3 + k] = 1.0 / layout.km_per_px
        rows[k, 3 + layout.features + k] = 1.0
    return System(rows.T @ rows / sigma_px**2, rows.T @ shifts_px / sigma_px**2, np.zeros(layout.count))


def _freed(errors_px: FloatArray) -> list[int]:
    """Features that are let go where their edges are off by errors and all by one offset."""
    count = len(errors_px)
    layout = _layout(count)
    system = _system(layout, _normals(count) @ _OFFSET + errors_px)
    found = without_outlier(system, layout, _radii(count, 0.4), np.full(count, 1.0 / layout.km_per_px), 0.1)
    return [k for k in range(count) if found.free[k]]


def test_one_wrong_feature_of_four_is_found_though_it_moves_all_others() -> None:
    for wrong in range(4):
        assert _freed(3.0 * (np.arange(4) == wrong)) == [wrong]


def test_small_errors_free_nothing() -> None:
    assert _freed(np.array([0.08, -0.05, 0.02, 0.06])) == []


def test_where_all_scatter_none_is_to_blame() -> None:
    rng = np.random.default_rng(5)
    freed = [len(_freed(rng.normal(0.0, 1.0, 10))) for _ in range(40)]
    assert np.mean(freed) < 0.2
