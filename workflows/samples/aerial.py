"""Make a sample flight: an airframe over terrain on WGS 84, its frames matched to ground points of satellite tiles.

The flight is the project's own source of truth for poses: nothing here is shared with the navigator, which sees only
the files.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from workflows.samples.write import refuse_used

Array = npt.NDArray[np.float64]

# WGS 84: NIMA TR8350.2, table 3.1.
_A_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563
_SHAPE_VU = (1080, 1440)
_FOCAL_MM, _PX_PER_MM = 8.0, 140.0
_EPS1 = -8e-4
_PRINCIPAL_VU = np.array([541.3, 716.8])
_START_DEG = (48.2, 34.6)
_SPEED_M_S, _PERIOD_S = 28.0, 1.0
_ALTITUDE_M = 820.0
_TILE_SIGMA_M = np.array([0.4, 0.4, 0.8])
_PIXEL_SIGMA = 0.6
_DRIFT_START_M, _DRIFT_M_SQRT_S = 25.0, 0.4
_BORESIGHT_RAD, _TWIST_RAD, _ATTITUDE_RAD = 4e-3, 4e-3, 1e-3
CONVENTION = (
    "x_camera = camera_from_body (X - position), body-fixed kilometres on WGS 84; believed attitude: "
    "body_from_camera_believed = body_from_camera Exp(bias) Exp(noise), "
    "bias = boresight about x, about y, twist about z"
)


@dataclass(frozen=True)
class AerialOptions:
    """Choices of a sample flight.

    Attributes
    ----------
    frames
        Frames, one per second.
    seed
        Seed of everything random.
    outliers
        Largest share of wrong matches in a frame, [0, 0.6].
    """

    frames: int = 120
    seed: int = 1
    outliers: float = 0.5

    def check(self) -> None:
        """Raise ValueError, in one line, for a choice that makes no sense."""
        if not 10 <= self.frames <= 20_000:
            raise ValueError(f"frames must lie in [10, 20000]; got {self.frames}")
        if not 0.0 <= self.outliers <= 0.6:
            raise ValueError(f"outliers must lie in [0, 0.6]; got {self.outliers}")


def _body_fixed(lat_deg: Array, lon_deg: Array, height_m: Array) -> Array:
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    n = _A_M / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    flat = (n + height_m) * np.cos(lat)
    return np.stack([flat * np.cos(lon), flat * np.sin(lon), (n * (1.0 - e2) + height_m) * np.sin(lat)], axis=-1)


def _local_axes(lat_deg: float, lon_deg: float) -> Array:
    """Rows: east, north, up."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.stack([east, np.cross(up, east), up])


def _exp(vector: Array) -> Array:
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew)


def _terrain_m(lat_deg: Array, lon_deg: Array) -> Array:
    """Hills and gullies of some tens of metres."""
    y, x = np.radians(lat_deg) * _A_M, np.radians(lon_deg) * _A_M * np.cos(np.radians(_START_DEG[0]))
    return np.asarray(
        110.0
        + 35.0 * np.sin(x / 410.0) * np.cos(y / 530.0)
        + 12.0 * np.sin((x + 2 * y) / 140.0)
        + 4.0 * np.sin(x / 37.0)
    )


def _project(points_m: Array) -> Array:
    """Pixels (v, u) of points in the camera frame, with radial distortion."""
    photo = _FOCAL_MM * points_m[:, :2] / points_m[:, 2:]
    photo = photo * (1.0 + _EPS1 * (photo**2).sum(axis=1))[:, None]
    return np.asarray(photo[:, ::-1] * _PX_PER_MM + _PRINCIPAL_VU)


@dataclass(frozen=True)
class _Frame:
    """One frame's truth."""

    place: Array
    camera_from_body: Array
    lat_deg: float
    lon_deg: float


