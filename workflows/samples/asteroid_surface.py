"""The invented asteroid: heights and albedo on the six faces of a cube, as functions of direction.

A point (p, q) of a face is where the ray from the body's centre meets the face of the cube about the unit sphere, both
in -1..1; neighbouring faces meet in the same directions, so nothing jumps at an edge. Everything is a sum of functions
of direction: a triaxial figure, fractal noise, craters, boulders.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from workflows.samples.cameras import FloatArray

MapArray = NDArray[np.float32]

FACES = 6
RELIEF = 0.034
"""Amplitude of the broadest noise over the mean radius."""
ROUGHNESS = 0.95
"""Amplitude of noise falls as wavelength to this power (Hurst exponent; 0.8 to 1 on small bodies)."""
BROADEST = 0.7
"""Waves of the broadest noise per radius."""
OCTAVES = 10
CRATERS = 1600
CRATER_RADIUS = (0.008, 0.22)
"""Smallest and largest, over the body's; the number above a size falls as its square."""
CRATER_DEPTH = 0.22
"""Of a fresh crater over its radius; old ones have less."""
RIM_SHARE = 0.18
"""Height of the rim over the depth."""
BOULDERS = 5000
BOULDER_RADIUS = (0.0028, 0.016)
BOULDER_HEIGHT = 0.7
"""Over the radius."""
ALBEDO_RMS = 0.09
DARKEST = 0.3


@dataclass(frozen=True)
class Asteroid:
    """Maps of the body.

    Attributes
    ----------
    radius_km
        (6, n + 1, n + 1) distance of the surface from the centre.
    albedo
        (6, n + 1, n + 1) relative to the mean.
    highest_km
        Largest radius.
    steepness
        Bound on how fast the height above the surface may change along a ray.
    """

    radius_km: MapArray
    albedo: MapArray
    highest_km: float
    steepness: float


@numba.njit(cache=True)
def _hash(i, j, k, seed):  # type: ignore[no-untyped-def]
    """Even random number in -1..1 of a lattice point: integers mixed as by Jenkins' and Wang's hashes."""
    h = np.uint32(i * 0x8DA6B343) ^ np.uint32(j * 0xD8163841) ^ np.uint32(k * 0xCB1AB31F) ^ np.uint32(seed)
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    h = h ^ (h >> np.uint32(16))
    return np.float64(h) * (2.0 / 4294967295.0) - 1.0


