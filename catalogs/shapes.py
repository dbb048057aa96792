"""Shape files of bodies as triangle meshes: OBJ, Gaskell's ICQ, plate tables, and NAIF's DSK.

All lengths are kilometres in the body-fixed frame, which is what the planetary archives keep.
"""

import tempfile
from collections.abc import Iterator, Sequence

import numpy as np
import spiceypy
from numpy.typing import NDArray
from spiceypy.utils.exceptions import NotFoundError, SpiceyError
from spiceypy.utils.support_types import SpiceDLADescr

from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.shape import ICQ_FACES, Shape, signed_volume
from pipeline.records import FloatArray, TriangleMesh
from pipeline.status import StatusReason

IntArray = NDArray[np.int64]
_DSK_MARKS = (b"DAS/DSK", b"NAIF/DAS")
# Binary formats that a DAS file record names behind its counts (NAIF's required reading on DAS).
_DAS_FORMATS = (b"LTL-IEEE", b"BIG-IEEE")
# Segment type 2 of a DSK holds plates (NAIF's required reading on DSK).
_PLATE_TYPE = 2
# Nothing in the Solar System but the Sun is larger; a file in metres or pixels shows itself here or in the ephemeris.
_LARGEST_KM = 1.0e6


class ShapeProblem(Exception):
    """One line on what is wrong with a shape file."""


def read_shape(data: bytes, name: str) -> TriangleMesh:
    """Mesh of a shape file, its format told by its content.

    Parameters
    ----------
    data
        The file's bytes.
    name
        For messages.

    Returns
    -------
    TriangleMesh
        Facets counter-clockwise seen from outside; facets without area are left out.

    Raises
    ------
    GeometryError
        If the file is damaged, or its surface encloses nothing.
    """
    try:
        vertices, facets = _parse(data)
        return _checked(vertices, facets)
    except (ShapeProblem, ContractError) as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"shape {name}: {error}") from error


def read_solid(data: bytes, name: str) -> Shape:
    """Shape of a shape file: its mesh, and its grid where it is one of Gaskell's.

    Parameters
    ----------
    data
        The file's bytes.
    name
        For messages.

    Returns
    -------
    Shape
        Facets outward.

    Raises
    ------
    GeometryError
        If the file is damaged, or its surface encloses nothing.
    """
    mesh = read_shape(data, name)
    lines = data.split(None, 1)[1].splitlines() if data.split(None, 1)[0].isdigit() else []
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith(b"#")]
    side = int(data.split(None, 1)[0]) if rows else 0
    if len(rows) != ICQ_FACES * (side + 1) ** 2:
        return Shape(mesh)
    return Shape(mesh, _icq_vertices(rows).reshape(ICQ_FACES, side + 1, side + 1, 3))


