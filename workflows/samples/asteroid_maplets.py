"""Maplets of the asteroid, cut from its fine maps with errors planted, as SPC's MAPFILES and LMKFILES keep them.

Layouts: the Planetary Science Institute's public description of SPC; see `map_bytes` and `landmark_text`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from workflows.samples.asteroid_options import AsteroidOptions
from workflows.samples.asteroid_plan import AsteroidShot, eye_of, pixels_of
from workflows.samples.asteroid_rays import Ground, hits
from workflows.samples.asteroid_surface import value_at, values_at
from workflows.samples.cameras import FloatArray

RECORD_BYTES = 72
HEIGHT_STEPS = 30_000
SMOOTH_CELLS = 1.5
"""Errors of neighbouring cells are alike within about this many."""
NORMAL_POINTS = 9
"""Places along a side from which a maplet's mean normal is taken."""
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
MARGIN_PX = 40.0
"""Landmarks this far outside every frame have no maplet."""
FACING = 0.15
"""Landmarks seen under a lower sine of elevation in every frame have none either."""


@dataclass(frozen=True)
class SampleMaplet:
    """A maplet with its truth.

    Attributes
    ----------
    true_km, told_km
        (3,) the landmark, body-fixed: where it is, and where the catalogue has it.
    sigma_km
        (3,) 1 sigma of the latter, body axes.
    axes
        (3, 3) rows x, y and z of its frame.
    heights, albedo
        (n, n) as the catalogue has them, cells and relative; not-a-number where unknown.
    """

    name: str
    scale_km: float
    true_km: FloatArray
    told_km: FloatArray
    sigma_km: FloatArray
    axes: FloatArray
    heights: FloatArray
    albedo: FloatArray


def spread(count: int) -> FloatArray:
    """Return unit vectors (count, 3) that share the sphere evenly, along a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(GOLDEN * k), across * np.sin(GOLDEN * k), z], axis=1)


def _axes(normal: FloatArray) -> FloatArray:
    """Return the rows of a frame whose z is a unit normal and whose y points east, or along the equator at a pole."""
    pole = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    y = np.cross(pole, normal)
    y /= np.linalg.norm(y)
    # Single precision, which map files keep, must hold the very axes along which heights are cut.
    return np.stack([np.cross(y, normal), y, normal])


def _mean_normal(ground: Ground, way: FloatArray, side_km: float) -> FloatArray:
    """Return the normal of the plane that fits the surface best over a maplet's side."""
    radius = float(value_at(ground.radius_km, *way))
    x, y, z = _axes(way)
    steps = (np.arange(NORMAL_POINTS) / (NORMAL_POINTS - 1) - 0.5) * side_km
    a, b = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    ways = radius * z + a[:, None] * x + b[:, None] * y
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    places = ways * values_at(ground.radius_km, ways)[:, None]
    places -= places.mean(axis=0)
    normal = np.linalg.svd(places, full_matrices=False)[2][2]
    outward: FloatArray = normal if normal @ way > 0.0 else -normal
    return outward


def _cut(
    ground: Ground, place: FloatArray, axes: FloatArray, half: int, scale_km: float
) -> tuple[FloatArray, FloatArray]:
    """Return heights (cells) and albedo (n, n) along the normal: means of rays through each cell's quarters."""
    parts = 1 if scale_km < 2.0 * float(np.linalg.norm(place)) / (ground.radius_km.shape[1] - 1) * 2.0 else 2
    steps = ((np.arange((2 * half + 1) * parts) + 0.5) / parts - 0.5 - half) * scale_km
    reach = np.sqrt(2.0) * half * scale_km
    starts = place + steps[:, None, None] * axes[0] + steps[None, :, None] * axes[1] + reach * axes[2]
    starts = starts.reshape(-1, 3)
    rays = np.broadcast_to(-axes[2], starts.shape)
    down = hits(ground, starts, rays, 2.0 * reach)
    met = starts + down[:, None] * rays
    known = np.isfinite(down)
    light = np.full(len(down), np.nan)
    light[known] = values_at(ground.albedo, met[known])
    n = 2 * half + 1
    fields = [field.reshape(n, parts, n, parts).mean(axis=(1, 3)) for field in ((reach - down) / scale_km, light)]
    return fields[0], fields[1]


def _smooth_error(shape: tuple[int, ...], rms: float, rng: np.random.Generator) -> FloatArray:
    field = gaussian_filter(rng.standard_normal(shape), SMOOTH_CELLS, mode="wrap")
    error: FloatArray = rms * field / field.std()
    return error


