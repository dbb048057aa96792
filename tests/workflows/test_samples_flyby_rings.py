"""Rings of the flyby sample against closed forms, SPICE and numerical experiments."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import spiceypy
import yaml
from numpy.typing import NDArray
from scipy.special import ndtr

from tests.support import pilotage
from workflows.samples.attitude import looking_at, shortest_turn
from workflows.samples.cameras import SampleCamera, unproject
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_bodies import Scenery, prepare
from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.flyby_expose import Scene, compose
from workflows.samples.flyby_options import FlybyOptions
from workflows.samples.flyby_plan import Shot, plan_shots
from workflows.samples.flyby_rays import Spheres
from workflows.samples.flyby_render import Light
from workflows.samples.flyby_ring_plan import (
    KIND,
    TRAP,
    plan_ring_shot,
    plan_ring_shots,
    project_ring_points,
    true_radii,
)
from workflows.samples.flyby_ring_rays import RingDisc, in_plane, lit_share, ring_light, scattered
from workflows.samples.flyby_ring_render import cell_kernels, gather_ring_light
from workflows.samples.flyby_ring_scene import plane_from_j2000, prepare_rings, sorted_edges
from workflows.samples.flyby_ring_system import FEATURES, RING_BODIES, RINGED, RingScene, edge_radii, ring_catalogue
from workflows.samples.flyby_ring_truth import RINGS, WHOLE, bound, ring_information, widest_bow
from workflows.samples.flyby_system import Sighting, body_state, equator_from_pole, sun_state
from workflows.samples.flyby_terrain import smooth_terrain
from workflows.samples.flyby_time import et_from_utc

Floats = NDArray[np.float64]
NO_WINGS = (0.0, 1.0)
CAMERAS = flyby_cameras()
SMALL = replace(CAMERAS["voyager_na"].optics, shape_vu=(160, 160), principal_point_vu=(79.5, 79.5), psf_sigma_px=0.6)
FINE = replace(
    SMALL, shape_vu=(320, 320), k_px_per_mm=tuple(tuple(2.0 * k for k in row) for row in SMALL.k_px_per_mm),  # type: ignore[arg-type]
    principal_point_vu=(159.5, 159.5), psf_sigma_px=1.2,
)  # fmt: skip
OPTIONS = FlybyOptions(
    frames=1, ring_frames=3, seed=11, processes=1, cameras=("lorri_4x4", "cassini_nac_sum2"), diameter_px=(6.0, 60.0),
    trap_share=0.0, smooth=True,
)  # fmt: skip


def _shot(
    longitude_deg: float,
    radius_km: float,
    opening_deg: float,
    km_per_px: float,
    bearing_deg: float = 40.0,
    speed_kms: float = 0.0,
    optics: SampleCamera = SMALL,
) -> Shot:
    """A frame of a small camera that looks at one point of the rings."""
    base = plan_ring_shot(0, replace(OPTIONS, cameras=("voyager_na",)))
    longitude, opening, bearing = np.radians([longitude_deg, opening_deg, bearing_deg])
    aim = radius_km * np.array([np.cos(longitude), np.sin(longitude), 0.0])
    way = np.array([np.cos(opening) * np.cos(bearing), np.cos(opening) * np.sin(bearing), np.sin(opening)])
    turn = plane_from_j2000()
    place, velocity = body_state(RINGED, base.et)
    position = place + turn.T @ (aim + km_per_px / optics.rad_per_px * way)
    drift = speed_kms * np.array([0.36, -0.8, 0.48])
    level = looking_at(turn.T @ -way, 1.15)
    truth = shortest_turn(np.array([0.0, 0.0, 1.0]), unproject(optics, optics.centre_vu[None])[0]) @ level
    camera = replace(base.camera, optics=optics, wings=NO_WINGS)
    return replace(
        base, camera=camera, position_km=position, velocity_kms=velocity + drift, truth=truth, apriori=truth,
        ring=RingScene(aim), smooth=True, snr=50.0,
    )  # fmt: skip


def _spheres(shot: Shot, sightings: list[Sighting] | None = None) -> Spheres:
    seen = shot.sightings() if sightings is None else sightings
    clothed = [Scenery(sighting, smooth_terrain()) for sighting in seen]
    return prepare(shot.seen_with, shot.truth, clothed, seen, RINGED.name)


def _disc(shot: Shot) -> RingDisc:
    assert shot.ring is not None
    disc = prepare_rings(shot, shot.ring, np.random.default_rng(3))
    return disc._replace(waves=np.zeros((0, 5)), spokes=np.zeros((0, 6)), propellers=np.zeros((0, 5)))


def _light(shot: Shot) -> Light:
    return gather_ring_light(shot.seen_with, NO_WINGS, _spheres(shot), _disc(shot))


def _name(name: str) -> int:
    return next(k for k, feature in enumerate(FEATURES) if feature.name == name)


def _true_edge(shot: Shot, name: str, which: int, longitudes: Floats) -> Floats:
    """Radii of an edge by the formula of the archive's description, written out once more."""
    f = FEATURES[_name(name)]
    place, _ = body_state(RINGED, shot.et)
    then = shot.et - np.linalg.norm(place - shot.position_km) / 299_792.458
    days = (then - et_from_utc(datetime(1998, 1, 1))) / 86_400.0
    a = true_radii(shot.seed)[name] + which * f.width_km
    e = f.ae_km / f.a_km
    peri = np.radians(f.peri_deg + f.peri_rate_deg_day * days)
    radius = a * (1.0 - e**2) / (1.0 + e * np.cos(longitudes - peri))
    for mode in f.modes:
        radius -= mode.amplitude_km * np.cos(
            mode.m * (longitudes - np.radians(mode.longitude_deg + mode.speed_deg_day * days))
        )
    return np.asarray(radius)


