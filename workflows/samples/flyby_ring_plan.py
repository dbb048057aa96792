"""Where the spacecraft of the flyby sample are when they look at rings, and what is planted.

A point of the rings that the camera looks at, the scale, the opening and the bearing are drawn first; the place
follows. The spacecraft then drifts past the planet as it does in frames of bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from workflows.samples.attitude import looking_at, pointing_error, shortest_turn
from workflows.samples.cameras import FloatArray, SampleCamera, project, unproject
from workflows.samples.flyby_cameras import FlybyCamera, flyby_cameras
from workflows.samples.flyby_options import FlybyOptions
from workflows.samples.flyby_plan import FASTEST_KMS, MAX_TRIES, OFFSET_SHARE, SLOT_S, SMEAR_PX, Shot
from workflows.samples.flyby_ring_scene import plane_from_j2000, sorted_edges
from workflows.samples.flyby_ring_system import (
    FEATURES,
    GAP_MOONS,
    RING_BODIES,
    RINGED,
    RingFeature,
    RingScene,
    edge_radii,
    radius_errors,
)
from workflows.samples.flyby_system import body_state, see
from workflows.samples.flyby_time import et_from_utc, whole_milliseconds
from workflows.samples.sky import SPEED_OF_LIGHT_KMS

KIND, TRAP = "ring", "ring_radius_trap"
KM_PER_PX = (0.8, 250.0)
NEAREST_KM = 1.2e5
"""From the aimed point."""
LOW_SHARE, HIGH_SHARE = 0.2, 0.15
LOW_DEG, MIDDLE_DEG, HIGH_DEG = (1.0, 6.0), (6.0, 60.0), (60.0, 90.0)
MOON_SHARE = 0.1
"""Frames that look at a moon in a gap."""
RING_SNR = (3.0, 100.0)
TRAP_PX = 3.0
TRAP_FEATURES = 4
"""Features that a frame must show for one that lies wrong to be told from a shifted frame."""
TRAP_KM_PER_PX = (2.0, 60.0)
CURVE = 1440
"""Points along an edge by which its part in the frame is judged."""
SHORTEST_PX = 60.0


@dataclass(frozen=True)
class _View:
    """A place from which rings are seen: target point, spacecraft and attitude."""

    scene: RingScene
    position_km: FloatArray
    velocity_kms: FloatArray
    truth: FloatArray


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))


def _opening(rng: np.random.Generator) -> float:
    """Draw the angle (rad) between line of sight and ring plane, positive from the north."""
    draw = rng.random()
    if draw < LOW_SHARE:
        angle = _log_uniform(rng, LOW_DEG)
    elif draw < LOW_SHARE + HIGH_SHARE:
        angle = float(rng.uniform(*HIGH_DEG))
    else:
        low, high = np.sin(np.radians(MIDDLE_DEG))
        angle = float(np.degrees(np.arcsin(rng.uniform(low, high))))
    return float(np.radians(angle) * rng.choice([-1.0, 1.0]))


def _aim(et: float, rng: np.random.Generator) -> FloatArray:
    """Draw a point (3,) on an edge or at a moon in a gap, ring-plane axes, km."""
    if rng.random() < MOON_SHARE:
        moon = GAP_MOONS[int(rng.integers(len(GAP_MOONS)))]
        aim: FloatArray = plane_from_j2000() @ (body_state(moon, et)[0] - body_state(RINGED, et)[0])
        return aim
    edge, k = sorted_edges()[int(rng.integers(len(sorted_edges())))]
    longitude = float(rng.uniform(0.0, 2.0 * np.pi))
    radius = float(edge_radii(FEATURES[k], edge, np.array([longitude]), et)[0])
    return radius * np.array([np.cos(longitude), np.sin(longitude), 0.0])


def _meets_planet(start: FloatArray, way: FloatArray) -> bool:
    """Whether a half-line (km, ring-plane axes) meets the planet's ellipsoid."""
    radii = np.array(RINGED.radii_km)
    p, w = start / radii, way / radii
    along = -float(p @ w) / float(w @ w)
    return along > 0.0 and float(np.linalg.norm(p + along * w)) < 1.0


