"""Scenes of the benchmark: stars, and lit spheres drawn by a few lines of their own."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.io import fits

from workflows.samples.options import StarSampleOptions
from workflows.samples.stars import make_star_sample

_SIDE = 1024
_PX_PER_RAD = 2000.0 * 1000.0 / 12.0
_PLANTED_VU = np.array([21.3, -77.6])
_SUN = np.array([0.45, -0.35, -0.822])
_SUPERSAMPLES = 4
_RANGE_KM = 1.0e6
# Sine of the opening of the benchmark's ring, and its plane: the pole leans back by the opening from +Z of J2000.
_RING_SINE = 0.5
_RING_PLANE_WXYZ = [0.6830127018922193, 0.1830127018922193, 0.1830127018922193, -0.6830127018922193]


def make_scene(name: str, folder: Path) -> Path:
    """Archive of one scene.

    Parameters
    ----------
    name
        Of :data:`SCENES`.
    folder
        New folder.

    Returns
    -------
    pathlib.Path
        Its archive.yaml.
    """
    return SCENES[name](folder)


def _stars_1024(folder: Path) -> Path:
    """Archive of one 1024 x 1024 frame with 40 catalogue stars and 300 detections, rotation searched too."""
    rng = np.random.default_rng(4)
    catalogue = rng.uniform(20.0, 1003.0, (40, 2))
    flux = np.concatenate([10.0 ** rng.uniform(2.9, 4.5, 40), 10.0 ** rng.uniform(2.5, 4.2, 270)])
    places = np.concatenate([catalogue + _PLANTED_VU, rng.uniform(5.0, 1018.0, (270, 2))])
    return _write(folder, "stars_1024", _stars(places, flux), (catalogue, flux[:40]), [], turns=True)


def _lorri_256(folder: Path) -> Path:
    """Archive of LORRI-like 4x4-binned frames with 5 to 40 catalogue stars."""
    options = StarSampleOptions(frames=8, seed=11, cameras=("lorri_4x4",), min_stars=5, max_stars=40, processes=1)
    return make_star_sample(folder, options)


def _disc_1024(folder: Path) -> Path:
    """Archive of one 1024 x 1024 frame with a disc of 400 pixels, margins 50 x 140."""
    discs = [(np.array([520.0, 480.0]), 200.0, "ALPHA")]
    return _write(folder, "disc_1024", _spheres(discs), None, discs, turns=False)


def _disc_turned(folder: Path) -> Path:
    """Archive of the disc with a small moon beside the disc and a rotation of up to five degrees to be searched."""
    discs = [(np.array([520.0, 480.0]), 200.0, "ALPHA"), (np.array([230.0, 800.0]), 60.0, "BETA")]
    return _write(folder, "disc_turned", _spheres(discs), None, discs, turns=True)


def _moons_and_stars(folder: Path) -> Path:
    """Archive of one 1024 x 1024 frame with two moons and twenty catalogue stars."""
    rng = np.random.default_rng(5)
    discs = [(np.array([620.0, 420.0]), 110.0, "ALPHA"), (np.array([300.0, 760.0]), 60.0, "BETA")]
    catalogue = rng.uniform(100.0, 920.0, (60, 2))
    clear = np.all([np.hypot(*(catalogue - place).T) > radius + 15.0 for place, radius, _ in discs], axis=0)
    catalogue = catalogue[clear][:20]
    flux = 10.0 ** rng.uniform(3.0, 4.2, len(catalogue))
    light = _spheres(discs) + _stars(catalogue + _PLANTED_VU, flux)
    return _write(folder, "moons_stars", light, (catalogue, flux), discs, turns=False)


def _ring_1024(folder: Path) -> Path:
    """Archive of one 1024 x 1024 frame with an inclined eccentric ringlet, margins 50 x 140."""
    rings: dict[str, object] = {
        "planet": "ALPHA", "position_km": [_RANGE_KM, 0.0, 0.0],
        "plane_from_j2000_wxyz": _RING_PLANE_WXYZ, "opening_sun_deg": 40.0,
        "features": [{
            "name": "R1", "kind": "ringlet", "a_km": 380.0 / _PX_PER_RAD * _RANGE_KM, "ae_km": 0.0,
            "long_peri_deg": 0.0, "width_km": 24.0 / _PX_PER_RAD * _RANGE_KM, "tau": 1.0, "sigma_a_km": 0.1,
            "modes": [],
        }],
    }  # fmt: skip
    return _write(folder, "ring_1024", _ringlet(380.0, 24.0), None, [], turns=False, rings=rings)


def _ringlet(inner: float, width: float) -> np.ndarray:
    """Light of a circular ringlet around the array's centre, its plane 30 degrees from the line of sight."""
    light = np.zeros((_SIDE, _SIDE))
    fine = (np.arange(_SIDE * _SUPERSAMPLES) + 0.5) / _SUPERSAMPLES - 0.5 - 511.5
    v, u = (fine[:, None] - _PLANTED_VU[0]) / _PX_PER_RAD, (fine - _PLANTED_VU[1]) / _PX_PER_RAD
    # The ray (1, u, v) meets the plane through the planet at this share of the planet's range.
    share = _RING_SINE / (_RING_SINE - np.sqrt(1.0 - _RING_SINE**2) * v)
    radius = _PX_PER_RAD * np.sqrt((share - 1.0) ** 2 + (share * v) ** 2 + (share * u) ** 2)
    lit = ((radius >= inner) & (radius < inner + width)).astype(float)
    light += 300.0 * lit.reshape(_SIDE, _SUPERSAMPLES, _SIDE, _SUPERSAMPLES).mean(axis=(1, 3))
    return light


