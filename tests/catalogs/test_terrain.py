"""Terrain models of a ball with a bump, in two projections."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from typer.testing import CliRunner

from catalogs.maplets import open_catalog
from catalogs.terrain import is_raster, read_terrain
from pipeline.errors import GeometryError
from pipeline.geometry.maplet import maplet_points_km
from pipeline.records import FloatArray
from workflows.cli import app

RADIUS_M = 250_000.0
SIDE = 61
STEP_DEG = 0.01
RUN = CliRunner()


def bump_m(lon_deg: FloatArray, lat_deg: FloatArray) -> FloatArray:
    return 300.0 * np.exp(-((lon_deg - 30.0) ** 2 + (lat_deg - 20.0) ** 2) / 0.1**2)


def write(path: Path, heights: FloatArray, crs: str | None, origin: tuple[float, float], step: float) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", height=SIDE, width=SIDE, count=1, dtype="float32", crs=crs, nodata=-9999.0,
        transform=Affine(step, 0.0, origin[0], 0.0, -step, origin[1]),
    ) as raster:  # fmt: skip
        raster.write(heights.astype(np.float32), 1)
    return path


def steps() -> tuple[FloatArray, FloatArray]:
    middle = SIDE // 2
    lat, lon = np.meshgrid(20.0 - (np.arange(SIDE) - middle) * STEP_DEG, 30.0 + (np.arange(SIDE) - middle) * STEP_DEG,
                           indexing="ij")  # fmt: skip
    return lon, lat


def geographic(path: Path) -> Path:
    half = (SIDE / 2) * STEP_DEG
    return write(path, bump_m(*steps()), f"+proj=longlat +R={RADIUS_M} +no_defs", (30.0 - half, 20.0 + half), STEP_DEG)


def projected(path: Path) -> Path:
    """The same posts in metres of a plate carree: east by longitude, north by latitude."""
    metres = np.radians(1.0) * RADIUS_M
    half = (SIDE / 2) * STEP_DEG
    return write(path, bump_m(*steps()), f"+proj=eqc +R={RADIUS_M} +units=m +no_defs",
                 ((30.0 - half) * metres, (20.0 + half) * metres), STEP_DEG * metres)  # fmt: skip


@pytest.mark.parametrize("make", [geographic, projected])
def test_posts_lie_over_the_ball_and_face_outward(make, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    mesh = read_terrain(make(tmp_path / "dtm.tif")).mesh
    x, y, z = mesh.vertices_km.T
    lon, lat = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    assert np.abs(lon - steps()[0].ravel()).max() < 1e-6
    assert np.linalg.norm(mesh.vertices_km, axis=1) * 1000.0 == pytest.approx(RADIUS_M + bump_m(lon, lat), abs=0.05)
    assert len(mesh.facets) == 2 * (SIDE - 1) ** 2
    p, q, r = (mesh.vertices_km[mesh.facets[:, k]] for k in range(3))
    assert ((np.cross(q - p, r - p) * p).sum(axis=1) > 0).all()


def test_an_oblate_ellipsoid_is_geodetic(tmp_path: Path) -> None:
    half = (SIDE / 2) * STEP_DEG
    path = write(tmp_path / "d.tif", np.full((SIDE, SIDE), 1000.0), "EPSG:4326", (30.0 - half, 20.0 + half), STEP_DEG)
    mesh = read_terrain(path).mesh
    # Height over WGS 84 along the normal: the place less a kilometre of it lies on the ellipsoid.
    lon, lat = (np.radians(angle.ravel()) for angle in steps())
    normal = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    foot = mesh.vertices_km - normal
    assert np.abs((foot / [6378.137, 6378.137, 6356.752314245]) ** 2 @ np.ones(3) - 1.0).max() < 1e-9


def test_posts_without_height_make_holes(tmp_path: Path) -> None:
    heights = bump_m(*steps())
    heights[10, 10] = -9999.0
    half = (SIDE / 2) * STEP_DEG
    path = write(tmp_path / "d.tif", heights, f"+proj=longlat +R={RADIUS_M} +no_defs", (30.0 - half, 20.0 + half),
                 STEP_DEG)  # fmt: skip
    mesh = read_terrain(path).mesh
    assert len(mesh.facets) == 2 * ((SIDE - 1) ** 2 - 4)
    assert len(mesh.vertices_km) == SIDE**2 - 1


def test_damage_is_one_line(tmp_path: Path) -> None:
    data = geographic(tmp_path / "dtm.tif").read_bytes()
    assert is_raster(data)
    assert not is_raster(b"v 1 2 3\n" * 4)
    (tmp_path / "cut.tif").write_bytes(data[: len(data) // 2])
    empty = write(tmp_path / "empty.tif", np.full((SIDE, SIDE), -9999.0), "EPSG:4326", (0.0, 0.3), STEP_DEG)
    nowhere = write(tmp_path / "nowhere.tif", np.zeros((SIDE, SIDE)), None, (7.0, 0.0), 2.0)
    for path in (tmp_path / "cut.tif", empty, nowhere):
        with pytest.raises(GeometryError) as caught:
            read_terrain(path)
        assert len(str(caught.value).splitlines()) == 1


def test_maplets_are_made_from_a_terrain_model(tmp_path: Path) -> None:
    path = geographic(tmp_path / "dtm.tif")
    made = RUN.invoke(app, ["catalog", "make-maplets", "--shape", str(path), "--size", "21", "--scale", "40", "--scale",
                            "20", "--count", "4", "-o", str(tmp_path / "cat")])  # fmt: skip
    assert made.exit_code == 0, made.output
    catalog = open_catalog(tmp_path / "cat")
    assert len(catalog.index) == 8
    assert set(np.round(catalog.index.scale_km, 6)) == {0.04, 0.02}
    for row in range(8):
        points = maplet_points_km(catalog.maplet(row)).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        x, y, z = points.T
        lon, lat = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
        # Triangles of 44 m under a bump of 0.4 km, and heights kept in two bytes.
        assert np.abs(np.linalg.norm(points, axis=1) * 1000.0 - RADIUS_M - bump_m(lon, lat)).max() < 3.0