def make_maplet(ground: Ground, options: AsteroidOptions, series: int, number: int, way: FloatArray) -> SampleMaplet:
    """Cut a maplet about the surface in a direction (3,), and plant its errors."""
    rng = np.random.default_rng([options.seed, series, number, 43])
    scale_km = options.scales_km[series]
    place = way * float(value_at(ground.radius_km, *way))
    axes = _axes(_mean_normal(ground, way, 2.0 * options.half * scale_km)).astype(np.float32).astype(np.float64)
    heights, albedo = _cut(ground, place, axes, options.half, scale_km)
    middle = heights[options.half, options.half]
    if np.isfinite(middle):
        # The landmark lies on the maplet's own surface.
        place, heights = place + middle * scale_km * axes[2], heights - middle
    heights += _smooth_error(heights.shape, options.height_error_cells, rng)
    albedo = albedo / np.nanmean(albedo) + _smooth_error(albedo.shape, options.albedo_error, rng)
    low, high = options.landmark_sigma_cells
    sigma = scale_km * np.exp(rng.uniform(np.log(low), np.log(high), 3)) if high > 0.0 else np.zeros(3)
    name = f"{chr(ord('A') + series)}A{number:04d}"
    told = place + sigma * rng.standard_normal(3)
    return SampleMaplet(name, scale_km, place, told, sigma, axes, heights, albedo)


def wanted(
    ground: Ground, shots: list[AsteroidShot], options: AsteroidOptions, series: int
) -> list[tuple[int, FloatArray]]:
    """Return numbers and directions of the landmarks of a scale that some frame may show."""
    area = 4.0 * np.pi * float(np.mean(ground.radius_km.astype(np.float64) ** 2))
    side = (2 * options.half + 1) * options.scales_km[series]
    ways = spread(max(1, round(options.coverage * area / side**2)))
    places = ways * values_at(ground.radius_km, ways)[:, None]
    seen = np.zeros(len(ways), np.bool_)
    for item in shots:
        optics, sighting = item.shot.camera.optics, item.sighting()
        sight = eye_of(sighting) - places
        facing = (sight * ways).sum(axis=1) > FACING * np.linalg.norm(sight, axis=1)
        pixels = pixels_of(optics, item.shot.truth, sighting, places)
        high = np.array(optics.shape_vu) - 1.0 + MARGIN_PX
        seen |= facing & np.all((pixels > -MARGIN_PX) & (pixels < high), axis=1)
    return [(int(k), ways[k]) for k in np.flatnonzero(seen)]


def map_bytes(maplet: SampleMaplet) -> bytes:
    """Return a MAP file: a record of 72 bytes, then three bytes per cell, filled up to whole records."""
    half = len(maplet.heights) // 2
    known = np.isfinite(maplet.heights)
    heights = np.where(known, maplet.heights, 0.0)
    step = float(np.float32(max(1.0, float(np.abs(heights).max())) / HEIGHT_STEPS))
    length = float(np.linalg.norm(maplet.sigma_km))
    direction = np.rint(255.0 * maplet.sigma_km / length).astype(int) if length > 0.0 else np.zeros(3, int)
    header = (
        bytes(6) + struct.pack(">f", maplet.scale_km) + struct.pack("<H", half) + bytes(direction.tolist())
        + struct.pack(">12f", *maplet.told_km, *maplet.axes.ravel()) + struct.pack(">ff", step, length) + bytes(1)
    )  # fmt: skip
    cells = np.zeros(heights.size, np.dtype([("height", ">i2"), ("albedo", "u1")]))
    cells["height"] = np.rint(heights / step).ravel()
    shade = np.clip(np.rint(100.0 * np.nan_to_num(maplet.albedo)), 1, 199)
    cells["albedo"] = np.where(known, shade, 0).ravel()
    body = cells.tobytes()
    return header + body + bytes(-len(body) % RECORD_BYTES)


def landmark_text(maplet: SampleMaplet) -> str:
    """Return an LMK file, without lists of pictures and neighbours."""
    half = len(maplet.heights) // 2
    rows = [
        f"{maplet.name:<8} T",
        f"{half:8d}{maplet.scale_km:12.7f}{'':42}SIZE, SCALE(KM)",
        f"{'-1':>10}{'-1':>10}{'-1':>10}{'-1':>10}{'':22}HORIZON",
        f"{_fortran([maplet.scale_km / 2.0, 0.0]):62}SIGKM, RMSLMK",
        f"{_fortran(maplet.told_km):62}VLM",
        *(f"{_fortran(axis):62}{label}" for axis, label in zip(maplet.axes, ("UX", "UY", "UZ"), strict=True)),
        f"{_fortran(maplet.sigma_km):62}SIGMA_LMK",
        "PICTURES",
        "MAP OVERLAPS",
        "LIMB FITS",
        "END FILE",
    ]
    return "\n".join(rows) + "\n"


def _fortran(values: FloatArray | list[float]) -> str:
    """Return numbers with D exponents, twenty columns each."""
    return "".join(f"{f'{float(value):.10E}'.replace('E', 'D'):>20}" for value in values)


def write_maplet(maplet: SampleMaplet, folder: Path) -> None:
    """Write a maplet's two files into MAPFILES and LMKFILES of a folder."""
    (folder / "MAPFILES" / f"{maplet.name}.MAP").write_bytes(map_bytes(maplet))
    (folder / "LMKFILES" / f"{maplet.name}.LMK").write_text(landmark_text(maplet), encoding="ascii")