def _stars(places_vu: np.ndarray, flux_dn: np.ndarray) -> np.ndarray:
    """Light of Gaussian stars."""
    light = np.zeros((_SIDE, _SIDE))
    reach = np.arange(-6, 7)
    for (v, u), flux in zip(places_vu, flux_dn, strict=True):
        rows, cols = int(np.rint(v)) + reach, int(np.rint(u)) + reach
        rows, cols = rows[(rows >= 0) & (rows < _SIDE)], cols[(cols >= 0) & (cols < _SIDE)]
        fine = (np.arange(7) - 3.0) / 7.0
        profile_v = np.exp(-((rows[:, None] + fine - v) ** 2) / 0.72).mean(axis=1)
        profile_u = np.exp(-((cols[:, None] + fine - u) ** 2) / 0.72).mean(axis=1)
        light[np.ix_(rows, cols)] += flux * np.outer(profile_v, profile_u) / (0.72 * np.pi)
    return light


def _spheres(discs: list[tuple[np.ndarray, float, str]]) -> np.ndarray:
    """Light of Lambert spheres at the planted offset, supersampled; the optics' blur is the supersampling's alone."""
    light = np.zeros((_SIDE, _SIDE))
    fine = (np.arange(_SIDE * _SUPERSAMPLES) + 0.5) / _SUPERSAMPLES - 0.5
    for place, radius, _ in discs:
        y, x = (fine[:, None] - place[0] - _PLANTED_VU[0]) / radius, (fine - place[1] - _PLANTED_VU[1]) / radius
        r2 = x * x + y * y
        z = -np.sqrt(np.clip(1.0 - r2, 0.0, None))
        shade = np.clip(x * _SUN[0] + y * _SUN[1] + z * _SUN[2], 0.0, None) * (r2 < 1.0)
        light += 1500.0 * shade.reshape(_SIDE, _SUPERSAMPLES, _SIDE, _SUPERSAMPLES).mean(axis=(1, 3))
    return light


