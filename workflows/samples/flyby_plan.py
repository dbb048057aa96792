"""Where the spacecraft of the flyby sample are at each exposure, where they look, and what is planted.

Each frame is a pass of its own: for ten minutes either side the spacecraft moves straight relative to the planet. The
target, its size and the phase are drawn first; the place follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np

from workflows.samples.attitude import looking_at, pointing_error, shortest_turn, turn_about
from workflows.samples.cameras import FloatArray, SampleCamera, unproject
from workflows.samples.flyby_bodies import centre_and_radius, shades_of
from workflows.samples.flyby_cameras import FlybyCamera, flyby_cameras
from workflows.samples.flyby_options import TRAPS, FlybyOptions
from workflows.samples.flyby_ring_system import RingScene
from workflows.samples.flyby_system import (
    BODIES,
    MOONS,
    PLANET,
    SampleBody,
    Sighting,
    body_named,
    body_state,
    see,
    sun_state,
)
from workflows.samples.flyby_time import (
    CASSINI_CLOCK,
    NEW_HORIZONS_CLOCK,
    VOYAGER_CLOCK,
    et_from_utc,
    whole_milliseconds,
)
from workflows.samples.sky import SPEED_OF_LIGHT_KMS

SLOT_S = 3600.0
"""Time from frame to frame."""
OFFSET_SHARE = 0.9
"""Share of the search margin that planted offsets fill."""
SMEAR_PX = 0.03
"""Most that a target moves over the array during an exposure."""
FASTEST_KMS = 12.0
MAX_TRIES = 400
PATIENCE = 40
"""Tries before another trap is laid."""
PLANET_SHARE = 0.12
COMPANION_SHARE = 0.45
EDGE_SHARE = 0.12
LARGEST_FRAMES = 10.0
"""Largest diameter over the shorter side of the array."""
TRAP_DIAMETER_PX = (30.0, 500.0)
TRAP_SNR = 20.0
OVEREXPOSED_SHARE = 0.03
OVEREXPOSED = (1.3, 3.0)
"""How often the brightest light of an overexposed frame fills the scale."""
TWINS = ("CORVETH", "HALVREN")


@dataclass(frozen=True)
class Shot:
    """All that decides one frame, small enough to send to a worker.

    Attributes
    ----------
    utc, et
        Middle of the exposure.
    position_km, velocity_kms
        Of the spacecraft from the barycentre, J2000 axes.
    apriori, truth
        camera_from_j2000 (3, 3): what the C-kernel says, and where the camera looked.
    offset_vu, rotation_rad
        The planted (dv, du), px, and rotation about the array centre.
    target, kind
        Name of the body; ``single``, ``companion``, ``edge`` or one of `TRAPS`.
    snr
        Wanted mean light of the lit disc over the noise of a pixel.
    overexposure
        How often the brightest light fills the detector's scale; zero where the wanted signal decides.
    stars
        Whether there are stars.
    bodies
        Planet and moons that the spacecraft passes, the planet first.
    ring
        What is special about a frame of rings, None for one of bodies.
    """

    index: int
    seed: int
    camera: FlybyCamera
    utc: datetime
    et: float
    exposure_s: float
    position_km: FloatArray
    velocity_kms: FloatArray
    apriori: FloatArray
    truth: FloatArray
    offset_vu: FloatArray
    rotation_rad: float
    target: str
    kind: str
    snr: float
    overexposure: float
    stars: bool
    haze_km: float
    smooth: bool
    scale_error: float
    bodies: tuple[SampleBody, ...] = BODIES
    ring: RingScene | None = None

    @property
    def seen_with(self) -> SampleCamera:
        """The optics that really made the frame; only LORRI's may differ from what is told."""
        optics = self.camera.optics
        if self.camera.stored != "lorri" or self.scale_error == 0.0:
            return optics
        (a, b), (c, d) = optics.k_px_per_mm
        factor = 1.0 + self.scale_error
        return replace(optics, k_px_per_mm=((factor * a, factor * b), (factor * c, factor * d)))

    @property
    def start_utc(self) -> datetime:
        """Opening of the shutter."""
        return self.utc - timedelta(seconds=self.exposure_s / 2.0)

    @property
    def stop_utc(self) -> datetime:
        """Closing of the shutter."""
        return self.utc + timedelta(seconds=self.exposure_s / 2.0)

    @property
    def image_id(self) -> str:
        """Product id and stem of the files."""
        if self.camera.stored == "cassini":
            return f"{self.camera.letter}{CASSINI_CLOCK.fields(et_from_utc(self.stop_utc))[0]:010d}_1"
        if self.camera.stored == "voyager":
            count = VOYAGER_CLOCK.fields(self.et)
            return f"C{count[0]:05d}{count[1]:02d}_GEOMED"
        apid = "0x633" if self.camera.summation == 4 else "0x631"
        return f"lor_{round(self.et - NEW_HORIZONS_CLOCK.zero_et):010d}_{apid}_sci"

    def sightings(self) -> list[Sighting]:
        """Return every body as the spacecraft sees it."""
        return [see(body, self.et, self.position_km, self.velocity_kms) for body in self.bodies]


