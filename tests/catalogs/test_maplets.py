"""Maplet catalogues: lazily read, exported byte for byte, made from a shape by the command line."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from catalogs.maplets import MapletCatalogProblem, map_files, open_catalog, write_catalog
from catalogs.spc_files import read_map, write_map
from catalogs.spc_text import SpcProblem, read_landmark, write_landmark, write_picture
from pipeline.geometry.maplet import maplet_points_km
from tests.catalogs.test_shapes import icq_of_cube
from tests.catalogs.test_spc_files import landmark, picture, real_map
from workflows.cli import app

RUN = CliRunner()


def test_what_is_written_is_read_maplet_by_maplet(tmp_path: Path) -> None:
    files = {f"L{k:03d}": real_map(5 if k % 3 else 8) for k in range(300)}
    assert write_catalog(tmp_path, ((name, file, None) for name, file in files.items())) == 300
    catalog = open_catalog(tmp_path)
    assert len(catalog.index) == 300
    assert catalog.groups["half0005"]["heights"].attrs["units"] == "cells"
    for number in (0, 199, 200, 299):
        maplet = catalog.maplet(number)
        file = files[maplet.name]
        assert maplet.half == catalog.index.half[number] == file.half
        assert maplet.name == catalog.index.name[number]
        known = np.isfinite(maplet.heights)
        assert maplet.heights[known] == pytest.approx((file.steps * file.height_step)[known], rel=1e-6)
        points = maplet_points_km(maplet) - maplet.landmark_km
        assert catalog.index.radius_km[number] >= np.nanmax(np.linalg.norm(points, axis=2)) * (1 - 1e-4)


def test_names_are_unique_and_short(tmp_path: Path) -> None:
    with pytest.raises(SpcProblem, match="A: the name occurs twice"):
        write_catalog(tmp_path, [("A", real_map(2), None)] * 2)
    with pytest.raises(SpcProblem, match="too long"):
        write_catalog(tmp_path, [("A" * 30, real_map(2), None)])
    with pytest.raises(MapletCatalogProblem, match="no maplets"):
        open_catalog(tmp_path / "nowhere")


def spc_folder(root: Path) -> Path:
    for kind in ("MAPFILES", "LMKFILES", "SUMFILES"):
        (root / kind).mkdir(parents=True)
    for name, half in (("ENDFIL", 49), ("EE0426", 11)):
        data = bytearray(write_map(real_map(half)))
        # Filling bytes mean nothing and are kept all the same.
        data[-1] = 77 if half == 49 else data[-1]
        (root / "MAPFILES" / f"{name}.MAP").write_bytes(data)
    (root / "LMKFILES" / "ENDFIL.LMK").write_bytes(write_landmark(landmark()))
    (root / "SUMFILES" / "W1.SUM").write_bytes(write_picture(picture()))
    return root


def test_import_and_export_give_the_same_bytes(tmp_path: Path) -> None:
    source = spc_folder(tmp_path / "spc")
    made = RUN.invoke(app, ["catalog", "import-spc", str(source), "-o", str(tmp_path / "catalog")])
    assert made.exit_code == 0, made.output
    assert "2 maplets, 1 pictures" in made.output
    assert RUN.invoke(app, ["catalog", "export-spc", str(tmp_path / "catalog"), str(tmp_path / "out")]).exit_code == 0
    for path in source.rglob("*.*"):
        assert (tmp_path / "out" / path.relative_to(source)).read_bytes() == path.read_bytes(), path.name
    catalog = open_catalog(tmp_path / "catalog")
    full = catalog.maplet(int(np.flatnonzero(catalog.index.name == "ENDFIL")[0]))
    # The landmark file's eleven digits win over the map's single precision.
    assert full.landmark_km.tolist() == landmark().landmark_km.tolist()
    assert full.covariance_km2 == pytest.approx(np.diag(landmark().sigma_landmark_km ** 2))


def test_a_damaged_file_ends_the_import_in_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    source = spc_folder(tmp_path / "spc")
    (source / "MAPFILES" / "EE0426.MAP").write_bytes(write_map(real_map(11))[:500])
    made = RUN.invoke(app, ["catalog", "import-spc", str(source), "-o", str(tmp_path / "catalog")])
    assert made.exit_code != 0
    assert "EE0426.MAP: byte 501" in made.output + str(made.exception)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["spc"]


def test_maplets_of_a_cube_lie_on_its_faces(tmp_path: Path) -> None:
    (tmp_path / "cube.txt").write_text(icq_of_cube(8, 5.0))
    arguments = ["catalog", "make-maplets", "--shape", str(tmp_path / "cube.txt"), "--size", "21"]
    out = tmp_path / "catalog"
    made = RUN.invoke(app, [*arguments, "--scale", "100", "--scale", "50", "--count", "60", "-o", str(out)])
    assert made.exit_code == 0, made.output
    catalog = open_catalog(out)
    assert len(catalog.index) == 120
    assert sorted(set(catalog.index.scale_km.round(6))) == [0.05, 0.1]
    for number in range(0, 120, 7):
        points = maplet_points_km(catalog.maplet(number))
        inside = points[np.isfinite(points).all(axis=2)]
        assert np.abs(np.abs(inside).max(axis=1) - 5.0).max() < 1e-3
    for name, file in map_files(catalog):
        assert write_map(read_map(write_map(file), name)) == write_map(file)
    assert RUN.invoke(app, ["catalog", "export-spc", str(out), str(tmp_path / "spc")]).exit_code == 0
    text = (tmp_path / "spc" / "LMKFILES" / "AA0000.LMK").read_bytes()
    assert read_landmark(text, "AA0000").half == 10
