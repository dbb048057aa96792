"""Renderings against brute force, and derivatives against their numerical twins."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage

from pipeline.imaging.masks import spikes
from pipeline.imaging.ncc import make_level, ncc_around, ncc_map, peak_of
from pipeline.imaging.render import Template, Window
from pipeline.options import InstrumentSettings
from pipeline.predict.bodies import BodyPredictionOptions, BodyScene, predict_bodies
from pipeline.records import (
    Attitude,
    Body,
    CameraModel,
    Detector,
    FloatArray,
    Spacecraft,
    State,
    TriangleMesh,
)

SIDE = 72
SIGMA = 0.8
FOCAL_MM, PX_PER_MM, RANGE_KM = 1000.0, 100.0, 1.0e6
RADIUS_PX = 21.3
OVER = 20


def _state(bodies: tuple[Body, ...], turns: bool = False) -> State:
    camera = CameraModel((SIDE, SIDE), FOCAL_MM, np.diag([PX_PER_MM, PX_PER_MM]), np.array([35.5, 35.5]))
    return State(
        "x", "SIM", "NAC", 0.0, "2000-01-01T12:00:00", 1.0, camera, Detector(psf_sigma_px=SIGMA, read_noise_dn=2.0),
        Attitude(np.eye(3)), Spacecraft(),
        InstrumentSettings(fit_camera_rotation=turns, search_margin_vu=(8.0, 8.0)), bodies,
    )  # fmt: skip


def _body(place_vu: tuple[float, float], radius_px: float, phase_deg: float, name: str = "A") -> Body:
    scale = FOCAL_MM * PX_PER_MM
    position = RANGE_KM * np.array([(place_vu[1] - 35.5) / scale, (place_vu[0] - 35.5) / scale, 1.0])
    phase = np.radians(phase_deg)
    sun = np.array([np.sin(phase) * 0.8, np.sin(phase) * 0.6, -np.cos(phase)])
    return Body(name, None, position, np.full(3, radius_px * RANGE_KM / scale), np.eye(3), sun)


def _scene(bodies: tuple[Body, ...], turns: bool = False) -> BodyScene:
    return predict_bodies(_state(bodies, turns), SIGMA, BodyPredictionOptions())


def _template(scene: BodyScene) -> Template:
    return scene.render(scene.views, Window(0, 0, SIDE, SIDE))


def _brute(place_vu: tuple[float, float], radius_px: float, sun: FloatArray) -> FloatArray:
    """Lambert sphere in orthographic view, which at this range is the camera's to a millionth of a pixel."""
    fine = (np.arange(SIDE * OVER) + 0.5) / OVER - 0.5
    y, x = (fine[:, None] - place_vu[0]) / radius_px, (fine[None, :] - place_vu[1]) / radius_px
    r2 = x**2 + y**2
    z = -np.sqrt(np.clip(1.0 - r2, 0.0, None))
    light = np.clip(x * sun[0] + y * sun[1] + z * sun[2], 0.0, None) * (r2 < 1.0)
    blurred = scipy.ndimage.gaussian_filter(light, SIGMA * OVER, truncate=5.0)
    return np.asarray(blurred.reshape(SIDE, OVER, SIDE, OVER).mean(axis=(1, 3)))


@pytest.mark.parametrize("phase_deg", [5.0, 60.0, 120.0, 150.0])
def test_a_sphere_is_what_brute_force_draws(phase_deg: float) -> None:
    place = (33.37, 37.81)
    body = _body(place, RADIUS_PX, phase_deg)
    image = _template(_scene((body,))).image.astype(float)
    expected = _brute(place, RADIUS_PX, body.sun_direction_j2000)
    # A limb's cells are right to some thousandths of their brightness.
    assert np.abs(image - expected).max() < 0.01
    v, u = np.indices(image.shape)
    for axis in (v, u):
        moved = (image * axis).sum() / image.sum() - (expected * axis).sum() / expected.sum()
        # A thin crescent has few pixels to average over.
        assert abs(moved) < (0.02 if phase_deg > 140.0 else 0.004)


def test_derivatives_have_numerical_twins() -> None:
    place, step = (33.37, 37.81), 0.02
    template = _template(_scene((_body(place, RADIUS_PX, 60.0),)))
    sun = _body(place, RADIUS_PX, 60.0).sun_direction_j2000
    twins = []
    for dv, du in ((step, 0.0), (0.0, step)):
        ahead = _brute((place[0] + dv, place[1] + du), RADIUS_PX, sun)
        behind = _brute((place[0] - dv, place[1] - du), RADIUS_PX, sun)
        # A body moved ahead moves its image ahead: minus the derivative by position.
        twins.append(-(ahead - behind) / (2.0 * step))
    for mine, twin in zip((template.along_v, template.along_u), twins, strict=True):
        assert np.sqrt(((mine - twin) ** 2).mean()) < 0.06 * np.sqrt((twin**2).mean())
    scene = _scene((_body(place, RADIUS_PX, 60.0),))
    wide, narrow = (_template(scene.with_sigma(float(np.sqrt(SIGMA**2 + d)))).image for d in (0.02, -0.02))
    wider = (wide - narrow) / 0.04
    assert np.sqrt(((template.widening - wider) ** 2).mean()) < 0.05 * np.sqrt((wider**2).mean())


