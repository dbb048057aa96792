"""Raw pixels to a Frame: refusals with reasons, masks, level, noise, class, smear."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from pipeline.camera import project
from pipeline.errors import ImageError
from pipeline.frame import Frame, FrameOptions, ImageClass, make_frame, point_spread, smear_trail
from pipeline.geometry.rotations import rotation_about
from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, BoolArray, CameraModel, Detector, FloatArray, Spacecraft, State
from pipeline.status import StatusReason

SHAPE = (256, 320)
OPTIONS = FrameOptions()
DETECTOR = Detector(psf_sigma_px=1.0, read_noise_dn=3.0)


def _state(
    detector: Detector = DETECTOR,
    rate: FloatArray | None = None,
    exposure_s: float | None = 2.0,
    mirrored: bool = False,
) -> State:
    k = np.diag([50.0, -50.0 if mirrored else 50.0])
    camera = CameraModel(SHAPE, 200.0, k, np.array([127.5, 159.5]))
    attitude = Attitude(np.eye(3), rate_rad_s=rate)
    return State("i", "m", "c", 0.0, "", exposure_s, camera, detector, attitude, Spacecraft(), InstrumentSettings())


def _raw(level: float = 100.0, sigma: float = 3.0, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(level, sigma, SHAPE)


def _frame(pixels: NDArray[Any], state: State, flagged: BoolArray | None = None) -> Frame:
    """Images come in the type of their file."""
    return make_frame(pixels, flagged, state, OPTIONS)


def _reason(pixels: np.ndarray, detector: Detector = DETECTOR) -> StatusReason:
    with pytest.raises(ImageError) as caught:
        _frame(pixels, _state(detector))
    assert caught.value.detail
    return caught.value.reason


def test_images_that_are_none_are_refused_by_name() -> None:
    flat = np.full(SHAPE, 7.0)
    assert _reason(np.zeros((256, 300))) is StatusReason.IMAGE_SHAPE_MISMATCH
    assert _reason(np.zeros((1, *SHAPE))) is StatusReason.IMAGE_SHAPE_MISMATCH
    assert _reason(flat) is StatusReason.IMAGE_BLANK
    assert _reason(np.zeros(SHAPE), replace(DETECTOR, missing_value=0.0)) is StatusReason.IMAGE_BLANK
    assert _reason(flat * np.nan) is StatusReason.IMAGE_NOT_FINITE
    assert _reason(_raw(990.0), replace(DETECTOR, saturation_dn=900.0)) is StatusReason.IMAGE_OVEREXPOSED
    lost = _raw()
    lost[:200] = 0.0
    assert _reason(lost, replace(DETECTOR, missing_value=0.0)) is StatusReason.IMAGE_MOSTLY_MISSING


def test_the_background_is_taken_away_and_the_noise_known() -> None:
    frame = _frame(_raw(), _state())
    # 20 tiles of 256 samples whose median scatters by 0.08 sigma each.
    assert frame.background_dn == pytest.approx(100.0, abs=0.3)
    assert frame.noise_dn == pytest.approx(3.0, rel=0.1)
    assert abs(float(frame.pixels.mean())) < 0.3
    assert frame.pixels.dtype == frame.sigma.dtype == np.float32
    assert frame.image_class is ImageClass.NORMAL
    assert (frame.missing_share, frame.saturated_share, int(frame.bad.sum())) == (0.0, 0.0, 0)
    assert (frame.sigma >= 3.0 - 1e-6).all()  # never below the read noise


def test_the_callers_pixels_stay_as_they_were() -> None:
    for dtype in (np.float32, np.float64, np.int16, np.dtype(">i2")):
        raw = _raw().astype(dtype)
        before = raw.copy()
        _frame(raw, _state())
        assert_array_equal(raw, before)


def test_quantisation_counts_as_noise_of_integers_only() -> None:
    quiet = replace(DETECTOR, read_noise_dn=0.0)
    raw = np.random.default_rng(1).normal(100.0, 0.01, SHAPE)
    whole = np.round(raw).astype(np.int16)
    whole[0, 0] = 101  # else the image is blank
    assert _frame(whole, _state(quiet)).noise_dn == pytest.approx(12**-0.5, rel=1e-6)
    assert _frame(raw, _state(quiet)).noise_dn == pytest.approx(0.01, rel=0.2)


def test_missing_flagged_and_saturated_pixels_are_bad() -> None:
    raw = _raw()
    raw[10, 20:40] = 0.0
    raw[100, 100] = 5000.0
    raw[50, 50] = np.nan
    flagged = np.zeros(SHAPE, bool)
    flagged[200, 200] = True
    detector = replace(DETECTOR, missing_value=0.0, saturation_dn=4000.0)
    frame = _frame(raw, _state(detector), flagged)
    expected = flagged.copy()
    expected[10, 20:40] = expected[100, 100] = expected[50, 50] = True
    assert_array_equal(frame.bad, expected)
    assert np.argwhere(frame.saturated).tolist() == [[100, 100]]
    assert frame.missing_share == pytest.approx(21 / raw.size)
    assert frame.saturated_share == pytest.approx(1 / raw.size)
    assert frame.pixels[100, 100] > 4000  # a full pixel still shows where the star is
    assert_array_equal(frame.pixels[frame.bad & ~frame.saturated], 0.0)
    assert np.isfinite(frame.pixels).all()


def test_clipped_zeros_are_measurements() -> None:
    raw = np.round(np.clip(_raw(2.0), 0, None)).astype(np.uint8)
    frame = _frame(raw, _state(replace(DETECTOR, missing_value=0.0)))
    assert (raw == 0).mean() > 0.2
    assert frame.missing_share == 0.0


def test_eight_bits_end_at_255_unless_the_camera_says_otherwise() -> None:
    raw = np.clip(np.round(_raw()), 0, 255).astype(np.uint8)
    raw[9, 9], raw[11, 11] = 255, 230
    quiet = replace(DETECTOR, read_noise_dn=1.0)
    assert np.argwhere(_frame(raw, _state(quiet)).saturated).tolist() == [[9, 9]]
    told = replace(quiet, saturation_dn=220.0)
    assert _frame(raw, _state(told)).saturated.sum() == 2
    assert not _frame(raw.astype(np.int16), _state(quiet)).saturated.any()


def test_a_bias_is_in_the_level_but_makes_no_shot_noise() -> None:
    rng = np.random.default_rng(3)
    raw = 500.0 + rng.poisson(50.0 * 2.0, SHAPE) / 2.0 + rng.normal(0, 3.0, SHAPE)
    detector = replace(DETECTOR, bias_dn=500.0, gain_e_per_dn=2.0)
    frame = _frame(raw, _state(detector))
    assert frame.background_dn == pytest.approx(550.0, abs=0.6)
    assert frame.noise_dn == pytest.approx(np.hypot(3.0, 5.0), rel=0.08)  # not that of 550 DN, 16.9
    assert abs(float(frame.pixels.mean())) < 0.6
    assert frame.gain_e_per_dn == 2.0


def test_an_unknown_gain_is_read_off_the_image() -> None:
    rng = np.random.default_rng(4)
    level = np.repeat(np.linspace(20, 2000, 5), 64)[None, :] * np.ones((SHAPE[0], 1))
    raw = rng.poisson(2.0 * level) / 2.0 + rng.normal(0, 3.0, SHAPE)
    frame = _frame(raw, _state())
    assert frame.gain_e_per_dn is not None
    # 20 tiles of 256 samples, 15 % each in variance.
    assert frame.gain_e_per_dn == pytest.approx(2.0, rel=0.2)
    assert frame.image_class is ImageClass.GRADIENT
    blind = replace(DETECTOR, read_noise_dn=None)
    assert _frame(raw, _state(blind)).gain_e_per_dn is None


def test_a_noisy_image_is_called_one() -> None:
    assert _frame(_raw(sigma=15.0), _state()).image_class is ImageClass.NOISY
    assert _frame(_raw(sigma=9.0), _state()).image_class is ImageClass.NORMAL


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rate", [(3e-4, 0.0, 0.0), (0.0, 3e-4, 0.0), (-2e-4, 1e-4, 0.0), (0.0, 0.0, 1e-3)])
def test_the_trail_is_how_far_a_turning_camera_sees_a_star_move(
    rate: tuple[float, float, float], mirrored: bool
) -> None:
    """The star at the boresight, projected before and after the camera's own turn."""
    state = _state(rate=np.array(rate), mirrored=mirrored)
    angle = float(np.linalg.norm(rate)) * 2.0
    # The camera turns by +angle about the axis; directions in its frame turn by -angle.
    boresight = np.array([[0.0, 0.0, 1.0]])
    before, after = (boresight @ rotation_about(np.array(rate), share * angle).T for share in (0.5, -0.5))
    moved = project(state.camera_model, after)[0] - project(state.camera_model, before)[0]
    assert_allclose(smear_trail(state), moved[0], atol=1e-4)  # tan of 3e-4 rad for the angle


