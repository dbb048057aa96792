"""Bodies of sidecars and their catalogue: what is taken from where, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from catalogs.bodies import BodyBlock, BodyModels, bounding_radii, merged_blocks
from catalogs.shapes import read_shape
from catalogs.sidecar import state_from_sidecar
from pipeline.errors import GeometryError
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.records import Photometry, State, TriangleMesh
from pipeline.status import StatusReason
from tests.scenes.data import DATA, needs_data
from tests.support import (
    Document,
    document,
    inputs_of,
    run_serial,
    sidecar_of,
    some_frames,
    write_sidecar,
)
from workflows.config import load_configuration

BLOCKS = merged_blocks(load_configuration().bodies, {})
TETRAHEDRON = "v 1 0 0\nv 0 2 0\nv 0 0 3\nv -1 -1 -1\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
MESH = read_shape(TETRAHEDRON.encode(), "tetrahedron.obj")
MOON: Document = {
    "name": "Mimas", "naif_id": None, "position_km": [0.0, 3.0e5, 4.0e5], "radii_km": [208.0, 197.0, 191.0],
    "shape": "ellipsoid", "body_from_j2000_wxyz": [0.5, 0.5, 0.5, -0.5], "sun_direction_j2000": [0.0, -0.6, 0.8],
    "photometry": "lambert",
}  # fmt: skip


@pytest.fixture(scope="module")
def plain(lorri_archive: Path) -> Document:
    return sidecar_of(sorted((lorri_archive / "frames").glob("*.fits"))[0])


def state_of(plain: Document, *bodies: Document, models: BodyModels | None = None) -> State:
    data = json.dumps({**plain, "bodies": list(bodies)}).encode()
    return state_from_sidecar(data, "id", None, {}, (256, 256), models or BodyModels(BLOCKS))


def without(content: Document, *keys: str) -> Document:
    return {key: value for key, value in content.items() if key not in keys}


def test_a_body_is_what_the_sidecar_says(plain: Document) -> None:
    (body,) = state_of(plain, MOON).bodies
    assert body.position_km.tolist() == [0.0, 3.0e5, 4.0e5]
    assert body.radii_km.tolist() == [208.0, 197.0, 191.0]
    assert np.allclose(body.body_from_j2000, matrix_from_quaternion(np.array([0.5, 0.5, 0.5, -0.5])), atol=1e-15)
    assert body.sun_direction_j2000.tolist() == [0.0, -0.6, 0.8]
    assert body.photometry is Photometry.LAMBERT
    assert body.mesh is None


def test_the_catalogue_speaks_where_the_sidecar_is_silent(plain: Document) -> None:
    (body,) = state_of(plain, without(MOON, "photometry")).bodies
    assert (body.naif_id, body.photometry, body.shape_sigma_km) == (601, Photometry.LUNAR_LAMBERT, 0.6)
    said: Document = {
        **MOON, "photometry": "minnaert", "photometry_parameter": 0.7, "shape_sigma_km": 0.0,
        "shape_correlation_deg": 9.0, "haze_km": 2.0, "naif_id": 77,
    }  # fmt: skip
    (body,) = state_of(plain, said).bodies
    assert (body.naif_id, body.photometry, body.photometry_parameter) == (77, Photometry.MINNAERT, 0.7)
    assert (body.shape_sigma_km, body.shape_correlation_deg, body.haze_km) == (0.0, 9.0, 2.0)


def test_an_unknown_body_has_no_known_topography(plain: Document) -> None:
    (body,) = state_of(plain, {**without(MOON, "photometry"), "name": "NOWHERE"}).bodies
    assert (body.naif_id, body.photometry, body.shape_sigma_km, body.haze_km) == (None, Photometry.LAMBERT, None, 0.0)


def test_bodies_come_nearest_first(plain: Document) -> None:
    far: Document = {**MOON, "name": "FAR", "position_km": [1e7, 0.0, 0.0]}
    assert [body.name for body in state_of(plain, far, MOON).bodies] == ["Mimas", "FAR"]


@pytest.mark.parametrize("bodies", [None, []])
def test_no_bodies_is_no_fault(plain: Document, bodies: object) -> None:
    data = json.dumps({**plain, "bodies": bodies}).encode()
    assert state_from_sidecar(data, "id", None, {}).bodies == ()


BAD = [
    {"name": ""}, {"position_km": [0.0, 0.0, 0.0]}, {"position_km": [1e300, 0.0, 0.0]}, {"position_km": [1.0, 2.0]},
    {"position_km": [float("nan"), 0.0, 1e6]}, {"radii_km": [0.0, 1.0, 1.0]}, {"radii_km": [-1.0, 1.0, 1.0]},
    {"radii_km": [1e13, 1e13, 1e13]}, {"radii_km": [6e5, 6e5, 6e5]}, {"radii_km": None}, {"photometry": "phong"},
    {"photometry_parameter": -1.0}, {"body_from_j2000_wxyz": [0.0, 0.0, 0.0, 0.0]}, {"haze_km": -1.0},
    {"body_from_j2000_wxyz": [2.0, 0.0, 0.0, 0.0]}, {"body_from_j2000_wxyz": [1e200, 0.0, 0.0, 0.0]},
    {"sun_direction_j2000": [0.0, 0.0, 0.0]}, {"sun_direction_j2000": [1.5e8, 0.0, 0.0]}, {"shape_sigma_km": -0.1},
    {"sun_direction_j2000": [1e200, 0.0, 0.0]}, {"shape_correlation_deg": 0.0}, {"shape": ""}, {"shape": "a\0b"},
]  # fmt: skip


@pytest.mark.parametrize("change", BAD, ids=str)
def test_impossible_bodies_are_geometry_invalid(plain: Document, change: Document) -> None:
    with pytest.raises(GeometryError) as failure:
        state_of(plain, {**MOON, **change})
    assert failure.value.reason is StatusReason.GEOMETRY_INVALID
    assert "\n" not in failure.value.detail


def reader_of(read: list[str]) -> Callable[[str], TriangleMesh]:
    def mesh(path: str) -> TriangleMesh:
        read.append(path)
        return MESH

    return mesh


def test_shapes_lie_beside_the_sidecar(plain: Document) -> None:
    read: list[str] = []
    models = BodyModels({}, reader_of(read), "frames/deep")
    (body,) = state_of(plain, {**MOON, "shape": "../../shapes/a.obj", "radii_km": None}, models=models).bodies
    assert read == ["shapes/a.obj"]
    assert body.mesh is MESH
    scaled = body.mesh.vertices_km / body.radii_km
    # The farthest vertex lies on the bounding ellipsoid, the others inside.
    assert (scaled**2).sum(axis=1).max() == pytest.approx(1.0, rel=1e-14)


def test_shapes_of_the_catalogue_lie_in_the_archive(plain: Document) -> None:
    read: list[str] = []
    models = BodyModels({"MIMAS": BodyBlock(shape="shapes/m.obj")}, reader_of(read), "frames")
    (body,) = state_of(plain, {**without(MOON, "shape"), "radii_km": None}, models=models).bodies
    assert (read, body.mesh is MESH) == (["shapes/m.obj"], True)
    # Who gives radii means the ellipsoid.
    assert state_of(plain, MOON, models=models).bodies[0].mesh is None


def test_bounding_radii_of_a_box_touch_its_corners() -> None:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-2.0, 2.0) for z in (-3.0, 3.0)])
    mesh = TriangleMesh(corners, np.array([[0, 1, 2]]))
    assert bounding_radii(mesh) == pytest.approx(np.sqrt(3.0) * np.array([1.0, 2.0, 3.0]), rel=1e-14)


def test_an_archives_word_wins_key_by_key() -> None:
    configured = {"Rhea": BodyBlock(photometry=Photometry.MCEWEN, haze_km=1.0)}
    own = {"RHEA": BodyBlock(haze_km=0.0, shape_sigma_km=0.3), "Mock": BodyBlock(haze_km=5.0)}
    merged = merged_blocks(configured, own)
    assert merged["RHEA"] == BodyBlock(photometry=Photometry.MCEWEN, haze_km=0.0, shape_sigma_km=0.3)
    assert merged["MOCK"].haze_km == 5.0


def test_a_shape_is_an_input_of_its_image(lorri_archive: Path, tmp_path: Path) -> None:
    frames = some_frames(lorri_archive, tmp_path / "archive", 2)
    shape = tmp_path / "archive" / "rock.obj"
    shape.write_text(TETRAHEDRON)
    # Behind the camera: the mesh is read, and the stars are navigated as ever.
    behind: Document = {**MOON, "position_km": [0.0, 0.0, 0.0], "radii_km": None, "shape": "../rock.obj"}
    axis = state_of(sidecar_of(frames[0])).attitude.camera_from_j2000[2]
    write_sidecar(frames[0], bodies=[{**behind, "position_km": (-1e6 * axis).tolist()}])
    write_sidecar(frames[1])
    run = tmp_path / "run"
    assert run_serial(tmp_path / "archive", run).code == 0
    assert set(inputs_of(run, frames[0].stem)) >= {"rock.obj"}
    provenance = document(run, frames[0].stem)["provenance"]
    assert isinstance(provenance, dict)
    assert [entry["name"] for entry in provenance["shapes"]] == ["rock.obj"]
    assert "0 to do" in run_serial(tmp_path / "archive", run).err
    shape.write_text(TETRAHEDRON.replace("v 1 0 0", "v 2 0 0"))
    assert "1 to do" in run_serial(tmp_path / "archive", run).err
    shape.unlink()
    run_serial(tmp_path / "archive", run)
    assert document(run, frames[0].stem)["status_reason"] == "geometry_missing"
    shape.write_text("v 1 2\n")
    run_serial(tmp_path / "archive", run)
    assert document(run, frames[0].stem)["status_reason"] == "geometry_invalid"
    assert "0 to do" in run_serial(tmp_path / "archive", run).err


@needs_data
def test_eros_and_the_planted_bodies_are_read() -> None:
    folder = DATA / "eros_near"
    models = BodyModels(BLOCKS, lambda path: read_shape((folder / path).read_bytes(), path))
    data = (folder / "m0126865998f4_2p_iof.geometry.json").read_bytes()
    (eros,) = state_from_sidecar(data, "id", None, {}, (), models).bodies
    assert (eros.name, eros.naif_id, eros.photometry) == ("EROS", 2000433, Photometry.MCEWEN)
    assert eros.mesh is not None
    # NEAR circled Eros at 200 to 400 km in February 2000.
    assert 200.0 < np.linalg.norm(eros.position_km) < 400.0
    for path in sorted((DATA / "planted").glob("*.geometry.json")):
        said = json.loads(path.read_bytes())["bodies"]
        assert len(state_from_sidecar(path.read_bytes(), "id", None, {}, (), models).bodies) == len(said)