def _view(camera: FlybyCamera, et: float, exposure_s: float, trap: bool, phase_deg: tuple[float, float],
          rng: np.random.Generator) -> _View | None:  # fmt: skip
    """Draw a place and an attitude; None if the draw is no good."""
    optics = camera.optics
    aim, opening, bearing = _aim(et, rng), _opening(rng), float(rng.uniform(0.0, 2.0 * np.pi))
    low, high = TRAP_KM_PER_PX if trap else KM_PER_PX
    scale = _log_uniform(rng, (max(low, NEAREST_KM * optics.rad_per_px), high))
    way = np.array([np.cos(opening) * np.cos(bearing), np.cos(opening) * np.sin(bearing), np.sin(opening)])
    range_km = scale / optics.rad_per_px
    turn = plane_from_j2000()
    place, velocity = body_state(RINGED, et)
    position = place + turn.T @ (aim + range_km * way)
    speed = min(FASTEST_KMS, SMEAR_PX * scale / exposure_s)
    drift = rng.standard_normal(3)
    velocity = velocity + speed * drift / np.linalg.norm(drift)
    planet = see(RINGED, et, position, velocity)
    sun = turn @ planet.sun
    phase = float(np.degrees(np.arccos(np.clip(way @ sun, -1.0, 1.0))))
    clear = planet.range_km > 1.5 * max(RINGED.radii_km) and not _meets_planet(aim, sun)
    if not clear or _meets_planet(aim, way) or not phase_deg[0] <= phase <= phase_deg[1]:
        return None
    truth = _attitude(optics, turn.T @ -way, rng)
    return _View(RingScene(aim), position, velocity, truth)


