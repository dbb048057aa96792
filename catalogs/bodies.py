"""What is known of bodies beside their ephemeris: scattering law, topography, haze, shape file."""

import posixpath
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from pipeline.errors import GeometryError
from pipeline.options import Options
from pipeline.records import Body, FloatArray, Photometry, TriangleMesh
from pipeline.status import StatusReason


class BodyBlock(Options):
    """One body of ``config_300_bodies.yaml``; an archive or a sidecar may know better."""

    naif_id: int | None = Field(None, description="NAIF code, where no kernel gives it")
    photometry: Photometry = Field(Photometry.LAMBERT, description="law by which the surface scatters light")
    photometry_parameter: float | None = Field(
        None, ge=0, le=2, description="lunar-Lambert weight or Minnaert exponent; by default the law's own"
    )
    shape_sigma_km: float | None = Field(None, ge=0, description="1-sigma of the surface about its shape, km")
    shape_correlation_deg: float = Field(5.0, gt=0, le=180, description="e-folding angle of those heights, degrees")
    haze_km: float = Field(0.0, ge=0, description="scale height of the atmosphere at the limb, km; 0 without one")
    shape: str | None = Field(
        None, pattern=r"^[^\x00]+$", description="shape file, relative to the archive's root, or a URL"
    )

    def body(
        self,
        name: str,
        position_km: FloatArray,
        body_from_j2000: FloatArray,
        sun_direction_j2000: FloatArray,
        radii_km: FloatArray | None,
        mesh: TriangleMesh | None,
    ) -> Body:
        """Record of this body at a place.

        Parameters
        ----------
        name
            As the provider calls it.
        position_km
            (3,) apparent, from the spacecraft, J2000 axes.
        body_from_j2000
            (3, 3).
        sun_direction_j2000
            (3,) unit vector.
        radii_km
            (3,) semi-axes; None where a mesh tells them.
        mesh
            Shape, None for the ellipsoid.

        Returns
        -------
        Body
            Checked.

        Raises
        ------
        ContractError
            If a figure is impossible.
        """
        radii = bounding_radii(mesh) if mesh is not None else radii_km
        return Body(
            name, self.naif_id, position_km, np.zeros(3) if radii is None else radii, body_from_j2000,
            sun_direction_j2000, self.photometry, self.photometry_parameter, mesh, self.shape_sigma_km,
            self.shape_correlation_deg, self.haze_km,
        )  # fmt: skip


def bounding_radii(mesh: TriangleMesh) -> FloatArray:
    """Semi-axes of an ellipsoid about the body-fixed axes that holds all of a mesh.

    Parameters
    ----------
    mesh
        Shape.

    Returns
    -------
    numpy.ndarray
        (3,) km: the box's half-widths about the origin, blown up together until the farthest vertex is inside.
    """
    half = np.maximum(np.abs(mesh.vertices_km).max(axis=0), np.finfo(float).tiny)
    return np.asarray(half * np.sqrt(((mesh.vertices_km / half) ** 2).sum(axis=1).max()))


def nearest_first(bodies: Iterable[Body]) -> tuple[Body, ...]:
    """Bodies in the order of their distance.

    Parameters
    ----------
    bodies
        In any order.

    Returns
    -------
    tuple of Body
        Ties keep their order.
    """
    return tuple(sorted(bodies, key=lambda body: float(np.linalg.norm(body.position_km))))


def _no_mesh(path: str) -> TriangleMesh:
    raise GeometryError(StatusReason.GEOMETRY_MISSING, f"{path}: no shapes can be read here")


@dataclass(frozen=True)
class BodyModels:
    """Catalogue blocks by name, and the way to shape files.

    Attributes
    ----------
    blocks
        By upper-case name.
    read_mesh
        From a path relative to the archive's root (or a URL) to the mesh; raises GeometryError.
    sidecar_folder
        Where the image's sidecar lies, relative to the root.
    """

    blocks: Mapping[str, BodyBlock] = field(default_factory=dict)
    read_mesh: Callable[[str], TriangleMesh] = _no_mesh
    sidecar_folder: str = ""

    def block_of(self, name: str) -> BodyBlock:
        """A body's block; what nobody knows scatters like Lambert's surface and has no known topography."""
        return self.blocks.get(name.upper(), _UNKNOWN)

    def mesh_of(self, block: BodyBlock) -> TriangleMesh | None:
        """Mesh that a block names, None where it names none."""
        return None if block.shape is None else self.read_mesh(block.shape)

    def mesh_beside_sidecar(self, path: str) -> TriangleMesh:
        """Mesh whose path is relative to the sidecar."""
        if "://" in path:
            return self.read_mesh(path)
        return self.read_mesh(posixpath.normpath(posixpath.join(self.sidecar_folder, path)))


_UNKNOWN = BodyBlock()
NO_MODELS = BodyModels()


def merged_blocks(configured: Mapping[str, BodyBlock], own: Mapping[str, BodyBlock]) -> dict[str, BodyBlock]:
    """Configuration's blocks with what an archive says of the same bodies on top, key by key.

    Parameters
    ----------
    configured
        From the configuration.
    own
        From the archive's description.

    Returns
    -------
    dict
        By upper-case name.
    """
    merged = {name.upper(): block for name, block in configured.items()}
    for name, block in own.items():
        said = {key: getattr(block, key) for key in block.model_fields_set}
        merged[name.upper()] = merged.get(name.upper(), _UNKNOWN).model_copy(update=said)
    return merged
