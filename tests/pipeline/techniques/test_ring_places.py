"""Places of rings by all of the light, and the pixels of their fits."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.frame import make_frame
from pipeline.navigate import NavigationOptions
from pipeline.predict.rings import RingScene, predict_rings
from pipeline.techniques.base import NavContext
from pipeline.techniques.ring_bands import left_over
from pipeline.techniques.ring_image import RingImage, ring_image
from pipeline.techniques.ring_peaks import Peak
from pipeline.techniques.ring_pixels import select_pixels
from pipeline.techniques.ring_places import (
    independent_pixels,
    likely_places,
    settled_place,
    telling_pixels,
    worse_by,
)
from tests.scenes.ring_scene import Band, RingView, ring_scene

_TRUTH = (6.3, -4.8)
_DEGREES = 0.4
_OPTIONS = NavigationOptions()


def _setting(snr: float, fit_rotation: bool) -> tuple[RingScene, RingImage, NavContext]:
    bands = tuple(Band(radius, 6.0, 1.0, sigma=0.02) for radius in (150.0, 185.0, 210.0, 250.0))
    drawn = ring_scene(
        np.random.default_rng(21), bands, RingView(0.6, 0.4, (200.0, 0.8)), _TRUTH,
        np.radians(_DEGREES) if fit_rotation else 0.0, snr=snr, fit_rotation=fit_rotation,
    )  # fmt: skip
    frame = make_frame(drawn.pixels, None, drawn.state, _OPTIONS.frame)
    scene = predict_rings(drawn.state, frame.spread.sigma_px, _OPTIONS.ring_prediction)
    return scene, ring_image(frame), NavContext.of(drawn.state)


def _in_sight(scene: RingScene, image: RingImage) -> float:
    return left_over(scene, image.lattice, np.array(_TRUTH), 0.0).pixels


@pytest.mark.parametrize("snr", [2.0, 30.0])
def test_a_displaced_peak_comes_to_the_rings(snr: float) -> None:
    scene, image, context = _setting(snr, False)
    start = Peak((_TRUTH[0] + 2.0, _TRUTH[1] - 2.5), 0.0, 0.3)
    place = settled_place(scene, image, start, _in_sight(scene, image), context)
    assert np.hypot(*np.subtract(place.peak.offset_vu, _TRUTH)) < (1.0 if snr < 10.0 else 0.2)
    assert place.peak.correlation == start.correlation


def test_so_does_its_rotation() -> None:
    scene, image, context = _setting(30.0, True)
    start = Peak((_TRUTH[0] + 1.5, _TRUTH[1] + 1.0), np.radians(_DEGREES - 0.5), 0.3)
    place = settled_place(scene, image, start, _in_sight(scene, image), context)
    assert abs(np.degrees(place.peak.rotation_rad) - _DEGREES) < 0.1
    assert place.left < left_over(scene, image.lattice, np.array(start.offset_vu), start.rotation_rad).mean


def test_peaks_on_one_slope_are_one_place_and_the_best_comes_first() -> None:
    scene, image, context = _setting(30.0, False)
    near = [Peak((_TRUTH[0] + v, _TRUTH[1] + u), 0.0, 0.3) for v, u in ((1.0, 0.0), (-1.0, 1.0))]
    places = likely_places(scene, image, [Peak((-14.0, 15.0), 0.0, 0.9), *near], context, 5)
    assert np.hypot(*np.subtract(places[0].peak.offset_vu, _TRUTH)) < 0.2
    assert [place.left for place in places] == sorted(place.left for place in places)
    gaps = [np.subtract(a.peak.offset_vu, b.peak.offset_vu) for k, a in enumerate(places) for b in places[:k]]
    assert all(np.hypot(*gap) > 1.0 for gap in gaps)


def test_a_peak_without_rivals_stays() -> None:
    scene, image, context = _setting(30.0, False)
    peak = Peak((5.0, -5.0), 0.0, 0.5)
    (place,) = likely_places(scene, image, [peak], context, 5)
    assert place.peak is peak
    assert not place.settled


def test_texture_makes_fewer_pixels_independent() -> None:
    assert independent_pixels(1000.0, 0.9) == 1000.0
    assert independent_pixels(16_000.0, 40.0) == pytest.approx(400.0)
    # Lines across the rings are left however coherent the texture is along them.
    assert independent_pixels(16_000.0, 1e6) == pytest.approx(np.sqrt(16_000.0))


def test_places_are_told_by_a_part_of_many_pixels() -> None:
    assert telling_pixels(16_000.0, 1.0) == 4_000.0
    assert telling_pixels(16_000.0, 10.0) == pytest.approx(1600.0)


def test_worse_by_is_no_difference_at_the_same_place() -> None:
    _, image, _ = _setting(30.0, False)
    assert worse_by(image, 1.5, 1.5) == 0.0
    assert worse_by(image, 1.2, 1.5) < 0.0 < worse_by(image, 1.8, 1.5)


def test_a_lattice_is_a_part_of_all_pixels_near_edges() -> None:
    scene, image, _ = _setting(30.0, False)
    pose = scene.pose(np.array(_TRUTH), 0.0)
    every = select_pixels(scene, image, pose, 4.0)
    some = select_pixels(scene, replace(image, enough_pixels=len(every) // 4), pose, 4.0)
    assert set(some.tolist()) <= set(every.tolist())
    assert 0.15 < len(some) / len(every) < 0.25
    v, u = np.divmod(some, image.frame.raw.shape[1])
    assert not ((u + 2 * v) % 5).any()


def test_noise_asks_for_more_pixels() -> None:
    bands = tuple(Band(radius, 12.0, 1.0) for radius in range(100, 330, 24))
    drawn = (
        ring_scene(np.random.default_rng(4), bands, RingView(1.2, 0.4, (200.0, 0.8)), _TRUTH, snr=snr)
        for snr in (2.0, 60.0)
    )
    frames = (make_frame(one.pixels, None, one.state, _OPTIONS.frame) for one in drawn)
    noisy, clean = (ring_image(frame).enough_pixels for frame in frames)
    assert (noisy, clean) == (400_000, 100_000)