@dataclass(frozen=True)
class _Wish:
    """What is wanted of a frame before its place is known."""

    target: SampleBody
    kind: str
    diameter_px: float
    phase_rad: float


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))


def _wish(options: FlybyOptions, optics: SampleCamera, trap: str | None, rng: np.random.Generator) -> _Wish:
    """Draw target, kind, size and phase."""
    largest = LARGEST_FRAMES * min(optics.shape_vu)
    low, high = options.diameter_px
    if trap is not None:
        low, high = max(low, TRAP_DIAMETER_PX[0]), min(max(high, TRAP_DIAMETER_PX[0]), TRAP_DIAMETER_PX[1])
    diameter = min(_log_uniform(rng, (low, max(low, high))), largest)
    if trap == "twins":
        target, diameter = body_named(TWINS[int(rng.integers(2))]), _log_uniform(rng, (15.0, 60.0))
    elif trap is None and rng.random() < PLANET_SHARE:
        target = PLANET
    else:
        target = MOONS[int(rng.integers(len(MOONS)))]
    draw = rng.random()
    plain = "companion" if draw < COMPANION_SHARE else "edge" if draw < COMPANION_SHARE + EDGE_SHARE else "single"
    phase = float(np.radians(rng.uniform(*options.phase_deg)))
    return _Wish(target, trap or plain, diameter, phase)


def _turned_aside(axis: FloatArray, angle: float, rng: np.random.Generator) -> FloatArray:
    """Return a unit vector at an angle from another, in any direction."""
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    turned: FloatArray = turn_about(axis, float(rng.uniform(0.0, 2.0 * np.pi))) @ (turn_about(across, angle) @ axis)
    return turned


def _direction_for_companion(
    wish: _Wish, et: float, range_km: float, field_rad: float, options: FlybyOptions, rng: np.random.Generator
) -> FloatArray | None:
    """Return a direction from the target to the spacecraft that puts another body near the line of sight, or None."""
    here, _ = body_state(wish.target, et)
    sun = sun_state(et)[0] - here
    sun /= np.linalg.norm(sun)
    found: list[FloatArray] = []
    for other in BODIES:
        apart = body_state(other, et)[0] - here
        distance = float(np.linalg.norm(apart))
        if other is wish.target:
            continue
        for side in (1.0, -1.0):
            toward_other = range_km - side * distance
            if toward_other < 3.0 * other.mean_radius_km:
                continue
            touching = (wish.target.mean_radius_km / range_km) + other.mean_radius_km / toward_other
            shift = rng.uniform(0.0, touching if rng.random() < 0.4 else max(field_rad, touching))
            sine = shift * toward_other / distance
            if sine > 0.5:
                continue
            way = _turned_aside(side * apart / distance, float(np.arcsin(sine)), rng)
            if options.phase_deg[0] <= np.degrees(np.arccos(np.clip(way @ sun, -1.0, 1.0))) <= options.phase_deg[1]:
                found.append(way)
    return found[int(rng.integers(len(found)))] if found else None


