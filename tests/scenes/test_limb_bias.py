"""The limb's known inward bias must be absent: lit spheres drawn by brute force, measured where they are."""

import numpy as np
import pytest
import scipy.ndimage

from pipeline.frame import FrameOptions, make_frame
from pipeline.options import InstrumentSettings
from pipeline.predict.bodies import BodyPredictionOptions, predict_bodies
from pipeline.predict.outlines import limb_outline
from pipeline.records import Attitude, Body, CameraModel, Detector, FloatArray, Spacecraft, State
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import cut_out
from pipeline.techniques.contour_fit import BandOptions, measure_segments
from pipeline.techniques.model_errors import ModelErrorOptions
from pipeline.techniques.template_fit import fit_template

SIDE, OVER, DISCS = 130, 8, 100
CAMERA = CameraModel((SIDE, SIDE), 1000.0, np.diag([100.0, 100.0]), np.array([64.5, 64.5]))


def _drawn(place: FloatArray, radius: float, sun: FloatArray, sigma: float) -> FloatArray:
    fine = (np.arange(SIDE * OVER) + 0.5) / OVER - 0.5
    y, x = (fine[:, None] - place[0]) / radius, (fine[None, :] - place[1]) / radius
    r2 = x**2 + y**2
    z = -np.sqrt(np.clip(1.0 - r2, 0.0, None))
    light = np.clip(x * sun[0] + y * sun[1] + z * sun[2], 0.0, None) * (r2 < 1.0)
    blurred = scipy.ndimage.gaussian_filter(light, sigma * OVER, truncate=4.0)
    return np.asarray(blurred.reshape(SIDE, OVER, SIDE, OVER).mean(axis=(1, 3)))


def _residual(rng: np.random.Generator) -> float:
    """Weighted mean shift along the limb's normals of one disc."""
    radius, sigma, phase, turn = rng.uniform(20, 45), rng.uniform(0.5, 2.0), rng.uniform(0.1, 2.1), rng.uniform(0, 6.28)
    place = 64.5 + rng.uniform(-1, 1, 2)
    sun = np.array([np.sin(phase) * np.cos(turn), np.sin(phase) * np.sin(turn), -np.cos(phase)])
    image = 20.0 + 1000.0 * _drawn(place, radius, sun, sigma) + rng.normal(0.0, 3.0, (SIDE, SIDE))
    position = 1e6 * np.array([(place[1] - 64.5) / 1e5, (place[0] - 64.5) / 1e5, 1.0])
    body = Body("A", None, position, np.full(3, radius * 10.0), np.eye(3), sun)
    state = State(
        "x", "SIM", "NAC", 0.0, "2000-01-01T12:00:00", 1.0, CAMERA,
        Detector(psf_sigma_px=sigma, read_noise_dn=3.0, gain_e_per_dn=1e6), Attitude(np.eye(3)), Spacecraft(),
        InstrumentSettings(search_margin_vu=(10.0, 10.0)), (body,),
    )  # fmt: skip
    frame = make_frame(image.astype(np.float32), None, state, FrameOptions())
    scene = predict_bodies(state, sigma, BodyPredictionOptions())
    fit = fit_template(scene, frame, np.zeros(2), 0.0, NavContext.of(state), ModelErrorOptions())
    cutout = cut_out(scene, frame, np.zeros(2), 0.0)
    assert cutout is not None
    assert not isinstance(fit, str)
    outline = limb_outline(cutout.views, CAMERA, cutout.template)
    segments = measure_segments(cutout, outline, frame, fit.levels, fit.errors, BandOptions())
    assert not isinstance(segments, str)
    good = segments.take(segments.ok)
    return float(np.average(good.shift_px, weights=good.sigma_px**-2.0))


@pytest.mark.slow
def test_limbs_are_not_drawn_inward() -> None:
    rng = np.random.default_rng(0)
    residuals = np.array([_residual(rng) for _ in range(DISCS)])
    assert abs(residuals.mean()) < 0.005
    assert np.abs(residuals).max() < 0.03