def _fly(options: AerialOptions, rng: np.random.Generator) -> list[_Frame]:
    frames, lat, lon = [], _START_DEG[0], _START_DEG[1]
    phase = rng.uniform(0, 2 * np.pi, 4)
    for k in range(options.frames):
        heading = 0.6 + 0.5 * np.sin(k / 60.0 + phase[0])
        lat += np.degrees(_SPEED_M_S * _PERIOD_S * np.cos(heading) / _A_M)
        lon += np.degrees(_SPEED_M_S * _PERIOD_S * np.sin(heading) / _A_M / np.cos(np.radians(lat)))
        height = _ALTITUDE_M + 15.0 * np.sin(k / 25.0 + phase[1])
        north = np.array(
            [[np.sin(heading), np.cos(heading), 0.0], [np.cos(heading), -np.sin(heading), 0.0], [0, 0, -1.0]]
        )
        # Image up is along the track, the camera looks down; roll and pitch wobble.
        level = np.stack([north[1], -north[0], north[2]])
        wobble = _exp(np.array([0.08 * np.sin(k / 7.0 + phase[2]), 0.06 * np.sin(k / 9.0 + phase[3]), 0.0]))
        turn = wobble @ level @ _local_axes(lat, lon)
        place = _body_fixed(np.array([lat]), np.array([lon]), np.array([height]))[0]
        frames.append(_Frame(place, turn, lat, lon))
    return frames


def _matches(frame: _Frame, rng: np.random.Generator, count: int, wrong: int) -> dict[str, Array]:
    """Columns of one frame's matches; wrong ones have a right point and a pixel of somewhere else."""
    axes = _local_axes(frame.lat_deg, frame.lon_deg)
    reach = np.degrees(_ALTITUDE_M * 0.8 / _A_M)
    lat = frame.lat_deg + rng.uniform(-reach, reach, 12 * count)
    lon = frame.lon_deg + rng.uniform(-reach, reach, 12 * count) / np.cos(np.radians(frame.lat_deg))
    points = _body_fixed(lat, lon, _terrain_m(lat, lon))
    pixels = _project((points - frame.place) @ frame.camera_from_body.T)
    seen = np.flatnonzero(((pixels > 0) & (pixels < np.array(_SHAPE_VU) - 1.0)).all(axis=1))[: count + wrong]
    points, pixels = points[seen], pixels[seen] + rng.normal(size=(len(seen), 2)) * _PIXEL_SIGMA
    chosen = rng.permutation(len(seen))[:wrong]
    pixels[chosen] = rng.uniform(0, np.array(_SHAPE_VU) - 1.0, (len(chosen), 2))
    points = points + (rng.normal(size=points.shape) * _TILE_SIGMA_M) @ axes
    spread = axes.T @ np.diag(_TILE_SIGMA_M**2) @ axes * 1e-6
    columns = {"v_px": pixels[:, 0], "u_px": pixels[:, 1]}
    columns |= {f"{name}_km": points[:, k] * 1e-3 for k, name in enumerate("xyz")}
    columns |= {"cov_vv": np.full(len(seen), _PIXEL_SIGMA**2), "cov_vu": np.zeros(len(seen))}
    columns["cov_uu"] = columns["cov_vv"]
    pairs = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))
    return columns | {f"cov_{name}_km2": np.full(len(seen), spread[i, j]) for name, i, j in pairs}


