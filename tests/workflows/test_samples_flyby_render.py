"""The flyby sample's light against closed forms, brute force and numerical experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtr

from workflows.samples.attitude import looking_at
from workflows.samples.cameras import SampleCamera, project, unproject
from workflows.samples.flyby_bodies import Scenery, prepare
from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.flyby_rays import PAD, SILHOUETTE, STEP_DEG, axes_of_sight, trace_silhouette
from workflows.samples.flyby_render import Light, core_kernels, gather_light
from workflows.samples.flyby_system import SampleBody, Sighting, Surface, body_named
from workflows.samples.flyby_terrain import Terrain, lumpy, random_field, smooth_terrain, terrain_of
from workflows.samples.flyby_truth import cramer_rao

Floats = NDArray[np.float64]
NO_WINGS = (0.0, 1.0)
CAMERAS = flyby_cameras()
SMALL = replace(
    CAMERAS["voyager_na"].optics, shape_vu=(96, 96), principal_point_vu=(47.5, 47.5), psf_sigma_px=0.6
)  # fmt: skip


def _ball(radii_km: tuple[float, float, float] = (250.0, 250.0, 250.0), law: str = "lambert") -> SampleBody:
    return SampleBody("BALL", 1077, radii_km, Surface(0.0, 6, 2.0, 0.0, law))


def _seen(
    optics: SampleCamera, body: SampleBody, radius_px: float, centre_vu: tuple[float, float], phase_deg: float
) -> tuple[Sighting, Floats]:
    """A body of some size and phase, and the camera_from_j2000 that puts its centre on a pixel."""
    ray = unproject(optics, np.array([centre_vu]))[0]
    attitude = looking_at(np.array([0.6, -0.48, 0.64]), 0.7)
    place = body.mean_radius_km / np.sin(radius_px * optics.rad_per_px) * (attitude.T @ ray)
    aside = np.cross(place, [0.3, 0.1, -0.9])
    aside /= np.linalg.norm(aside)
    back = -place / np.linalg.norm(place)
    sun = np.cos(np.radians(phase_deg)) * back + np.sin(np.radians(phase_deg)) * aside
    return Sighting(body, place, looking_at(np.array([0.0, 0.8, -0.6]), 1.9), sun), attitude


def _light(
    optics: SampleCamera, sighting: Sighting, attitude: Floats, terrain: Terrain, wings: tuple[float, float] = NO_WINGS
) -> Light:
    spheres = prepare(optics, attitude, [Scenery(sighting, terrain)], [sighting], sighting.body.name)
    return gather_light(optics, wings, spheres)


def _limb_polygon(optics: SampleCamera, sighting: Sighting, attitude: Floats, count: int = 20_000) -> Floats:
    """Pixels of a sphere's limb: the cone of half-angle asin(R/d) about its direction, projected point by point."""
    axis = attitude @ sighting.place_km / sighting.range_km
    half = np.arcsin(sighting.body.mean_radius_km / sighting.range_km)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]
    side = np.cos(turn) * across + np.sin(turn) * np.cross(axis, across)
    return project(optics, np.cos(half) * axis + np.sin(half) * side)


