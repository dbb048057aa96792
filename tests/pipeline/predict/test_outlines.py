"""Limbs and terminators against the borders of traced light."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.camera import unproject
from pipeline.geometry.ellipsoid import intersect
from pipeline.geometry.rotations import rotation_about
from pipeline.imaging.render import Window
from pipeline.predict.bodies import BodyPredictionOptions, predict_bodies
from pipeline.predict.body_view import BodyView
from pipeline.predict.outlines import Outline, limb_outline, terminator_outline
from pipeline.records import Body, CameraModel, TriangleMesh
from tests.scenes.body_scene import body_at, body_state, camera_of, corner_camera, trace

SHAPE = (64, 64)
CENTRE = (31.2, 30.7)
RADIUS = 20.0
NEAR = (18.0, 24.0)
OVER = 8
PINHOLE = camera_of(SHAPE)
CAMERAS = [PINHOLE, camera_of(SHAPE, mirrored=True), corner_camera(SHAPE), corner_camera(SHAPE, mirrored=True)]
CAMERA_NAMES = ["pinhole", "mirrored", "distorted", "mirrored and distorted"]
every_camera = pytest.mark.parametrize("camera", CAMERAS, ids=CAMERA_NAMES)
TILTED = rotation_about(np.array([0.3, 1.0, -0.4]), 0.8)


def _views(bodies: tuple[Body, ...], camera: CameraModel) -> tuple[BodyView, ...]:
    return predict_bodies(body_state(bodies, camera), 0.8, BodyPredictionOptions()).views


def _traced_at(body: Body, camera: CameraModel, outline: Outline, step_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Light and cover that traced rays show beside the vertices, along the normals."""
    light, cover = trace((body,), camera, np.eye(3), OVER)
    places = outline.vertices_vu + step_px * outline.normal_vu
    i, j = np.floor((places + 0.5) * OVER).astype(int).T
    inside = (i >= 0) & (j >= 0) & (i < light.shape[0]) & (j < light.shape[1])
    i, j = np.where(inside, i, 0), np.where(inside, j, 0)
    return np.where(inside, light[i, j], np.nan), np.where(inside, cover[i, j], np.nan)


@every_camera
def test_a_limb_is_the_border_of_what_traced_rays_cover(camera: CameraModel) -> None:
    body = body_at(camera, CENTRE, RADIUS, 50.0, axes=(1.2, 0.9, 0.8), body_from_j2000=TILTED)
    outline = limb_outline(_views((body,), camera), camera)
    assert len(outline) > 100
    # Rays are an eighth of a pixel apart: on either side of the line by a fifth everything is decided.
    assert (_traced_at(body, camera, outline, -0.2)[1] == 1.0).all()
    assert (_traced_at(body, camera, outline, 0.2)[1] == 0.0).all()
    light, _ = _traced_at(body, camera, outline, -0.2)
    assert (light[outline.usable] > 0.0).all()
    assert set(outline.reason.tolist()) == {"", "dark"}
    assert_allclose(np.linalg.norm(outline.normal_vu, axis=1), 1.0)
    assert_allclose(np.linalg.norm(outline.direction, axis=1), 1.0)


@every_camera
def test_a_terminator_is_the_border_of_what_is_lit(camera: CameraModel) -> None:
    body = body_at(camera, CENTRE, RADIUS, 70.0, axes=(1.1, 0.9, 1.0), body_from_j2000=TILTED)
    outline = terminator_outline(_views((body,), camera), camera, clear_px=3.0)
    assert np.count_nonzero(outline.usable) > 20
    lit, _ = _traced_at(body, camera, outline, -0.3)
    dark, cover = _traced_at(body, camera, outline, 0.3)
    assert (lit > 0.0).all()
    assert (dark == 0.0).all()
    assert (cover == 1.0).all()


def test_a_spheres_limb_is_a_circle_and_its_terminator_half_an_ellipse() -> None:
    views = _views((body_at(PINHOLE, CENTRE, RADIUS, 60.0, 0.0),), PINHOLE)
    limb = limb_outline(views, PINHOLE)
    assert_allclose(np.hypot(*(limb.vertices_vu - CENTRE).T), RADIUS, atol=5e-3)  # seen in perspective
    assert_allclose(limb.normal_vu, (limb.vertices_vu - CENTRE) / RADIUS, atol=2e-3)
    distant = _views((body_at(camera := camera_of(SHAPE), CENTRE, 2.0, 60.0, 0.0),), camera)
    arms = 10.0 * (terminator_outline(distant, PINHOLE).vertices_vu - np.array(CENTRE))
    # The Sun stands along one image axis: across it the semi-axis is R, along it R cos(phase).
    along = np.argmin(np.ptp(arms, axis=0))
    # Nearer points look larger, by the body's radius over its range: a thousandth here.
    assert_allclose((arms[:, along] / (RADIUS / 2)) ** 2 + (arms[:, 1 - along] / RADIUS) ** 2, 1.0, atol=4e-3)