def _kinds(options: AerialOptions, rng: np.random.Generator) -> list[str]:
    """What is special about each frame: two gaps, a few wrong places, the rest plain."""
    kinds = ["plain"] * options.frames
    length = max(options.frames // 14, 2)
    for start in (options.frames // 4, 2 * options.frames // 3):
        kinds[start : start + length] = ["gap"] * min(length, options.frames - start)
    plain = [k for k in range(1, options.frames) if kinds[k] == "plain"]
    for k in rng.choice(plain, max(options.frames // 30, 1), replace=False):
        kinds[k] = "misplaced"
    return kinds


def make_aerial_sample(directory: Path, options: AerialOptions) -> Path:
    """Write a sample flight and return the path of its cameras.json.

    Parameters
    ----------
    directory
        New or empty folder.
    options
        What to write.

    Raises
    ------
    ValueError
        If an option makes no sense.
    FileExistsError
        If the directory holds anything, or is not a directory.
    """
    options.check()
    refuse_used(directory)
    directory.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([options.seed, 0xAE])
    frames, kinds = _fly(options, rng), _kinds(options, rng)
    tables = []
    for k, (frame, kind) in enumerate(zip(frames, kinds, strict=True)):
        if kind == "gap" and rng.random() < 0.7:
            continue
        count = 3 if kind == "gap" else int(rng.integers(25, 110))
        wrong = int(count * rng.uniform(0, options.outliers) / (1 - options.outliers / 2))
        table = pd.DataFrame(_matches(frame, rng, count, wrong))
        if kind == "misplaced":
            # The whole frame is matched to a place that looks alike, eighty metres off.
            shift = np.array([60.0, -53.0, 0.0]) @ _local_axes(frame.lat_deg, frame.lon_deg) * 1e-3
            table[["x_km", "y_km", "z_km"]] += shift
        table.insert(0, "view_id", k)
        table.insert(1, "point_id", np.arange(len(table)) + 1000 * k)
        tables.append(table)
    pd.concat(tables, ignore_index=True).to_parquet(directory / "matches.parquet", index=False)
    throttled = range(options.frames // 2, options.frames // 2 + max(options.frames // 12, 1))
    arc, bias = _arc(frames, options, rng, throttled)
    _write_truth(directory, frames, kinds, bias, throttled)
    return _write_cameras(directory, arc)


def _arc(
    frames: list[_Frame], options: AerialOptions, rng: np.random.Generator, throttled: range
) -> tuple[dict[str, object], Array]:
    """What was believed of each pose: a drifting position, an attitude with a common bias."""
    bias = rng.normal(size=3) * np.array([_BORESIGHT_RAD, _BORESIGHT_RAD, _TWIST_RAD])
    steps = rng.normal(size=(options.frames, 3)) * _DRIFT_M_SQRT_S * np.sqrt(_PERIOD_S)
    steps[0] = rng.normal(size=3) * _DRIFT_START_M
    drift = steps.cumsum(axis=0)
    views = []
    for k, frame in enumerate(frames):
        believed = frame.camera_from_body.T @ _exp(bias) @ _exp(rng.normal(size=3) * _ATTITUDE_RAD)
        views.append({
            "view_id": k, "et": k * _PERIOD_S, "position_km": ((frame.place + drift[k]) * 1e-3).tolist(),
            "camera_from_body": believed.T.tolist(), "throttled": k in throttled,
        })  # fmt: skip
    sigmas = {
        "position_sigma_km": _DRIFT_START_M * 1e-3, "walk_km_per_sqrt_s": _DRIFT_M_SQRT_S * 1e-3,
        "attitude_sigma_rad": _ATTITUDE_RAD, "boresight_sigma_rad": _BORESIGHT_RAD, "twist_sigma_rad": _TWIST_RAD,
    }  # fmt: skip
    return {"arc_id": "flight", "options": sigmas, "views": views}, np.asarray(bias)


def _write_truth(directory: Path, frames: list[_Frame], kinds: list[str], bias: Array, throttled: range) -> None:
    views = {
        str(k): {
            "position_km": (frame.place * 1e-3).tolist(), "camera_from_body": frame.camera_from_body.tolist(),
            "kind": kind, "throttled": k in throttled,
        }
        for k, (frame, kind) in enumerate(zip(frames, kinds, strict=True))
    }  # fmt: skip
    content = {"convention": CONVENTION, "bias_rad": bias.tolist(), "views": views}
    (directory / "truth.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_cameras(directory: Path, arc: dict[str, object]) -> Path:
    polar_km = _A_M * (1.0 - _FLATTENING) * 1e-3
    content = {
        "camera_model": {
            "shape_vu": _SHAPE_VU, "focal_length_mm": _FOCAL_MM,
            "k_px_per_mm": [[_PX_PER_MM, 0.0], [0.0, _PX_PER_MM]], "principal_point_vu": _PRINCIPAL_VU.tolist(),
            "distortion_eps": [_EPS1, 0.0, 0.0, 0.0, 0.0, 0.0],
        },
        "datum": {"name": "WGS84", "radii_km": [_A_M * 1e-3, _A_M * 1e-3, polar_km]}, "views": [], "arcs": [arc],
    }  # fmt: skip
    path = directory / "cameras.json"
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path