@numba.njit(cache=True)
def _noise(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Random numbers at lattice points, joined smoothly (quintic, as in Perlin 2002)."""
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    a, b, c = x - i, y - j, z - k
    i, j, k = np.int64(i), np.int64(j), np.int64(k)
    a = a * a * a * (a * (a * 6.0 - 15.0) + 10.0)
    b = b * b * b * (b * (b * 6.0 - 15.0) + 10.0)
    c = c * c * c * (c * (c * 6.0 - 15.0) + 10.0)
    total = 0.0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
        total += weight * _hash(i + di, j + dj, k + dk, seed)
    return total


@numba.njit(cache=True)
def direction_of(face, p, q):  # type: ignore[no-untyped-def]
    """Unit vector through (p, q) of a face."""
    norm = 1.0 / np.sqrt(1.0 + p * p + q * q)
    m = norm if face % 2 == 0 else -norm
    if face // 2 == 0:
        return m, p * norm, q * norm
    if face // 2 == 1:
        return q * norm, m, p * norm
    return p * norm, q * norm, m


@numba.njit(cache=True)
def _fractal(field, waves, octaves, fall, seed):  # type: ignore[no-untyped-def]
    """Add octaves of noise, the first one of amplitude 1, to maps."""
    n = field.shape[1] - 1
    for face in range(FACES):
        for row in range(n + 1):
            for column in range(n + 1):
                x, y, z = direction_of(face, 2.0 * row / n - 1.0, 2.0 * column / n - 1.0)
                size, amplitude, total = waves, 1.0, 0.0
                for octave in range(octaves):
                    # Shifts keep the lattices of different octaves from meeting in one point.
                    shift = 17.3 * octave + 5.1
                    total += amplitude * _noise(x * size + shift, y * size - shift, z * size + 0.7 * shift, seed)
                    size, amplitude = 2.0 * size, amplitude * fall
                field[face, row, column] += total


@numba.njit(cache=True)
def _stamp(field, centres, radii, heights, is_boulder):  # type: ignore[no-untyped-def]
    """Add round features: centres (k, 3), angular radii, heights in the map's unit."""
    n = field.shape[1] - 1
    for k in range(len(radii)):
        reach = radii[k] if is_boulder else 2.0 * radii[k]
        for face in range(FACES):
            axis = face // 2
            sign = 1.0 if face % 2 == 0 else -1.0
            along = sign * centres[k, axis]
            # A disc of this radius comes nowhere near faces that look away; the cube's corners are 55 deg off.
            if along < 0.2:
                continue
            p, q = centres[k, (axis + 1) % 3] / along, centres[k, (axis + 2) % 3] / along
            # A gnomonic face stretches by the square of the distance from the cube's centre at most.
            wide = (1.0 + p * p + q * q) * np.tan(reach) * 1.2
            low_p, high_p = int((p - wide + 1.0) * n / 2.0), int((p + wide + 1.0) * n / 2.0) + 1
            low_q, high_q = int((q - wide + 1.0) * n / 2.0), int((q + wide + 1.0) * n / 2.0) + 1
            for row in range(max(0, low_p), min(n, high_p) + 1):
                for column in range(max(0, low_q), min(n, high_q) + 1):
                    x, y, z = direction_of(face, 2.0 * row / n - 1.0, 2.0 * column / n - 1.0)
                    a, b, c = x - centres[k, 0], y - centres[k, 1], z - centres[k, 2]
                    d = np.sqrt(a * a + b * b + c * c) / radii[k]
                    field[face, row, column] += heights[k] * (_boulder(d) if is_boulder else _crater(d))


@numba.njit(cache=True)
def _boulder(d):  # type: ignore[no-untyped-def]
    return (1.0 - d * d) * (1.0 - d**4) if d < 1.0 else 0.0


@numba.njit(cache=True)
def _crater(d):  # type: ignore[no-untyped-def]
    """Bowl with a raised rim that fades to nothing at two radii; unit depth below the surroundings."""
    if d >= 2.0:
        return 0.0
    fade = (2.0 - d) ** 2
    return d * d * (1.0 + RIM_SHARE) - 1.0 if d < 1.0 else RIM_SHARE * fade * fade


@numba.njit(cache=True)
def value_at(field, x, y, z):  # type: ignore[no-untyped-def]
    """Bilinear value of a map in a direction of any length."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, p, q = (0 if x > 0.0 else 1), y / ax, z / ax
    elif ay >= az:
        face, p, q = (2 if y > 0.0 else 3), z / ay, x / ay
    else:
        face, p, q = (4 if z > 0.0 else 5), x / az, y / az
    n = field.shape[1] - 1
    row, column = 0.5 * (p + 1.0) * n, 0.5 * (q + 1.0) * n
    i, j = min(int(row), n - 1), min(int(column), n - 1)
    a, b = row - i, column - j
    above = (1.0 - b) * field[face, i, j] + b * field[face, i, j + 1]
    below = (1.0 - b) * field[face, i + 1, j] + b * field[face, i + 1, j + 1]
    return (1.0 - a) * above + a * below


@numba.njit(cache=True)
def values_at(field, places):  # type: ignore[no-untyped-def]
    """Values (n,) of a map in directions (n, 3)."""
    values = np.empty(len(places))
    for k in range(len(places)):
        values[k] = value_at(field, places[k, 0], places[k, 1], places[k, 2])
    return values


@numba.njit(cache=True)
def _steepest(radius):  # type: ignore[no-untyped-def]
    """Largest slope between neighbours of a map, rise over run."""
    n = radius.shape[1] - 1
    largest = 0.0
    for face in range(FACES):
        for row in range(n):
            for column in range(n):
                here = radius[face, row, column]
                x, y, z = direction_of(face, 2.0 * row / n - 1.0, 2.0 * column / n - 1.0)
                squares = 0.0
                for step in range(2):
                    other = radius[face, row + step, column + 1 - step]
                    a, b, c = direction_of(face, 2.0 * (row + step) / n - 1.0, 2.0 * (column + 1 - step) / n - 1.0)
                    run = here * np.sqrt((a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2)
                    squares += ((other - here) / run) ** 2
                largest = max(largest, squares)
    return np.sqrt(largest)


def _features(
    count: int, radii: tuple[float, float], slope: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return random directions (count, 3) and angular radii of which the number above a size falls as size^-slope."""
    centres = rng.standard_normal((count, 3))
    centres /= np.linalg.norm(centres, axis=1)[:, None]
    low, high = (r**-slope for r in radii)
    return centres, (low - rng.random(count) * (low - high)) ** (-1.0 / slope)


@numba.njit(cache=True)
def _figure(radius, semi_axes):  # type: ignore[no-untyped-def]
    """Fill maps with the radius of an ellipsoid."""
    n = radius.shape[1] - 1
    for face in range(FACES):
        for row in range(n + 1):
            for column in range(n + 1):
                x, y, z = direction_of(face, 2.0 * row / n - 1.0, 2.0 * column / n - 1.0)
                x, y, z = x / semi_axes[0], y / semi_axes[1], z / semi_axes[2]
                radius[face, row, column] = 1.0 / np.sqrt(x * x + y * y + z * z)


def directions_of_face(face: int, cells: int) -> FloatArray:
    """Return the unit vectors (n + 1, n + 1, 3) of a face's grid of n cells a side."""
    p, q = np.meshgrid(*[np.linspace(-1.0, 1.0, cells + 1)] * 2, indexing="ij")
    axis, sign = face // 2, 1.0 if face % 2 == 0 else -1.0
    rays = np.empty((cells + 1, cells + 1, 3))
    rays[..., axis], rays[..., (axis + 1) % 3], rays[..., (axis + 2) % 3] = sign, p, q
    unit: FloatArray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit


def make_asteroid(semi_axes_km: tuple[float, float, float], cells: int, seed: int, fine: bool = True) -> Asteroid:
    """Return the maps of the body; the same seed gives the same body at every resolution.

    Parameters
    ----------
    semi_axes_km
        Of the figure under all relief.
    cells
        Along each side of a face.
    seed
        Of everything random.
    fine
        Without it boulders and what is smaller than the cells are left out, as from a survey of far away.
    """
    rng = np.random.default_rng([seed, 31])
    mean_km = float(np.prod(semi_axes_km) ** (1.0 / 3.0))
    noise_seed, albedo_seed = (int(s) for s in rng.integers(1, 2**31, 2))
    relief = np.zeros((FACES, cells + 1, cells + 1))
    octaves = OCTAVES if fine else max(1, min(OCTAVES, int(np.log2(cells / (4.0 * BROADEST)))))
    _fractal(relief, BROADEST, octaves, 2.0**-ROUGHNESS, noise_seed)
    relief *= RELIEF
    centres, radii = _features(CRATERS, CRATER_RADIUS, 2.0, rng)
    depths = CRATER_DEPTH * radii * rng.uniform(0.25, 1.0, CRATERS)
    large = radii > (0.0 if fine else 2.0 / cells)
    _stamp(relief, centres[large], radii[large], depths[large], False)
    places, sizes = _features(BOULDERS, BOULDER_RADIUS, 2.5, rng)
    heights = BOULDER_HEIGHT * sizes * rng.uniform(0.5, 1.0, BOULDERS)
    if fine:
        _stamp(relief, places, sizes, heights, True)
    radius, albedo = np.zeros_like(relief), np.zeros_like(relief)
    _figure(radius, np.array(semi_axes_km))
    surface = (radius + mean_km * relief).astype(np.float32)
    _fractal(albedo, 2.0, OCTAVES - 2, 2.0**-0.45, albedo_seed)
    # Boulders are a little brighter than what they lie on.
    _stamp(albedo, places, sizes, rng.uniform(-0.2, 1.0, BOULDERS), True)
    albedo -= albedo.mean()
    albedo = np.maximum(1.0 + ALBEDO_RMS * albedo / albedo.std(), DARKEST).astype(np.float32)
    steep = float(np.hypot(1.0, _steepest(surface)))
    return Asteroid(surface, albedo, float(surface.max()), steep)
