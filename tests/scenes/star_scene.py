"""Star frames drawn for tests, with code of their own: brute-force sub-pixels, no part of the navigator."""

from dataclasses import dataclass

import numpy as np

from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, CameraModel, Detector, FloatArray, Image, Spacecraft, StarTable, State

FOCAL_MM = 2000.0
K_PX_PER_MM = 1000.0 / 12.0
READ_NOISE_DN = 4.0
GAIN_E_PER_DN = 12.0
ZERO_POINT_DN = 1.0e7
# The camera looks along +X of J2000, its x axis toward +Y and its y axis toward +Z.
LOOKING_ALONG_X = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class StarScene:
    """A frame with its catalogue and what was planted in it."""

    pixels: Image
    state: State
    stars: StarTable
    offset_vu: FloatArray
    rotation_rad: float


def turn(theta: float) -> FloatArray:
    """Rotation on (v, u) columns that turns +u toward +v."""
    return np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])


def draw(shape: tuple[int, int], places: FloatArray, flux: FloatArray, sigma: float, rng: np.random.Generator) -> Image:
    """Noisy frame of pixel-averaged Gaussians."""
    light = np.full(shape, 20.0)
    reach, fine = np.arange(-7, 8), (np.arange(7) - 3.0) / 7.0
    for (v, u), total in zip(places, flux, strict=True):
        rows, cols = int(np.rint(v)) + reach, int(np.rint(u)) + reach
        rows, cols = rows[(rows >= 0) & (rows < shape[0])], cols[(cols >= 0) & (cols < shape[1])]
        share_v = np.exp(-((rows[:, None] + fine - v) ** 2) / (2 * sigma**2)).mean(axis=1)
        share_u = np.exp(-((cols[:, None] + fine - u) ** 2) / (2 * sigma**2)).mean(axis=1)
        light[np.ix_(rows, cols)] += total * np.outer(share_v, share_u) / (2 * np.pi * sigma**2)
    noisy = rng.poisson(light * GAIN_E_PER_DN) / GAIN_E_PER_DN + rng.normal(0.0, READ_NOISE_DN, shape)
    return np.clip(np.rint(noisy), -32768, 32767).astype(np.float32)


def star_scene(
    rng: np.random.Generator,
    offset_vu: FloatArray,
    rotation_rad: float,
    *,
    shape: tuple[int, int] = (1024, 1024),
    stars: int = 40,
    false: int = 40,
    fit_rotation: bool = True,
    margin_vu: tuple[float, float] = (50.0, 140.0),
) -> StarScene:
    """Frame of an array with planted pointing error, false detections included."""
    centre = (np.array(shape) - 1) / 2
    catalogue = rng.uniform(-0.1, 1.1, (3 * stars, 2)) * np.array(shape)
    actual = centre + (catalogue - centre) @ turn(rotation_rad).T + offset_vu
    inside = ((actual > 5) & (actual < np.array(shape) - 6)).all(axis=1)
    catalogue, actual = catalogue[inside][:stars], actual[inside][:stars]
    flux = 10.0 ** rng.uniform(2.9, 4.5, len(catalogue))
    places = np.concatenate([actual, rng.uniform(5, np.array(shape) - 6, (false, 2))])
    pixels = draw(shape, places, np.concatenate([flux, 10.0 ** rng.uniform(2.7, 4.4, false)]), 0.6, rng)
    scale = 1.0 / (FOCAL_MM * K_PX_PER_MM)
    x, y = (catalogue[:, 1] - centre[1]) * scale, (catalogue[:, 0] - centre[0]) * scale
    return StarScene(
        pixels, scene_state(shape, fit_rotation, margin_vu),
        table(np.degrees(np.arctan2(x, 1.0)), np.degrees(np.arctan(y / np.hypot(1.0, x))), flux), offset_vu,
        rotation_rad,
    )  # fmt: skip


def table(ra_deg: FloatArray, dec_deg: FloatArray, flux_dn: FloatArray) -> StarTable:
    """Catalogue as seen, magnitudes that give the fluxes."""
    n, unknown = len(ra_deg), np.full(len(ra_deg), np.nan)
    return StarTable(
        np.array([f"s{k}" for k in range(n)]), ra_deg, dec_deg, -2.5 * np.log10(flux_dn / ZERO_POINT_DN), unknown,
        unknown, unknown, unknown, np.ones(n, bool),
    )  # fmt: skip


def scene_state(shape: tuple[int, int], fit_rotation: bool, margin_vu: tuple[float, float]) -> State:
    """State of the scene's pinhole camera."""
    centre = (np.array(shape) - 1) / 2
    camera = CameraModel(shape, FOCAL_MM, np.array([[K_PX_PER_MM, 0.0], [0.0, K_PX_PER_MM]]), centre)
    detector = Detector(
        psf_sigma_px=0.6, read_noise_dn=READ_NOISE_DN, gain_e_per_dn=GAIN_E_PER_DN, star_dn_per_s_mag0=ZERO_POINT_DN
    )
    settings = InstrumentSettings(fit_camera_rotation=fit_rotation, max_rotation_deg=5.0, search_margin_vu=margin_vu)
    return State(
        "scene", "SIM", "CAM", 0.0, "2000-01-01T12:00:00", 1.0, camera, detector, Attitude(LOOKING_ALONG_X),
        Spacecraft(), settings,
    )  # fmt: skip
