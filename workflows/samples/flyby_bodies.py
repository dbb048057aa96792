"""Bodies of one frame of the flyby sample, made ready for its rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workflows.samples.cameras import FloatArray, SampleCamera, project
from workflows.samples.flyby_rays import HAZE_HEIGHTS, LAWS, Spheres, axes_of_sight, trace_silhouette
from workflows.samples.flyby_system import Sighting
from workflows.samples.flyby_terrain import Terrain

LIMB_DEPTH = 1.5
"""Optical depth of an atmosphere along a line of sight that grazes the surface."""
HAZE_BRIGHTNESS = 0.8
"""Brightness of a thick atmosphere under a high Sun, of the surface's."""


@dataclass(frozen=True)
class Scenery:
    """One body of a frame: how it is seen, what covers it, and a haze's scale height (km, zero for none)."""

    sighting: Sighting
    terrain: Terrain
    haze_km: float = 0.0
    brightness: float = 1.0


def _scaled_from_j2000(sighting: Sighting) -> FloatArray:
    """Return the matrix (3, 3) from J2000 km to a body's scaled axes."""
    scaled: FloatArray = sighting.from_j2000 / np.array(sighting.body.radii_km)[:, None]
    return scaled


def shades_of(sighting: Sighting, all_bodies: list[Sighting]) -> list[Sighting]:
    """Return the bodies whose shadow, a cylinder along the Sun's direction, comes near one."""
    near = []
    for other in all_bodies:
        apart = other.place_km - sighting.place_km
        along = float(apart @ sighting.sun)
        aside = float(np.linalg.norm(apart - along * sighting.sun))
        if other is not sighting and along > 0.0 and aside < max(other.body.radii_km) + max(sighting.body.radii_km):
            near.append(other)
    return near


def _shade(sighting: Sighting, other: Sighting) -> tuple[FloatArray, FloatArray]:
    """Return the matrix from one body's km to another's scaled axes, and the latter's centre there."""
    matrix = _scaled_from_j2000(other) @ sighting.from_j2000.T
    return matrix, _scaled_from_j2000(other) @ (other.place_km - sighting.place_km)


def _all_shades(sightings: list[Sighting], all_bodies: list[Sighting]) -> tuple[FloatArray, FloatArray]:
    """Return the matrices (n, m, 3, 3) and centres (n, m, 3) of the bodies that may shade each of n bodies."""
    shades = [[_shade(sighting, other) for other in shades_of(sighting, all_bodies)] for sighting in sightings]
    most = max(len(found) for found in shades)
    matrices, centres = np.zeros((len(shades), most, 3, 3)), np.zeros((len(shades), most, 3))
    for k, found in enumerate(shades):
        for j, (matrix, centre) in enumerate(found):
            matrices[k, j], centres[k, j] = matrix, centre
    return matrices, centres


def centre_and_radius(
    camera: SampleCamera, camera_from_j2000: FloatArray, sighting: Sighting
) -> tuple[FloatArray, float]:
    """Return the pixel (2,) of a body's centre, NaN behind the camera, and its apparent mean radius, px."""
    centre = project(camera, (camera_from_j2000 @ sighting.place_km)[None])[0]
    return centre, sighting.radius_rad / camera.rad_per_px


def prepare(
    camera: SampleCamera,
    camera_from_j2000: FloatArray,
    scenery: list[Scenery],
    all_bodies: list[Sighting],
    target: str,
) -> Spheres:
    """Return bodies ready for the rays of a camera.

    Parameters
    ----------
    camera_from_j2000
        (3, 3) where the camera really looks.
    scenery
        What can be in the frame; sorted here.
    all_bodies
        Whatever may throw a shadow.
    target
        Name of the body that the frame is about.
    """
    scenery = sorted(scenery, key=lambda item: item.sighting.range_km)
    sightings = [item.sighting for item in scenery]
    matrices = [_scaled_from_j2000(sighting) for sighting in sightings]
    eyes = [-matrix @ sighting.place_km for matrix, sighting in zip(matrices, sightings, strict=True)]
    axes = [axes_of_sight(eye) for eye in eyes]
    tables = [
        trace_silhouette(eye, ax, item.terrain.heights, item.terrain.highest)
        for eye, ax, item in zip(eyes, axes, scenery, strict=True)
    ]
    discs = [centre_and_radius(camera, camera_from_j2000, sighting) for sighting in sightings]
    hazes = [item.haze_km / item.sighting.body.mean_radius_km for item in scenery]
    radius_px = np.array([radius for _, radius in discs])
    widest = np.array([max(s.body.radii_km) / s.body.mean_radius_km for s in sightings])
    highest = np.array([item.terrain.highest for item in scenery])
    shades, shade_centres = _all_shades(sightings, all_bodies)
    return Spheres(
        eye=np.array(eyes),
        from_camera=np.array([matrix @ camera_from_j2000.T for matrix in matrices]),
        axes=np.array(axes),
        sun=np.array([s.from_j2000 @ s.sun for s in sightings]),
        inverse_radii=1.0 / np.array([s.body.radii_km for s in sightings]),
        silhouette=np.array(tables),
        centre_vu=np.array([centre for centre, _ in discs]),
        radius_px=radius_px,
        # Perspective enlarges what is near the camera's edge by less than a percent.
        reach_px=1.01 * radius_px * widest * (1.0 + highest) * (1.0 + HAZE_HEIGHTS * np.array(hazes)) + 3.0,
        highest=highest,
        law=np.array([LAWS.index(s.body.surface.law) for s in sightings]),
        parameter=np.array([s.body.surface.parameter for s in sightings]),
        brightness=np.array([item.brightness for item in scenery]),
        haze=np.array([(haze, LIMB_DEPTH if haze else 0.0, HAZE_BRIGHTNESS) for haze in hazes]),
        shades=shades,
        shade_centres=shade_centres,
        heights=np.stack([item.terrain.heights for item in scenery]),
        albedo=np.stack([item.terrain.albedo for item in scenery]),
        target=next(k for k, s in enumerate(sightings) if s.body.name == target),
    )