@pytest.mark.parametrize(
    ("name", "radius", "centre"), [("cassini_nac", 301.3, (433.4, 590.2)), ("lorri_1x1", 40.7, (700.2, 333.9))]
)
def test_the_limb_lies_where_the_cone_of_tangents_meets_the_array(
    name: str, radius: float, centre: tuple[float, float]
) -> None:
    optics = CAMERAS[name].optics
    # Under the Sun at the camera's back this law makes a sphere an even disc, so its rim is a blurred step.
    sighting, attitude = _seen(optics, _ball(law="lommel_seeliger"), radius, centre, 0.0)
    image = _light(optics, sighting, attitude, smooth_terrain()).total
    limb = _limb_polygon(optics, sighting, attitude)
    middle = limb.mean(axis=0)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    near = np.abs(np.hypot(v - middle[0], u - middle[1]) - radius) < 4.0
    pixels = np.stack([v[near], u[near]], axis=1).astype(float)
    outward = limb - middle
    bearing = np.unwrap(np.arctan2(outward[:, 0], outward[:, 1]))
    order = np.argsort(bearing % (2.0 * np.pi))
    reach = np.hypot(*outward.T)
    angle = np.arctan2(pixels[:, 0] - middle[0], pixels[:, 1] - middle[1]) % (2.0 * np.pi)
    expected = np.interp(angle, bearing[order] % (2.0 * np.pi), reach[order], period=2.0 * np.pi)
    beyond = np.hypot(*(pixels - middle).T) - expected
    sigma = np.sqrt(optics.psf_sigma_px**2 + 1.0 / 12.0)
    model = ndtr(-beyond / sigma)
    slope = np.exp(-0.5 * (beyond / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    for sector in range(12):
        mine = (angle // (2.0 * np.pi / 12)).astype(int) == sector
        shift = ((image[near] - model)[mine] @ slope[mine]) / (slope[mine] @ slope[mine])
        # A curved rim blurred by sigma retreats by sigma^2 / 2 r, 0.01 px for the smaller disc.
        assert abs(shift + sigma**2 / (2.0 * radius)) < 0.01, (sector, shift)


def test_light_against_brute_force() -> None:
    optics = SMALL
    sighting, attitude = _seen(optics, _ball((131.0, 117.0, 109.0)), 14.0, (45.3, 50.8), 70.0)
    image = _light(optics, sighting, attitude, smooth_terrain()).total
    fine = 24
    v, u = np.meshgrid(*(((np.arange(96 * fine) + 0.5) / fine - 0.5) for _ in range(2)), indexing="ij")
    rays = unproject(optics, np.stack([v.ravel(), u.ravel()], axis=1)) @ attitude
    radii = np.array(sighting.body.radii_km)
    way = rays @ sighting.from_j2000.T / radii
    eye = -(sighting.from_j2000 @ sighting.place_km) / radii
    a, b, c = (way**2).sum(axis=1), way @ eye, eye @ eye - 1.0
    root = b**2 - a * c
    hit = root > 0.0
    point = (eye + ((-b[hit] - np.sqrt(root[hit])) / a[hit])[:, None] * way[hit]) / radii
    normal = point / np.linalg.norm(point, axis=1, keepdims=True)
    light = np.zeros(len(rays))
    light[hit] = np.maximum(normal @ (sighting.from_j2000 @ sighting.sun), 0.0)
    blurred = gaussian_filter(light.reshape(v.shape), optics.psf_sigma_px * fine)
    expected = blurred.reshape(96, fine, 96, fine).mean(axis=(1, 3))
    # Eight samples a side place the rim to a few hundredths of a pixel.
    assert np.abs(image - expected).max() < 0.015 * expected.max()
    assert image.sum() == pytest.approx(expected.sum(), rel=2e-3)


@pytest.mark.parametrize("wings", [NO_WINGS, (0.05, 3.0)])
def test_the_optics_keep_all_light(wings: tuple[float, float]) -> None:
    sighting, attitude = _seen(SMALL, _ball(law="lommel_seeliger"), 9.0, (47.5, 47.5), 0.0)
    light = _light(SMALL, sighting, attitude, smooth_terrain(), wings)
    assert light.total.sum() == pytest.approx(np.pi * 81.0, rel=3e-3)
    assert light.target.sum() == pytest.approx(light.total.sum(), rel=1e-3)
    far = np.hypot(*(np.indices(light.total.shape) - 47.5)) > 13.0
    # Some percents of the broad part of the disc's light end this far out; of the core nothing does.
    assert (light.total[far].sum() / light.total.sum() > 1e-3) == (wings[0] > 0.0)


def test_core_kernels_are_the_integral_of_a_gaussian_over_pixels() -> None:
    shares, slopes = core_kernels(0.5, 8)
    assert shares.sum(axis=1) == pytest.approx(1.0, abs=1e-12)
    place = (np.arange(8) + 0.5) / 8 - 0.5
    taps = np.arange(shares.shape[1]) - shares.shape[1] // 2
    # A pixel is not fine enough for a centroid to follow exactly: exp(-2 pi^2 (0.5^2)) / pi is left of the sampling.
    assert shares @ taps == pytest.approx(place, abs=2.5e-3)
    # Variance of core, pixel and strip, about the strip's middle.
    variance = (shares * (taps - place[:, None]) ** 2).sum(axis=1)
    assert variance == pytest.approx(0.25 + 1.0 / 12.0, abs=0.02)
    assert slopes.sum(axis=1) == pytest.approx(0.0, abs=1e-6)
    ahead, _ = core_kernels(0.5, 8)
    numeric = (ahead[2:] - ahead[:-2]) / 0.25
    assert np.abs(numeric - slopes[1:-1]).max() < 0.03


def test_derivatives_are_those_of_a_moved_scene() -> None:
    body = _ball((131.0, 117.0, 109.0))
    step = 0.2
    moved: dict[str, list[Floats]] = {"v": [], "u": []}
    for sign in (1.0, -1.0):
        for axis, (dv, du) in {"v": (step, 0.0), "u": (0.0, step)}.items():
            sighting, attitude = _seen(SMALL, body, 25.0, (45.3 + sign * dv, 50.8 + sign * du), 60.0)
            moved[axis].append(_light(SMALL, sighting, attitude, smooth_terrain()).total)
    sighting, attitude = _seen(SMALL, body, 25.0, (45.3, 50.8), 60.0)
    light = _light(SMALL, sighting, attitude, smooth_terrain())
    for axis, mine in {"v": light.shift_v, "u": light.shift_u}.items():
        numeric = (moved[axis][0] - moved[axis][1]) / (2.0 * step)
        # The body turns a little under the moving line of sight, and the rim's samples jump.
        assert np.sqrt(((mine - numeric) ** 2).sum() / (numeric**2).sum()) < 0.05


def test_cramer_rao_is_what_a_matched_fit_reaches() -> None:
    sighting, attitude = _seen(SMALL, _ball(), 11.0, (44.0, 51.0), 50.0)
    light = _light(SMALL, sighting, attitude, smooth_terrain())
    expected = 200.0 * light.total + 5.0
    variance = 4.0 + expected / 30.0
    columns = [200.0 * light.shift_v, 200.0 * light.shift_u, light.total, np.ones_like(expected)]
    useful = np.ones(expected.shape, dtype=bool)
    useful[40:43] = False
    bound = np.sqrt(np.diag(cramer_rao(columns, variance, useful, (0.0, 0.0, 0.0, 0.0))))
    weight = 1.0 / np.sqrt(variance[useful])
    design = np.stack([c[useful] * weight for c in columns], axis=1)
    rng = np.random.default_rng(4)
    noise = rng.normal(size=(400, int(useful.sum())))
    found = np.linalg.lstsq(design, noise.T, rcond=None)[0][:2]
    # The spread of 400 draws is known to 3.5 %.
    assert found.std(axis=1) == pytest.approx(bound[:2], rel=0.12)
    wider = np.sqrt(np.diag(cramer_rao(columns, 4.0 * variance, useful, (0.0,) * 4)))
    assert wider == pytest.approx(2.0 * bound, rel=1e-6)


def test_heights_have_the_rms_and_the_correlation_that_is_told() -> None:
    terrain = terrain_of(body_named("CORVETH"), 3)
    heights = terrain.heights[PAD:-PAD, PAD:-PAD].astype(float)
    weight = np.cos(np.radians(np.linspace(-90.0, 90.0, len(heights))))[:, None]
    mean = (heights * weight).sum() / weight.sum() / heights.shape[1]
    # Limbs, not the mean surface, stand at the told radii.
    assert -0.6 * terrain.rms < mean < 0.3 * terrain.rms
    heights -= mean
    assert np.sqrt((heights**2 * weight).sum() / weight.sum() / heights.shape[1]) == pytest.approx(
        terrain.rms, rel=1e-3
    )
    # Pairs of points on parallels, an angle apart that makes the great circle the told one.
    rows = np.arange(120, 601, 4)
    latitude = np.radians(rows * STEP_DEG - 90.0)
    apart = 2.0 * np.arcsin(np.sin(np.radians(terrain.correlation_deg) / 2.0) / np.cos(latitude))
    product, power = 0.0, 0.0
    for row, step in zip(rows, np.rint(np.degrees(apart) / STEP_DEG).astype(int), strict=True):
        line = heights[row]
        cosine = np.cos(np.radians(row * STEP_DEG - 90.0))
        product += cosine * (line * np.roll(line, step)).mean()
        power += cosine * (line**2).mean()
    # One realisation along one direction: a tenth or so.
    assert product / power == pytest.approx(1.0 / np.e, abs=0.12)


def test_fields_are_isotropic() -> None:
    field, variance = random_field((3, 3), 2.0, np.random.default_rng(8))
    assert variance[:3].sum() == 0.0
    # A field of one degree solves the Laplace equation of the sphere with eigenvalue n (n + 1), whatever the order.
    step = np.radians(STEP_DEG)
    latitude = np.radians(np.linspace(-90.0, 90.0, len(field)))[:, None]
    inner = slice(200, 500)
    second = (np.roll(field, 1, axis=0) - 2.0 * field + np.roll(field, -1, axis=0)) / step**2
    first = (np.roll(field, -1, axis=0) - np.roll(field, 1, axis=0)) / (2.0 * step)
    around = (np.roll(field, 1, axis=1) - 2.0 * field + np.roll(field, -1, axis=1)) / step**2
    laplace = second - np.tan(latitude) * first + around / np.cos(latitude) ** 2
    assert np.abs(laplace[inner] + 12.0 * field[inner]).max() < 1e-2


def test_the_silhouette_is_the_outermost_line_that_touches_the_relief() -> None:
    body = body_named("FENWYCK")
    terrain = terrain_of(body, 3)
    sighting, attitude = _seen(SMALL, body, 30.0, (47.5, 47.5), 40.0)
    spheres = prepare(SMALL, attitude, [Scenery(sighting, terrain)], [sighting], body.name)
    axes, eye = spheres.axes[0], spheres.eye[0]
    for k in range(0, SILHOUETTE, 101):
        angle = 2.0 * np.pi * k / SILHOUETTE
        out = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
        psi = np.linspace(1.2, 1.9, 5000)[:, None]
        p = np.sin(psi) * out - np.cos(psi) * axes[2]
        row = (np.degrees(np.arcsin(p[:, 2])) + 90.0) / STEP_DEG + PAD
        column = np.degrees(np.arctan2(p[:, 1], p[:, 0])) % 360.0 / STEP_DEG + PAD
        rho = 1.0 + map_coordinates(terrain.heights.astype(float), [row, column], order=3)
        top = np.arctan2(rho * np.sin(psi[:, 0]), np.linalg.norm(eye) - rho * np.cos(psi[:, 0])).max()
        # A thousandth of the heights' own spread.
        assert spheres.silhouette[0, k + 1] == pytest.approx(top, rel=5e-6)


def test_limbs_scatter_about_the_told_radii() -> None:
    body = body_named("FENWYCK")
    lifts = []
    for seed in range(3):
        terrain = terrain_of(body, seed)
        for way in np.random.default_rng(seed + 50).standard_normal((10, 3)):
            eye = 200.0 * way / np.linalg.norm(way)
            edge = trace_silhouette(eye, axes_of_sight(eye), terrain.heights, terrain.highest)
            lifts.append((200.0 * np.sin(edge).mean() - 1.0) / terrain.rms)
    # Thirty limbs whose means scatter by a sixth of the rms; the mean surface lies a third of it lower.
    assert abs(np.mean(lifts)) < 0.12


def test_relief_shows_at_the_limb_and_lumps_more() -> None:
    body = body_named("FENWYCK")
    terrain = terrain_of(body, 3)
    lumps = lumpy(terrain, 0.03, np.random.default_rng(1))
    sighting, attitude = _seen(SMALL, body, 30.0, (47.5, 47.5), 20.0)
    edges = [
        prepare(SMALL, attitude, [Scenery(sighting, t)], [sighting], body.name).silhouette[0, 1:-2]
        for t in (smooth_terrain(), terrain, lumps)
    ]
    rough, broad = (np.std(edge / edges[0] - 1.0) for edge in edges[1:])
    assert 0.3 * terrain.rms < rough < 1.5 * terrain.rms
    assert broad > 5.0 * rough


def test_a_nearer_body_hides_and_a_sunward_one_shades() -> None:
    optics, ball = SMALL, _ball(law="lommel_seeliger")
    behind, attitude = _seen(optics, ball, 20.0, (47.5, 47.5), 0.0)
    ahead = behind.place_km / np.linalg.norm(behind.place_km)
    front = replace(behind, body=replace(ball, name="FRONT"), place_km=behind.place_km - 4000.0 * ahead)
    dark = replace(front, sun=ahead)
    spheres = prepare(
        optics, attitude, [Scenery(behind, smooth_terrain()), Scenery(dark, smooth_terrain())], [behind, dark], "BALL"
    )
    light = gather_light(optics, NO_WINGS, spheres)
    assert light.total[47, 47] == 0.0
    # With the Sun behind the camera the unseen shadow of the nearer body lies where it hides the farther one.
    alone = prepare(optics, attitude, [Scenery(behind, smooth_terrain())], [behind, front], "BALL")
    shaded = gather_light(optics, NO_WINGS, alone).total
    whole = _light(optics, behind, attitude, smooth_terrain()).total
    assert whole[47, 47] == pytest.approx(1.0, abs=1e-3)
    assert shaded[47, 47] == 0.0
    assert shaded.sum() < 0.05 * whole.sum()


def test_haze_lifts_the_limb_by_about_its_scale_height() -> None:
    optics, ball = SMALL, _ball(law="lommel_seeliger")
    sighting, attitude = _seen(optics, ball, 25.0, (47.5, 47.5), 30.0)
    haze_km = 2.0 * ball.mean_radius_km / 25.0
    spheres = prepare(optics, attitude, [Scenery(sighting, smooth_terrain(), haze_km)], [sighting], "BALL")
    hazy = gather_light(optics, NO_WINGS, spheres).total
    clear = _light(optics, sighting, attitude, smooth_terrain()).total
    ring = np.hypot(*(np.indices(hazy.shape) - 47.5))
    for low, high in ((27.0, 29.0), (31.0, 33.0), (35.0, 37.0)):
        band = (ring > low) & (ring < high)
        assert hazy[band].mean() > clear[band].mean() + 1e-4
    bright = [hazy[(ring > r - 1.0) & (ring < r + 1.0)].mean() for r in (33.0, 37.0)]
    # Four pixels are two scale heights.
    assert bright[0] / bright[1] == pytest.approx(np.exp(2.0), rel=0.15)