def _attitude(optics: SampleCamera, ahead: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return camera_from_j2000: a random roll, and the aimed direction in the middle half of the array."""
    level = looking_at(ahead, float(rng.uniform(0.0, 2.0 * np.pi)))
    at = rng.uniform(0.25, 0.75, 2) * np.array(optics.shape_vu)
    return shortest_turn(np.array([0.0, 0.0, 1.0]), unproject(optics, at[None])[0]) @ level


def project_ring_points(
    optics: SampleCamera, truth: FloatArray, position_km: FloatArray, velocity_kms: FloatArray, et: float,
    points_km: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the pixels (n, 2) of points (n, 3) of the ring plane, km from the planet's centre.

    In the planet's frame a point is displaced by the aberration of the spacecraft's motion alone: the light time and
    the planet's own motion cancel to second order.
    """
    place, velocity = body_state(RINGED, et)
    from_here = points_km @ plane_from_j2000() + (place - position_km)
    distance = np.linalg.norm(from_here, axis=1, keepdims=True)
    seen = from_here + (velocity_kms - velocity) / SPEED_OF_LIGHT_KMS * distance
    pixels: FloatArray = project(optics, seen @ truth.T)
    return pixels


def _edge_lengths(optics: SampleCamera, view: _View, et: float) -> dict[str, float]:
    """Return the length in pixels, within the array, of each feature's longest edge."""
    # Edges are long: points are dense around the aimed longitude, where the frame is.
    steps = np.linspace(-1.0, 1.0, CURVE)
    longitudes = np.arctan2(view.scene.aim_km[1], view.scene.aim_km[0]) + np.pi * np.sign(steps) * np.abs(steps) ** 3
    lengths: dict[str, float] = {}
    for edge, k in sorted_edges():
        radius = edge_radii(FEATURES[k], edge, longitudes, et)
        points = np.stack([radius * np.cos(longitudes), radius * np.sin(longitudes), 0.0 * radius], axis=1)
        at = project_ring_points(optics, view.truth, view.position_km, view.velocity_kms, et, points)
        middle, step = 0.5 * (at[1:] + at[:-1]), np.linalg.norm(np.diff(at, axis=0), axis=1)
        on = np.all((middle > 0.0) & (middle < np.array(optics.shape_vu) - 1.0), axis=1)
        name = FEATURES[k].name
        lengths[name] = max(lengths.get(name, 0.0), float(step[on].sum()))
    return lengths


def _room(feature: RingFeature, moved_km: float) -> bool:
    """Whether a feature can be moved without coming near another's edges, whatever their shapes."""
    others = [(edge, FEATURES[k]) for edge, k in sorted_edges() if FEATURES[k] is not feature]

    def swing(f: RingFeature) -> float:
        return f.ae_km + sum(mode.amplitude_km for mode in f.modes) + 4.0 * f.sigma_a_km

    for mine in feature.edges_km:
        low, high = sorted((mine, mine + moved_km))
        for edge, other in others:
            beyond = swing(feature) + swing(other) + 2.0
            if low - beyond < edge < high + beyond:
                return False
    return True


def _with_trap(optics: SampleCamera, view: _View, et: float, rng: np.random.Generator) -> _View | None:
    """Move one of the frame's features by three pixels; None if the frame shows too few, or none has room."""
    lengths = _edge_lengths(optics, view, et)
    shown = [f for f in FEATURES if lengths[f.name] > SHORTEST_PX]
    if len(shown) < TRAP_FEATURES:
        return None
    aim = view.scene.aim_km
    ends = np.stack([aim, aim * (1.0 + 1.0 / np.linalg.norm(aim))])
    at = project_ring_points(optics, view.truth, view.position_km, view.velocity_kms, et, ends)
    moved = float(TRAP_PX / np.linalg.norm(at[1] - at[0]) * rng.choice([-1.0, 1.0]))
    able = [f for f in shown if _room(f, moved)]
    if not able:
        return None
    chosen = able[int(rng.integers(len(able)))]
    scene = RingScene(aim, chosen.name, round(moved, 3))
    return _View(scene, view.position_km, view.velocity_kms, view.truth)


def plan_ring_shot(number: int, options: FlybyOptions) -> Shot:
    """Draw one frame of rings; the same number, seed and options give the same.

    Raises
    ------
    ValueError
        If no place shows what is wanted.
    """
    rng = np.random.default_rng([options.seed, number, 21])
    camera = flyby_cameras()[options.cameras[number % len(options.cameras)]]
    optics, index = camera.optics, options.frames + number
    trap = bool(rng.random() < options.trap_share)
    seconds = SLOT_S * (index + rng.uniform(0.1, 0.9))
    utc = whole_milliseconds(camera.spacecraft.start_utc + timedelta(seconds=seconds))
    et, exposure = et_from_utc(utc), float(rng.choice(optics.exposures_s))
    for _ in range(MAX_TRIES):
        view = _view(camera, et, exposure, trap, options.phase_deg, rng)
        if view is not None and trap:
            view = _with_trap(optics, view, et, rng)
        if view is not None and max(_edge_lengths(optics, view, et).values()) > SHORTEST_PX:
            break
    else:
        raise ValueError(f"no place shows frame {index} rings as wanted")
    offset = OFFSET_SHARE * rng.uniform(-1.0, 1.0, 2) * np.array(optics.search_margin_vu)
    limit = np.radians(options.max_rotation_deg) if optics.fit_camera_rotation else 0.0
    rotation = float(rng.uniform(-limit, limit))
    snr = min(max(_log_uniform(rng, options.snr), RING_SNR[0]), RING_SNR[1])
    return Shot(
        index=index, seed=options.seed, camera=camera, utc=utc, et=et, exposure_s=exposure,
        position_km=view.position_km, velocity_kms=view.velocity_kms,
        apriori=pointing_error(optics, offset, rotation).T @ view.truth, truth=view.truth, offset_vu=offset,
        rotation_rad=rotation, target=RINGED.name, kind=TRAP if trap else KIND, snr=snr, overexposure=0.0,
        stars=False, haze_km=0.0, smooth=options.smooth, scale_error=options.scale_error, bodies=RING_BODIES,
        ring=view.scene,
    )  # fmt: skip


def plan_ring_shots(options: FlybyOptions) -> list[Shot]:
    """Draw every frame of rings."""
    return [plan_ring_shot(number, options) for number in range(options.ring_frames)]


def true_radii(seed: int) -> dict[str, float]:
    """Return the semi-major axes (km) of inner, or only, edges as they really are, by feature."""
    return {f.name: round(f.a_km + radius_errors(seed)[f.name], 4) for f in FEATURES}
