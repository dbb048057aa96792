"""Take one frame of the flyby sample: light of bodies and stars, stray light, the detector, and what was lost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from workflows.samples.cameras import FloatArray, SampleCamera, project, unproject
from workflows.samples.flyby_bodies import Scenery, centre_and_radius, prepare
from workflows.samples.flyby_plan import Shot
from workflows.samples.flyby_rays import HAZE_HEIGHTS, Spheres, approach
from workflows.samples.flyby_render import BORDER_PX, Light, gather_light
from workflows.samples.flyby_ring_rays import RingDisc
from workflows.samples.flyby_ring_render import gather_ring_light
from workflows.samples.flyby_ring_scene import prepare_rings
from workflows.samples.flyby_system import PLANET_ID, Sighting
from workflows.samples.flyby_terrain import lumpy, smooth_terrain, terrain_of
from workflows.samples.photometry import Exposure
from workflows.samples.render import add_stars
from workflows.samples.scene import Sources

FULLEST = 0.9
"""Share of the full scale that the light of a frame reaches at most, unless it is overexposed."""
LIT_SHARE = 0.1
"""Pixels of the target brighter than this share of its bright ones are its lit disc."""
LUMP_RMS = (0.02, 0.04)
UNTOLD_HAZE_PX = (1.5, 6.0)
GHOST_SHARE = (0.1, 0.4)
GHOST_SHIFT_PX = (30.0, 140.0)
STRAY_SHARE = 0.02
"""Stray light across the frame, of the disc's."""
STAR_COUNT = 14.0
STAR_SNR = (6.0, 150.0)
STEP_PX = 0.05
"""Half step of the stars' numerical derivatives."""
BYTE_TOP = 240.0
"""Frames of Cassini that stay below may be stored as bytes."""


@dataclass(frozen=True)
class Scene:
    """Everything that shines in a frame, noise-free, in DN.

    Attributes
    ----------
    expected
        (rows, columns) light of all sources and the background, without bias.
    shift_v, shift_u, scale
        (rows, columns) derivatives of it with respect to a shift by one pixel, and to the sources' brightness.
    factor
        DN of a source of brightness one.
    spheres, disc
        The bodies, and the rings of a frame of rings, as the rays see them.
    stars
        Table of the field's stars, as seen.
    n_stars
        Stars in the frame.
    bodies
        Pixel (2,) of the centre, diameter (px) and told name of every body whose disc touches the array.
    """

    expected: FloatArray
    shift_v: FloatArray
    shift_u: FloatArray
    scale: FloatArray
    factor: float
    spheres: Spheres
    disc: RingDisc | None
    snr: float
    stars: pd.DataFrame
    n_stars: int
    bodies: dict[str, tuple[FloatArray, float]]


@dataclass(frozen=True)
class Taken:
    """A stored frame: its pixels, which of them carry no information, and how many lines were lost."""

    image: FloatArray
    useless: NDArray[np.bool_]
    missing_lines: int
    as_bytes: bool


def _is_near(shot: Shot, optics: SampleCamera, sighting: Sighting, haze_km: float) -> bool:
    """Whether any of a body's light can fall on the array or just beside it."""
    if (shot.truth @ sighting.place_km)[2] <= 0.0:
        return False
    centre, radius = centre_and_radius(optics, shot.truth, sighting)
    body = sighting.body
    widest = max(body.radii_km) + HAZE_HEIGHTS * haze_km
    reach = 1.05 * radius * widest / body.mean_radius_km + BORDER_PX + 4.0
    shape = np.array(optics.shape_vu)
    beyond = np.maximum(np.maximum(-centre, centre - shape + 1.0), 0.0)
    return bool(np.hypot(*beyond) < reach)


