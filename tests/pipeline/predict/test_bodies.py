"""Bodies drawn into frames against rays traced one by one; which bodies are left out, and why."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.geometry.pointing import corrected_attitude
from pipeline.geometry.rotations import rotation_about
from pipeline.imaging.render import Template, Window, ray_grid
from pipeline.predict.bodies import BodyPredictionOptions, BodyScene, predict_bodies, reach_px
from pipeline.predict.body_view import form_of, view_body
from pipeline.records import Body, CameraModel, FloatArray, Image, Photometry
from tests.scenes.body_scene import body_at, body_state, camera_of, corner_camera, seen, trace

SHAPE = (64, 64)
WINDOW = Window(0, 0, *SHAPE)
CENTRE = (31.2, 30.7)
OVER = 12
SIGMA = 0.8
TILTED = rotation_about(np.array([0.3, 1.0, -0.4]), 0.8)
PINHOLE = camera_of(SHAPE)


def _scene(
    bodies: tuple[Body, ...], camera: CameraModel = PINHOLE, sigma: float = SIGMA, turns: bool = False
) -> BodyScene:
    return predict_bodies(body_state(bodies, camera, fit_rotation=turns), sigma, BodyPredictionOptions())


def _template(scene: BodyScene) -> Template:
    return scene.render(scene.views, WINDOW)


def _agree(mine: FloatArray | Image, truth: FloatArray, peak: float, rms: float) -> None:
    difference = np.abs(mine - truth)
    assert float(difference.max()) < peak
    assert float(np.sqrt((difference**2).mean())) < rms


BODIES = {
    "sphere": body_at(PINHOLE, CENTRE, 20.0),
    "full": body_at(PINHOLE, CENTRE, 20.0, 5.0),
    "crescent": body_at(PINHOLE, CENTRE, 20.0, 140.0),
    "ellipsoid": body_at(PINHOLE, CENTRE, 20.0, axes=(1.2, 0.9, 0.75), body_from_j2000=TILTED),
    "seeliger": body_at(PINHOLE, CENTRE, 20.0, photometry=Photometry.LOMMEL_SEELIGER),
    "mcewen": body_at(PINHOLE, CENTRE, 20.0, 40.0, photometry=Photometry.MCEWEN),
    "minnaert": body_at(PINHOLE, CENTRE, 20.0, 30.0, photometry=Photometry.MINNAERT),
    "very far": body_at(PINHOLE, CENTRE, 20.0, range_km=1e9),
    "very near": body_at(PINHOLE, CENTRE, 20.0, range_km=1.0),
    "giant": body_at(PINHOLE, (-380.0, 20.0), 400.0, 30.0),
}


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES.keys())
def test_templates_are_what_traced_rays_show(body: Body) -> None:
    light, cover = trace((body,), PINHOLE, np.eye(3), OVER)
    template = _template(_scene((body,)))
    # Twelve rays a side make the truth's own limb ragged by some hundredths where it is bright or nearly straight;
    # within four sigmas of the border light from outside is missing in both, differently.
    inside = np.s_[4:-4, 4:-4]
    _agree(template.image[inside], seen(light, OVER, SIGMA)[inside], 0.02, 1e-3)
    _agree(template.cover[inside], seen(cover, OVER, SIGMA)[inside], 0.05, 4e-3)
    # A cell is night or it is not: half a cell of a terminator, where neither shines.
    _agree(template.night[inside], seen(np.where(light > 0, 0.0, cover), OVER, SIGMA)[inside], 0.25, 0.03)


@pytest.mark.parametrize("phase_deg", [20.0, 100.0])
@pytest.mark.parametrize(
    "camera", [camera_of(SHAPE, mirrored=True), corner_camera(SHAPE), corner_camera(SHAPE, mirrored=True)],
    ids=["mirrored", "distorted", "mirrored and distorted"],
)  # fmt: skip
def test_so_they_are_through_other_cameras(camera: CameraModel, phase_deg: float) -> None:
    body = body_at(camera, CENTRE, 20.0, phase_deg, axes=(1.1, 0.9, 1.0), body_from_j2000=TILTED)
    light, _ = trace((body,), camera, np.eye(3), OVER)
    template, truth = _template(_scene((body,), camera)), seen(light, OVER, SIGMA)
    _agree(template.image, truth, 0.012, 1.2e-3)
    for axis in np.indices(SHAPE):
        # Rays that are linear over sixteen pixels are off by under 1e-3 px; twelve samples a side by 4e-3.
        mine = float((template.image * axis).sum() / template.image.sum())
        assert mine == pytest.approx(float((truth * axis).sum() / truth.sum()), abs=6e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_rays_are_linear_between_their_knots_to_a_thousandth_of_a_pixel(mirrored: bool) -> None:
    camera = corner_camera(SHAPE, mirrored)
    grid = ray_grid(camera, Window(-37, -21, 140, 150)).slopes
    between = ray_grid(camera, Window(-29, -13, 100, 100)).slopes
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
    pixel = 1.0 / (camera.focal_length_mm * abs(camera.k_px_per_mm[0, 0]))
    assert np.abs(middle[:6, :6] - between[:6, :6]).max() < 2e-3 * pixel
    assert np.abs(np.diff(grid, 2, axis=0)).max() > 1e-4 * pixel  # it is distorted


@pytest.mark.parametrize("place", [(-4.0, 30.0), (30.0, 67.0), (-9.0, -9.0)])
def test_a_body_partly_outside(place: tuple[float, float]) -> None:
    body = body_at(PINHOLE, place, 18.0, 50.0)
    light, _ = trace((body,), PINHOLE, np.eye(3), OVER)
    inside = np.s_[4:-4, 4:-4]
    _agree(_template(_scene((body,))).image[inside], seen(light, OVER, SIGMA)[inside], 0.01, 1e-3)


def test_a_body_outside_the_window_leaves_it_dark() -> None:
    body = body_at(PINHOLE, (-19.0, 30.0), 12.0)
    scene = _scene((body,))
    assert len(scene) == 1  # the margin may bring it in
    template = _template(scene)
    assert not template.image.any()
    assert not template.cover.any()


def test_bodies_hide_and_shade_each_other_as_traced_rays_say() -> None:
    planet = body_at(PINHOLE, CENTRE, 22.0, 40.0, 0.0, name="PLANET")
    radius, sun = float(planet.radii_km[0]), planet.sun_direction_j2000
    hiding = body_at(PINHOLE, (24.0, 40.0), 6.0, 40.0, 0.0, name="HIDING", range_km=0.9e5)
    # One shade stands beside the disc in the field, the other beyond the field: both darken the planet.
    shades = tuple(
        Body(name, None, planet.position_km + radius * (times * sun + aside), np.full(3, share * radius), TILTED, sun)
        for name, times, aside, share in (
            ("SHADE", 3.0, np.array([0.0, 0.3, 0.0]), 0.25), ("UNSEEN", 30.0, np.array([0.0, -0.4, 0.0]), 0.2)
        )
    )  # fmt: skip
    bodies = (planet, hiding, *shades)
    alone, _ = trace((planet,), PINHOLE, np.eye(3), OVER)
    light, _ = trace(bodies, PINHOLE, np.eye(3), OVER)
    assert np.abs(alone - light).sum() / alone.sum() > 0.1
    scene = _scene(bodies)
    assert "UNSEEN" not in scene.names
    # The edge of a shadow is not sampled as a limb is: a cell, half a pixel wide, is in it or not.
    _agree(_template(scene).image, seen(light, OVER, SIGMA), 0.2, 0.01)


def test_gradients_have_numerical_twins() -> None:
    """Of the renderer itself, moved by attitudes: a scale of the gradient would be one of every fitted offset."""
    for sigma, body in ((0.5, BODIES["sphere"]), (0.8, BODIES["crescent"]), (2.0, BODIES["ellipsoid"])):
        scene = _scene((body,), sigma=sigma)
        template, step = _template(scene), 0.1
        for axis, slope in enumerate((template.along_v, template.along_u)):
            ahead, behind = (
                scene.render(
                    scene.views_at(corrected_attitude(PINHOLE, np.eye(3), sign * step * np.eye(2)[axis])), WINDOW
                )
                for sign in (1.0, -1.0)
            )
            twin = (behind.image - ahead.image).astype(float) / (2 * step)
            assert float((slope * twin).sum() / (twin**2).sum()) == pytest.approx(1.0, abs=0.015)
            # Cells of half a pixel and a step of a fifth: three hundredths of the gradient, pixel by pixel.
            assert float(((slope - twin) ** 2).sum()) < 0.05**2 * float((twin**2).sum())


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_spin_is_what_traced_rays_show_of_a_rolled_camera(mirrored: bool) -> None:
    camera = camera_of(SHAPE, mirrored)
    body = body_at(camera, CENTRE, 18.0, 80.0, 30.0, axes=(1.3, 0.8, 0.9), body_from_j2000=TILTED)
    spin = _template(_scene((body,), camera, 1.0, turns=True)).spin
    assert spin is not None
    axis, step = body.position_km / np.linalg.norm(body.position_km), 0.03
    # The image turns from +u to +v as x turns to y, unless one of them is mirrored.
    sense = -1.0 if mirrored else 1.0
    images = [
        seen(trace((body,), camera, rotation_about(axis, sign * sense * step), OVER)[0], OVER, 1.0)
        for sign in (1.0, -1.0)
    ]
    twin = (images[0] - images[1]) / (2 * step)
    assert float((spin * twin).sum() / (twin**2).sum()) == pytest.approx(1.0, abs=0.02)
    assert float(((spin - twin) ** 2).sum()) < 0.06**2 * float((twin**2).sum())
    assert _template(_scene((body,), camera)).spin is None


FATES = [
    (body_at(PINHOLE, CENTRE, 20.0), ""),
    (body_at(PINHOLE, CENTRE, 1.2), "too_small"),
    (body_at(PINHOLE, CENTRE, 20.0, 179.5), "unlit"),
    (body_at(PINHOLE, (400.0, 30.0), 20.0), "outside_field"),
    (replace(body_at(PINHOLE, CENTRE, 20.0), position_km=np.array([0.0, 0.0, -1e5])), "behind_camera"),
    (replace(body_at(PINHOLE, CENTRE, 20.0), radii_km=np.full(3, 2e5)), "around_camera"),
]


@pytest.mark.parametrize(("body", "reason"), FATES, ids=[reason or "used" for _, reason in FATES])
def test_every_body_says_what_became_of_it(body: Body, reason: str) -> None:
    scene = _scene((body,))
    assert [fate.reason for fate in scene.fates] == [reason]
    assert len(scene) == (0 if reason else 1)
    assert (scene.rays is None) == bool(reason)


def test_a_body_that_fills_the_frame_is_a_background_of_others_only() -> None:
    wall = body_at(PINHOLE, CENTRE, 500.0, 20.0, name="WALL")
    moon = body_at(PINHOLE, CENTRE, 10.0, 20.0, name="MOON", range_km=0.2e5)
    both = _scene((moon, wall))
    assert both.names == ("MOON",)
    assert {fate.name: fate.reason for fate in both.fates} == {"MOON": "", "WALL": "fills_frame"}
    assert _scene((wall,)).names == ("WALL",)


def test_a_dark_body_is_drawn_where_it_hides_another_one() -> None:
    night = body_at(PINHOLE, CENTRE, 8.0, 179.5, name="NIGHT", range_km=0.2e5)
    moon = body_at(PINHOLE, CENTRE, 20.0, 20.0, name="MOON")
    both = _scene((moon, night))
    assert set(both.names) == {"MOON", "NIGHT"}
    assert {fate.name: fate.reason for fate in both.fates} == {"MOON": "", "NIGHT": "unlit"}
    lit, covered = _template(_scene((moon,))), _template(both)
    part = covered.window.slices_in(lit.window)
    middle = tuple(np.rint(np.array(CENTRE) - [covered.window.v0, covered.window.u0]).astype(int))
    assert covered.image[middle] == 0.0 < lit.image[part][middle]
    beside = body_at(PINHOLE, (CENTRE[0], CENTRE[1] + 60.0), 8.0, 179.5, name="NIGHT", range_km=0.2e5)
    assert _scene((moon, beside)).names == ("MOON",)


def test_figures_of_a_view() -> None:
    body = body_at(PINHOLE, CENTRE, 20.0, 70.0)
    view = view_body(body, PINHOLE, np.eye(3))
    assert not isinstance(view, str)
    assert_allclose(view.centre_vu, CENTRE, atol=1e-9)
    assert view.diameter_px == pytest.approx(40.0, rel=1e-6)
    assert np.degrees(view.phase_rad) == pytest.approx(70.0)
    assert view.lit_px == pytest.approx(40.0 * (1 + np.cos(np.radians(70.0))) / 2)
    assert view.box.v0 <= CENTRE[0] - 20
    assert view.box.v0 + view.box.rows >= CENTRE[0] + 21
    surface = body.radii_km[0] * np.array([0.6, 0.0, 0.8])
    assert surface @ form_of(view) @ surface == pytest.approx(1.0)


def test_lit_areas_are_those_of_traced_rays() -> None:
    planet = body_at(PINHOLE, CENTRE, 20.0, 70.0, name="PLANET")
    moon = body_at(PINHOLE, (25.0, 40.0), 7.0, 70.0, name="MOON", range_km=0.5e5)
    scene = _scene((planet, moon))
    areas = dict(zip(scene.names, scene.lit_areas(scene.views), strict=True))
    alone, _ = trace((planet,), PINHOLE, np.eye(3), 4)
    _, hidden = trace((moon,), PINHOLE, np.eye(3), 4)
    # A grid of 32 rays over the body's box.
    assert areas["PLANET"][0] == pytest.approx(float(((alone > 0) & (hidden == 0)).sum()) / 16.0, rel=0.03)
    assert areas["PLANET"][1] == {"MOON"}
    assert areas["MOON"][1] == set()
    assert scene.primary(scene.views).body.name == "PLANET"


def test_minor_bodies_stand_apart_unless_they_hide() -> None:
    planet = body_at(PINHOLE, (32.0, 20.0), 18.0, name="PLANET")
    beside = body_at(PINHOLE, (20.0, 55.0), 3.0, name="BESIDE")
    before = body_at(PINHOLE, (32.0, 15.0), 3.0, name="BEFORE", range_km=0.5e5)
    scene = _scene((planet, beside, before))
    assert set(scene.major().names) == {"PLANET", "BEFORE"}
    assert scene.minor().names == ("BESIDE",)


def test_the_reach_is_the_margin_and_what_a_rotation_adds() -> None:
    state = body_state((), PINHOLE, fit_rotation=True, margin_vu=(10.0, 20.0))
    added = np.radians(5.0) * 32.0
    assert reach_px(state) == (int(np.ceil(10 + added)), int(np.ceil(20 + added)))
    assert reach_px(body_state((), PINHOLE, margin_vu=(10.0, 20.0))) == (10, 20)
    assert len(_scene(())) == 0


def test_templates_are_shared_by_pointings_that_agree() -> None:
    scene = _scene((BODIES["sphere"],))
    offset, rotation = scene.quantised(np.array([1.03, -2.4]), 0.0)
    assert_allclose(offset, [1.0, -2.375])
    first = scene.template(offset, rotation)[1]
    assert scene.template(offset.copy(), rotation)[1] is first
    moved = scene.template(*scene.quantised(np.array([3.0, 0.0]), 0.0))[1]
    window = moved.window
    assert window.v0 > first.window.v0
    # A body outside the array at this pointing has no template.
    away = _scene((body_at(PINHOLE, (-20.0, 30.0), 5.0),))
    assert away.template(np.array([-12.0, 0.0]), 0.0)[1].window.pixels == 0