def _parse(data: bytes) -> tuple[FloatArray, IntArray]:
    if data.startswith(_DSK_MARKS):
        return _dsk(data)
    lines = [line for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#")]
    if not lines:
        raise ShapeProblem("the file is empty")
    if lines[0].split()[0] in (b"v", b"f", b"o", b"g", b"s", b"vn", b"vt", b"mtllib", b"usemtl"):
        return _obj(lines)
    counts = lines[0].split()
    if len(counts) == 1 and (side := _count(counts[0])) > 0 and len(lines) == 1 + ICQ_FACES * (side + 1) ** 2:
        return _icq(lines[1:], side)
    return _plates(lines)


def _count(token: bytes) -> int:
    try:
        return int(token)
    except ValueError as error:
        raise ShapeProblem(f"{token[:20]!r} is no number of rows") from error


def _numbers(rows: Sequence[bytes], columns: int, what: str) -> FloatArray:
    """(n, columns) numbers of rows of equal width."""
    if not rows:
        raise ShapeProblem(f"there are no {what} rows")
    tokens = b" ".join(rows).split()
    odd = next((k for k, row in enumerate(rows) if len(row.split()) != columns), None)
    if odd is not None:
        raise ShapeProblem(f"{what} row {odd + 1} has {len(rows[odd].split())} columns, not {columns}")
    try:
        return np.array(tokens).astype(float).reshape(-1, columns)
    except ValueError as error:
        odd = next(k for k, row in enumerate(rows) if not _is_numbers(row))
        raise ShapeProblem(f"{what} row {odd + 1} holds something that is no number") from error


def _is_numbers(row: bytes) -> bool:
    try:
        np.array(row.split()).astype(float)
    except ValueError:
        return False
    return True


def _indices(rows: Sequence[bytes], columns: int) -> IntArray:
    values = _numbers(rows, columns, "facet")
    whole = np.isfinite(values) & (np.abs(values) < 2**53) & (values == np.rint(values))
    if not whole.all():
        odd = int(np.flatnonzero(~whole.all(axis=1))[0])
        raise ShapeProblem(f"facet row {odd + 1} holds something that is no index")
    return values.astype(np.int64)


def _obj(lines: Sequence[bytes]) -> tuple[FloatArray, IntArray]:
    """Wavefront OBJ: ``v x y z`` and ``f a b c ...``, indices from 1, or from -1 backwards."""
    places = [line.split(None, 4)[1:4] for line in lines if line.startswith(b"v ")]
    vertices = _numbers([b" ".join(place) for place in places], 3, "vertex")
    faces = [line[2:] for line in lines if line.startswith(b"f ")]
    if any(b"/" in face for face in faces):
        faces = [b" ".join(corner.split(b"/")[0] for corner in face.split()) for face in faces]
    widths = [len(face.split()) for face in faces]
    parts = [
        _fan(_indices([face for face, width in zip(faces, widths, strict=True) if width == corners], corners))
        for corners in sorted(set(widths))
    ]
    if not parts:
        raise ShapeProblem("there are no facets")
    facets = np.concatenate(parts)
    return vertices, np.where(facets < 0, facets + len(vertices), facets - 1)


def _fan(polygons: IntArray) -> IntArray:
    """Triangles of convex polygons, all with equally many corners."""
    corners = polygons.shape[1]
    if corners < 3:
        raise ShapeProblem(f"a facet has {corners} corners")
    return np.concatenate([polygons[:, [0, k, k + 1]] for k in range(1, corners - 1)])


def _icq_vertices(lines: Sequence[bytes]) -> FloatArray:
    return _numbers([b" ".join(line.split(None, 3)[:3]) for line in lines], 3, "vertex")


def _icq(lines: Sequence[bytes], side: int) -> tuple[FloatArray, IntArray]:
    """Gaskell's implicitly connected quadrilaterals: six faces of (Q + 1)^2 vertices, row by row.

    Rows may carry an albedo and more behind x, y, z. Adjacent faces repeat the vertices of their common edge; these
    become one. Faces need not wind the same way, so each is turned by the sign of its own volume about the origin.
    """
    vertices = _icq_vertices(lines)
    grid = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    face = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    facets = [face + k * (side + 1) ** 2 for k in range(ICQ_FACES)]
    facets = [part if signed_volume(vertices, part) >= 0 else part[:, ::-1] for part in facets]
    unique, place = np.unique(vertices, axis=0, return_inverse=True)
    return unique, place.reshape(-1)[np.concatenate(facets)]


def _plates(lines: Sequence[bytes]) -> tuple[FloatArray, IntArray]:
    """Plate tables of the archives: counts, vertex rows, plate rows; rows may start with their own number from 1.

    The counts stand in one line, or each before its own rows.
    """
    counts = [_count(token) for token in lines[0].split()]
    if len(counts) not in (1, 2) or counts[0] < 4:
        raise ShapeProblem("neither OBJ, ICQ, a plate table nor DSK")
    end = 1 + counts[0]
    if len(counts) == 1:
        if len(lines) <= end or len(lines[end].split()) != 1:
            raise ShapeProblem(f"the number of plates does not follow {counts[0]} vertex rows")
        counts.append(_count(lines[end].split()[0]))
        plates = lines[end + 1 :]
    else:
        plates = lines[end:]
    if len(lines) < end or len(plates) != counts[1]:
        raise ShapeProblem(f"{len(lines) - 1} rows where {counts[0]} vertices and {counts[1]} plates are announced")
    vertices, facets = (_unnumbered(rows) for rows in (lines[1:end], plates))
    return _numbers(vertices, 3, "vertex"), _indices(facets, 3) - 1


def _unnumbered(rows: Sequence[bytes]) -> list[bytes]:
    """Rows without the number that some tables put in front."""
    numbered = bool(rows) and len(rows[0].split()) == 4
    return [row.split(None, 1)[-1] for row in rows] if numbered else list(rows)


def _dsk(data: bytes) -> tuple[FloatArray, IntArray]:
    """All plate segments of a DSK file; CSPICE reads files by name only, and crashes on a DAS header of rubbish."""
    if data[84:92] not in _DAS_FORMATS or b"FTPSTR" not in data[:1024]:
        raise ShapeProblem("DSK: the file's header is damaged")
    with tempfile.NamedTemporaryFile(suffix=".bds") as file:
        file.write(data)
        file.flush()
        try:
            parts = _dsk_segments(file.name)
        except SpiceyError as error:
            raise ShapeProblem(f"DSK: {' '.join(str(error.short).split())}") from error
    if not parts:
        raise ShapeProblem("DSK without plates")
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    facets = [facets + start for (_, facets), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(facets)


def _dsk_segments(path: str) -> list[tuple[FloatArray, IntArray]]:
    handle = spiceypy.dasopr(path)
    try:
        return [_dsk_plates(handle, s) for s in _segments(handle) if spiceypy.dskgd(handle, s).dtype == _PLATE_TYPE]
    finally:
        spiceypy.dascls(handle)


def _segments(handle: int) -> Iterator[SpiceDLADescr]:
    try:
        segment = spiceypy.dlabfs(handle)
        while True:
            yield segment
            segment = spiceypy.dlafns(handle, segment)
    except NotFoundError:
        return


def _dsk_plates(handle: int, segment: SpiceDLADescr) -> tuple[FloatArray, IntArray]:
    count, plates = spiceypy.dskz02(handle, segment)
    vertices = np.array(spiceypy.dskv02(handle, segment, 1, count), dtype=float).reshape(-1, 3)
    facets = np.array(spiceypy.dskp02(handle, segment, 1, plates), dtype=np.int64).reshape(-1, 3)
    return vertices, facets - 1


def _checked(vertices: FloatArray, facets: IntArray) -> TriangleMesh:
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > _LARGEST_KM:
        odd = np.flatnonzero(~(np.abs(vertices) <= _LARGEST_KM).all(axis=1))[0]
        raise ShapeProblem(f"vertex {odd + 1} is not finite or beyond {_LARGEST_KM:g} km")
    if facets.min() < 0 or facets.max() >= len(vertices):
        odd = np.flatnonzero(((facets < 0) | (facets >= len(vertices))).any(axis=1))[0]
        raise ShapeProblem(f"facet {odd + 1} names a vertex outside 1 to {len(vertices)}")
    a, b, c = (vertices[facets[:, corner]] for corner in range(3))
    facets = facets[(np.cross(b - a, c - a) != 0).any(axis=1)]
    volume = signed_volume(vertices, facets)
    extent = float(np.ptp(vertices, axis=0).max())
    # The volume about the origin is that of the body only if the surface is closed; a sheet or a point has none.
    if not len(facets) or abs(volume) <= 1e-9 * extent**3:
        raise ShapeProblem("the surface encloses no volume")
    return TriangleMesh(vertices, facets if volume > 0 else facets[:, ::-1])
