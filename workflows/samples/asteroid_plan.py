"""Where the spacecraft of the asteroid sample is at each exposure, where it looks, and what it believes of both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np

from workflows.samples.asteroid_options import BODY, AsteroidOptions
from workflows.samples.asteroid_rays import Ground, seen_places
from workflows.samples.attitude import looking_at, pointing_error, shortest_turn, turn_about
from workflows.samples.cameras import FloatArray, SampleCamera, project, unproject
from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.flyby_plan import Shot
from workflows.samples.flyby_system import Sighting, body_state, see, sun_state
from workflows.samples.flyby_time import et_from_utc, whole_milliseconds
from workflows.samples.sky import SPEED_OF_LIGHT_KMS

SLOT_S = 3600.0
"""Time from frame to frame."""
DRIFT_KMS = 0.002
"""Speed past the asteroid."""
WORST_SIGMA = 3.0
"""Planted errors are Gaussian, drawn anew beyond this."""
GRID = 40
"""Lines of sight along each side of the array at which the surface is looked up."""
MIDDLE_SHARE = 0.06
"""How far from the array's centre, in sides, the body's centre may be on the approach."""
RIM_COSINE = 0.55
"""Frames from orbit look at places under a Sun and a line of sight at least this high."""


@dataclass(frozen=True)
class AsteroidShot:
    """One frame: the truth, and the same frame as the kernels tell it.

    Attributes
    ----------
    shot
        With the true place; its attitudes are the true one and the told one.
    told
        The same with the told place.
    kind
        ``approach`` or ``orbit``.
    """

    shot: Shot
    told: Shot
    kind: str

    def sighting(self) -> Sighting:
        """Return the body as it is seen."""
        return see(BODY, self.shot.et, self.shot.position_km, self.shot.velocity_kms)

    def told_sighting(self) -> Sighting:
        """Return the body as seen from where the kernels have the spacecraft."""
        return see(BODY, self.told.et, self.told.position_km, self.told.velocity_kms)


def normal_within(rng: np.random.Generator, count: int) -> FloatArray:
    """Return Gaussian numbers of sigma 1, none beyond three."""
    drawn = rng.standard_normal(count)
    while (far := np.abs(drawn) > WORST_SIGMA).any():
        drawn[far] = rng.standard_normal(int(far.sum()))
    return drawn


def eye_of(sighting: Sighting) -> FloatArray:
    """Return the camera's place (3,) from the body's centre, in the body's axes, as the light has it."""
    place: FloatArray = -sighting.from_j2000 @ sighting.place_km
    return place


def looked_at(
    camera: SampleCamera, camera_from_j2000: FloatArray, sighting: Sighting, ground: Ground
) -> tuple[FloatArray, FloatArray]:
    """Return places (n, 3) of the surface that a frame shows, in the body's axes, and their pixels (n, 2).

    One line of sight from every field of a grid over the array; those that miss the body are left out.
    """
    sides = [(np.arange(GRID) + 0.5) / GRID * size - 0.5 for size in camera.shape_vu]
    pixels = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    rays = unproject(camera, pixels) @ camera_from_j2000 @ sighting.from_j2000.T
    places = seen_places(ground, eye_of(sighting), np.ascontiguousarray(rays))
    hit = np.isfinite(places[:, 0])
    return places[hit], pixels[hit]


def pixels_of(
    camera: SampleCamera, camera_from_j2000: FloatArray, sighting: Sighting, places: FloatArray
) -> FloatArray:
    """Return the pixels (n, 2) of places (n, 3) in the body's axes."""
    sight = sighting.place_km + places @ sighting.from_j2000
    return project(camera, sight @ camera_from_j2000.T)


def _draw_place(
    et: float, range_km: float, phase_rad: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return position and velocity of a spacecraft that sees the body at a distance and phase."""
    place, velocity = body_state(BODY, et - range_km / SPEED_OF_LIGHT_KMS)
    sun = sun_state(et)[0] - place
    sun /= np.linalg.norm(sun)
    across = np.cross(sun, np.eye(3)[int(np.argmin(np.abs(sun)))])
    across /= np.linalg.norm(across)
    way = turn_about(sun, float(rng.uniform(0.0, 2.0 * np.pi))) @ (turn_about(across, phase_rad) @ sun)
    drift = rng.standard_normal(3)
    return place + way * range_km, velocity + DRIFT_KMS * drift / np.linalg.norm(drift)


def _aim(kind: str, optics: SampleCamera, sighting: Sighting, ground: Ground, rng: np.random.Generator) -> FloatArray:
    """Return the true camera_from_j2000: the body in the middle, or a well lit and well seen place of it."""
    ahead = sighting.place_km / sighting.range_km
    level = looking_at(ahead, float(rng.uniform(0.0, 2.0 * np.pi)))
    middle = optics.centre_vu + rng.uniform(-1.0, 1.0, 2) * MIDDLE_SHARE * np.array(optics.shape_vu)
    if kind == "orbit":
        ways = rng.standard_normal((400, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        eye = eye_of(sighting) / sighting.range_km
        good = (ways @ (sighting.from_j2000 @ sighting.sun) > RIM_COSINE) & (ways @ eye > RIM_COSINE)
        way = ways[int(np.argmax(good))]
        aimed = sighting.place_km + (way * ground.highest_km * 0.85) @ sighting.from_j2000
        level = shortest_turn(level @ (aimed / np.linalg.norm(aimed)), np.array([0.0, 0.0, 1.0])) @ level
    turned: FloatArray = shortest_turn(np.array([0.0, 0.0, 1.0]), unproject(optics, middle[None])[0]) @ level
    return turned


def plan_frame(index: int, options: AsteroidOptions, ground: Ground) -> AsteroidShot:
    """Draw one frame; the same index, seed and options give the same."""
    rng = np.random.default_rng([options.seed, index, 41])
    camera = flyby_cameras()[options.camera]
    optics = camera.optics
    seconds = SLOT_S * (index + rng.uniform(0.1, 0.9))
    utc = whole_milliseconds(camera.spacecraft.start_utc + timedelta(seconds=seconds))
    et, exposure = et_from_utc(utc), float(rng.choice(optics.exposures_s[1:4]))
    kind = "approach" if index % 3 == 0 else "orbit"
    sizes = options.pixel_km[1:] if kind == "approach" else options.pixel_km[:2]
    range_km = float(np.exp(rng.uniform(*np.log(sizes)))) / optics.rad_per_px
    phase = float(np.radians(rng.uniform(*options.phase_deg)))
    position, velocity = _draw_place(et, range_km, phase, rng)
    truth = _aim(kind, optics, see(BODY, et, position, velocity), ground, rng)
    offset = options.pointing_sigma_px * normal_within(rng, 2)
    rotation = float(np.radians(options.twist_sigma_deg) * normal_within(rng, 1)[0])
    error_km = options.position_sigma_share * range_km * normal_within(rng, 3)
    snr = float(np.exp(rng.uniform(*np.log(options.snr))))
    shot = Shot(
        index=index, seed=options.seed, camera=camera, utc=utc, et=et, exposure_s=exposure, position_km=position,
        velocity_kms=velocity, apriori=pointing_error(optics, offset, rotation).T @ truth, truth=truth,
        offset_vu=offset, rotation_rad=rotation, target=BODY.name, kind="single", snr=snr, overexposure=0.0,
        stars=False, haze_km=0.0, smooth=False, scale_error=0.0, bodies=(BODY,),
    )  # fmt: skip
    return AsteroidShot(shot, replace(shot, position_km=position + error_km), kind)
