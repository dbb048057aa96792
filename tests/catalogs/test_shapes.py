"""Shape files: volumes that are known, every format, and damage that ends in one line."""

import time
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from catalogs.shapes import read_shape, read_solid
from pipeline.errors import GeometryError
from pipeline.geometry.shape import icq_adjacency, volume_km3
from pipeline.records import FloatArray, TriangleMesh
from pipeline.status import StatusReason
from tests.scenes.data import DATA, needs_data

# A box of 2 x 4 x 6 km: corners, and its twelve facets from 1, outward.
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-2.0, 2.0) for z in (-3.0, 3.0)])
FACETS = np.array(
    [[1, 2, 4], [1, 4, 3], [5, 7, 8], [5, 8, 6], [1, 5, 6], [1, 6, 2], [3, 4, 8], [3, 8, 7], [1, 3, 7], [1, 7, 5],
     [2, 6, 8], [2, 8, 4]]
)  # fmt: skip
VOLUME_KM3 = 48.0


def rows(mark: str, values: np.ndarray) -> str:
    return "".join(f"{mark}{' '.join(f'{value:.17g}' for value in row)}\n" for row in values)


def numbered(values: np.ndarray) -> str:
    return "".join(f" {n} {' '.join(f'{value:.17g}' for value in row)}\n" for n, row in enumerate(values, 1))


OBJ = f"# box\n{rows('v ', CORNERS)}{rows('f ', FACETS)}"
TEXTS = {
    "obj": OBJ,
    "obj inward": f"{rows('v ', CORNERS)}{rows('f ', FACETS[:, ::-1])}",
    "obj from the end": f"{rows('v ', CORNERS)}{rows('f ', FACETS - 9)}",
    "obj with normals and colours": rows("v ", np.column_stack([CORNERS, CORNERS]))
    + "vn 0 0 1\n" + "".join(f"f {a}//1 {b}/2/1 {c}/3\n" for a, b, c in FACETS),
    "obj of quadrilaterals": rows("v ", CORNERS)
    + "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n",
    "obj with a facet without area": OBJ + "f 1 2 1\n",
    "plates": f"8 12\n{rows('', CORNERS)}{rows('', FACETS)}",
    "plates with numbers": f"8\n{numbered(CORNERS)}12\n{numbered(FACETS)}",
}  # fmt: skip


def failure(data: bytes) -> str:
    with pytest.raises(GeometryError) as caught:
        read_shape(data, "box.obj")
    assert caught.value.reason is StatusReason.GEOMETRY_INVALID
    assert "\n" not in caught.value.detail
    assert caught.value.detail.startswith("shape box.obj: ")
    return caught.value.detail


