"""Heights and albedo of the flyby sample's bodies: Gaussian random fields on the sphere, and what is told of them.

A field is a sum of surface harmonics with random coefficients, isotropic because their variance depends on the degree
alone. Maps hold one value per quarter of a degree, with the neighbours that interpolation needs beyond each edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from scipy.special import eval_legendre, expit

from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_rays import PAD, STEP_DEG, MapArray, axes_of_sight, trace_silhouette
from workflows.samples.flyby_system import SampleBody

ROWS, COLUMNS = round(180 / STEP_DEG) + 1, round(360 / STEP_DEG)
HIGHEST_DEGREE = 180
"""Shortest wavelength 2 deg, eight cells of the map."""
ALBEDO_DEGREES = (2, 120)
ALBEDO_SLOPE = 1.3
DARKEST = 0.25
"""Lowest relative albedo."""
LUMP_DEGREES = (2, 5)
LIMB_VIEWS = 6
FAR = 300.0
"""Distance, in radii, from which limbs are looked at."""


@dataclass(frozen=True)
class Terrain:
    """Maps of one body, rows from the south pole, columns eastward from the prime meridian.

    Attributes
    ----------
    heights
        (725, 1444) relative to the radius.
    albedo
        (725, 1444) relative to the mean.
    highest
        Largest height.
    rms, correlation_deg
        Of the heights: their rms about their mean over the sphere, and the angle at which their autocovariance has
        fallen to 1/e.
    """

    heights: MapArray
    albedo: MapArray
    highest: float
    rms: float
    correlation_deg: float


@numba.njit(cache=True)
def _longitude_series(cosines, sines, latitudes):  # type: ignore[no-untyped-def]
    """Sum over degrees of harmonics of 4 pi norm, per order: complex (latitudes, degrees), as irfft wants it.

    The recursion of Holmes and Featherstone 2002, J. Geodesy 76, 279, eqs. 11-13. Sines to a high power underflow to
    zero near the poles, where those harmonics vanish.
    """
    top = cosines.shape[0] - 1
    series = np.zeros((len(latitudes), top + 1), np.complex128)
    for row in range(len(latitudes)):
        t, u = np.sin(latitudes[row]), np.cos(latitudes[row])
        sectoral = 1.0
        for m in range(top + 1):
            if m > 0:
                factor = 3.0 if m == 1 else (2.0 * m + 1.0) / (2.0 * m)
                sectoral *= u * np.sqrt(factor)
            before, here = 0.0, sectoral
            real, imaginary = cosines[m, m] * here, sines[m, m] * here
            for n in range(m + 1, top + 1):
                a = np.sqrt((2.0 * n - 1.0) * (2.0 * n + 1.0) / ((n - m) * (n + m)))
                b = 0.0
                if n > m + 1:
                    b = np.sqrt((2.0 * n + 1.0) * (n + m - 1.0) * (n - m - 1.0) / ((n - m) * (n + m) * (2.0 * n - 3.0)))
                before, here = here, a * t * here - b * before
                real += cosines[n, m] * here
                imaginary += sines[n, m] * here
            series[row, m] = complex(real, -imaginary)
    return series


def degree_variances(degrees: tuple[int, int], slope: float) -> FloatArray:
    """Return the variance (n,) of each degree from 0 on: degree^-slope between two degrees, one in all."""
    n = np.arange(degrees[1] + 1, dtype=np.float64)
    variance = np.where(n >= degrees[0], np.maximum(n, 1.0) ** -slope, 0.0)
    normed: FloatArray = variance / variance.sum()
    return normed


def random_field(
    degrees: tuple[int, int], slope: float, rng: np.random.Generator, zonal: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return a random field of rms 1 on the map's grid (721, 1440), and the variance (n,) that each degree got."""
    variance = degree_variances(degrees, slope)
    top = len(variance)
    sigma = np.sqrt(variance / (2.0 * np.arange(top) + 1.0))[:, None]
    below = np.tri(top) if not zonal else np.eye(1, top)[np.zeros(top, dtype=int)]
    cosines = sigma * rng.standard_normal((top, top)) * below
    sines = sigma * rng.standard_normal((top, top)) * below
    sines[:, 0] = 0.0
    got = (cosines**2 + sines**2).sum(axis=1)
    latitudes = np.radians(np.linspace(-90.0, 90.0, ROWS))
    series = _longitude_series(cosines, sines, latitudes)
    # irfft divides by the count and doubles every order but the first.
    series[:, 0] *= 2.0
    field = np.fft.irfft(series, n=COLUMNS, axis=1) * COLUMNS / 2.0
    norm = np.sqrt(got.sum())
    return field / norm, got / got.sum()


