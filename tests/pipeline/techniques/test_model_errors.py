"""Errors of a rendering: correlated sums against dense covariances, and planted albedo that residuals show."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.predict.bodies import BodyPredictionOptions, predict_bodies
from pipeline.predict.body_view import BodyView, view_body
from pipeline.records import FloatArray
from pipeline.techniques.model_errors import (
    ModelErrorOptions,
    assumed_errors,
    correlated_sums,
    haze_px,
    measured_errors,
)
from tests.scenes.body_scene import body_at, body_state, camera_of

CAMERA = camera_of((128, 128))
OPTIONS = ModelErrorOptions()


def _view(shape_sigma_km: float | None = None) -> BodyView:
    view = view_body(body_at(CAMERA, (64.0, 64.0), 50.0, shape_sigma_km=shape_sigma_km), CAMERA, np.eye(3))
    assert isinstance(view, BodyView)
    return view


@pytest.mark.parametrize("reach", [2.0, 5.0, 12.0])
def test_correlated_sums_are_those_of_a_dense_covariance(reach: float) -> None:
    rng = np.random.default_rng(1)
    row, col = (index.ravel().astype(float) for index in np.indices((30, 32)))
    # Smooth columns, as a fit's are, and a rough one.
    design = np.stack([row / 10 - 1, np.cos(col / 5), np.ones_like(row), rng.normal(size=len(row))], axis=1)
    amplitude = 0.5 + rng.random(len(row))
    distance = np.hypot(row[:, None] - row[None, :], col[:, None] - col[None, :])
    weighted = design * amplitude[:, None]
    dense = weighted.T @ np.exp(-distance / reach) @ weighted
    mine = correlated_sums(design, amplitude, (row, col), reach)
    assert_allclose(mine, mine.T)
    # Blocks of a quarter of the reach overstate a variance by their own size, a little.
    scale = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))[:3, :3]
    assert np.abs((mine - dense)[:3, :3] / scale).max() < 0.12
    assert mine[3, 3] == pytest.approx(dense[3, 3], rel=0.5)


def test_a_limb_softer_than_optics_and_relief_may_have_a_haze() -> None:
    body = body_at(CAMERA, (64.0, 64.0), 50.0, shape_sigma_km=0.0)
    scene = predict_bodies(body_state((body,), CAMERA), 0.8, BodyPredictionOptions())
    (view,) = scene.views
    assert haze_px(scene, view, OPTIONS) == 0.0
    assert haze_px(scene.with_sigma(0.95), view, OPTIONS) == 0.0
    assert haze_px(scene.with_sigma(2.0), view, OPTIONS) == pytest.approx(np.sqrt(4.0 - 1.5 * 0.64))
    rough = replace(view, body=replace(body, shape_sigma_km=1.5 / view.px_per_km))
    assert haze_px(scene.with_sigma(2.0), rough, OPTIONS) == pytest.approx(np.sqrt(4.0 - 1.5 * 0.64 - 2.25))


def test_what_is_assumed_scales_with_the_body() -> None:
    view = _view()
    errors = assumed_errors(view, OPTIONS)
    assert errors.texture == OPTIONS.texture
    assert errors.texture_px == pytest.approx(0.15 * 50.0)
    assert errors.wide_texture == pytest.approx(0.7 * 0.07)
    assert errors.relief_px == pytest.approx(2e-3 * 50.0)
    assert errors.relief_reach_px == pytest.approx(np.radians(5.0) * 50.0)
    told = assumed_errors(_view(0.01 * float(view.body.radii_km[0])), OPTIONS)
    assert told.relief_px == pytest.approx(0.01 * 50.0, rel=1e-3)


def _field(rng: np.random.Generator, side: int, reach: float) -> FloatArray:
    """Unit-variance field with an exponential covariance, by the square root of its spectrum."""
    lag = np.minimum(np.arange(2 * side), 2 * side - np.arange(2 * side))
    covariance = np.exp(-np.hypot(lag[:, None], lag[None, :]) / reach)
    root = np.sqrt(np.clip(np.fft.fft2(covariance).real, 0.0, None))
    return np.asarray(np.fft.ifft2(root * np.fft.fft2(rng.normal(size=covariance.shape))).real[:side, :side])


@pytest.mark.parametrize(("rms", "reach"), [(0.02, 4.0), (0.15, 4.0), (0.15, 9.0)])
def test_albedo_is_read_off_the_residuals(rms: float, reach: float) -> None:
    rng = np.random.default_rng(4)
    side, scale = 120, 1000.0
    light = np.full((side, side), scale)
    slope = np.zeros((side, side))
    slope[0] = 500.0  # the limb, far from the face
    noise = rng.normal(0.0, 5.0, (side, side))
    residual = light * rms * _field(rng, side, reach) + noise
    good, assumed = np.ones((side, side), bool), assumed_errors(_view(), OPTIONS)
    measured = measured_errors(residual**2 - 25.0, residual, scale, light, slope, good, assumed, OPTIONS)
    # What was assumed counts as so many patches, and a face of 120 px has about as many of its own.
    count = side**2 / (2 * np.pi * reach**2)
    expected = np.sqrt((OPTIONS.texture_dof * OPTIONS.texture**2 + count * rms**2) / (OPTIONS.texture_dof + count))
    assert measured.texture == pytest.approx(expected, rel=0.3)
    assert measured.wide_texture == pytest.approx(OPTIONS.wide_share * measured.texture)
    if rms > 0.1:
        assert 0.5 * reach < measured.texture_px < 2.0 * reach


def test_relief_is_never_below_the_catalogues_and_grows_with_misfit_at_edges() -> None:
    rng = np.random.default_rng(6)
    side = 80
    light, slope = np.zeros((side, side)), np.zeros((side, side))
    light[:, :40], slope[:, 38:42] = 1000.0, 400.0
    assumed = assumed_errors(_view(), OPTIONS)
    good = np.ones((side, side), bool)
    calm = measured_errors(np.zeros((side, side)), np.zeros((side, side)), 1e3, light, slope, good, assumed, OPTIONS)
    assert calm.relief_px == assumed.relief_px
    residual = 0.5 * slope * rng.normal(size=(side, side))
    rough = measured_errors(residual**2, residual, 1e3, light, slope, good, assumed, OPTIONS)
    assert rough.relief_px == pytest.approx(0.5, rel=0.2)