@pytest.mark.parametrize(
    ("name", "which", "opening", "scale", "speed"),
    [
        ("B outer edge", 0, 33.0, 4.0, 0.0),
        ("A gap 1", 1, -71.0, 9.0, 0.0),
        ("Ringlet 6", 0, 12.0, 3.0, 0.0),
        ("A outer edge", 0, 2.0, 6.0, 0.0),
        ("B outer edge", 0, 33.0, 2.0, 11.0),
    ],
)
def test_edges_lie_where_the_formula_puts_them(
    name: str, which: int, opening: float, scale: float, speed: float
) -> None:
    feature = FEATURES[_name(name)]
    shot = _shot(65.0, feature.a_km + which * feature.width_km, opening, scale, 20.0, speed)
    optics = shot.seen_with
    image = _light(shot).total
    longitudes = np.radians(65.0) + np.linspace(-0.3, 0.3, 200_001)
    radius = _true_edge(shot, name, which, longitudes)
    points = np.stack([radius * np.cos(longitudes), radius * np.sin(longitudes), 0.0 * radius], axis=1)
    # Light time and aberration once more, in the barycentre's frame: each point where it was, seen by one who moves.
    place, velocity = body_state(RINGED, shot.et)
    apart = points @ plane_from_j2000() + (place - shot.position_km)
    for _ in range(4):
        back = np.linalg.norm(apart, axis=1, keepdims=True) / 299_792.458
        apart = points @ plane_from_j2000() + (place - velocity * back - shot.position_km)
    seen = apart / np.linalg.norm(apart, axis=1, keepdims=True) + shot.velocity_kms / 299_792.458
    camera_xyz = seen @ shot.truth.T
    k = optics.k_px_per_mm[0][0] * optics.focal_length_mm
    at = k * camera_xyz[:, 1::-1] / camera_xyz[:, 2:] + np.array(optics.principal_point_vu)
    keep = np.all((at > 12.0) & (at < 147.0), axis=1)
    at = at[keep]
    tangent = np.gradient(at, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    v, u = np.indices(image.shape)
    pixels = np.stack([v.ravel(), u.ravel()], axis=1).astype(float)
    sample = at[:: max(1, len(at) // 4000)], normal[:: max(1, len(at) // 4000)]
    nearest = np.argmin(((pixels[:, None, :] - sample[0][None]) ** 2).sum(axis=2), axis=1)
    beyond = ((pixels - sample[0][nearest]) * sample[1][nearest]).sum(axis=1)
    inner = np.linalg.norm(pixels - sample[0][nearest], axis=1) < 3.0
    sigma = np.sqrt(optics.psf_sigma_px**2 + 1.0 / 12.0)
    x, light = beyond[inner], image.ravel()[inner]
    shape = ndtr(x / sigma)
    slope = np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    design = np.stack([np.ones_like(x), x, shape, slope], axis=1)
    fit = np.linalg.lstsq(design, light, rcond=None)[0]
    assert inner.sum() > 400
    assert abs(fit[3] / fit[2]) < 0.02, fit[3] / fit[2]


def test_cells_spread_as_wide_as_the_point_spread_function() -> None:
    for sigma in (0.27, 0.54, 0.85):
        share, slope = cell_kernels(sigma)
        taps = np.arange(share.shape[1]) - share.shape[1] // 2
        assert share.sum() == pytest.approx(1.0, abs=1e-12)
        variance = (share * (taps[None, :] - np.array([[-0.25], [0.25]])) ** 2).sum()
        # Core and pixel; the cell's own share is left to the cell.
        assert variance + 0.25 / 12.0 == pytest.approx(sigma**2 + 1.0 / 12.0, abs=0.01)
        assert slope.sum() == pytest.approx(0.0, abs=1e-9)


def test_brightness_is_chandrasekhars_single_scattering() -> None:
    mu, mu0, tau = 0.37, 0.22, 0.8
    depth = np.linspace(0.0, tau, 200_001)
    middle, step = 0.5 * (depth[1:] + depth[:-1]), depth[1]
    seen_from_lit = (np.exp(-middle / mu0) * np.exp(-middle / mu)).sum() * step / mu
    from_behind = (np.exp(-middle / mu0) * np.exp(-(tau - middle) / mu)).sum() * step / mu
    assert scattered(tau, 1.0, mu, mu0, True) == pytest.approx(seen_from_lit, rel=1e-6)
    assert scattered(tau, 1.0, mu, mu0, False) == pytest.approx(from_behind, rel=1e-6)
    assert scattered(tau, 1.0, mu, mu, False) == pytest.approx(scattered(tau, 1.0, mu + 2e-4, mu, False), rel=1e-3)


def test_stretches_of_radii_are_averaged_exactly() -> None:
    disc = _disc(_shot(10.0, 57_000.0, 40.0, 3.0))
    fine = np.linspace(56_300.0, 58_400.0, 210_001)
    lights = np.array([ring_light(disc, r, 1.0, 1e-3, 0.6, 0.3, True, True) for r in fine[::10]])
    whole = ring_light(disc, 57_350.0, 1.0, 2_100.0, 0.6, 0.3, True, True)
    assert whole == pytest.approx(lights.mean(axis=0), rel=2e-3)


def test_no_edges_cross_and_regions_follow_the_catalogue() -> None:
    shot = plan_ring_shot(0, OPTIONS)
    disc = _disc(shot)
    for day in (0.0, 400.0, 4000.0):
        longitudes = np.linspace(0.0, 2.0 * np.pi, 2000)
        rows = [edge_radii(FEATURES[k], edge, longitudes, shot.et + 86_400.0 * day) for edge, k in sorted_edges()]
        assert np.diff(np.stack(rows), axis=0).min() > 2.0
    middles = {f.name: f.a_km + 0.5 * f.width_km for f in FEATURES if f.width_km}
    for name, middle in middles.items():
        if name in ("C gap 1", "C gap 2", "A gap 1", "Division gap 4"):
            continue
        # Narrow eccentric ringlets are met where they are.
        f = FEATURES[_name(name)]
        a = np.radians(f.peri_deg)
        radius = float(_true_edge(shot, name, 0, np.array([a]))[0]) + 0.5 * f.width_km
        _, through = ring_light(disc, radius, a % (2.0 * np.pi), 0.5, 1.0, 1.0, True, True)
        assert through == pytest.approx(np.exp(-f.tau), rel=1e-6), (name, middle)


def test_the_planet_throws_its_shadow_on_the_rings() -> None:
    disc = _disc(_shot(0.0, 50_000.0, 30.0, 10.0))
    equator, pole = RINGED.radii_km[0], RINGED.radii_km[2]
    rng = np.random.default_rng(2)
    for _ in range(300):
        radius, longitude = rng.uniform(30_000.0, 79_000.0), rng.uniform(0.0, 2.0 * np.pi)
        point = radius * np.array([np.cos(longitude), np.sin(longitude), 0.0])
        # Step along the ray to the Sun and look whether it enters the spheroid.
        steps = point + np.linspace(0.0, 2.0e5, 20_001)[:, None] * disc.sun
        height = np.sqrt((steps[:, 0] ** 2 + steps[:, 1] ** 2) / equator**2 + steps[:, 2] ** 2 / pole**2).min()
        share = lit_share(disc, point[0], point[1], 1.0)
        if abs(height - 1.0) > 0.004:
            assert share == (1.0 if height > 1.0 else 0.0)
    half = np.array([lit_share(disc, -r * disc.sun[0], -r * disc.sun[1], 1.0) for r in np.linspace(27e3, 79e3, 999)])
    assert half.min() == 0.0


def test_rings_before_and_behind_the_planet() -> None:
    shot = _shot(40.0, 30_000.0, 20.0, 800.0, 40.0)
    dark = [s for s in shot.sightings() if s.body.name == RINGED.name]
    light = gather_ring_light(shot.seen_with, NO_WINGS, _spheres(shot, dark), _disc(shot))
    planet = dark[0]
    centre = project_ring_points(
        shot.seen_with, shot.truth, shot.position_km, shot.velocity_kms, shot.et, np.zeros((1, 3))
    )[0]
    near, far = (
        np.rint(
            project_ring_points(
                shot.seen_with,
                shot.truth,
                shot.position_km,
                shot.velocity_kms,
                shot.et,
                radius * np.array([[np.cos(np.radians(40.0)), np.sin(np.radians(40.0)), 0.0]]),
            )[0]
        ).astype(int)
        for radius in (49_500.0, -49_500.0)
    )
    radius_px = planet.radius_rad / shot.seen_with.rad_per_px
    assert np.hypot(*(near - centre)) < 0.9 * radius_px
    assert np.hypot(*(far - centre)) < 0.9 * radius_px
    # The near arm shines before the disc, the far one is hidden.
    assert light.target[tuple(near)] > 0.0
    assert light.target[tuple(far)] == 0.0


def test_a_moon_behind_rings_is_dimmed_by_their_slant_depth() -> None:
    shot = _shot(0.0, 62_000.0, 50.0, 6.0)
    disc = _disc(shot)._replace(scatter=np.zeros(71))
    turn, moon = plane_from_j2000(), RING_BODIES[4]
    place = body_state(RINGED, shot.et)[0]
    aim = place + turn.T @ np.array([62_000.0, 0.0, 0.0])
    sight = aim - shot.position_km
    sun = -sight / np.linalg.norm(sight)
    lights = []
    for beyond in (1.002, 0.998):
        seen = Sighting(moon, beyond * sight, np.eye(3), sun)
        planet = next(s for s in shot.sightings() if s.body.name == RINGED.name)
        spheres = prepare(
            shot.seen_with, shot.truth, [Scenery(s, smooth_terrain()) for s in (seen, planet)], [seen, planet],
            RINGED.name,
        )  # fmt: skip
        lights.append(gather_ring_light(shot.seen_with, NO_WINGS, spheres, disc).total[79, 79])
    mu = abs(float(turn[2] @ sight)) / np.linalg.norm(sight)
    assert lights[0] / lights[1] == pytest.approx(np.exp(-0.6 / mu), rel=1e-3)


def _quiet(shot: Shot) -> tuple[Scene, RingDisc]:
    scene = compose(shot, np.random.default_rng(4))
    assert scene.disc is not None
    return scene, scene.disc


def test_cramer_rao_is_what_a_fit_of_planted_errors_reaches() -> None:
    shot = _shot(65.0, 57_600.0, 60.0, 40.0)
    scene, disc = _quiet(shot)
    useless = np.zeros(SMALL.shape_vu, dtype=bool)
    information, _, prior = ring_information(shot, scene, disc, useless)
    covariance = np.linalg.inv(bound(information, RINGS, prior)[:2, :2])
    # Derivatives by drawing the rings again with each feature moved, and shifts by turning the camera; on finer pixels,
    # so that the grain of the sampling does not pass for knowledge.
    variance = SMALL.read_noise_dn**2 + scene.expected / SMALL.gain_e_per_dn
    step, columns, sigmas = 0.5, [], []

    def drawn(there: Shot, edges: Floats) -> Floats:
        there = replace(there, camera=replace(there.camera, optics=FINE))
        light = gather_ring_light(FINE, NO_WINGS, _spheres(there), _disc(there)._replace(edges=edges))
        total: Floats = scene.factor * light.total.reshape(160, 2, 160, 2).mean(axis=(1, 3))
        return total

    owner = np.array([k for _, k in sorted_edges()])
    for axis in (0, 1):
        ends = []
        for sign in (1.0, -1.0):
            unit = sign * 0.1 * np.eye(2)[axis]
            before, after = unproject(SMALL, np.stack([SMALL.centre_vu, SMALL.centre_vu + unit]))
            ends.append(drawn(replace(shot, truth=shortest_turn(before, after) @ shot.truth), disc.edges))
        columns.append((ends[0] - ends[1]) / 0.2)
    for k, feature in enumerate(FEATURES):
        if information[8 + k, 8 + k] > 1e-12:
            ends = [drawn(shot, disc.edges + sign * step * (owner == k)) for sign in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * step))
            sigmas.append(feature.sigma_a_km)
    assert len(sigmas) >= 4
    columns += [scene.scale, np.ones(SMALL.shape_vu)]
    weight = 1.0 / np.sqrt(variance.ravel())
    design = np.stack([c.ravel() * weight for c in columns], axis=1)
    drawn_information = design[:, :2].T @ design[:, :2]
    assert information[3:5, 3:5] == pytest.approx(drawn_information, rel=0.03, abs=0.01 * drawn_information.max())
    precision = np.concatenate([[0.0, 0.0], 1.0 / np.array(sigmas) ** 2, [0.0, 0.0]])
    rng = np.random.default_rng(9)
    errors = rng.standard_normal((600, len(sigmas))) * sigmas
    data = design[:, 2 : 2 + len(sigmas)] @ errors.T + rng.standard_normal((len(design), 600))
    found = np.linalg.solve(design.T @ design + np.diag(precision), design.T @ data)[:2]
    assert np.linalg.inv(np.cov(found)) == pytest.approx(np.linalg.inv(covariance), rel=0.2)
    assert np.sqrt(np.diag(np.cov(found))) == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.12)


def test_straight_edges_leave_one_direction_unknown() -> None:
    shot = _shot(65.0, 55_630.0, 80.0, 0.6)
    scene, disc = _quiet(shot)
    information, alone, prior = ring_information(shot, scene, disc, np.zeros(SMALL.shape_vu, dtype=bool))
    values, vectors = np.linalg.eigh(bound(information, RINGS, prior)[:2, :2])
    # Across the edge nothing is better known than the catalogue's radius, along it only by a sagitta of 0.03 px.
    assert 1.0 / np.sqrt(values[1]) == pytest.approx(1.0 / 0.6, rel=0.05)
    assert 1.0 / np.sqrt(values[0]) > 3.0
    points = _edge_points(shot, 55_630.0)
    chord = points[1] - points[0]
    # Modes tilt the edge by a few thousandths of a radian.
    assert abs(vectors[:, 1] @ chord) < 1e-2 * np.linalg.norm(chord)
    assert (alone > 16.0).sum() == 1
    everything = bound(information, WHOLE, prior)[:2, :2]
    assert np.linalg.eigvalsh(everything)[1] == pytest.approx(values[1], rel=0.05)


def test_bows_are_the_sagittas_of_circles() -> None:
    for scale, radius in ((0.6, 55_630.0), (40.0, 57_600.0)):
        shot = _shot(65.0, radius, 80.0, scale)
        scene, disc = _quiet(shot)
        useless = np.zeros(SMALL.shape_vu, dtype=bool)
        _, alone, _ = ring_information(shot, scene, disc, useless)
        seen = [int(k) for k in np.flatnonzero(alone > 16.0)]
        # The longest chord is between the array's side and its diagonal.
        sagittas = [n**2 / 8.0 / (radius / scale) for n in (160.0, 160.0 * np.sqrt(2.0))]
        bow = widest_bow(shot, scene, disc, useless, seen)
        assert 0.7 * sagittas[0] < bow < 1.4 * sagittas[1] + 0.1


def _edge_points(shot: Shot, radius_km: float) -> Floats:
    """Pixels of two points of a circle beside the one that the camera looks at."""
    longitudes = np.radians(65.0) + np.array([-1e-4, 1e-4])
    points = radius_km * np.stack([np.cos(longitudes), np.sin(longitudes), [0.0, 0.0]], axis=1)
    return project_ring_points(shot.seen_with, shot.truth, shot.position_km, shot.velocity_kms, shot.et, points)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rings") / "archive"
    make_flyby_sample(folder, OPTIONS)
    return folder


@pytest.fixture
def kernels(archive: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(archive / "kernels")
    try:
        spiceypy.kclear()
        spiceypy.furnsh("meta.tm")
        yield
    finally:
        spiceypy.kclear()
        os.chdir(before)


@pytest.mark.usefixtures("kernels")
def test_ring_points_are_where_spice_puts_them() -> None:
    for shot in plan_ring_shots(OPTIONS):
        disc, optics = _disc(shot), shot.seen_with
        craft, planet = str(shot.camera.spacecraft.naif_id), RINGED.name
        assert [round(float(x), 9) for x in spiceypy.bodvrd(planet, "RADII", 3)[1]] == list(RINGED.radii_km)
        ahead = shot.truth.T @ unproject(optics, optics.centre_vu[None])[0]
        # The ray that reaches the camera left a point fixed in the planet's turning axes; SPICE finds it by iteration.
        guess = np.array([*in_plane(disc, *(shot.truth @ ahead))[1:3], 0.0])
        turn = plane_from_j2000()
        then = shot.et - np.linalg.norm(turn.T @ guess - turn.T @ disc.eye) / 299_792.458
        fixed = spiceypy.pxform("J2000", f"IAU_{planet}", then) @ turn.T @ guess
        place, _ = spiceypy.spkcpt(fixed, planet, f"IAU_{planet}", shot.et, "J2000", "OBSERVER", "CN+S", craft)
        at = place[:3] / np.linalg.norm(place[:3])
        # A hundredth of a pixel: (v/c)^2 and what SPICE and the plane's closed form make of it.
        assert np.linalg.norm(at - ahead) < 0.01 * optics.rad_per_px
        node = equator_from_pole(RINGED.pole_deg)[:, 0]
        pole = spiceypy.pxform(f"IAU_{planet}", "J2000", shot.et)[:, 2]
        assert np.cross([0.0, 0.0, 1.0], pole) @ node == pytest.approx(np.hypot(pole[0], pole[1]), abs=1e-9)
        sun, _ = spiceypy.spkpos("SUN", shot.et, "J2000", "LT", planet)
        assert turn @ sun / np.linalg.norm(sun) == pytest.approx(disc.sun, abs=1e-5)
        assert sun_state(shot.et)[0] == pytest.approx(spiceypy.spkpos("SUN", shot.et, "J2000", "NONE", "SSB")[0])


def test_the_archive_holds_catalogue_and_truth(archive: Path) -> None:
    described = yaml.safe_load((archive / "archive.yaml").read_text())
    assert described["rings"] == "rings.yaml"
    assert {body.name for body in RING_BODIES} < set(described["bodies"])
    told = yaml.safe_load((archive / "rings.yaml").read_text())
    assert told == ring_catalogue()
    truth = json.loads((archive / "truth.json").read_text())
    assert len(truth["frames"]) == 4
    rings = [entry for entry in truth["frames"].values() if entry["kind"] == KIND]
    assert len(rings) == 3
    for entry in rings:
        assert (entry["opening_deg"] * entry["opening_sun_deg"] > 0.0) == entry["lit_side"]
        alone = entry["rings_alone"]
        assert np.hypot(alone["observable_dv"], alone["observable_du"]) == pytest.approx(1.0, abs=1e-5)
        for name, radius in entry["features"].items():
            assert radius == truth["rings"][name]["true_a_km"]


def test_planted_radius_errors_have_the_stated_distribution() -> None:
    pulls = np.array(
        [[(true_radii(seed)[f.name] - f.a_km) / f.sigma_a_km for f in FEATURES] for seed in range(60)]
    ).ravel()
    # 2280 draws: mean to 0.021, rms to 0.015.
    assert abs(pulls.mean()) < 0.08
    assert pulls.std() == pytest.approx(1.0, abs=0.06)
    assert (np.abs(pulls) < 2.0).mean() == pytest.approx(0.954, abs=0.02)


def test_traps_move_one_feature_by_three_pixels() -> None:
    for shot in plan_ring_shots(replace(OPTIONS, ring_frames=4, trap_share=1.0)):
        assert shot.kind == TRAP
        assert shot.ring is not None
        assert shot.ring.moved in {f.name for f in FEATURES}
        plain = replace(shot, ring=RingScene(shot.ring.aim_km))
        change = _disc(shot).edges - _disc(plain).edges
        owner = np.array([k for _, k in sorted_edges()])
        assert np.abs(change[:, owner != _name(shot.ring.moved)]).max() == 0.0
        assert np.abs(change[:, owner == _name(shot.ring.moved)] - shot.ring.moved_km).max() < 0.05
        assert np.diff(_disc(shot).edges, axis=1).min() > 0.0
        ends = np.stack([shot.ring.aim_km, shot.ring.aim_km * (1.0 + 1e-5)])
        at = project_ring_points(shot.seen_with, shot.truth, shot.position_km, shot.velocity_kms, shot.et, ends)
        px_per_km = np.linalg.norm(at[1] - at[0]) / np.linalg.norm(ends[1] - ends[0])
        assert abs(shot.ring.moved_km) * px_per_km == pytest.approx(3.0, abs=0.05)


def test_planned_frames_cover_openings_scales_and_sides() -> None:
    planned = plan_ring_shots(FlybyOptions(frames=5, ring_frames=80, seed=2))
    assert len({shot.image_id for shot in planned}) == 80
    assert min(shot.index for shot in planned) == 5
    turn, openings, scales = plane_from_j2000(), [], []
    for shot in planned:
        assert shot.ring is not None
        back = turn @ (shot.position_km - body_state(RINGED, shot.et)[0]) - shot.ring.aim_km
        distance = float(np.linalg.norm(back))
        openings.append(float(np.degrees(np.arcsin(back[2] / distance))))
        scales.append(distance * shot.camera.optics.rad_per_px)
        assert 2.9 < shot.snr < 100.1
        assert np.all(np.abs(shot.offset_vu) <= 0.9 * np.array(shot.camera.optics.search_margin_vu))
    assert min(np.abs(openings)) < 2.0
    assert max(np.abs(openings)) > 75.0
    assert min(openings) < 0.0 < max(openings)
    assert min(scales) < 2.0
    assert max(scales) > 120.0


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_same_seed_gives_the_same_bytes_whatever_the_processes(archive: Path, tmp_path: Path) -> None:
    make_flyby_sample(tmp_path / "again", replace(OPTIONS, processes=2))
    assert _bytes(tmp_path / "again") == _bytes(archive)


def test_frames_of_bodies_do_not_depend_on_those_of_rings(archive: Path, tmp_path: Path) -> None:
    make_flyby_sample(tmp_path / "bodies", replace(OPTIONS, ring_frames=0))
    (image_id,) = (shot.image_id for shot in plan_shots(OPTIONS))
    for path in (tmp_path / "bodies" / "data").glob(f"{image_id}*"):
        assert path.read_bytes() == (archive / "data" / path.name).read_bytes()
    ours, theirs = (json.loads((folder / "truth.json").read_text()) for folder in (tmp_path / "bodies", archive))
    assert ours["frames"][image_id] == theirs["frames"][image_id]
    assert "rings" not in yaml.safe_load((tmp_path / "bodies" / "archive.yaml").read_text())


def test_frames_of_rings_alone_can_be_asked_for(tmp_path: Path) -> None:
    ended = pilotage("sample", "flyby", tmp_path / "new", "--frames", 0, "--ring-frames", 0)
    assert "frames must lie in" in ended.refusal()


def test_information_is_that_of_the_pixels_that_count() -> None:
    shot = _shot(65.0, 57_600.0, 25.0, 10.0)
    scene, disc = _quiet(shot)
    half = np.zeros(SMALL.shape_vu, dtype=bool)
    half[:, 80:] = True
    parts = [ring_information(shot, scene, disc, mask)[0] for mask in (half, ~half, np.zeros_like(half))]
    assert parts[0] + parts[1] == pytest.approx(parts[2], rel=1e-9, abs=1e-9)
    assert np.linalg.eigvalsh(parts[2]).min() > -1e-9 * np.linalg.eigvalsh(parts[2]).max()
