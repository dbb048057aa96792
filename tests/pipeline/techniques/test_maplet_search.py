"""Landmarks far from where they are believed to be, alone."""

import numpy as np
import pytest

from pipeline.geometry.maplet import index_of
from pipeline.imaging.maplet_images import MapletImageOptions
from pipeline.predict.maplets import maplet_jacobian
from pipeline.techniques.maplet_correlation import CorrelationOptions, LandmarkMatch, PeakStatus, locate
from pipeline.techniques.maplet_search import stands_alone, wide_surface, widest_bin
from tests.pipeline.techniques.maplet_scene import Relief, maplet_on, picture_of, relief, view_down

SUN = np.array([0.5, 0.3, 0.7])
OPTIONS = (MapletImageOptions(), CorrelationOptions(bin_start=12))


def search(drawn: Relief, believed: Relief, offset: tuple[float, float]) -> LandmarkMatch:
    maplet = maplet_on(believed, 30, 0.05)
    view = view_down(0.05, 0.3, 0.4, SUN, 160)
    phase = np.arccos(view.sun @ view.position_km / 100.0)
    image = picture_of(drawn, view, np.array(offset), float(np.exp(-np.degrees(phase) / 60))).astype(np.float32)
    jacobian = maplet_jacobian(view, index_of([maplet]), np.array([0]))[0]
    return locate(view, maplet, (image, np.ones(image.shape, bool)), jacobian, np.zeros(2), OPTIONS)


@pytest.mark.parametrize("offset", [(42.4, -41.7), (-31.3, 5.2)])
def test_a_landmark_sixty_pixels_away_is_found_alone(offset: tuple[float, float]) -> None:
    match = search(relief(1), relief(1), offset)
    assert match.status is PeakStatus.FOUND
    assert match.offset_vu == pytest.approx(offset, abs=0.1)


@pytest.mark.parametrize("seed", [2, 3])
def test_a_landmark_that_is_not_there_is_not_found(seed: int) -> None:
    assert search(relief(seed), relief(1), (0.0, 0.0)).status is not PeakStatus.FOUND


def test_the_wide_surface_has_the_sign_of_the_narrow_one_and_is_pearsons() -> None:
    rng = np.random.default_rng(5)
    p, e = rng.normal(size=(20, 20)), rng.normal(size=(44, 44))
    e[12 + 7 : 32 + 7, 12 - 9 : 32 - 9] += 2.0 * p
    mp = rng.uniform(size=p.shape) > 0.2
    surface = wide_surface((p, mp), (e, np.ones(e.shape, bool)))
    assert surface.shape == (25, 25)
    assert surface.argmax() == (12 + 7) * 25 + 12 - 9
    for a, b in ((0, 0), (19, 3), (24, 11)):
        part = e[a : a + 20, b : b + 20]
        assert surface[a, b] == pytest.approx(np.corrcoef(p[mp], part[mp])[0, 1], abs=1e-4)


def test_a_peak_stands_alone_unless_another_comes_near() -> None:
    surface = np.full((11, 11), 0.1)
    surface[5, 5], surface[5, 6] = 0.9, 0.85
    surface[9, 2] = np.nan
    assert stands_alone(surface, (5, 5), 0.6)
    surface[1, 1] = 0.84
    assert not stands_alone(surface, (5, 5), 0.6)
    assert stands_alone(surface, (5, 5), 1.0)
    assert stands_alone(np.where(surface == 0.9, 0.9, np.nan), (5, 5), 0.1)


def test_bins_leave_a_maplet_its_pattern() -> None:
    assert [widest_bin(side) for side in (9, 47, 49, 99)] == [1, 1, 2, 4]