def padded(field: FloatArray) -> MapArray:
    """Return a map (721, 1440) with the rows beyond the poles and the columns beyond the date line."""
    over = np.roll(field, COLUMNS // 2, axis=1)
    rows = np.vstack([over[PAD:0:-1], field, over[-2 : -PAD - 2 : -1]])
    return np.ascontiguousarray(np.hstack([rows[:, -PAD:], rows, rows[:, :PAD]]), dtype=np.float32)


def correlation_angle_deg(variance: FloatArray) -> float:
    """Return the angle at which the autocovariance, the sum of V_n P_n(cos angle), has fallen to 1/e of its start."""
    angles = np.linspace(0.0, 60.0, 6001)
    cosine = np.cos(np.radians(angles))
    covariance = sum(v * eval_legendre(n, cosine) for n, v in enumerate(variance) if v > 0.0)
    return float(angles[np.argmax(np.asarray(covariance) < variance.sum() / np.e)])


def _spots(count: int, rng: np.random.Generator) -> FloatArray:
    """Return bright and dark spots of several sizes with soft rims, on the map's grid."""
    latitude = np.radians(np.linspace(-90.0, 90.0, ROWS))[:, None]
    longitude = np.radians(np.arange(COLUMNS) * STEP_DEG)[None, :]
    field = np.zeros((ROWS, COLUMNS))
    for _ in range(count):
        sine, east = rng.uniform(-1.0, 1.0), rng.uniform(0.0, 2.0 * np.pi)
        radius = np.radians(12.0 * rng.random() ** 2 + 2.0)
        near = np.sin(latitude) * sine + np.cos(latitude) * np.sqrt(1.0 - sine**2) * np.cos(longitude - east)
        apart = np.arccos(np.clip(near, -1.0, 1.0))
        field += rng.normal() * expit(12.0 * (1.0 - apart / radius))
    return field


def _albedo(body: SampleBody, rng: np.random.Generator) -> MapArray:
    field, _ = random_field(ALBEDO_DEGREES, ALBEDO_SLOPE, rng)
    if body.surface.banded:
        bands, _ = random_field((3, 40), 1.0, rng, zonal=True)
        field = 0.3 * field + bands
    else:
        field = field + 0.7 * _spots(25, rng)
    weight = np.cos(np.radians(np.linspace(-90.0, 90.0, ROWS)))[:, None]
    mean = float((field * weight).sum() / (weight.sum() * COLUMNS))
    rms = float(np.sqrt(((field - mean) ** 2 * weight).sum() / (weight.sum() * COLUMNS)))
    return padded(np.maximum(1.0 + body.surface.albedo_rms * (field - mean) / rms, DARKEST))


def limb_lift(heights: MapArray, highest: float, rng: np.random.Generator) -> float:
    """Return by how much limbs stand above the surface's mean, over the radius.

    A limb is the outermost of all that is near it, so ellipsoids that are fitted to limbs, as the radii of real bodies
    are, lie above the mean surface by up to a third of the rms.
    """
    lifts = []
    for way in rng.standard_normal((LIMB_VIEWS, 3)):
        eye = FAR * way / np.linalg.norm(way)
        lifts.append(FAR * np.sin(trace_silhouette(eye, axes_of_sight(eye), heights, highest)).mean() - 1.0)
    return float(np.mean(lifts))


@lru_cache(maxsize=16)
def terrain_of(body: SampleBody, seed: int) -> Terrain:
    """Return the terrain of a body, its radii being those of limbs; the same seed gives the same."""
    rng = np.random.default_rng([seed, body.naif_id, 11])
    surface = body.surface
    field, variance = random_field((surface.lowest_degree, HIGHEST_DEGREE), surface.slope, rng)
    heights, highest = padded(surface.roughness * field), float(surface.roughness * field.max())
    lift = limb_lift(heights, highest, rng)
    correlation = round(correlation_angle_deg(variance), 3)
    return Terrain(heights - np.float32(lift), _albedo(body, rng), highest - lift, surface.roughness, correlation)


def lumpy(terrain: Terrain, rms: float, rng: np.random.Generator) -> Terrain:
    """Return a terrain with broad lumps added that no ellipsoid has, of some rms over the radius."""
    field, _ = random_field(LUMP_DEGREES, 1.0, rng)
    heights = terrain.heights + padded(rms * field)
    return Terrain(heights, terrain.albedo, float(heights.max()), terrain.rms, terrain.correlation_deg)


def smooth_terrain() -> Terrain:
    """Return the terrain of a smooth grey ellipsoid."""
    flat = np.zeros((ROWS + 2 * PAD, COLUMNS + 2 * PAD), dtype=np.float32)
    return Terrain(flat, flat + np.float32(1.0), 0.0, 0.0, 5.0)