def is_closed(mesh: TriangleMesh) -> bool:
    """Whether every edge is walked once in each sense."""
    edges = np.concatenate([mesh.facets[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    once = np.unique(edges, axis=0)
    return len(once) == len(edges) and np.array_equal(once, np.unique(edges[:, ::-1], axis=0))


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS.keys())
def test_every_format_gives_the_box(text: str) -> None:
    mesh = read_shape(text.encode(), "box")
    assert volume_km3(mesh) == pytest.approx(VOLUME_KM3, rel=1e-14)
    assert len(mesh.facets) == 12
    assert is_closed(mesh)
    assert np.array_equal(np.abs(mesh.vertices_km).max(axis=0), [1.0, 2.0, 3.0])


def icq_of_cube(side: int, half_km: float) -> str:
    """A cube in ICQ form whose faces wind both ways."""
    grid = np.linspace(-half_km, half_km, side + 1)
    faces: list[FloatArray] = []
    for axis in range(3):
        for end in (-half_km, half_km):
            face = np.empty((side + 1, side + 1, 3))
            face[..., axis] = end
            face[..., (axis + 1) % 3], face[..., (axis + 2) % 3] = np.meshgrid(grid, grid, indexing="ij")
            faces.append(face.reshape(-1, 3))
    return f"  {side}\n{rows('', np.concatenate(faces))}"


def test_icq_faces_share_their_edges() -> None:
    mesh = read_shape(icq_of_cube(4, 5.0).encode(), "cube")
    assert volume_km3(mesh) == pytest.approx(1000.0, rel=1e-13)
    assert is_closed(mesh)
    # V - E + F = 2: 6 Q^2 + 2 vertices, 12 Q^2 facets.
    assert mesh.vertices_km.shape == (98, 3)
    assert mesh.facets.shape == (192, 3)


def dsk_of_box(path: Path) -> bytes:
    """The box as NAIF's own library writes it."""
    handle = spiceypy.dskopn(str(path), "box", 0)
    spread, longs = spiceypy.dskmi2(CORNERS, FACETS, 1.0, 2, 10_000, 10_000, 10_000, True, 200_000)
    lowest, highest = spiceypy.dskrb2(CORNERS, FACETS, 1, np.zeros(10))
    spiceypy.dskw02(
        handle, 499, 1, 1, "IAU_MARS", 1, np.zeros(10), -np.pi, np.pi, -np.pi / 2, np.pi / 2, lowest, highest,
        -1e9, 1e9, CORNERS, FACETS, spread, longs,
    )  # fmt: skip
    spiceypy.dskcls(handle, True)
    return path.read_bytes()


def test_dsk(tmp_path: Path) -> None:
    mesh = read_shape(dsk_of_box(tmp_path / "box.bds"), "box.bds")
    assert volume_km3(mesh) == pytest.approx(VOLUME_KM3, rel=1e-14)
    assert is_closed(mesh)
    assert "DSK" in failure((tmp_path / "box.bds").read_bytes()[:3000])


DAMAGED = {
    "empty": "", "only a comment": "# box\n", "no facets": rows("v ", CORNERS), "prose": "here is no shape\n",
    "a short vertex": OBJ.replace("v -1 -2 -3\n", "v -1 -2\n"), "no number": OBJ.replace("v -1 -2 -3", "v -1 x -3"),
    "not finite": OBJ.replace("v -1 -2 -3", "v -1 nan -3"), "metres of a giant": OBJ.replace("v -1 ", "v -1e9 "),
    "vertex 9": OBJ.replace("f 1 2 4", "f 1 2 9"), "vertex 0": OBJ.replace("f 1 2 4", "f 0 2 4"),
    "vertex -9": OBJ.replace("f 1 2 4", "f -9 2 4"), "half a vertex": OBJ.replace("f 1 2 4", "f 1.5 2 4"),
    "two corners": OBJ + "f 1 2\n", "a sheet": rows("v ", CORNERS * [1, 1, 0]) + rows("f ", FACETS),
    "huge index": OBJ.replace("f 1 2 4", "f 1e300 2 4"),
    "cut plates": f"8 12\n{rows('', CORNERS)}{rows('', FACETS[:-1])}", "cut ICQ": icq_of_cube(4, 5.0)[:-40],
    "no plates": f"8\n{rows('', CORNERS)}", "negative counts": "-8 12\n", "a lone count": "8\n",
}  # fmt: skip


@pytest.mark.parametrize("text", DAMAGED.values(), ids=DAMAGED.keys())
def test_damage_is_one_line(text: str) -> None:
    failure(text.encode())


@pytest.mark.parametrize(
    ("name", "row"),
    [("a short vertex", "vertex row 1 has 2 columns"), ("no number", "vertex row 1 holds"), ("not finite", "vertex 1 "),
     ("vertex 9", "facet 1 names"), ("half a vertex", "facet row 1 holds")],
)  # fmt: skip
def test_damage_is_named_by_its_row(name: str, row: str) -> None:
    assert row in failure(DAMAGED[name].encode())


def test_binary_rubbish_is_one_line() -> None:
    failure(bytes(range(256)) * 20)
    failure(b"DAS/DSK " + bytes(5000))


@needs_data
@pytest.mark.parametrize(("name", "volume"), [("eros", 2506.0), ("itokawa", 0.01779), ("bennu", 0.06163)])
def test_volumes_of_small_bodies(name: str, volume: float) -> None:
    data = (DATA / "shapes" / f"{name}.obj").read_bytes()
    start = time.process_time()
    mesh = read_shape(data, name)
    seconds = time.process_time() - start
    # The README gives four digits.
    assert volume_km3(mesh) == pytest.approx(volume, rel=3e-4)
    assert len(mesh.facets) == 49_152
    assert is_closed(mesh)
    # 0.13 s; twice the budget on a machine with other things to do.
    assert seconds < 0.6


@needs_data
def test_phoebe_is_closed_and_as_large_as_published() -> None:
    mesh = read_shape((DATA / "phoebe" / "phoebe_ICQ_Q64.TXT").read_bytes(), "phoebe")
    assert is_closed(mesh)
    assert mesh.vertices_km.shape == (6 * 64**2 + 2, 3)
    # Mean radius 106.5 +- 0.7 km (Thomas 2010, Icarus 208, 395).
    assert (3 * volume_km3(mesh) / (4 * np.pi)) ** (1 / 3) == pytest.approx(106.5, abs=0.7)


def test_a_grid_keeps_its_faces() -> None:
    text = icq_of_cube(4, 5.0)
    shape = read_solid(text.encode(), "cube")
    assert shape.icq_km is not None
    assert np.array_equal(shape.icq_km.reshape(-1, 3), np.array(text.split()[1:], float).reshape(-1, 3))
    assert shape.volume_km3 == pytest.approx(1000.0, rel=1e-13)
    assert read_solid(OBJ.encode(), "box").icq_km is None
    plates = f"8 12\n{rows('', CORNERS)}{rows('', FACETS)}"
    assert read_solid(plates.encode(), "box").icq_km is None


@needs_data
def test_phoebe_joins_face_to_face() -> None:
    shape = read_solid((DATA / "phoebe" / "phoebe_ICQ_Q64.TXT").read_bytes(), "phoebe")
    assert shape.icq_km is not None
    joined = icq_adjacency(shape.icq_km)
    # Top and bottom never touch, and every face has the other four around it.
    assert all(set(joined[face, :, 0]) == set(range(6)) - {face, 5 - face} for face in (0, 5))
    assert all(len(set(joined[face, :, 0])) == 4 for face in range(6))