def _scenery(shot: Shot, sighting: Sighting, rng: np.random.Generator) -> Scenery:
    """Clothe a body in its terrain, and the target of a trap in what nobody tells."""
    body = sighting.body
    terrain = smooth_terrain() if shot.smooth else terrain_of(body, shot.seed)
    haze_km = shot.haze_km if body.naif_id == PLANET_ID else 0.0
    if body.name == shot.target and shot.kind == "lumpy":
        terrain = lumpy(terrain, float(rng.uniform(*LUMP_RMS)), rng)
    if body.name == shot.target and shot.kind == "haze":
        km_per_px = sighting.range_km * shot.camera.optics.rad_per_px
        haze_km = float(rng.uniform(*UNTOLD_HAZE_PX)) * km_per_px
    return Scenery(sighting, terrain, haze_km)


def _level(shot: Shot, light: Light, background_dn: float) -> tuple[float, float]:
    """Return the brightness that gives the lit disc the wanted signal to noise, as far as the detector holds it.

    The second number is the mean light of the target's lit disc for a brightness of one.
    """
    optics = shot.camera.optics
    shining = light.target[light.target > 0.0]
    if not len(shining):
        # The optics bring light from outside the array; its own peak stands for a disc.
        shining = light.total[light.total > 0.0]
    lit = shining[shining > LIT_SHARE * np.percentile(shining, 95.0)]
    mean = float(lit.mean())
    still = optics.read_noise_dn**2 + background_dn / optics.gain_e_per_dn
    half = shot.snr**2 / (2.0 * optics.gain_e_per_dn)
    wanted = half + np.sqrt(half**2 + shot.snr**2 * still)
    room = FULLEST * (optics.saturation_dn - optics.bias_dn - background_dn) / float(light.total.max())
    return room * shot.overexposure if shot.overexposure else min(wanted / mean, room), mean


@numba.njit(cache=True)
def _hidden(spheres, rays):  # type: ignore[no-untyped-def]
    """Whether each line of sight (n, 3) ends on a body."""
    hidden = np.zeros(len(rays), np.bool_)
    for i in range(len(rays)):
        for k in range(len(spheres.law)):
            _, _, _, angle, edge = approach(spheres, k, rays[i, 0], rays[i, 1], rays[i, 2])
            if angle < edge:
                hidden[i] = True
    return hidden


def _stars(
    shot: Shot, spheres: Spheres, background_dn: float, rng: np.random.Generator
) -> tuple[pd.DataFrame, Sources]:
    """Draw stars around the field; returns the table of places as seen, and those that shine into the frame."""
    optics = shot.camera.optics
    shape = np.array(optics.shape_vu, dtype=np.float64)
    beyond = 2.0 * np.array(optics.search_margin_vu) + 40.0
    count = int(rng.poisson(STAR_COUNT * np.prod(shape + 2.0 * beyond) / np.prod(shape))) if shot.stars else 0
    pixels = rng.uniform(-beyond, shape - 1.0 + beyond, (count, 2))
    snr = np.exp(rng.uniform(np.log(STAR_SNR[0]), np.log(STAR_SNR[1]), count))
    area = 4.0 * np.pi * (optics.psf_sigma_px**2 + 1.0 / 12.0)
    noise2 = optics.read_noise_dn**2 + background_dn / optics.gain_e_per_dn
    half = snr**2 / (2.0 * optics.gain_e_per_dn)
    flux = half + np.sqrt(half**2 + snr**2 * area * noise2)
    rays = unproject(optics, pixels)
    places = rays @ shot.truth
    table = pd.DataFrame(
        {
            "star_id": [f"{shot.image_id}-{k:03d}" for k in range(count)],
            "ra_deg": np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360.0,
            "dec_deg": np.degrees(np.arcsin(places[:, 2])),
            "mag": -2.5 * np.log10(flux / (optics.star_dn_per_s_mag0 * shot.exposure_s)),
        }
    )
    near = np.all((pixels > -8.0) & (pixels < shape + 7.0), axis=1) & ~_hidden(spheres, rays)
    ids = np.array(table["star_id"], dtype=np.str_)
    all_stars = Sources(ids, np.full(count, "star"), pixels, flux, snr)
    return table, all_stars.take(near)


