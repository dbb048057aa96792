import numpy as np
import pytest

from pipeline.frame import FrameOptions, make_frame
from pipeline.predict.bodies import BodyPredictionOptions, predict_bodies
from pipeline.records import FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.model_errors import ModelErrorOptions
from pipeline.techniques.template_fit import TemplateFit, fit_template
from tests.scenes.ball_scene import Ball, BallScene, ball_scene


def _fit(scene: BallScene, start_vu: FloatArray, start_rad: float = 0.0) -> TemplateFit | str:
    frame = make_frame(scene.pixels, None, scene.state, FrameOptions())
    bodies = predict_bodies(scene.state, frame.spread.sigma_px, BodyPredictionOptions())
    return fit_template(bodies, frame, start_vu, start_rad, NavContext.of(scene.state), ModelErrorOptions())


@pytest.mark.parametrize("start", [(0.0, 0.0), (1.5, -1.5), (-2.0, 0.5)])
def test_a_start_some_pixels_away_leads_to_the_planted_place(start: tuple[float, float]) -> None:
    planted = (4.3, -6.8)
    scene = ball_scene(np.random.default_rng(1), (Ball((80.0, 90.0), 25.0, 50.0),), planted)
    fit = _fit(scene, np.array(planted) + start)
    assert not isinstance(fit, str)
    assert fit.offset_vu == pytest.approx(planted, abs=0.02)
    assert fit.rotation_rad == 0.0
    # Brightness and sky come with it; noise alone is less than what was granted to an unknown surface.
    assert fit.scale_dn == pytest.approx(1000.0, rel=0.01)
    assert fit.level_dn == pytest.approx(20.0, abs=0.5)
    assert 0.4 < fit.chi2_per_sample < 1.1
    assert fit.correlation > 0.99 * fit.expected_correlation


def test_a_wider_point_spread_is_seen_as_such() -> None:
    scene = ball_scene(np.random.default_rng(2), (Ball((80.0, 90.0), 25.0, 50.0),), (0.0, 0.0), sigma_px=1.2)
    frame = make_frame(scene.pixels, None, scene.state, FrameOptions())
    bodies = predict_bodies(scene.state, 1.0, BodyPredictionOptions())
    fit = fit_template(bodies, frame, np.zeros(2), 0.0, NavContext.of(scene.state), ModelErrorOptions())
    assert not isinstance(fit, str)
    assert fit.variance_px2 == pytest.approx(1.2**2 - 1.0**2, abs=0.1)
    assert fit.offset_vu == pytest.approx([0.0, 0.0], abs=0.02)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("radius_px", [4.0, 5.0])
def test_a_body_that_a_step_carries_out_of_the_frame_has_no_fit(radius_px: float, turns: bool) -> None:
    # Half a pixel of the body is inside; noise alone decides where the step goes, and with these seeds it is outward.
    for seed in (1, 14, 20, 21):
        scene = ball_scene(
            np.random.default_rng(seed), (Ball((0.5 - radius_px, 90.0), radius_px, 40.0),), (0.0, 0.0),
            shape=(60, 180), fit_rotation=turns, drawn=False,
        )  # fmt: skip
        assert isinstance(_fit(scene, np.zeros(2)), str)


def test_sky_alone_is_not_bright_where_the_body_is() -> None:
    refused = 0
    for seed in range(8):
        scene = ball_scene(np.random.default_rng(seed), (Ball((80.0, 90.0), 15.0, 50.0),), (0.0, 0.0), drawn=False)
        fit = _fit(scene, np.zeros(2))
        refused += isinstance(fit, str)
        # What fits sky by chance has next to no brightness.
        assert isinstance(fit, str) or fit.scale_dn < 3.0
    assert refused >= 1
