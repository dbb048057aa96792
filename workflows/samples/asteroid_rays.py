"""Rays onto the asteroid's surface: hits, normals, light and shadow."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from workflows.samples.asteroid_surface import Asteroid, MapArray, value_at
from workflows.samples.cameras import FloatArray

MOST_STEPS = 4000
TOLERANCE = 2e-6
"""Distance to the surface, over the largest radius, at which a ray has met it."""
STEEPEST = 1.6
"""The few cells, sides of boulders, that rise faster lose a sliver of their edges at worst."""
SHADOW_STEP = 1.5e-4
"""Least step of a ray toward the Sun, and below half of it a dip under the surface counts as none; over the radius."""
PHASE_SCALE_DEG = 60.0
"""Phase over which the Lommel-Seeliger part falls by e (the law that stereophotoclinometry uses)."""


class Ground(NamedTuple):
    """The body as compiled loops take it: see `Asteroid`."""

    radius_km: MapArray
    albedo: MapArray
    highest_km: float
    steepness: float


def ground_of(asteroid: Asteroid) -> Ground:
    """Return the body for compiled loops."""
    steepness = min(asteroid.steepness, STEEPEST)
    return Ground(asteroid.radius_km, asteroid.albedo, asteroid.highest_km, steepness)


@numba.njit(cache=True, fastmath=True)
def meet(ground, ox, oy, oz, dx, dy, dz, start, end):  # type: ignore[no-untyped-def]
    """Distance along a unit ray, between start and end, to where it first dips under the surface; negative for none.

    The height above the surface along the radius changes by at most `steepness` per step, so steps of it over that
    bound never pass through anything.
    """
    near = TOLERANCE * ground.highest_km
    t, before, gap_before = start, start, 0.0
    for _ in range(MOST_STEPS):
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        gap = np.sqrt(x * x + y * y + z * z) - value_at(ground.radius_km, x, y, z)
        if gap < near:
            # Secant between the last two places, the first above and the second at or under the surface.
            return t if gap_before <= 0.0 else before + (t - before) * gap_before / (gap_before - gap)
        before, gap_before = t, gap
        t += max(gap / ground.steepness, near)
        if t > end:
            return -1.0
    return -1.0


@numba.njit(cache=True, fastmath=True)
def enter(highest, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Distances at which a unit ray enters and leaves the ball that holds the body; both negative if it passes by."""
    along = -(ox * dx + oy * dy + oz * dz)
    x, y, z = ox + along * dx, oy + along * dy, oz + along * dz
    under = highest * highest - (x * x + y * y + z * z)
    if under <= 0.0 or along + np.sqrt(under) <= 0.0:
        return -1.0, -1.0
    half = np.sqrt(under)
    return max(along - half, 0.0), along + half


@numba.njit(cache=True, fastmath=True)
def normal_at(ground, x, y, z):  # type: ignore[no-untyped-def]
    """Outward unit normal of the surface over a direction: differences of the radius over one cell of the map."""
    size = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / size, y / size, z / size
    # Two directions across this one.
    if abs(z) < 0.7:
        ax, ay, az = -y, x, 0.0
    else:
        ax, ay, az = 0.0, -z, y
    length = np.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    bx, by, bz = y * az - z * ay, z * ax - x * az, x * ay - y * ax
    step = 1.0 / (ground.radius_km.shape[1] - 1)
    radius = ground.radius_km
    here = value_at(radius, x, y, z)
    a = value_at(radius, x + step * ax, y + step * ay, z + step * az)
    a = (a - value_at(radius, x - step * ax, y - step * ay, z - step * az)) / (2.0 * step)
    b = value_at(radius, x + step * bx, y + step * by, z + step * bz)
    b = (b - value_at(radius, x - step * bx, y - step * by, z - step * bz)) / (2.0 * step)
    nx, ny, nz = here * x - a * ax - b * bx, here * y - a * ay - b * by, here * z - a * az - b * bz
    norm = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * norm, ny * norm, nz * norm


@numba.njit(cache=True, fastmath=True)
def is_shaded(ground, x, y, z, sx, sy, sz):  # type: ignore[no-untyped-def]
    """Whether the body stands between a place of its surface and the Sun."""
    least = SHADOW_STEP * ground.highest_km
    t = least
    for _ in range(MOST_STEPS):
        a, b, c = x + t * sx, y + t * sy, z + t * sz
        size = np.sqrt(a * a + b * b + c * c)
        if size > ground.highest_km:
            return False
        gap = size - value_at(ground.radius_km, a, b, c)
        if gap < -0.5 * least:
            return True
        t += max(gap / ground.steepness, least)
    return False


@numba.njit(cache=True, fastmath=True)
def brightness(ground, x, y, z, eye, sun, weight):  # type: ignore[no-untyped-def]
    """Light of a place of the surface; weight is that of the law's Lommel-Seeliger part."""
    nx, ny, nz = normal_at(ground, x, y, z)
    incidence = nx * sun[0] + ny * sun[1] + nz * sun[2]
    if incidence <= 0.0 or is_shaded(ground, x, y, z, sun[0], sun[1], sun[2]):
        return 0.0
    a, b, c = eye[0] - x, eye[1] - y, eye[2] - z
    emission = max((nx * a + ny * b + nz * c) / np.sqrt(a * a + b * b + c * c), 1e-3)
    law = (1.0 - weight) * incidence + weight * incidence / (incidence + emission)
    return value_at(ground.albedo, x, y, z) * law


@numba.njit(cache=True)
def look(ground, eye, rays, sun, weight):  # type: ignore[no-untyped-def]
    """Light (n,) along unit rays (n, 3) from the eye, all in the body's axes; zero beside the body."""
    light = np.zeros(len(rays), np.float32)
    for k in range(len(rays)):
        dx, dy, dz = rays[k, 0], rays[k, 1], rays[k, 2]
        start, end = enter(ground.highest_km, eye[0], eye[1], eye[2], dx, dy, dz)
        if end < 0.0:
            continue
        t = meet(ground, eye[0], eye[1], eye[2], dx, dy, dz, start, end)
        if t > 0.0:
            light[k] = brightness(ground, eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz, eye, sun, weight)
    return light


@numba.njit(cache=True)
def hits(ground, eyes, rays, reach):  # type: ignore[no-untyped-def]
    """Distance (n,) to the surface along unit rays (n, 3) from places (n, 3), not-a-number beyond the reach."""
    found = np.full(len(rays), np.nan)
    for k in range(len(rays)):
        o, d = eyes[k], rays[k]
        start, end = enter(ground.highest_km, o[0], o[1], o[2], d[0], d[1], d[2])
        if end >= 0.0:
            t = meet(ground, o[0], o[1], o[2], d[0], d[1], d[2], start, min(end, reach))
            if t >= 0.0:
                found[k] = t
    return found


def weight_of(phase_rad: float) -> float:
    """Return the weight of the Lommel-Seeliger part at a phase."""
    return float(np.exp(-np.degrees(phase_rad) / PHASE_SCALE_DEG))


def seen_places(ground: Ground, eye: FloatArray, rays: FloatArray) -> FloatArray:
    """Return where unit rays (n, 3) from one eye meet the surface, not-a-number where they do not."""
    far = 2.0 * float(np.linalg.norm(eye))
    distance = hits(ground, np.broadcast_to(eye, rays.shape), rays, far)
    places: FloatArray = eye + distance[:, None] * rays
    return places
