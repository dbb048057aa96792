"""Frames of rings drawn for tests by sub-pixels, with formulas of their own: no part of the navigator."""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.ndimage

from pipeline.options import InstrumentSettings
from pipeline.records import (
    Attitude,
    CameraModel,
    Detector,
    FloatArray,
    Image,
    RingFeature,
    RingKind,
    RingSystem,
    Spacecraft,
    State,
)
from tests.scenes.star_scene import turn

# A kilometre per pixel, in so narrow a field that a shift of the image is a turn of the camera.
FOCAL_MM, PX_PER_MM, RANGE_KM = 5000.0, 1000.0, 5.0e6
READ_NOISE_DN, GAIN_E_PER_DN, SKY_DN = 4.0, 12.0, 20.0


@dataclass(frozen=True)
class Band:
    """A ringlet (brighter than what is around) or gap (darker) between two radii, pixels at the frame's centre."""

    inner: float
    width: float
    light: float
    eccentric: float = 0.0
    peri_rad: float = 0.0
    mode: tuple[int, float, float] | None = None
    sigma: float = 0.0
    error: float = 0.0

    def inside(self, radius: FloatArray, longitude: FloatArray) -> FloatArray:
        """Where a point lies between the true edges."""
        e = self.eccentric / self.inner
        wave = np.zeros(len(longitude))
        if self.mode is not None:
            m, amplitude, longitude0 = self.mode
            wave = amplitude * np.cos(m * (longitude - longitude0))
        conic = (1.0 - e * e) / (1.0 + e * np.cos(longitude - self.peri_rad))
        low = self.inner * conic - wave + self.error
        high = (self.inner + self.width) * conic - wave + self.error
        return np.asarray((radius >= low) & (radius < high), float)

    def feature(self, name: str) -> RingFeature:
        """What the navigator is told."""
        modes = np.zeros((0, 3))
        if self.mode is not None:
            m, amplitude, longitude0 = self.mode
            modes = np.array([[m, amplitude, m * longitude0]])
        kind = RingKind.RINGLET if self.light > 0 else RingKind.GAP
        return RingFeature(
            name, kind, self.inner, self.eccentric, self.peri_rad, self.width, 1.0 if self.light > 0 else 0.0,
            self.sigma, modes,
        )  # fmt: skip


@dataclass(frozen=True)
class RingView:
    """How a ring plane lies before the camera.

    Attributes
    ----------
    opening_rad
        Elevation of the camera over the plane.
    tilt_rad
        Direction of the node line in the image, from +u toward +v.
    aim
        (2,) radius and longitude of the ring point in the middle of the frame.
    """

    opening_rad: float
    tilt_rad: float
    aim: tuple[float, float]

    def axes(self) -> FloatArray:
        """(3, 3) rows: x, y and pole of the ring frame in camera axes."""
        c, s = np.cos(self.tilt_rad), np.sin(self.tilt_rad)
        x = np.array([c, s, 0.0])
        pole = np.array([-s * np.cos(self.opening_rad), c * np.cos(self.opening_rad), -np.sin(self.opening_rad)])
        return np.stack([x, np.cross(pole, x), pole])

    def centre_km(self) -> FloatArray:
        """(3,) planet's centre in camera axes."""
        radius, longitude = self.aim
        point = radius * np.array([np.cos(longitude), np.sin(longitude), 0.0])
        return np.asarray(np.array([0.0, 0.0, RANGE_KM]) - self.axes().T @ point)


@dataclass(frozen=True)
class RingScene:
    """A frame with its geometry and what was planted in it."""

    pixels: Image
    state: State
    offset_vu: FloatArray
    rotation_rad: float
    clean: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