def _write(
    folder: Path,
    name: str,
    light: np.ndarray,
    stars: tuple[np.ndarray, np.ndarray] | None,
    discs: list[tuple[np.ndarray, float, str]],
    turns: bool,
    rings: dict[str, object] | None = None,
) -> Path:
    """Frame, sidecar, star table and archive.yaml; the camera's x, y, z are +Y, +Z, +X of J2000."""
    frames = folder / "frames"
    frames.mkdir(parents=True)
    rng = np.random.default_rng(6)
    noisy = rng.poisson((light + 20.0) * 12.0) / 12.0 + rng.normal(0.0, 4.0, light.shape)
    image = np.clip(np.rint(noisy), -32768, 4095).astype(np.int16)
    fits.PrimaryHDU(image).writeto(frames / f"{name}.fits")
    sidecar = _sidecar(name, turns) | {"bodies": [_body(*disc) for disc in discs], "rings": rings}
    (frames / f"{name}.geometry.json").write_text(json.dumps(sidecar))
    if stars is not None:
        x, y = (stars[0][:, 1] - 511.5) / _PX_PER_RAD, (stars[0][:, 0] - 511.5) / _PX_PER_RAD
        columns = {
            "ra_deg": np.degrees(np.arctan2(x, 1.0)), "dec_deg": np.degrees(np.arctan(y / np.hypot(1.0, x))),
            "mag": -2.5 * np.log10(stars[1] / 1.0e7),
        }  # fmt: skip
        pd.DataFrame(columns).to_parquet(frames / f"{name}.stars.parquet")
    path = folder / "archive.yaml"
    path.write_text("images: frames/*.fits\ngeometry: sidecar\nstars: per-image\n")
    return path


def _body(place_vu: np.ndarray, radius_px: float, name: str) -> dict[str, object]:
    """Sphere whose centre is imaged at a place, in the sidecar's words."""
    y, x = (place_vu - 511.5) / _PX_PER_RAD
    position = _RANGE_KM * np.array([1.0, x, y])
    sun = np.array([_SUN[2], _SUN[0], _SUN[1]])
    radius_km = radius_px / _PX_PER_RAD * _RANGE_KM
    return {
        "name": name, "naif_id": None, "position_km": position.tolist(), "radii_km": [radius_km] * 3,
        "body_from_j2000_wxyz": [1.0, 0.0, 0.0, 0.0], "sun_direction_j2000": (sun / np.linalg.norm(sun)).tolist(),
        "shape": "ellipsoid", "photometry": "lambert", "shape_sigma_km": 5e-4 * radius_km,
    }  # fmt: skip


def _sidecar(name: str, turns: bool) -> dict[str, object]:
    k = 1000.0 / 12.0
    return {
        "schema": "geometry/1", "image_id": name, "mission": "SIM", "camera": "NAC",
        "mid_time_utc": "2010-01-01T00:00:00", "exposure_s": 1.0,
        "camera_model": {
            "shape_vu": [_SIDE, _SIDE], "focal_length_mm": 2000.0, "k_px_per_mm": [[k, 0.0], [0.0, k]],
            "principal_point_vu": [511.5, 511.5], "distortion_eps": [0.0] * 6, "psf_sigma_px": 0.6,
            "read_noise_dn": 4.0, "saturation_dn": 4095.0, "missing_value": None, "star_dn_per_s_mag0": 1.0e7,
        },
        "gain_e_per_dn": 12.0, "fit_camera_rotation": turns, "max_rotation_deg": 5.0,
        "search_margin_vu": [50.0, 140.0], "attitude": {"camera_from_j2000_wxyz": [0.5, -0.5, -0.5, -0.5]},
    }  # fmt: skip


SCENES: dict[str, Callable[[Path], Path]] = {
    "stars_1024": _stars_1024, "lorri_256": _lorri_256, "disc_1024": _disc_1024, "moons_stars": _moons_and_stars,
    "disc_turned": _disc_turned, "ring_1024": _ring_1024,
}  # fmt: skip
"""Scenes by name."""
