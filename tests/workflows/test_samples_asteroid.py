"""The asteroid sample: its rays by brute force, its kernels by SPICE, its maplets by the project's readers."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import spiceypy
from numpy.typing import NDArray

from catalogs.maplets import open_catalog
from catalogs.shapes import read_solid
from catalogs.spc_files import maplet_of, read_map
from catalogs.spc_text import read_landmark
from pipeline.geometry.maplet import maplet_points_km
from pipeline.geometry.rotations import matrix_from_quaternion
from tests.support import pilotage
from workflows.samples.asteroid import make_asteroid_sample
from workflows.samples.asteroid_maplets import landmark_text, make_maplet, map_bytes, spread
from workflows.samples.asteroid_options import BODY, AsteroidOptions
from workflows.samples.asteroid_plan import eye_of, looked_at, pixels_of, plan_frame
from workflows.samples.asteroid_rays import Ground, enter, ground_of, hits, is_shaded, normal_at
from workflows.samples.asteroid_render import light_of
from workflows.samples.asteroid_surface import Asteroid, make_asteroid, value_at
from workflows.samples.asteroid_truth import best_offset

Floats = NDArray[np.float64]
SMALL = AsteroidOptions(frames=1, seed=3, processes=1, cells=96, coarse_cells=16, coverage=0.03)


@pytest.fixture(scope="module")
def asteroid() -> Asteroid:
    return make_asteroid(BODY.radii_km, SMALL.cells, SMALL.seed)


@pytest.fixture(scope="module")
def ground(asteroid: Asteroid) -> Ground:
    return ground_of(asteroid)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("asteroid") / "archive"
    make_asteroid_sample(folder, SMALL)
    return folder


def _sphere(radius_km: float) -> Ground:
    flat = np.full((6, 17, 17), radius_km, np.float32)
    return Ground(flat, np.ones_like(flat), radius_km, 1.0)


def _rays(count: int, seed: int) -> tuple[Floats, Floats]:
    """Places far out and unit rays that pass somewhere near the body."""
    rng = np.random.default_rng(seed)
    eyes = 20.0 * spread(count)[rng.permutation(count)]
    rays = rng.uniform(-2.2, 2.2, (count, 3)) - eyes
    return eyes, rays / np.linalg.norm(rays, axis=1)[:, None]


def test_rays_meet_a_sphere_where_algebra_says() -> None:
    eyes, rays = _rays(400, 1)
    along = -(eyes * rays).sum(axis=1)
    under = 1.7**2 - ((eyes + along[:, None] * rays) ** 2).sum(axis=1)
    wanted = np.where(under > 0.0, along - np.sqrt(np.maximum(under, 0.0)), np.nan)
    assert hits(_sphere(1.7), eyes, rays, 100.0) == pytest.approx(wanted, abs=1e-4, nan_ok=True)
    assert enter(1.7, 5.0, 0.0, 0.0, 1.0, 0.0, 0.0) == (-1.0, -1.0)


def test_rays_meet_relief_first_where_small_steps_do(ground: Ground) -> None:
    eyes, rays = _rays(60, 2)
    found = hits(ground, eyes, rays, 100.0)
    assert 10 < np.isfinite(found).sum() < 60
    steps = np.arange(0.0, 6.0, 5e-4)
    for eye, ray, t in zip(eyes, rays, found, strict=True):
        start = max(enter(ground.highest_km, *eye, *ray)[0], 0.0)
        places = eye + (start + steps)[:, None] * ray
        gaps = np.linalg.norm(places, axis=1) - [value_at(ground.radius_km, *place) for place in places]
        under = np.flatnonzero(gaps < 0.0)
        assert (t == pytest.approx(start + steps[under[0]], abs=1.5e-3)) if len(under) else not t > 0.0


def test_shade_is_what_small_steps_toward_the_sun_meet(ground: Ground) -> None:
    sun = np.array([0.9, 0.2, 0.4]) / np.linalg.norm([0.9, 0.2, 0.4])
    told, wanted = [], []
    for way in spread(300):
        place = way * value_at(ground.radius_km, *way)
        if way @ sun < 0.1:
            continue
        path = place + np.arange(2e-3, 3.0, 1e-3)[:, None] * sun
        gaps = np.linalg.norm(path, axis=1) - [value_at(ground.radius_km, *p) for p in path]
        # Grazing rays may go either way.
        if abs(gaps.min()) > 1e-3:
            told.append(is_shaded(ground, *place, *sun))
            wanted.append(bool(gaps.min() < 0.0))
    assert sum(wanted) >= 3
    assert told == wanted


def test_normals_are_those_of_an_ellipsoid() -> None:
    axes = np.array([2.7, 2.2, 1.9])
    asteroid = make_asteroid((2.7, 2.2, 1.9), 128, 1)
    p, q = np.meshgrid(*[np.linspace(-1.0, 1.0, 129)] * 2, indexing="ij")
    smooth = np.empty_like(asteroid.radius_km)
    for face in range(6):
        rays = np.empty((129, 129, 3))
        rays[..., face // 2] = 1.0 - 2.0 * (face % 2)
        rays[..., (face // 2 + 1) % 3], rays[..., (face // 2 + 2) % 3] = p, q
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        smooth[face] = 1.0 / np.linalg.norm(rays / axes, axis=-1)
    ground = Ground(smooth, np.ones_like(smooth), 2.7, 2.0)
    for way in spread(50):
        wanted = way / axes**2
        wanted /= np.linalg.norm(wanted)
        assert np.arccos(min(1.0, float(np.dot(normal_at(ground, *way), wanted)))) < 3e-3


def test_offset_and_twist_are_found_again() -> None:
    rng = np.random.default_rng(4)
    before, pivot, angle = rng.uniform(0.0, 511.0, (40, 2)), np.array([255.5, 255.5]), 0.01
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    after = pivot + (before - pivot) @ turn.T + [12.0, -7.0]
    offset, found, misfit = best_offset(before, after, pivot)
    assert offset == pytest.approx([12.0, -7.0], abs=1e-9)
    assert [found, misfit] == pytest.approx([angle, 0.0], abs=1e-9)


def test_spice_tells_the_planted_errors(archive: Path, ground: Ground) -> None:
    item = plan_frame(0, SMALL, ground)
    shot = item.shot
    (entry,) = json.loads((archive / "truth.json").read_text())["frames"].values()
    before = Path.cwd()
    os.chdir(archive / "kernels")
    try:
        spiceypy.kclear()
        spiceypy.furnsh("meta.tm")
        place, light_time = spiceypy.spkezp(BODY.naif_id, shot.et, "J2000", "LT+S", -82)
        turn = spiceypy.pxform("J2000", f"IAU_{BODY.name}", shot.et - light_time)
        instrument = spiceypy.pxform("J2000", shot.camera.frame, shot.et)
    finally:
        spiceypy.kclear()
        os.chdir(before)
    told = -np.array(turn) @ place
    assert told == pytest.approx(np.add(entry["true_position_km"], entry["position_error_km"]), abs=1e-6)
    assert np.linalg.norm(entry["position_error_km"]) > 0.01
    assert np.abs(shot.camera.camera_from_instrument @ instrument - shot.apriori).max() < 1e-12
    true = matrix_from_quaternion(np.array(entry["true_camera_from_body_wxyz"]))
    assert np.abs(true - shot.truth @ np.array(turn).T).max() < 1e-9


def test_places_land_where_they_were_looked_at(ground: Ground) -> None:
    item = plan_frame(0, SMALL, ground)
    sighting = item.sighting()
    places, pixels = looked_at(item.shot.camera.optics, item.shot.truth, sighting, ground)
    assert len(places) > 100
    assert pixels_of(item.shot.camera.optics, item.shot.truth, sighting, places) == pytest.approx(pixels, abs=1e-6)
    assert np.linalg.norm(places, axis=1) == pytest.approx([value_at(ground.radius_km, *p) for p in places], abs=2e-4)


def test_a_balls_disc_is_where_its_limb_projects(ground: Ground) -> None:
    item, radius = plan_frame(0, replace(SMALL, phase_deg=(0.0, 0.0)), ground), 1.5
    light = light_of(item, _sphere(radius))
    disc = np.stack(np.nonzero(light > 0.5 * np.median(light[light > 0.2 * light.max()])), axis=1)
    sighting = item.sighting()
    eye = eye_of(sighting)
    distance, axis = np.linalg.norm(eye), eye / np.linalg.norm(eye)
    across = np.linalg.svd(axis[None])[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, 721)[:-1, None]
    rim = radius * np.sqrt(1.0 - (radius / distance) ** 2) * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
    optics = item.shot.camera.optics
    v, u = pixels_of(optics, item.shot.truth, sighting, axis * radius**2 / distance + rim).T
    # Centroid of the polygon, by its triangles about the first corner.
    a, b, c, d = v[1:-1] - v[0], u[1:-1] - u[0], v[2:] - v[0], u[2:] - u[0]
    areas = a * d - b * c
    centre = np.array(
        [v[0] + (areas * (a + c)).sum() / 3.0 / areas.sum(), u[0] + (areas * (b + d)).sum() / 3.0 / areas.sum()]
    )
    # Where whole pixels end falls evenly: some 800 of them around the rim.
    assert disc.mean(axis=0) == pytest.approx(centre, abs=0.03)
    assert len(disc) == pytest.approx(abs(areas.sum()) / 2.0, rel=3e-3)


def test_maplets_are_pieces_of_the_surface_as_spc_keeps_them(ground: Ground) -> None:
    options = replace(SMALL, landmark_sigma_cells=(0.0, 0.0), height_error_cells=0.0, albedo_error=0.0)
    for number, way in enumerate(spread(12)):
        made = make_maplet(ground, options, 1, number, way)
        landmark = read_landmark(landmark_text(made).encode(), made.name)
        maplet = maplet_of(read_map(map_bytes(made), made.name), made.name, landmark)
        assert maplet.landmark_km == pytest.approx(made.true_km, abs=1e-9)
        points = maplet_points_km(maplet)
        points = points[np.isfinite(points).all(axis=-1)]
        radii = [value_at(ground.radius_km, *point) for point in points]
        # Heights are rounded to 1/30 000 of the highest, single precision keeps seven digits of kilometres.
        assert np.linalg.norm(points, axis=1) == pytest.approx(radii, abs=1e-5)
        assert np.nanmean(maplet.albedo) == pytest.approx(1.0, abs=0.005)


def test_landmarks_err_as_the_catalogue_says(ground: Ground) -> None:
    made = [make_maplet(ground, SMALL, 0, k, way) for k, way in enumerate(spread(60))]
    pulls = np.concatenate([(m.told_km - m.true_km) / m.sigma_km for m in made])
    # 180 numbers: the rms of a Gaussian is 1 within 3/sqrt(360).
    assert np.sqrt((pulls**2).mean()) == pytest.approx(1.0, abs=0.16)


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_same_seed_same_bytes_whatever_the_processes(archive: Path, tmp_path: Path) -> None:
    make_asteroid_sample(tmp_path / "again", replace(SMALL, processes=2))
    assert _digests(archive) == _digests(tmp_path / "again")


def test_shape_is_gaskells_and_lies_near_the_surface(archive: Path, ground: Ground) -> None:
    solid = read_solid((archive / "shape_coarse.txt").read_bytes(), "shape")
    assert solid.icq_km is not None
    vertices = solid.mesh.vertices_km
    # Adjacent faces share their edges: closed.
    assert len(vertices) == 6 * 16**2 + 2
    gaps = np.linalg.norm(vertices, axis=1) - [value_at(ground.radius_km, *vertex) for vertex in vertices]
    assert np.sqrt((gaps**2).mean()) < 0.02


def test_what_makes_no_sense_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="camera must be one of cassini_nac"):
        make_asteroid_sample(tmp_path / "a", replace(SMALL, camera="voyager_na"))
    with pytest.raises(ValueError, match="coverage must lie"):
        make_asteroid_sample(tmp_path / "a", replace(SMALL, coverage=0.0))
    with pytest.raises(ValueError, match="phase_deg must rise"):
        make_asteroid_sample(tmp_path / "a", replace(SMALL, phase_deg=(60.0, 20.0)))


@pytest.mark.slow
def test_position_and_attitude_are_found_from_the_command_line(tmp_path: Path) -> None:
    folder = str(tmp_path / "a")
    made = pilotage("sample", "asteroid", folder, "--images=1", "--coverage=0.8", "--seed=5", "--processes=1")
    assert made.code == 0, made.err
    run = pilotage("run", str(tmp_path / "a"), "--output", str(tmp_path / "run"), "--serial")
    document = json.loads(next((tmp_path / "run" / "images").glob("*.json")).read_text())
    assert document["status"] == "success", run.err
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())["frames"][document["image_id"]]
    landmarks = pd.read_parquet(tmp_path / "a" / "truth_landmarks.parquet")
    assert set(landmarks["landmark"]) == set(open_catalog(tmp_path / "a" / "tessary.maplets").index.name)
    state = document["landmark_state"]
    true = matrix_from_quaternion(np.array(truth["true_camera_from_body_wxyz"]))
    found = matrix_from_quaternion(np.array(state["camera_from_body_wxyz"]))
    turn = true.T @ found
    error = np.concatenate(
        [
            np.subtract(state["position_km"], truth["true_position_km"]),
            0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
        ]
    )
    # Chi-square of six: beyond this once in a thousand.
    assert error @ np.linalg.solve(state["covariance"], error) < 22.5
    assert np.linalg.norm(error[:3]) < 0.5 * np.linalg.norm(truth["position_error_km"])