def light(
    shape: tuple[int, int], bands: tuple[Band, ...], view: RingView, base: float, offset_vu: FloatArray,
    rotation_rad: float, sigma_px: float, over: int,
) -> FloatArray:  # fmt: skip
    """Blurred light of the bands, in the bands' own unit."""
    pad = int(np.ceil(4.0 * sigma_px)) + 1
    rows, cols = (n + 2 * pad for n in shape)
    v, u = ((np.arange(n * over) + 0.5) / over - 0.5 - pad for n in (rows, cols))
    seen = np.stack(np.meshgrid(v, u, indexing="ij"), axis=2).reshape(-1, 2)
    centre = (np.array(shape) - 1) / 2
    # Where the prediction had what is seen here.
    before = centre + (seen - centre - offset_vu) @ turn(rotation_rad)
    rays = np.column_stack([(before - centre)[:, ::-1] / (FOCAL_MM * PX_PER_MM), np.ones(len(seen))])
    axes, planet = view.axes(), view.centre_km()
    reach = (axes[2] @ planet) / (rays @ axes[2])
    points = (rays * reach[:, None] - planet) @ axes[:2].T
    radius, longitude = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    fine = np.full(len(seen), base)
    for band in bands:
        fine = fine + band.light * band.inside(radius, longitude)
    fine[reach <= 0] = 0.0
    blurred = scipy.ndimage.gaussian_filter(fine.reshape(rows * over, cols * over), sigma_px * over, truncate=4.0)
    return np.asarray(blurred.reshape(rows, over, cols, over).mean(axis=(1, 3))[pad:-pad, pad:-pad])


def ring_scene(
    rng: np.random.Generator,
    bands: tuple[Band, ...],
    view: RingView,
    offset_vu: tuple[float, float],
    rotation_rad: float = 0.0,
    *,
    shape: tuple[int, int] = (200, 220),
    snr: float = 30.0,
    sigma_px: float = 0.8,
    fit_rotation: bool = False,
    margin_vu: tuple[float, float] = (20.0, 20.0),
    over: int = 4,
) -> RingScene:
    """Noisy frame of rings with a planted pointing error; ``snr`` is a unit of light over a dark pixel's noise."""
    noise = float(np.hypot(READ_NOISE_DN, np.sqrt(SKY_DN / GAIN_E_PER_DN)))
    base = 1.0 if any(band.light < 0 for band in bands) else 0.0
    offset = np.array(offset_vu)
    signal = SKY_DN + snr * noise * light(shape, bands, view, base, offset, rotation_rad, sigma_px, over)
    pixels = rng.poisson(np.maximum(signal, 0.0) * GAIN_E_PER_DN) / GAIN_E_PER_DN
    pixels = pixels + rng.normal(0.0, READ_NOISE_DN, shape)
    centre = (np.array(shape) - 1) / 2
    rings = RingSystem(
        "RINGED", view.centre_km(), view.axes(), view.opening_rad, None,
        tuple(band.feature(f"R{k}") for k, band in enumerate(bands)),
    )  # fmt: skip
    state = State(
        "scene", "SIM", "CAM", 0.0, "2000-01-01T12:00:00", 1.0,
        CameraModel(shape, FOCAL_MM, np.diag([PX_PER_MM, PX_PER_MM]), centre),
        Detector(psf_sigma_px=sigma_px, read_noise_dn=READ_NOISE_DN, gain_e_per_dn=GAIN_E_PER_DN),
        Attitude(np.eye(3)), Spacecraft(),
        InstrumentSettings(fit_camera_rotation=fit_rotation, max_rotation_deg=5.0, search_margin_vu=margin_vu),
        (), rings,
    )  # fmt: skip
    return RingScene(pixels.astype(np.float32), state, offset, rotation_rad, signal)


def random_bands(rng: np.random.Generator, radius: float, squeeze: float, count: int, sigma: float) -> tuple[Band, ...]:
    """Ringlets or gaps around a radius, some pixels apart as seen where radii are squeezed by a factor."""
    gaps = rng.random() < 0.3
    starts = np.cumsum(rng.uniform(8.0, 30.0, count) / squeeze)
    starts += radius - starts.mean()
    bands = []
    for start in starts:
        width = rng.uniform(1.5, 7.0) / squeeze
        share = rng.uniform(0.4, 1.0)
        ae = float(rng.uniform(0.0, 0.003)) * start if rng.random() < 0.5 else 0.0
        mode = (int(rng.integers(2, 6)), float(rng.uniform(0.5, 2.0)), float(rng.uniform(0, 6.0)))
        bands.append(
            Band(
                float(start), float(width), -share if gaps else share, float(ae), float(rng.uniform(0, 2 * np.pi)),
                mode if rng.random() < 0.4 else None, sigma, float(rng.normal(0.0, sigma)),
            )
        )
    return tuple(bands)


def with_error(band: Band, error: float) -> Band:
    """The same band, truly elsewhere."""
    return replace(band, error=error)
