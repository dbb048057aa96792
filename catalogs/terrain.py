"""Digital terrain models as surfaces of a body: rasters of heights over the ellipsoid of their own map projection."""

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioIOError
from rasterio.warp import transform

from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.shape import Shape
from pipeline.records import BoolArray, FloatArray, TriangleMesh
from pipeline.status import StatusReason

# First bytes of TIFF and BigTIFF in either order, and of the labels of PDS3 images and ISIS cubes.
_RASTER_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"PDS_VERSION_ID", b"Object = IsisCube")
# A mesh of more posts takes more than a gigabyte.
_MOST_POSTS = 4_000_000


def is_raster(head: bytes) -> bool:
    """Tell a raster from a shape file by its first bytes.

    Parameters
    ----------
    head
        At least 20 bytes.

    Returns
    -------
    bool
        True for formats that heights come in.
    """
    return head.startswith(_RASTER_MARKS)


def read_terrain(path: Path) -> Shape:
    """Surface of a digital terrain model.

    Parameters
    ----------
    path
        Raster of one band: heights in metres over the ellipsoid of its coordinate system, geographic or projected.

    Returns
    -------
    Shape
        Open mesh in the body-fixed frame, two triangles between four neighbouring posts with a height, outward.

    Raises
    ------
    GeometryError
        If the file is damaged, says not where it lies, or holds no surface.
    """
    try:
        with warnings.catch_warnings():
            # Said in the project's own words below.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            raster = rasterio.open(path)
        with raster:
            if raster.crs is None or raster.transform.is_identity:
                raise _problem(path, "the raster does not say where on a body it lies")
            if raster.width * raster.height > _MOST_POSTS:
                raise _problem(path, f"{raster.width} x {raster.height} posts; at most {_MOST_POSTS}")
            band = raster.read(1, masked=True)
            rows, cols = np.meshgrid(np.arange(raster.height) + 0.5, np.arange(raster.width) + 0.5, indexing="ij")
            x, y = np.reshape(raster.transform[:6], (2, 3)) @ np.stack([cols.ravel(), rows.ravel(), np.ones(rows.size)])
            axes_m, geographic = _ellipsoid(raster.crs)
            longitude, latitude = transform(raster.crs, geographic, x, y)
    except (RasterioIOError, CRSError) as error:
        raise _problem(path, " ".join(str(error).split())) from error
    heights = np.ma.filled(band.astype(float), np.nan)
    places = _body_fixed(np.radians(longitude), np.radians(latitude), heights.ravel(), axes_m) / 1000.0
    try:
        return Shape(_mesh(places, np.isfinite(heights) & np.isfinite(places).all(axis=1).reshape(heights.shape)))
    except ContractError as error:
        raise _problem(path, str(error)) from error


def _problem(path: Path, what: str) -> GeometryError:
    return GeometryError(StatusReason.GEOMETRY_INVALID, f"terrain {path.name}: {what}")


def _ellipsoid(crs: CRS) -> tuple[tuple[float, float], CRS]:
    """Semi-axes in metres, and geographic coordinates on the same ellipsoid."""
    known = crs.to_dict()
    if "R" in known:
        axes = (float(known["R"]), float(known["R"]))
    elif "a" in known and ("b" in known or "rf" in known):
        a = float(known["a"])
        axes = (a, float(known["b"]) if "b" in known else a * (1.0 - 1.0 / float(known["rf"])))
    elif known.get("datum", known.get("ellps")) == "WGS84" or crs.to_epsg() == 4326:
        # Defining constants of WGS 84.
        axes = (6378137.0, 6378137.0 * (1.0 - 1.0 / 298.257223563))
    else:
        raise CRSError("the coordinate system does not tell its ellipsoid")
    return axes, CRS.from_dict(proj="longlat", a=axes[0], b=axes[1], no_defs=True)


def _body_fixed(
    longitude: FloatArray, latitude: FloatArray, heights_m: FloatArray, axes_m: tuple[float, float]
) -> FloatArray:
    """Places (n, 3) in metres of geodetic coordinates over an ellipsoid of revolution."""
    a, b = axes_m
    across = a * a / np.hypot(a * np.cos(latitude), b * np.sin(latitude))
    out = (across + heights_m) * np.cos(latitude)
    z = (across * (b / a) ** 2 + heights_m) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), z], axis=1)


def _mesh(places: FloatArray, known: BoolArray) -> TriangleMesh:
    """Triangles between four neighbouring posts that are all known, outward seen from the body's middle."""
    index = np.arange(known.size).reshape(known.shape)
    whole = known[:-1, :-1] & known[1:, :-1] & known[1:, 1:] & known[:-1, 1:]
    a, b, c, d = (part[whole] for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    facets = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    if not len(facets):
        raise ContractError("there are no four neighbouring posts with heights")
    used, place = np.unique(facets, return_inverse=True)
    vertices, facets = places[used], place.reshape(-1, 3)
    p, q, r = (vertices[facets[:, corner]] for corner in range(3))
    inward = (np.cross(q - p, r - p) * p).sum() < 0.0
    return TriangleMesh(vertices, facets[:, ::-1] if inward else facets)
