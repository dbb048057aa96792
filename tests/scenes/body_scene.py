"""Frames of lit ellipsoids drawn for tests by brute force: every ray is traced, no part of the navigator's renderer."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from pipeline.camera import unproject
from pipeline.geometry.pointing import corrected_attitude
from pipeline.options import InstrumentSettings
from pipeline.records import (
    Attitude,
    Body,
    BoolArray,
    CameraModel,
    Detector,
    FloatArray,
    Image,
    Photometry,
    Spacecraft,
    State,
)

FOCAL_MM = 200.0
PX_PER_MM = 10.0
READ_NOISE_DN = 3.0
GAIN_E_PER_DN = 10.0
SKY_DN = 20.0
BRIGHT_DN = 1500.0


def camera_of(shape: tuple[int, int], mirrored: bool = False) -> CameraModel:
    """Pinhole whose axis goes through the array's centre; a mirrored one counts its rows against +y."""
    k = np.diag([PX_PER_MM, -PX_PER_MM if mirrored else PX_PER_MM])
    return CameraModel(shape, FOCAL_MM, k, (np.array(shape) - 1) / 2)


def corner_camera(shape: tuple[int, int], mirrored: bool = False) -> CameraModel:
    """Corner of a camera that is distorted like Cassini's wide-angle one: some pixels, differently across the array."""
    k = 1000.0 / 12.0 * np.diag([1.0, -1.0 if mirrored else 1.0])
    eps = np.array([-6.3e-5, 0.0, 2e-5, -2e-5, 1e-5, 0.0])
    return CameraModel(shape, FOCAL_MM, k, np.array([480.0, -430.0]), eps)


def body_at(
    camera: CameraModel,
    centre_vu: tuple[float, float],
    radius_px: float,
    phase_deg: float = 60.0,
    clock_deg: float = 20.0,
    *,
    name: str = "BODY",
    range_km: float = 1e5,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
    body_from_j2000: FloatArray | None = None,
    photometry: Photometry = Photometry.LAMBERT,
    shape_sigma_km: float | None = None,
) -> Body:
    """Body at a pixel of a camera whose axes are J2000's, lit from a direction that turns about the line of sight.

    The semi-axes are ``axes`` times the radius.
    """
    ray = unproject(camera, np.array([centre_vu]))[0][0]
    across = np.cross(ray, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    clock, phase = np.radians(clock_deg), np.radians(phase_deg)
    aside = np.cos(clock) * across + np.sin(clock) * np.cross(ray, across)
    sun = -np.cos(phase) * ray + np.sin(phase) * aside
    focal_px = camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm)))
    radii = radius_px / focal_px * range_km * np.array(axes)
    rotation = np.eye(3) if body_from_j2000 is None else body_from_j2000
    return Body(
        name, None, ray * range_km, radii, rotation, sun / np.linalg.norm(sun), photometry,
        shape_sigma_km=shape_sigma_km,
    )  # fmt: skip


def body_state(
    bodies: tuple[Body, ...],
    camera: CameraModel,
    *,
    sigma_px: float = 0.8,
    fit_rotation: bool = False,
    margin_vu: tuple[float, float] = (12.0, 16.0),
) -> State:
    """Geometry that predicts the bodies where :func:`body_at` put them."""
    settings = InstrumentSettings(fit_camera_rotation=fit_rotation, search_margin_vu=margin_vu)
    detector = Detector(psf_sigma_px=sigma_px, read_noise_dn=READ_NOISE_DN, gain_e_per_dn=GAIN_E_PER_DN)
    return State(
        "scene", "SIM", "CAM", 0.0, "2000-01-01T12:00:00", 1.0, camera, detector, Attitude(np.eye(3)), Spacecraft(),
        settings, bodies,
    )  # fmt: skip