def test_what_is_left_of_a_crescent_is_half_of_its_limb() -> None:
    outline = limb_outline(_views((body_at(PINHOLE, CENTRE, RADIUS, 120.0),), PINHOLE), PINHOLE)
    share = float(outline.usable.mean())
    # Half of the limb is lit at any phase; nearest to the cusps the Sun is too low.
    assert 0.4 < share < 0.5


def test_limbs_behind_others_and_outside_are_named() -> None:
    planet = body_at(PINHOLE, (32.0, 12.0), RADIUS, 20.0, 110.0, name="PLANET")
    moon = body_at(PINHOLE, NEAR, 9.0, 20.0, 110.0, name="MOON", range_km=0.5e5)
    views = _views((moon, planet), PINHOLE)
    outline = limb_outline(views, PINHOLE)
    names = np.array([views[k].body.name for k in outline.body.tolist()])
    hidden = outline.reason == "hidden"
    assert set(names[hidden].tolist()) == {"PLANET"}
    from_moon = np.hypot(*(outline.vertices_vu - np.array(NEAR)).T)
    inside = (outline.vertices_vu >= 0).all(axis=1)
    far = names == "PLANET"
    lit = far & inside & (outline.reason != "dark")
    # But for a vertex on the moon's own border.
    assert np.count_nonzero(hidden[lit] != (from_moon < 9.0)[lit]) <= 1
    outside = outline.reason == "outside"
    assert outside.any()
    assert (outline.vertices_vu[outside].min(axis=1) < 0).all()
    assert not outline.usable[outside | hidden].any()


def test_a_meshs_outlines_are_drawn_ones() -> None:
    corner = np.array([[-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]])
    cube = np.stack(np.meshgrid(*corner, indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    facets = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    sphere = body_at(PINHOLE, CENTRE, 12.0, 30.0)
    box = replace(sphere, mesh=TriangleMesh(cube * sphere.radii_km[0], facets), radii_km=sphere.radii_km * np.sqrt(3.0))
    scene = predict_bodies(body_state((box,), PINHOLE), 0.8, BodyPredictionOptions())
    template = scene.render(scene.views, Window(0, 0, *SHAPE))
    outline = limb_outline(scene.views, PINHOLE, template)
    assert len(outline) > 60
    # The front of a cube seen face on is a square of twelve pixels to each side.
    gap = np.abs(np.abs(outline.vertices_vu - CENTRE).max(axis=1) - 12.0)
    assert float(gap.max()) < 2.0
    assert ((outline.normal_vu * (outline.vertices_vu - CENTRE)).sum(axis=1) > 0).all()
    assert not len(limb_outline(scene.views, PINHOLE))  # nothing is drawn without a template


@pytest.mark.parametrize("at_limb", [True, False], ids=["limb", "terminator"])
def test_places_on_a_mesh_lie_apart_as_on_the_body(at_limb: bool) -> None:
    body = body_at(PINHOLE, CENTRE, RADIUS, 70.0, axes=(1.6, 0.7, 0.7), body_from_j2000=TILTED)
    # Rings of latitude and a spoke at each pole of the same ellipsoid.
    latitude, longitude = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 61), np.linspace(0, 2 * np.pi, 121)[:-1])
    ball = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], 2)
    at = np.arange(latitude.size).reshape(latitude.shape)
    a, b, c, d = at[:, :-1], np.roll(at, -1, 0)[:, :-1], np.roll(at, -1, 0)[:, 1:], at[:, 1:]
    facets = np.concatenate([np.stack(f, 2).reshape(-1, 3) for f in ((a, b, c), (a, c, d))])
    meshed = replace(body, mesh=TriangleMesh(ball.reshape(-1, 3) * body.radii_km, facets))
    scene = predict_bodies(body_state((meshed,), PINHOLE), 0.8, BodyPredictionOptions())
    template = scene.render(scene.views, Window(0, 0, *SHAPE))
    outline = (limb_outline if at_limb else terminator_outline)(scene.views, PINHOLE, template)
    assert len(outline) > 20
    # What a ray through the same pixel meets on the closed form.
    view = scene.views[0]
    inward = outline.vertices_vu - (0.7 if at_limb else 0.0) * outline.normal_vu
    rays, _ = unproject(PINHOLE, inward)
    points, hit = intersect(body.radii_km, view.observer_km, rays @ view.camera_from_body)
    assert hit.mean() > 0.95
    expected = points[hit] @ view.camera_from_body.T
    cosine = (expected / np.linalg.norm(expected, axis=1)[:, None] * outline.direction[hit]).sum(axis=1)
    assert float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max()) < 12.0
    assert_allclose(np.linalg.norm(outline.direction, axis=1), 1.0)


def test_nothing_joined_is_an_outline() -> None:
    assert len(Outline.joined([])) == 0
    assert len(limb_outline((), PINHOLE)) == 0