def test_no_rate_or_no_exposure_no_trail() -> None:
    assert_array_equal(smear_trail(_state()), 0.0)
    assert_array_equal(smear_trail(_state(rate=np.ones(3), exposure_s=None)), 0.0)


def test_point_spreads() -> None:
    unknown = point_spread(_state(Detector()), OPTIONS)
    assert (unknown.sigma_px, unknown.misfit) == (OPTIONS.default_psf_sigma_px, OPTIONS.default_psf_misfit)
    known = point_spread(_state(replace(DETECTOR, psf_misfit=0.02), np.array([3e-4, 0.0, 0.0])), OPTIONS)
    assert (known.sigma_px, known.misfit) == (1.0, 0.02)
    assert known.trail_px == pytest.approx(6.0)  # 6e-4 rad at 10,000 px per radian
    fast = point_spread(_state(rate=np.array([1e-2, 1e-2, 0.0])), OPTIONS)
    assert fast.trail_px == pytest.approx(OPTIONS.max_trail_px)
    assert fast.trail_vu[0] == pytest.approx(-fast.trail_vu[1]) or fast.trail_vu[0] == pytest.approx(fast.trail_vu[1])
    slow = point_spread(_state(rate=np.array([4e-6, 0.0, 0.0])), OPTIONS)
    assert slow.trail_vu == (0.0, 0.0)