def test_spin_is_the_turn_of_the_shading() -> None:
    place = (35.5, 35.5)
    template = _template(_scene((_body(place, RADIUS_PX, 70.0),), turns=True))
    sun, step = _body(place, RADIUS_PX, 70.0).sun_direction_j2000, 0.02
    turned = []
    for sign in (1.0, -1.0):
        c, s = np.cos(sign * step), np.sin(sign * step)
        # +u (x) turns toward +v (y).
        turned.append(_brute(place, RADIUS_PX, np.array([c * sun[0] - s * sun[1], s * sun[0] + c * sun[1], sun[2]])))
    twin = (turned[0] - turned[1]) / (2.0 * step)
    assert template.spin is not None
    assert np.sqrt(((template.spin - twin) ** 2).mean()) < 0.1 * np.sqrt((twin**2).mean())


def test_a_nearer_body_hides_a_farther_one() -> None:
    far = _body((36.0, 36.0), 20.0, 10.0, "FAR")
    near = _body((36.0, 40.0), 8.0, 140.0, "NEAR")
    near = replace(near, position_km=0.9 * near.position_km, radii_km=0.9 * near.radii_km)
    alone = _template(_scene((far,))).image
    both = _template(_scene((far, near))).image
    assert alone[36, 40] > 0.9
    # The dark side of the near one is all that is seen in its middle.
    assert both[34, 37] < 0.05
    assert both[36, 24] == pytest.approx(alone[36, 24], abs=1e-6)


def test_a_shadow_falls_on_the_body_behind() -> None:
    body = _body((36.0, 36.0), 20.0, 20.0, "LIT")
    shade = replace(
        body, name="SHADE", position_km=body.position_km + 3.0 * body.radii_km[0] * body.sun_direction_j2000,
        radii_km=body.radii_km / 4.0,
    )  # fmt: skip
    lit = _template(_scene((body,))).image
    scene = _scene((body, shade))
    dimmed = scene.only(("LIT",))
    template = dimmed.render(dimmed.views, Window(0, 0, SIDE, SIDE))
    assert (lit - template.image).max() > 0.9
    assert (template.image <= lit + 1e-5).all()


def test_a_fine_mesh_looks_like_its_ellipsoid() -> None:
    body = _body((35.2, 36.1), RADIUS_PX, 40.0)
    polar, around = 80, 160
    theta = np.linspace(0.0, np.pi, polar + 1)[1:-1]
    phi = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    ring = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine + 0.0 * phi], axis=2)
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]]) * body.radii_km[0]
    facets = [(0, 1 + k, 1 + (k + 1) % around) for k in range(around)]
    for row in range(polar - 2):
        for k in range(around):
            a, b = 1 + row * around + k, 1 + row * around + (k + 1) % around
            facets += [(a, a + around, b), (b, a + around, b + around)]
    last = len(vertices) - 1
    start = last - around
    facets += [(last, start + (k + 1) % around, start + k) for k in range(around)]
    mesh = replace(body, mesh=TriangleMesh(vertices, np.array(facets)))
    difference = _template(_scene((mesh,))).image - _template(_scene((body,))).image
    assert np.sqrt((difference**2).mean()) < 0.01


def test_correlation_is_that_of_direct_sums() -> None:
    rng = np.random.default_rng(1)
    template = scipy.ndimage.gaussian_filter(rng.normal(size=(40, 44)), 2.0).astype(np.float32)
    image = np.zeros((30, 32), np.float32)
    image[:] = 5.0 + 3.0 * template[5 - 2 : 35 - 2, 6 + 3 : 38 + 3]
    good = rng.random(image.shape) > 0.2
    image[~good] = 1e4
    level = make_level(image, good, 1)
    values = ncc_map(level, template)
    assert values.shape == (11, 13)
    # image(x) = template(x - d): the cut begins at 5 - d.
    assert tuple(map(int, np.unravel_index(values.argmax(), values.shape))) == (5 + 2, 6 - 3)
    assert values.max() == pytest.approx(1.0, abs=1e-4)
    assert ncc_around(level, template, (2, -3), 1)[1, 1] == pytest.approx(values[7, 3], abs=1e-4)
    for i, j in ((0, 0), (4, 8), (10, 12)):
        cut = template[10 - i : 40 - i, 12 - j : 44 - j]
        assert values[i, j] == pytest.approx(np.corrcoef(cut[good], image[good])[0, 1], abs=1e-3)


def test_a_peak_between_samples_is_found() -> None:
    v, u = np.mgrid[-2:3, -2:3]
    place, height = peak_of(0.9 - 0.02 * (v - 0.3) ** 2 - 0.03 * (u + 0.2) ** 2)
    assert place == pytest.approx([0.3, -0.2], abs=1e-9)
    assert height == pytest.approx(0.9, abs=0.01)


def test_spikes_are_struck_pixels_and_no_crescent() -> None:
    rng = np.random.default_rng(2)
    image = (10.0 + rng.normal(0.0, 1.0, (60, 60))).astype(np.float32)
    image[10, 10] += 100.0
    image[30, 40:42] += 80.0
    image[45, 5:30] += 60.0
    found = spikes(image, np.zeros(image.shape, bool), np.ones(image.shape, np.float32), 8.0)
    assert found[10, 10]
    assert found[30, 40:42].all()
    assert not found[45, 8:27].any()
    assert np.count_nonzero(found) <= 7


def test_nothing_is_drawn_beyond_the_rays() -> None:
    scene = _scene((_body((33.0, 37.0), RADIUS_PX, 60.0),))
    wide = scene.canvas.grown(40, 40)
    template = scene.render(scene.views, wide)
    inside = np.zeros((wide.rows, wide.cols), bool)
    inside[scene.canvas.slices_in(wide)] = True
    assert np.isfinite(template.image).all()
    assert template.image[inside].max() > 0.5
    far = scipy.ndimage.distance_transform_edt(~inside) > 6.0
    assert not template.image[far].any()
