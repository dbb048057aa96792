"""Runs with planted poses, made of documents as the pipeline writes them."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.camera import project
from pipeline.curate import Json
from pipeline.geometry.pointing import corrected_attitude, offset_between
from pipeline.geometry.rotations import quaternion_from_matrix
from pipeline.pose.records import Pose
from pipeline.pose.se3 import SE3Utils
from pipeline.records import CameraModel
from workflows.store import RunFolder, prepare, write_tables

CAMERA = CameraModel((1024, 1024), 100.0, np.array([[60.0, 0.0], [0.0, 60.0]]), np.array([511.5, 511.5]))
SIGMA_PX = 0.3
ERROR = {"position": 3.0, "walk": 0.005, "attitude": 1e-4, "bias": 1e-3}
SETTINGS = ("position_sigma_km=3", "walk_km_per_sqrt_s=0.005", "attitude_sigma_rad=1e-4")


@dataclass(frozen=True)
class PlantedRun:
    """A run's folder and what is true in it."""

    folder: RunFolder
    poses: dict[str, Pose]
    bias_rad: np.ndarray
    image_ids: list[str]


def _looking(place: np.ndarray) -> Pose:
    z = -place / np.linalg.norm(place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z]), place)


def plant_run(
    root: Path, count: int = 16, seed: int = 0, kinds: str = "LL.SB", cameras: tuple[str, ...] = ("NAC",)
) -> PlantedRun:
    """One arc per camera; kinds: landmarks, nothing, stars, body, one letter per image, repeated."""
    rng, folder = np.random.default_rng(seed), RunFolder(root)
    prepare(folder)
    poses: dict[str, Pose] = {}
    bias = rng.normal(size=3) * ERROR["bias"]
    points = rng.normal(size=(120, 3))
    points *= rng.uniform(18.0, 25.0, (120, 1)) / np.linalg.norm(points, axis=1)[:, None]
    for camera in cameras:
        drift = rng.normal(size=3) * ERROR["position"]
        for k in range(count):
            et, image_id = 1000.0 + 60.0 * k, f"{camera.replace('/', '-')}_{k:03d}"
            drift = drift + (rng.normal(size=3) * ERROR["walk"] * np.sqrt(60.0) if k else 0.0)
            angle = 0.02 * k
            true = _looking(400.0 * np.array([np.cos(angle), np.sin(angle), 0.1]))
            turn = true.camera_from_body.T @ SE3Utils.exp(bias) @ SE3Utils.exp(rng.normal(size=3) * ERROR["attitude"])
            believed = Pose(turn.T, true.position_km + drift)
            document = _document(rng, (image_id, camera, et), (true, believed), points, kinds[k % len(kinds)])
            folder.document(image_id).write_text(json.dumps(document))
            poses[image_id] = true
    ids = sorted(poses)
    folder.plan.write_text(json.dumps({"images": ids, "digest": "x"}))
    write_tables(folder, ids)
    return PlantedRun(folder, poses, bias, ids)


