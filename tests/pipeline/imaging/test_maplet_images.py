"""Predicted and extracted images of maplets, equation by equation."""

import numpy as np
import pytest

from pipeline.geometry.maplet import Maplet
from pipeline.imaging.illumination import reflectance
from pipeline.imaging.maplet_images import (
    MapletImageOptions,
    MapletLaw,
    blocked_cells,
    brightness_scale,
    extend_shadows,
    extract_image,
    grid_pixels,
    law_of_maplet,
    maplet_images,
    predict_image,
    shadow_reach,
)
from pipeline.records import FloatArray
from tests.pipeline.techniques.maplet_scene import maplet_on, relief, view_down


def flat(heights: FloatArray) -> Maplet:
    return Maplet("A", np.zeros(3), np.eye(3), 0.1, heights, np.ones(heights.shape), np.zeros((3, 3)))


def unit(*values: float) -> FloatArray:
    return np.asarray(np.array(values) / np.linalg.norm(values))


@pytest.mark.parametrize("phase_deg", [0.0, 30.0, 100.0])
def test_eq_3_41_spc_form_and_its_relatives(phase_deg: float) -> None:
    mu0, mu = 0.7, 0.4
    beta = np.exp(-phase_deg / 60.0)
    spc = (1 - beta) * mu0 + beta * mu0 / (mu0 + mu)
    mcewen = (1 - beta) * mu0 + 2 * beta * mu0 / (mu0 + mu)
    fixed = 0.35 * mu0 + 0.65 * mu0 / (mu0 + mu)
    for law, expected in (
        (MapletLaw.MCEWEN, spc), (MapletLaw.LUNAR_LAMBERT, mcewen), (MapletLaw.FIXED_BETA, fixed),
        (MapletLaw.LAMBERT, mu0), (MapletLaw.LOMMEL_SEELIGER, 2 * mu0 / (mu0 + mu)),
        (MapletLaw.MINNAERT, mu0**0.7 * mu**-0.3),
    ):  # fmt: skip
        kind, parameter, factor = law_of_maplet(law, np.radians(phase_deg))
        assert factor * reflectance(kind, parameter, mu0, mu) == pytest.approx(expected)


def test_eq_3_38_to_3_40_angles_of_a_tilted_plane() -> None:
    i, j = np.meshgrid(np.arange(11.0), np.arange(11.0), indexing="ij")
    maplet = flat(0.2 * i - 0.1 * j)
    sun, ray = unit(0.3, 0.2, 1.0), unit(-0.4, 0.1, 1.0)
    light, lit = predict_image(maplet, sun, ray, MapletImageOptions())
    normal = unit(-0.2, 0.1, 1.0)
    beta = np.exp(-np.degrees(np.arccos(sun @ ray)) / 60)
    mu0, mu = normal @ sun, normal @ ray
    assert lit.all()
    assert light == pytest.approx(np.full((11, 11), (1 - beta) * mu0 + beta * mu0 / (mu0 + mu)))
    dark, lit = predict_image(maplet, unit(1.0, 0.0, 0.15), ray, MapletImageOptions())
    assert not lit.any()
    assert not dark.any()


def test_eq_3_42_to_3_45_scale_and_background_are_the_regression() -> None:
    rng = np.random.default_rng(4)
    predicted = rng.uniform(0.2, 1.0, 500)
    extracted = 37.0 * predicted + 5.0
    assert brightness_scale(predicted, extracted, 1.0, 0.5) == pytest.approx((37.0, 5.0))
    scale, background = brightness_scale(predicted, extracted, 0.4, 0.5)
    assert (scale, background) == pytest.approx((extracted.mean() / predicted.mean(), 0.0))
    noisy = extracted + rng.normal(size=500)
    slope, level = np.polyfit(predicted, noisy, 1)
    assert brightness_scale(predicted, noisy, 0.9, 0.5) == pytest.approx((slope, level))


def test_eq_3_47_to_3_51_bilinear_and_the_bad_pixels_around() -> None:
    rng = np.random.default_rng(4)
    image = rng.uniform(0, 100, (20, 30)).astype(np.float32)
    good = np.ones(image.shape, bool)
    good[10, 10] = False
    places = rng.uniform([-2, -2], [21, 31], (40, 40, 2))
    places[0, 0] = [19.0, 29.0]
    places[0, 1] = np.nan
    values, valid = extract_image(image, good, places, 0.7)
    for (v, u), value, known in zip(places.reshape(-1, 2), values.ravel(), valid.ravel(), strict=True):
        inside = 0 <= v <= 19 and 0 <= u <= 29
        if not inside:
            assert not known
            continue
        a, b = min(int(v), 18), min(int(u), 28)
        assert known == good[a : a + 2, b : b + 2].all()
        if known:
            x, y = u - b, v - a
            top, bottom = (image[k, b] * (1 - x) + image[k, b + 1] * x for k in (a, a + 1))
            assert value == pytest.approx(top * (1 - y) + bottom * y, rel=1e-5)


