"""Frames of lit spheres in parallel projection, drawn for tests by sub-pixels: no part of the navigator."""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, Body, CameraModel, Detector, FloatArray, Image, Spacecraft, State
from tests.scenes.star_scene import turn

# So narrow a field that a sphere's parallel projection is the camera's to some thousandths of a pixel.
FOCAL_MM, PX_PER_MM, RANGE_KM = 5000.0, 200.0, 1.0e7
KM_PER_PX = RANGE_KM / (FOCAL_MM * PX_PER_MM)
READ_NOISE_DN, GAIN_E_PER_DN, SKY_DN = 3.0, 10.0, 20.0
OVER = 8


@dataclass(frozen=True)
class Ball:
    """A Lambert sphere.

    Attributes
    ----------
    place_vu
        Predicted centre, pixels.
    radius_px
        Radius.
    phase_deg, sun_deg
        Phase angle; direction of the Sun in the image, from +u toward +v.
    nearness
        Range of the scene over the ball's own: of two balls the larger is in front.
    haze_px
        Scale height of an atmosphere that the navigator is not told of.
    """

    place_vu: tuple[float, float]
    radius_px: float
    phase_deg: float
    sun_deg: float = 35.0
    nearness: float = 1.0
    haze_px: float = 0.0

    def sun_vuz(self, rotation_rad: float = 0.0) -> FloatArray:
        """(3,) unit vector to the Sun along v, u and away from the camera."""
        phase = np.radians(self.phase_deg)
        in_image = np.radians(self.sun_deg) + rotation_rad
        return np.array([np.sin(phase) * np.sin(in_image), np.sin(phase) * np.cos(in_image), -np.cos(phase)])

    def body(self, name: str, centre_vu: FloatArray) -> Body:
        """What the navigator is told."""
        range_km = RANGE_KM / self.nearness
        v, u = (np.array(self.place_vu) - centre_vu) / (FOCAL_MM * PX_PER_MM)
        sun = self.sun_vuz()[[1, 0, 2]]
        radius_km = self.radius_px * KM_PER_PX / self.nearness
        return Body(name, None, range_km * np.array([u, v, 1.0]), np.full(3, radius_km), np.eye(3), sun)


@dataclass(frozen=True)
class BallScene:
    """A frame with its geometry and what was planted in it."""

    pixels: Image
    state: State
    offset_vu: FloatArray
    rotation_rad: float


def light(
    shape: tuple[int, int], balls: tuple[Ball, ...], places_vu: FloatArray, rotation_rad: float, sigma_px: float
) -> FloatArray:
    """Blurred light of balls at given places, 1 where the Sun stands overhead."""
    # Light from beyond the frame is blurred into it.
    pad = int(np.ceil(5.0 * sigma_px))
    rows, cols = (n + 2 * pad for n in shape)
    v, u = ((np.arange(n * OVER) + 0.5) / OVER - 0.5 - pad for n in (rows, cols))
    fine = np.zeros((len(v), len(u)))
    for ball, place in sorted(zip(balls, places_vu, strict=True), key=lambda pair: pair[0].nearness):
        y, x = (v[:, None] - place[0]) / ball.radius_px, (u[None, :] - place[1]) / ball.radius_px
        r2 = x**2 + y**2
        sun = ball.sun_vuz(rotation_rad)
        lit = np.clip(y * sun[0] + x * sun[1] - np.sqrt(np.clip(1.0 - r2, 0.0, None)) * sun[2], 0.0, None)
        fine = np.where(r2 < 1.0, lit, fine)
        if ball.haze_px > 0.0:
            height_px = (np.sqrt(r2) - 1.0) * ball.radius_px
            rim = np.clip((y * sun[0] + x * sun[1]) / np.sqrt(np.maximum(r2, 1e-9)), 0.0, None)
            fine = np.where(r2 >= 1.0, fine + 0.6 * rim * np.exp(-height_px / ball.haze_px), fine)
    blurred = scipy.ndimage.gaussian_filter(fine, sigma_px * OVER, truncate=4.0)
    return np.asarray(blurred.reshape(rows, OVER, cols, OVER).mean(axis=(1, 3))[pad:-pad, pad:-pad])


def ball_scene(
    rng: np.random.Generator,
    balls: tuple[Ball, ...],
    offset_vu: tuple[float, float],
    rotation_rad: float = 0.0,
    *,
    shape: tuple[int, int] = (160, 180),
    brightness_dn: float = 1000.0,
    sigma_px: float = 0.8,
    fit_rotation: bool = False,
    margin_vu: tuple[float, float] = (15.0, 15.0),
    drawn: bool = True,
) -> BallScene:
    """Noisy frame of balls with a planted pointing error; of sky alone where they are not drawn."""
    centre = (np.array(shape) - 1) / 2
    predicted = np.array([ball.place_vu for ball in balls])
    actual = centre + (predicted - centre) @ turn(rotation_rad).T + offset_vu
    signal = np.full(shape, SKY_DN)
    if drawn:
        signal += brightness_dn * light(shape, balls, actual, rotation_rad, sigma_px)
    pixels = rng.poisson(signal * GAIN_E_PER_DN) / GAIN_E_PER_DN + rng.normal(0.0, READ_NOISE_DN, shape)
    camera = CameraModel(shape, FOCAL_MM, np.diag([PX_PER_MM, PX_PER_MM]), centre)
    nearest_first = sorted(enumerate(balls), key=lambda pair: -pair[1].nearness)
    state = State(
        "scene", "SIM", "CAM", 0.0, "2000-01-01T12:00:00", 1.0, camera,
        Detector(psf_sigma_px=sigma_px, read_noise_dn=READ_NOISE_DN, gain_e_per_dn=GAIN_E_PER_DN), Attitude(np.eye(3)),
        Spacecraft(),
        InstrumentSettings(fit_camera_rotation=fit_rotation, max_rotation_deg=3.0, search_margin_vu=margin_vu),
        tuple(ball.body(f"BALL{k}", centre) for k, ball in nearest_first),
    )  # fmt: skip
    return BallScene(pixels.astype(np.float32), state, np.array(offset_vu), rotation_rad)