def _star_light(optics: SampleCamera, stars: Sources, step_vu: tuple[float, float]) -> FloatArray:
    """Return the light (rows, columns) of stars moved by a step."""
    light = np.zeros(optics.shape_vu)
    add_stars(light, optics, replace(stars, vu=stars.vu + np.array(step_vu)), Exposure(1.0, np.zeros(3)))
    return light


def _ghost(light: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the faint displaced copy that a reflection inside the camera makes."""
    angle, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*GHOST_SHIFT_PX)
    shift = np.rint(distance * np.array([np.sin(angle), np.cos(angle)])).astype(int)
    copy = np.zeros_like(light)
    into = tuple(slice(max(s, 0), n + min(s, 0)) for s, n in zip(shift, light.shape, strict=True))
    out = tuple(slice(max(-s, 0), n + min(-s, 0)) for s, n in zip(shift, light.shape, strict=True))
    copy[into] = rng.uniform(*GHOST_SHARE) * light[out]
    return copy


def _background(optics: SampleCamera, stray_dn: float, rng: np.random.Generator) -> FloatArray:
    """Return a level with slopes and a bend: sky, dark current and stray light, never negative."""
    v = np.linspace(-1.0, 1.0, optics.shape_vu[0])[:, None]
    u = np.linspace(-1.0, 1.0, optics.shape_vu[1])[None, :]
    a, b, c, d, e = rng.uniform(-1.0, 1.0, 5)
    stray = stray_dn * (2.5 + a * v + b * u + 0.5 * (c * v * v + d * u * u + e * u * v)) / 2.5
    level: FloatArray = optics.background_dn * rng.uniform(0.7, 1.3) + stray
    return level


def compose(shot: Shot, rng: np.random.Generator) -> Scene:
    """Return what shines in a frame, noise-free."""
    optics = shot.camera.optics
    sightings = shot.sightings()
    told = {s.body.name: shot.haze_km if s.body.naif_id == PLANET_ID else 0.0 for s in sightings}
    near = [s for s in sightings if s.body.name == shot.target or _is_near(shot, optics, s, told[s.body.name])]
    scenery = [_scenery(shot, sighting, rng) for sighting in near]
    spheres = prepare(shot.seen_with, shot.truth, scenery, sightings, shot.target)
    disc = None if shot.ring is None else prepare_rings(shot, shot.ring, rng)
    if disc is None:
        light = gather_light(shot.seen_with, shot.camera.wings, spheres)
    else:
        light = gather_ring_light(shot.seen_with, shot.camera.wings, spheres, disc)
    factor, mean = _level(shot, light, optics.background_dn)
    total = factor * light.total + (factor * _ghost(light.total, rng) if shot.kind == "ghost" else 0.0)
    background = _background(optics, STRAY_SHARE * factor * mean * rng.random(), rng)
    table, stars = _stars(shot, spheres, optics.background_dn, rng)
    moved = [_star_light(optics, stars, step) for step in ((STEP_PX, 0), (-STEP_PX, 0), (0, STEP_PX), (0, -STEP_PX))]
    starlight = _star_light(optics, stars, (0.0, 0.0))
    variance = optics.read_noise_dn**2 + (factor * mean + optics.background_dn) / optics.gain_e_per_dn
    return Scene(
        expected=total + starlight + background,
        shift_v=factor * light.shift_v + (moved[0] - moved[1]) / (2.0 * STEP_PX),
        shift_u=factor * light.shift_u + (moved[2] - moved[3]) / (2.0 * STEP_PX),
        scale=factor * light.total,
        factor=factor,
        spheres=spheres,
        disc=disc,
        snr=float(factor * mean / np.sqrt(variance)),
        stars=table,
        n_stars=int(np.all((stars.vu > 0.0) & (stars.vu < np.array(optics.shape_vu) - 1.0), axis=1).sum()),
        bodies={s.body.name: _disc(shot, s) for s in near if _touches(shot, s)},
    )


def _disc(shot: Shot, sighting: Sighting) -> tuple[FloatArray, float]:
    centre, radius = centre_and_radius(shot.camera.optics, shot.truth, sighting)
    return centre, 2.0 * radius


def _touches(shot: Shot, sighting: Sighting) -> bool:
    """Whether a body's disc, taken for a circle, touches the array."""
    centre, diameter = _disc(shot, sighting)
    shape = np.array(shot.camera.optics.shape_vu)
    beyond = np.maximum(np.maximum(-0.5 - centre, centre - shape + 0.5), 0.0)
    return bool(np.hypot(*beyond) < diameter / 2.0)


def _cosmic_rays(image: FloatArray, noise_dn: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Add short bright tracks to a frame in place; returns where."""
    struck = np.zeros(image.shape, dtype=np.bool_)
    for _ in range(int(rng.poisson(20.0 * image.size / 1e6))):
        start, angle = rng.uniform(0.0, 1.0, 2) * image.shape, rng.uniform(0.0, 2.0 * np.pi)
        steps = np.arange(0.0, 1.0 + rng.exponential(2.0), 0.5)[:, None]
        track = np.rint(start + steps * np.array([np.sin(angle), np.cos(angle)])).astype(int)
        track = np.unique(track[np.all((track >= 0) & (track < image.shape), axis=1)], axis=0)
        image[track[:, 0], track[:, 1]] += noise_dn * 10.0 ** rng.uniform(1.0, 2.3)
        struck[track[:, 0], track[:, 1]] = True
    return struck


def _lost_lines(optics: SampleCamera, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which lines (rows,) never arrived: mostly none, sometimes up to three runs."""
    lost = np.zeros(optics.shape_vu[0], dtype=np.bool_)
    if optics.missing_value is None or rng.random() > 0.15:
        return lost
    for _ in range(int(rng.integers(1, 4))):
        top = int(rng.integers(0, len(lost) - 8))
        lost[top : top + int(rng.integers(1, 9))] = True
    return lost


def take(shot: Shot, scene: Scene, rng: np.random.Generator) -> Taken:
    """Return the stored frame: photon noise, read noise, cosmic rays, bias, rounding, saturation, lost lines."""
    optics = shot.camera.optics
    electrons = rng.poisson(np.maximum(scene.expected, 0.0) * optics.gain_e_per_dn)
    # The stated read noise holds the rounding, so the electronics' share is what is left.
    rounding = 0.0 if shot.camera.stored == "lorri" else 1.0 / 12.0
    image = electrons / optics.gain_e_per_dn
    image += rng.standard_normal(image.shape) * np.sqrt(optics.read_noise_dn**2 - rounding) + optics.bias_dn
    useless = np.zeros(image.shape, dtype=np.bool_)
    if rng.random() < 0.3:
        useless |= _cosmic_rays(image, optics.read_noise_dn, rng)
    useless |= image >= optics.saturation_dn
    image = np.minimum(image, optics.saturation_dn)
    if rounding:
        image = np.maximum(np.rint(image), 0.0)
    as_bytes = shot.camera.stored == "voyager" or bool(rng.random() < 0.5 and image.max() < BYTE_TOP)
    lost = _lost_lines(optics, rng)
    if lost.any():
        image[lost] = float(optics.missing_value or 0)
        useless[lost] = True
    return Taken(image, useless, int(lost.sum()), as_bytes)


def predicted_centre(shot: Shot, sighting: Sighting) -> FloatArray:
    """Return the pixel (2,) at which the a-priori attitude puts a body's centre."""
    centre: FloatArray = project(shot.camera.optics, (shot.apriori @ sighting.place_km)[None])[0]
    return centre