def _document(
    rng: np.random.Generator, identity: tuple[str, str, float], pair: tuple[Pose, Pose], points: np.ndarray, kind: str
) -> dict[str, Json]:
    (image_id, camera, et), (true, believed) = identity, pair
    body = Rotation.from_euler("zyx", [et * 1e-4, 0.3, -0.2]).as_matrix()
    prior = believed.camera_from_body @ body
    pointing: dict[str, Json] = {
        "a_priori_camera_from_j2000_wxyz": quaternion_from_matrix(prior).tolist(), "camera_from_j2000_wxyz": None,
        "covariance": None,
    }  # fmt: skip
    document: dict[str, Json] = {
        "schema": "pilotage/1", "image_id": image_id, "mission": "M", "camera": camera, "time_utc": None, "et": et,
        "exposure_s": None, "status": "failed", "status_reason": "no_match", "detail": "", "rank": "failed",
        "confidence": None, "offset_px": None, "sigma_px": None, "covariance_px2": None, "observable": None,
        "rotation_deg": None, "sigma_rotation_deg": None, "pointing": pointing, "bodies": [], "rings": [],
        "ring_edges": None, "landmarks": None, "landmark_state": None, "frame": None, "techniques": [], "label": None,
        "provenance": {"config_digest": "c"},
        "geometry": {
            "camera_model": {
                "shape_vu": [1024, 1024], "focal_length_mm": 100.0, "k_px_per_mm": CAMERA.k_px_per_mm.tolist(),
                "principal_point_vu": [511.5, 511.5], "distortion_eps": [0.0] * 6, "k_xy_px_per_mm2": [0.0, 0.0],
            },
            "bodies": [{
                "name": "ROCK", "naif_id": 2000001, "radii_km": [25.0, 24.0, 18.0],
                "camera_in_body_km": believed.position_km.tolist(),
                "body_from_j2000_wxyz": quaternion_from_matrix(body).tolist(),
            }],
        },
    }  # fmt: skip
    if kind == "L":
        document |= _landmarks(rng, true, points)
    elif kind in "SB":
        # Stars show the attitude; a limb makes up for the wrong position by an attitude that is as wrong.
        seen = true.camera_from_body
        if kind == "B":
            shown = -believed.camera_from_body @ believed.position_km
            real = -true.camera_from_body @ true.position_km
            axis = np.cross(shown, real) / (np.linalg.norm(shown) * np.linalg.norm(real))
            seen = SE3Utils.exp(axis) @ believed.camera_from_body
        offset, theta = offset_between(CAMERA, prior, seen @ body)
        error = rng.normal(size=3) * [0.1, 0.1, 1e-4]
        known = 3 if kind == "S" else 2
        after = corrected_attitude(CAMERA, prior, offset + error[:2], theta + error[2] if kind == "S" else 0.0)
        pointing["camera_from_j2000_wxyz"] = quaternion_from_matrix(after).tolist()
        pointing["covariance"] = np.diag([0.01, 0.01, 1e-8])[:known, :known].tolist()
        document["offset_px"] = (offset + error[:2]).tolist()
        document["rotation_deg"] = float(np.degrees(theta + error[2])) if kind == "S" else None
        name = "StarFieldFromCatalogNav" if kind == "S" else "BodyLimbNav"
        document["techniques"] = [{"technique": name, "in_ensemble": True, "status_reason": "navigated"}]
    return document


def _landmarks(rng: np.random.Generator, true: Pose, points: np.ndarray) -> dict[str, Json]:
    facing = points[points @ true.position_km > 0.2 * 25.0 * np.linalg.norm(true.position_km)]
    pixels, _ = project(CAMERA, true.to_camera(facing))
    inside = ((pixels > 0) & (pixels < 1023)).all(axis=1)
    places, observed = facing[inside], pixels[inside] + rng.normal(size=(int(inside.sum()), 2)) * SIGMA_PX
    wrong = rng.random(len(places)) < 0.05
    observed[wrong] += rng.uniform(15, 40, (int(wrong.sum()), 2))
    count = len(places)
    names: list[Json] = [f"L{k}" for k in np.flatnonzero(np.isin(points, places).all(axis=1))]
    columns: dict[str, Json] = {
        "landmark": names, "status": ["found"] * count, "used": [True] * count,
        "observed_v_px": [None, *observed[1:, 0].tolist()], "observed_u_px": observed[:, 1].tolist(),
        "sigma_dv_px": [SIGMA_PX] * count, "sigma_du_px": [SIGMA_PX] * count, "cov_dv_du_px2": [0.0] * count,
    }  # fmt: skip
    for axis, name in enumerate("xyz"):
        columns[f"{name}_km"] = places[:, axis].tolist()
    rest = ("predicted_v_px", "predicted_u_px", "offset_dv_px", "offset_du_px", "correlation", "incidence_deg",
            "emission_deg", "cells_per_pixel")  # fmt: skip
    columns["bin"] = [1] * count
    for name in rest:
        columns[name] = [None] * count
    for axes in ("xx", "xy", "xz", "yy", "yz", "zz"):
        columns[f"cov_{axes}_km2"] = [1e-8 if axes[0] == axes[1] else 0.0] * count
    state: dict[str, Json] = {
        "body": "ROCK", "position_km": true.position_km.tolist(),
        "camera_from_body_wxyz": quaternion_from_matrix(true.camera_from_body).tolist(),
        "covariance": [[float(i == j) for j in range(6)] for i in range(6)],
        "landmarks_used": count, "landmarks_rejected": 0, "observable_directions": 6, "converged": True,
    }  # fmt: skip
    return {"landmarks": columns, "landmark_state": state}
