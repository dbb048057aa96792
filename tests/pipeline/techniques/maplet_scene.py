"""A rough plane in closed form: pictures by rays through every part of a pixel, maplets by its formula.

Nothing of the navigator's prediction is used: normals are analytic and pixels are integrated over 3 x 3 samples.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.camera import unproject
from pipeline.geometry.maplet import Maplet, MapletView
from pipeline.records import CameraModel, FloatArray

FOCAL_MM = 50.0
WAVES = 24


@dataclass(frozen=True)
class Relief:
    """Heights in km over a plane as a sum of waves; albedo likewise."""

    waves: FloatArray
    amplitudes: FloatArray
    phases: FloatArray

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray((self.amplitudes * np.sin(self._angles(x, y))).sum(axis=-1))

    def slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        inner = self.amplitudes * np.cos(self._angles(x, y))
        return (inner * self.waves[:, 0]).sum(axis=-1), (inner * self.waves[:, 1]).sum(axis=-1)

    def albedo(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(1.0 + 0.05 * np.sin(9.0 * x + 4.0 * y) * np.cos(3.0 * x - 8.0 * y))

    def _angles(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(x[..., None] * self.waves[:, 0] + y[..., None] * self.waves[:, 1] + self.phases)


def relief(seed: int, steepness: float = 0.12) -> Relief:
    """Waves of 0.25 to 3 km with one slope each."""
    rng = np.random.default_rng(seed)
    number = 2.0 * np.pi / 10 ** rng.uniform(np.log10(0.25), np.log10(3.0), WAVES)
    turn = rng.uniform(0, 2 * np.pi, WAVES)
    waves = number[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    amplitudes = 3.0 * steepness * np.sqrt(2 / WAVES) / number * rng.uniform(0.5, 1.5, WAVES)
    return Relief(waves, amplitudes, rng.uniform(0, 6.3, WAVES))


def maplet_on(surface: Relief, half: int, scale_km: float) -> Maplet:
    steps = np.arange(-half, half + 1) * scale_km
    x, y = np.meshgrid(steps, steps, indexing="ij")
    heights = (surface.height(x, y) - surface.height(np.zeros(1), np.zeros(1))) / scale_km
    place = np.array([0.0, 0.0, float(surface.height(np.zeros(1), np.zeros(1))[0])])
    return Maplet("A", place, np.eye(3), scale_km, heights, surface.albedo(x, y), np.zeros((3, 3)))


def view_down(
    pixel_km: float, off_nadir_rad: float, twist: float, sun: FloatArray, side: int = 160, mirrored: bool = False
) -> MapletView:
    """Camera 100 km from the origin with pixels of a given width there."""
    z = -np.array([np.sin(off_nadir_rad), 0.3 * np.sin(off_nadir_rad), np.cos(off_nadir_rad)])
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(twist), np.sin(twist)
    scale = 100.0 / pixel_km / FOCAL_MM
    camera = CameraModel(
        (side, side + 10), FOCAL_MM, np.diag([scale, -scale if mirrored else scale]),
        np.array([side / 2, side / 2 + 3]), np.array([2e-4, 0, 1e-5, 0, 0, 0]),
    )  # fmt: skip
    return MapletView(camera, np.stack([c * x + s * y, c * y - s * x, z]), -100.0 * z, sun / np.linalg.norm(sun))


def picture_of(surface: Relief, view: MapletView, offset_vu: FloatArray, beta: float) -> FloatArray:
    """DN as the camera sees the surface, everything displaced by ``offset_vu``; SPC's law with a given weight."""
    rows, cols = view.camera.shape_vu
    total = np.zeros((rows, cols))
    for a in (np.arange(3) + 0.5) / 3 - 0.5:
        for b in (np.arange(3) + 0.5) / 3 - 0.5:
            v, u = np.meshgrid(np.arange(rows) + a, np.arange(cols) + b, indexing="ij")
            rays, _ = unproject(view.camera, np.stack([v, u], axis=2).reshape(-1, 2) - offset_vu)
            rays = rays @ view.camera_from_body
            height = np.zeros(len(rays))
            for _ in range(5):
                depth = (height - view.position_km[2]) / rays[:, 2]
                points = view.position_km + depth[:, None] * rays
                height = surface.height(points[:, 0], points[:, 1])
            total += _light(surface, points, -rays, view.sun, beta).reshape(rows, cols)
    return 1000.0 * total / 9 + 20.0


def _light(surface: Relief, points: FloatArray, to_camera: FloatArray, sun: FloatArray, beta: float) -> FloatArray:
    dx, dy = surface.slopes(points[:, 0], points[:, 1])
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=1) / np.sqrt(1 + dx**2 + dy**2)[:, None]
    mu0, mu = np.clip(normal @ sun, 0, None), np.clip((normal * to_camera).sum(axis=1), 1e-6, None)
    light = (1 - beta) * mu0 + beta * mu0 / (mu0 + mu)
    return np.asarray(surface.albedo(points[:, 0], points[:, 1]) * light)