def _direction(
    wish: _Wish, et: float, range_km: float, optics: SampleCamera, options: FlybyOptions, rng: np.random.Generator
) -> FloatArray:
    """Return the unit vector from the target to the spacecraft."""
    here, _ = body_state(wish.target, et)
    if wish.kind == "companion":
        field = 0.5 * min(optics.shape_vu) * optics.rad_per_px
        way = _direction_for_companion(wish, et, range_km, field, options, rng)
        if way is not None:
            return way
    if wish.kind == "twins":
        other = body_named(TWINS[1 - TWINS.index(wish.target.name)])
        apart = body_state(other, et)[0] - here
        distance = float(np.linalg.norm(apart))
        wanted = rng.uniform(1.3, 3.0) * 2.0 * wish.target.mean_radius_km
        return _turned_aside(apart / distance * rng.choice([-1.0, 1.0]), float(np.arcsin(wanted / distance)), rng)
    sun = sun_state(et)[0] - here
    return _turned_aside(sun / np.linalg.norm(sun), wish.phase_rad, rng)


def _place(
    wish: _Wish, et: float, exposure_s: float, optics: SampleCamera, options: FlybyOptions, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray] | None:
    """Return a position and velocity from which the target is seen as wished, None if the draw is no good."""
    range_km = 2.0 * wish.target.mean_radius_km / (wish.diameter_px * optics.rad_per_px)
    way = _direction(wish, et, range_km, optics, options, rng)
    then = et - range_km / SPEED_OF_LIGHT_KMS
    place, velocity = body_state(wish.target, then)
    speed = min(FASTEST_KMS, SMEAR_PX * range_km * optics.rad_per_px / exposure_s)
    drift = rng.standard_normal(3)
    position = place + way * range_km
    velocity = velocity + speed * drift / np.linalg.norm(drift)
    sightings = {body.name: see(body, et, position, velocity) for body in BODIES}
    target = sightings[wish.target.name]
    clear = all(s.range_km > 3.0 * s.body.mean_radius_km for s in sightings.values())
    phase = np.degrees(target.phase_rad)
    as_wished = options.phase_deg[0] - 0.5 <= phase <= options.phase_deg[1] + 0.5
    in_light = not shades_of(target, list(sightings.values()))
    return (position, velocity) if clear and as_wished and in_light and not _is_hidden(target, sightings) else None


def _is_hidden(target: Sighting, sightings: dict[str, Sighting]) -> bool:
    """Whether a nearer body covers much of the target, or one in front is so large that it fills the field."""
    for other in sightings.values():
        if other is target or other.range_km > target.range_km:
            continue
        cosine = float(other.place_km @ target.place_km) / other.range_km / target.range_km
        apart = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if apart < other.radius_rad + 0.2 * target.radius_rad and other.radius_rad > 0.5 * target.radius_rad:
            return True
    return False


def _aim(wish: _Wish, optics: SampleCamera, target: Sighting, rng: np.random.Generator) -> FloatArray:
    """Return camera_from_j2000: a random roll, and the target where its size allows."""
    ahead = target.place_km / target.range_km
    level = looking_at(ahead, float(rng.uniform(0.0, 2.0 * np.pi)))
    shape = np.array(optics.shape_vu, dtype=np.float64)
    radius = target.radius_rad / optics.rad_per_px
    if wish.kind == "edge" or 2.0 * radius > 0.7 * shape.min():
        centre = _limb_inside(optics, level @ target.sun, target.phase_rad, radius, wish.kind == "edge", rng)
    elif wish.kind == "twins":
        centre = rng.uniform(0.1, 0.9, 2) * shape
    else:
        room = radius + 6.0
        centre = rng.uniform(room, shape - room)
    return shortest_turn(np.array([0.0, 0.0, 1.0]), unproject(optics, centre[None])[0]) @ level


def _limb_inside(
    optics: SampleCamera, sun: FloatArray, phase_rad: float, radius: float, near_edge: bool, rng: np.random.Generator
) -> FloatArray:
    """Return the centre's pixel (2,) that puts some of the lit limb well inside the array, or, near its edge, just."""
    uv = np.array(optics.k_px_per_mm) @ sun[:2]
    toward = np.arctan2(uv[1], uv[0])
    angle = toward + rng.uniform(-1.0, 1.0) * (np.pi if phase_rad < 0.8 else 1.0)
    shape = np.array(optics.shape_vu, dtype=np.float64)
    limb = rng.uniform(0.2, 0.8, 2) * shape
    if near_edge:
        side = int(rng.integers(2))
        limb[side] = shape[side] * rng.integers(2) + rng.uniform(-0.5, 0.5) * min(radius, 0.3 * shape[side])
    centre: FloatArray = limb - radius * np.array([np.sin(angle), np.cos(angle)])
    return centre