def test_a_cell_of_several_pixels_is_their_mean() -> None:
    rng = np.random.default_rng(4)
    image = rng.uniform(0, 100, (200, 200)).astype(np.float32)
    steps = 20.0 + 4.0 * np.arange(30)
    places = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=2)
    values, valid = extract_image(image, np.ones(image.shape, bool), places, 4.0)
    assert valid.all()
    exact = np.array([[image[v - 2 : v + 3, u - 2 : u + 3][1:-1, 1:-1].mean() for u in steps.astype(int)]
                      for v in steps.astype(int)])  # fmt: skip
    # Over many seeds 0.857 with a scatter of 0.009; a single pixel and its neighbours' mean would have a third.
    assert np.corrcoef(values.ravel(), exact.ravel())[0, 1] > 0.8
    assert values.std() < 0.35 * image.std()


def test_eq_3_52_reach_of_shadows_is_in_cells_and_follows_the_sun() -> None:
    assert [shadow_reach(ratio) for ratio in (0.4, 1.0, 2.9)] == [3, 4, 5]
    dark = np.zeros((40, 40), bool)
    dark[15:20, 18:22] = True
    # The Sun stands toward +x: the shadow's far end is its side of small i.
    cut = extend_shadows(dark, unit(1.0, 0.0, 0.5), 3)
    rows = np.flatnonzero(cut[:, 20])
    assert rows.tolist() == list(range(14 - 3 - 2, 14 + 2 + 1))
    assert not cut[:, [17, 22]].any()
    turned = extend_shadows(dark, unit(-1.0, 0.0, 0.5), 3)
    assert np.flatnonzero(turned[:, 20]).tolist() == list(range(20 - 2, 20 + 3 + 2 + 1))
    # Two dark cells are no shadow.
    dark[:] = False
    dark[15:17, 18:22] = True
    assert not extend_shadows(dark, unit(1.0, 0.0, 0.5), 3).any()


def test_a_wall_hides_what_lies_behind_it() -> None:
    heights = np.zeros((61, 61))
    heights[30] = 10.0
    # Along a ray of 45 degrees a wall of 10 cells covers 10 cells.
    blocked = blocked_cells(heights, unit(1.0, 0.0, 1.0))
    covered = np.flatnonzero(blocked[:, 30])
    # Steps of one cell length along the ray look at every 0.7th cell: the bilinear wall is two cells wide at its foot.
    assert covered[-1] in (28, 29)
    assert 20 <= covered[0] <= 22
    assert len(covered) >= 8
    assert not blocked_cells(heights, np.array([0.0, 0.0, 1.0])).any()
    sun = unit(1.0, 0.0, 1.0)
    with_cast = predict_image(flat(heights), sun, np.array([0.0, 0, 1]), MapletImageOptions())[1]
    without = predict_image(flat(heights), sun, np.array([0.0, 0, 1]), MapletImageOptions(cast_shadows=False))[1]
    assert np.array_equal(without & ~with_cast, without & blocked)


def test_the_filter_takes_out_dark_grazing_and_hidden_cells() -> None:
    surface = relief(3)
    maplet = maplet_on(surface, 30, 0.05)
    view = view_down(0.05, 0.5, 0.2, np.array([0.4, 0.1, 0.9]))
    image = np.full((160, 170), 100.0, np.float32)
    image[:, :80] = 1.0
    good = np.ones(image.shape, bool)
    jacobian = np.eye(2)
    found = maplet_images(view, maplet, (image, good), np.zeros(2), jacobian, MapletImageOptions())
    pixels = grid_pixels(view, maplet)
    assert not found.extracted_valid[pixels[..., 1] < 79].any()
    assert found.removed == (~found.extracted_valid).sum() > 500
    assert found.illuminated == pytest.approx((found.predicted > 0).mean())
    to_camera = view.position_km - maplet.landmark_km
    assert found.emission_rad == pytest.approx(np.arccos(to_camera[2] / np.linalg.norm(to_camera)))
    shifted = maplet_images(view, maplet, (image, good), np.array([0.0, 30.0]), jacobian, MapletImageOptions())
    assert shifted.extracted_valid.sum() > found.extracted_valid.sum()
    wide = maplet_images(view, maplet, (image, good), np.zeros(2), jacobian, MapletImageOptions(), 12)
    assert wide.extracted.shape == (85, 85)
    inner = slice(12, -12)
    both = wide.extracted_valid[inner, inner] & found.extracted_valid
    assert wide.extracted[inner, inner][both] == pytest.approx(found.extracted[both])