def law(body: Body, phase_rad: float, mu0: FloatArray, mu: FloatArray) -> FloatArray:
    """Scattering laws as printed, without a parameter of the body's own."""
    lit = np.clip(mu0, 0.0, None)
    if body.photometry is Photometry.LAMBERT:
        return lit
    if body.photometry is Photometry.MINNAERT:
        return np.where(lit > 0, lit**0.7 * np.clip(mu, 1e-6, None) ** -0.3, 0.0)
    seeliger = np.where(lit > 0, 2.0 * lit / np.where(lit > 0, lit + mu, 1.0), 0.0)
    if body.photometry is Photometry.LOMMEL_SEELIGER:
        return seeliger
    g = np.degrees(phase_rad)
    weight = min(max(1.0 - 0.019 * g + 2.42e-4 * g**2 - 1.46e-6 * g**3, 0.0), 1.0)
    return np.asarray(weight * seeliger + (1.0 - weight) * lit)


def first_hit(radii_km: FloatArray, start_km: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Distance along rays, in their lengths, to an ellipsoid at the origin; by closest approach on the unit sphere."""
    s, d = start_km / radii_km, rays / radii_km
    length = np.linalg.norm(d, axis=-1)
    unit = d / length[..., None]
    nearest = -(unit * s).sum(axis=-1)
    miss2 = ((s + nearest[..., None] * unit) ** 2).sum(axis=-1)
    hit = (miss2 < 1.0) & (nearest > 0)
    return (nearest - np.sqrt(np.where(hit, 1.0 - miss2, 0.0))) / length, hit


def rays_of(camera: CameraModel, over: int) -> FloatArray:
    """(rows * cols * over^2, 3) rays; solved at the corners of all pixels, linear inside each."""
    rows, cols = camera.shape_vu
    v, u = np.arange(rows + 1) - 0.5, np.arange(cols + 1) - 0.5
    knots = unproject(camera, np.stack(np.meshgrid(v, u, indexing="ij"), axis=-1).reshape(-1, 2))[0]
    knots = (knots / knots[:, 2:]).reshape(rows + 1, cols + 1, 3)
    row, col = (np.arange(rows * over) + 0.5) / over, (np.arange(cols * over) + 0.5) / over
    i, j = row.astype(int), col.astype(int)
    f, g = (row - i)[:, None, None], (col - j)[None, :, None]
    down = knots[i] * (1.0 - f) + knots[i + 1] * f
    return np.asarray(down[:, j] * (1.0 - g) + down[:, j + 1] * g).reshape(-1, 3)


def trace(
    bodies: tuple[Body, ...],
    camera: CameraModel,
    camera_from_j2000: FloatArray,
    over: int,
    shaded_by: tuple[Body, ...] = (),
) -> tuple[FloatArray, FloatArray]:
    """Radiance and cover along ``over`` times ``over`` rays in each pixel, the nearest body in front.

    ``shaded_by`` are bodies that throw shadows beside the drawn ones.
    """
    rays = rays_of(camera, over) @ camera_from_j2000
    light, cover, depth = np.zeros(len(rays)), np.zeros(len(rays)), np.full(len(rays), np.inf)
    for body in bodies:
        turn = body.body_from_j2000
        t, hit = first_hit(body.radii_km, -turn @ body.position_km, rays @ turn.T)
        won = np.flatnonzero(hit & (t < depth))
        points = t[won, None] * rays[won]
        normal = ((points - body.position_km) @ turn.T / body.radii_km**2) @ turn
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        sun = body.sun_direction_j2000
        mu = -(normal * rays[won]).sum(axis=1) / np.linalg.norm(rays[won], axis=1)
        phase = np.arccos(-sun @ body.position_km / np.linalg.norm(body.position_km))
        value = law(body, float(phase), normal @ sun, mu)
        for other in {o.name: o for o in (*bodies, *shaded_by) if o.name != body.name}.values():
            start = (points - other.position_km) @ other.body_from_j2000.T
            toward = np.broadcast_to(other.body_from_j2000 @ sun, start.shape)
            value = np.where(first_hit(other.radii_km, start, toward)[1], 0.0, value)
        light[won], cover[won], depth[won] = value, 1.0, t[won]
    shape = (camera.shape_vu[0] * over, camera.shape_vu[1] * over)
    return light.reshape(shape), cover.reshape(shape)


def seen(fine: FloatArray, over: int, sigma_px: float) -> FloatArray:
    """Traced light through a Gaussian and over whole pixels."""
    blurred = gaussian_filter(fine, sigma_px * over, mode="nearest", truncate=5.0)
    rows, cols = fine.shape[0] // over, fine.shape[1] // over
    return np.asarray(blurred.reshape(rows, over, cols, over).mean(axis=(1, 3)))


def planted_light(state: State, offset_vu: FloatArray, rotation_rad: float = 0.0, over: int = 6) -> FloatArray:
    """Light of all bodies, brightness one, under the pointing that a correction makes true."""
    camera, sigma = state.camera_model, state.detector.psf_sigma_px
    assert sigma is not None
    attitude = corrected_attitude(camera, state.attitude.camera_from_j2000, offset_vu, rotation_rad)
    return seen(trace(state.bodies, camera, attitude, over)[0], over, sigma)


def noisy(light: FloatArray, rng: np.random.Generator, bright_dn: float = BRIGHT_DN) -> Image:
    """Frame with photon and read noise."""
    total = rng.poisson((bright_dn * light + SKY_DN) * GAIN_E_PER_DN) / GAIN_E_PER_DN
    return np.asarray(total + rng.normal(0.0, READ_NOISE_DN, light.shape), np.float32)


@dataclass(frozen=True)
class Roughness:
    """Unknown albedo and relief of a sphere: Gaussian fields of exponential covariance.

    Attributes
    ----------
    texture, texture_reach
        Relative rms of albedo and its reach in radii.
    wide_texture, wide_reach
        The same of provinces.
    relief, relief_reach
        Relative rms of the radius and its reach in radii.
    """

    texture: float
    texture_reach: float
    wide_texture: float
    wide_reach: float
    relief: float
    relief_reach: float


def random_field(directions: FloatArray, reach: float, rng: np.random.Generator, waves: int = 96) -> FloatArray:
    """Unit-variance field with covariance exp(-distance / reach) at unit vectors, as a sum of random waves.

    In three dimensions that covariance is the characteristic function of Cauchy's distribution.
    """
    k = rng.normal(size=(waves, 3)) / np.abs(rng.normal(size=(waves, 1))) / reach
    phase = rng.uniform(0, 2 * np.pi, waves)
    return np.asarray(np.sqrt(2.0 / waves) * np.cos(directions @ k.T + phase).sum(axis=1))


def rough_light(
    state: State, offset_vu: FloatArray, rough: Roughness, rng: np.random.Generator, over: int = 5
) -> FloatArray:
    """Light of the state's one sphere with a rough limb and an unknown face."""
    (body,) = state.bodies
    camera, sigma = state.camera_model, state.detector.psf_sigma_px
    assert sigma is not None
    attitude = corrected_attitude(camera, state.attitude.camera_from_j2000, offset_vu)
    centre, radius = attitude @ body.position_km, float(body.radii_km[0])
    sun = attitude @ body.sun_direction_j2000
    rays = rays_of(camera, over)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    closest = (rays @ centre)[:, None] * rays - centre
    miss = np.linalg.norm(closest, axis=1)
    height = np.ones(len(rays))
    near = np.abs(miss / radius - 1.0) < 5.0 * rough.relief
    if near.any():
        height[near] += rough.relief * random_field(closest[near] / miss[near, None], rough.relief_reach, rng)
    hit = np.flatnonzero(miss < radius * height)
    normal = closest[hit] - np.sqrt(np.clip(radius**2 - miss[hit] ** 2, 0.0, None))[:, None] * rays[hit]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    phase = float(np.arccos(-sun @ centre / np.linalg.norm(centre)))
    light = np.zeros(len(rays))
    light[hit] = law(body, phase, normal @ sun, -(normal * rays[hit]).sum(axis=1))
    # Albedo hardly changes within a pixel: of neighbours in a row one is computed.
    some = normal[::over]
    albedo = 1.0 + rough.texture * random_field(some, rough.texture_reach, rng)
    albedo += rough.wide_texture * random_field(some, rough.wide_reach, rng)
    light[hit] *= np.repeat(albedo, over)[: len(hit)]
    rows, cols = camera.shape_vu
    return seen(light.reshape(rows * over, cols * over), over, sigma)