def _lit_limb_shows(optics: SampleCamera, truth: FloatArray, target: Sighting) -> bool:
    """Whether some of the lit limb, or all of a small disc's middle, falls into the array."""
    centre, radius = centre_and_radius(optics, truth, target)
    uv = np.array(optics.k_px_per_mm) @ (truth @ target.sun)[:2]
    toward = np.arctan2(uv[1], uv[0])
    angles = toward + np.linspace(-1.3, 1.3, 41)
    limb = centre + radius * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    on = np.all((limb > 2.0) & (limb < np.array(optics.shape_vu) - 3.0), axis=1)
    return int(on.sum()) >= 6


def plan_shot(index: int, options: FlybyOptions) -> Shot:
    """Draw one frame; the same index, seed and options give the same.

    Raises
    ------
    ValueError
        If no place shows what is wanted.
    """
    rng = np.random.default_rng([options.seed, index, 7])
    camera = flyby_cameras()[options.cameras[index % len(options.cameras)]]
    optics = camera.optics
    trap = TRAPS[int(rng.integers(len(TRAPS)))] if rng.random() < options.trap_share else None
    seconds = SLOT_S * (index + rng.uniform(0.1, 0.9))
    utc = whole_milliseconds(camera.spacecraft.start_utc + timedelta(seconds=seconds))
    et, exposure = et_from_utc(utc), float(rng.choice(optics.exposures_s))
    for attempt in range(1, MAX_TRIES):
        if trap is not None and attempt % PATIENCE == 0:
            # Twins stay in the planet's shadow for hours.
            trap = TRAPS[int(rng.integers(len(TRAPS)))]
        wish = _wish(options, optics, trap, rng)
        found = _place(wish, et, exposure, optics, options, rng)
        if found is None:
            continue
        target = see(wish.target, et, *found)
        truth = _aim(wish, optics, target, rng)
        if _lit_limb_shows(optics, truth, target):
            break
    else:
        raise ValueError(f"no place shows frame {index} a target as wanted")
    offset = OFFSET_SHARE * rng.uniform(-1.0, 1.0, 2) * np.array(optics.search_margin_vu)
    limit = np.radians(options.max_rotation_deg) if optics.fit_camera_rotation else 0.0
    rotation = float(rng.uniform(-limit, limit))
    snr = _log_uniform(rng, options.snr)
    return Shot(
        index=index,
        seed=options.seed,
        camera=camera,
        utc=utc,
        et=et,
        exposure_s=exposure,
        position_km=found[0],
        velocity_kms=found[1],
        apriori=pointing_error(optics, offset, rotation).T @ truth,
        truth=truth,
        offset_vu=offset,
        rotation_rad=rotation,
        target=wish.target.name,
        kind=wish.kind,
        snr=max(snr, min(TRAP_SNR, options.snr[1])) if trap else snr,
        overexposure=float(rng.uniform(*OVEREXPOSED)) if _is_overexposed(camera, trap, rng) else 0.0,
        stars=bool(rng.random() < options.star_share),
        haze_km=options.haze_km,
        smooth=options.smooth,
        scale_error=options.scale_error,
    )


def _is_overexposed(camera: FlybyCamera, trap: str | None, rng: np.random.Generator) -> bool:
    """Draw whether a frame saturates; Voyager's corrected products do not tell where they do."""
    return bool(rng.random() < OVEREXPOSED_SHARE) and camera.stored != "voyager" and trap is None


def plan_shots(options: FlybyOptions) -> list[Shot]:
    """Draw every frame."""
    return [plan_shot(index, options) for index in range(options.frames)]


def planet_relative(shot: Shot) -> tuple[FloatArray, FloatArray]:
    """Return position (km) and velocity (km/s) of a shot's spacecraft from the planet that it passes."""
    place, velocity = body_state(shot.bodies[0], shot.et)
    return shot.position_km - place, shot.velocity_kms - velocity
