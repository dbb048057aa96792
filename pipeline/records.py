"""Records and the conventions that they fix.

Pixels are ``(v, u)`` = (row, column) of the stored array, with the centre of the first pixel at (0, 0); arrays of
positions are ``(n, 2)`` in that order and end in ``_vu``. ``predicted + offset = actual``; with rotation
``actual = pivot + R(theta) (predicted - pivot) + d`` where a positive theta turns +u toward +v. Covariance order is
(dv, du, theta) in px^2 and rad^2. Frames stand in names (``camera_from_j2000``), units too (``_km``, ``_px``,
``_rad``, ``_deg``, ``_s``). Time inside is TDB seconds past J2000 (``et``).
"""

from dataclasses import dataclass, field, fields
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from pipeline.errors import ContractError
from pipeline.options import InstrumentSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Image = NDArray[np.float32]


def read_only(values: ArrayLike, shape: tuple[int | None, ...], dtype: DTypeLike = np.float64) -> NDArray[np.generic]:
    """Read-only copy of ``values``, refused when its shape is not the declared one.

    Parameters
    ----------
    values
        Anything that numpy turns into an array.
    shape
        Declared shape; None stands for any length.
    dtype
        Element type of the copy.

    Returns
    -------
    numpy.ndarray
        C-contiguous and not writeable.

    Raises
    ------
    ContractError
        If the shape differs.
    """
    array = np.array(values, dtype=dtype, order="C")
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise ContractError(f"array of shape {array.shape} where {shape} is declared")
    array.flags.writeable = False
    return array


class Record:
    """Frozen record whose arrays stay read-only after pickling, which forgets numpy's flag."""

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def _freeze(self, **shapes: tuple[int | None, ...]) -> None:
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None:
                dtype = value.dtype if isinstance(value, np.ndarray) and value.dtype.kind in "biUS" else np.float64
                object.__setattr__(self, name, read_only(value, shape, dtype))

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Array fields by name: one array is one table column (or a block of them)."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


@dataclass(frozen=True, eq=False)
class CameraModel(Record):
    """Owen camera (seed 001 eq. 1.6 and 1.12-1.16 with the corrections of the project's notes).

    Attributes
    ----------
    shape_vu
        Rows and columns of the stored array.
    focal_length_mm
        Focal length.
    k_px_per_mm
        (2, 2), ``[[Kx, Kxy], [Kyx, Ky]]``: photo-plane mm to (u, v) pixels; negative entries mirror or turn.
    principal_point_vu
        (2,), where the optical axis meets the array.
    distortion_eps
        (6,), epsilon 1-6 in mm^-2, mm^-4, mm^-1, mm^-1, mm^-1, mm^-3.
    k_xy_px_per_mm2
        (2,), ``(Kxxy, Kxyy)``: factors of x*y of the distorted point, added to (u, v).
    """

    shape_vu: tuple[int, int]
    focal_length_mm: float
    k_px_per_mm: FloatArray
    principal_point_vu: FloatArray
    distortion_eps: FloatArray = field(default_factory=lambda: np.zeros(6))
    k_xy_px_per_mm2: FloatArray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        self._freeze(k_px_per_mm=(2, 2), principal_point_vu=(2,), distortion_eps=(6,), k_xy_px_per_mm2=(2,))
        if min(self.shape_vu) < 2:
            raise ContractError(f"camera array of {self.shape_vu} pixels")
        if not self.focal_length_mm > 0:
            raise ContractError(f"focal length {self.focal_length_mm} mm must be positive")
        if not abs(float(np.linalg.det(self.k_px_per_mm))) > 0:
            raise ContractError("k_px_per_mm is singular")

    @property
    def centre_vu(self) -> FloatArray:
        """(2,), the array centre, where the ensemble reports offsets."""
        return np.array([(self.shape_vu[0] - 1) / 2, (self.shape_vu[1] - 1) / 2])

    @property
    def handedness(self) -> float:
        """+1 where the stored array shows the sky as the lens sees it, -1 where it is mirrored."""
        return float(np.sign(np.linalg.det(self.k_px_per_mm)))


@dataclass(frozen=True)
class Detector:
    """What turns light into numbers; None where nobody knows.

    Attributes
    ----------
    psf_sigma_px
        Standard deviation of the Gaussian core, before integration over the pixel.
    psf_misfit
        Share of a real star's light by which it misses the Gaussian; None takes the detection's default.
    model_residual_px
        Per-axis 1 sigma by which a star may lie off its predicted pixel because of distortion and PSF shape that the
        camera model leaves out.
    read_noise_dn, gain_e_per_dn, bias_dn, saturation_dn, missing_value
        As named; ``missing_value`` fills pixels that were never received.
    star_dn_per_s_mag0
        Flux of a star of magnitude zero.
    """

    psf_sigma_px: float | None = None
    psf_misfit: float | None = None
    model_residual_px: float = 0.0
    read_noise_dn: float | None = None
    gain_e_per_dn: float | None = None
    bias_dn: float = 0.0
    saturation_dn: float | None = None
    missing_value: float | None = None
    star_dn_per_s_mag0: float | None = None


@dataclass(frozen=True, eq=False)
class Attitude(Record):
    """A-priori attitude.

    Attributes
    ----------
    camera_from_j2000
        (3, 3) rotation; camera frame right-handed with z out of the lens.
    sigma_rad
        (3,) a-priori 1 sigma about the camera's x, y, z, if known.
    rate_rad_s
        (3,) angular rate of the camera about its own axes during the exposure, if known.
    """

    camera_from_j2000: FloatArray
    sigma_rad: FloatArray | None = None
    rate_rad_s: FloatArray | None = None

    def __post_init__(self) -> None:
        self._freeze(camera_from_j2000=(3, 3), sigma_rad=(3,), rate_rad_s=(3,))
        if not np.allclose(self.camera_from_j2000 @ self.camera_from_j2000.T, np.eye(3), atol=1e-9):
            raise ContractError("camera_from_j2000 is not a rotation")
        if np.linalg.det(self.camera_from_j2000) < 0:
            raise ContractError("camera_from_j2000 is a reflection")


@dataclass(frozen=True, eq=False)
class Spacecraft(Record):
    """Where the camera is and how it moves, J2000 axes from the Solar System's barycentre; None where unknown."""

    position_km: FloatArray | None = None
    velocity_km_s: FloatArray | None = None

    def __post_init__(self) -> None:
        self._freeze(position_km=(3,), velocity_km_s=(3,))


class Photometry(StrEnum):
    """Law by which a surface scatters light; parameters stand with the functions in ``imaging/illumination.py``."""

    LAMBERT = "lambert"
    LOMMEL_SEELIGER = "lommel_seeliger"
    LUNAR_LAMBERT = "lunar_lambert"
    MCEWEN = "mcewen"
    MINNAERT = "minnaert"


@dataclass(frozen=True, eq=False)
class TriangleMesh(Record):
    """Shape of a body as triangles.

    Attributes
    ----------
    vertices_km
        (n, 3) body-fixed.
    facets
        (m, 3) vertex indices, counter-clockwise seen from outside.
    """

    vertices_km: FloatArray
    facets: NDArray[np.int64]

    def __post_init__(self) -> None:
        self._freeze(vertices_km=(None, 3), facets=(None, 3))
        if not len(self.facets) or self.facets.min() < 0 or self.facets.max() >= len(self.vertices_km):
            raise ContractError("facets name vertices that are not there")
        if not np.isfinite(self.vertices_km).all():
            raise ContractError("a vertex is not finite")


@dataclass(frozen=True, eq=False)
class Body(Record):
    """One planet, moon or small body as the camera sees it: light time and stellar aberration are in its place.

    Attributes
    ----------
    name, naif_id
        Identity; the id is None where nobody gave one.
    position_km
        (3,) apparent, from the spacecraft, J2000 axes.
    radii_km
        (3,) semi-axes along the body-fixed axes; for a mesh those of its bounding ellipsoid.
    body_from_j2000
        (3, 3) orientation when the light left it.
    sun_direction_j2000
        (3,) unit vector from the body to the Sun.
    photometry
        Scattering law.
    photometry_parameter
        The law's one free parameter (lunar-Lambert weight, Minnaert exponent), None for its default.
    mesh
        Shape where it is no ellipsoid.
    shape_sigma_km
        1 sigma of the surface's height about the shape (topography and errors of the shape); None where unknown.
    shape_correlation_deg
        Angle at the body's centre over which those heights are alike (e-folding of their covariance).
    haze_km
        Scale height of an atmosphere that softens the limb; zero for an airless body.
    """

    name: str
    naif_id: int | None
    position_km: FloatArray
    radii_km: FloatArray
    body_from_j2000: FloatArray
    sun_direction_j2000: FloatArray
    photometry: Photometry = Photometry.LAMBERT
    photometry_parameter: float | None = None
    mesh: TriangleMesh | None = None
    shape_sigma_km: float | None = None
    shape_correlation_deg: float = 5.0
    haze_km: float = 0.0

    def __post_init__(self) -> None:
        self._freeze(position_km=(3,), radii_km=(3,), body_from_j2000=(3, 3), sun_direction_j2000=(3,))
        if not (np.isfinite(self.position_km).all() and np.linalg.norm(self.position_km) > 0):
            raise ContractError(f"{self.name}: position {self.position_km.tolist()} km")
        if not (np.isfinite(self.radii_km).all() and (self.radii_km > 0).all()):
            raise ContractError(f"{self.name}: radii {self.radii_km.tolist()} km must be positive")
        rotation = self.body_from_j2000
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
            raise ContractError(f"{self.name}: body_from_j2000 is not a rotation")
        if abs(float(np.linalg.norm(self.sun_direction_j2000)) - 1.0) > 1e-6:
            raise ContractError(f"{self.name}: sun_direction_j2000 is not a unit vector")


class RingKind(StrEnum):
    """What a ring feature is: two edges with something between them, or one edge of something wide."""

    RINGLET = "ringlet"
    GAP = "gap"
    EDGE_OUTER = "edge_outer"
    EDGE_INNER = "edge_inner"


@dataclass(frozen=True, eq=False)
class RingFeature(Record):
    """A ringlet, a gap, or the edge of a ring, at the time when its light left it.

    Attributes
    ----------
    name
        Identity, unique in its system.
    kind
        Of an ``edge_outer`` the ring lies inside, of an ``edge_inner`` outside.
    a_km, ae_km, long_peri_rad
        Semi-major axis of the (inner) edge, its eccentricity times that, and longitude of pericentre.
    width_km
        Outer minus inner edge; zero for single edges.
    tau
        Normal optical depth: of the ringlet, of what is left in the gap, of an edge's denser side; None if unknown.
    sigma_a_km
        1 sigma by which both edges together may lie elsewhere; None where nobody says.
    modes
        (n, 3) azimuthal number m, amplitude in km and phase in radians: the radius loses
        ``amplitude cos(m longitude - phase)``.
    a_sin_i_km, long_node_rad
        Height above the plane at the node plus a quarter turn, and longitude of the ascending node on the ring plane.
    """

    name: str
    kind: RingKind
    a_km: float
    ae_km: float = 0.0
    long_peri_rad: float = 0.0
    width_km: float = 0.0
    tau: float | None = None
    sigma_a_km: float | None = None
    modes: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    a_sin_i_km: float = 0.0
    long_node_rad: float = 0.0

    def __post_init__(self) -> None:
        self._freeze(modes=(None, 3))
        if not (self.a_km > 0 and 0 <= self.ae_km < self.a_km and self.width_km >= 0):
            raise ContractError(f"{self.name}: a {self.a_km} km, ae {self.ae_km} km, width {self.width_km} km")


@dataclass(frozen=True, eq=False)
class RingSystem(Record):
    """Rings of one planet as the camera sees them: light time and stellar aberration are in their place.

    Attributes
    ----------
    planet
        Name.
    position_km
        (3,) apparent centre, from the spacecraft, J2000 axes.
    plane_from_j2000
        (3, 3) x to the reference of longitudes, z to the pole.
    opening_sun_rad
        Elevation of the Sun over the plane, positive on the pole's side.
    sun_direction_j2000
        (3,) unit vector to the Sun, None where unknown (then nothing throws a shadow).
    features
        Edges to navigate by.
    """

    planet: str
    position_km: FloatArray
    plane_from_j2000: FloatArray
    opening_sun_rad: float
    sun_direction_j2000: FloatArray | None = None
    features: tuple[RingFeature, ...] = ()

    def __post_init__(self) -> None:
        self._freeze(position_km=(3,), plane_from_j2000=(3, 3), sun_direction_j2000=(3,))
        rotation = self.plane_from_j2000
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
            raise ContractError(f"rings of {self.planet}: plane_from_j2000 is not a rotation")
        if not (np.isfinite(self.position_km).all() and np.linalg.norm(self.position_km) > 0):
            raise ContractError(f"rings of {self.planet}: position {self.position_km.tolist()} km")

    @property
    def observer_km(self) -> FloatArray:
        """(3,) the camera from the planet's centre, in the ring frame."""
        return np.asarray(-self.plane_from_j2000 @ self.position_km)


@dataclass(frozen=True)
class State:
    """Geometry of one image, whichever provider filled it.

    Attributes
    ----------
    image_id, mission, camera
        Identity; mission and camera are the table's partitions.
    et, time_utc
        Mid-exposure: TDB seconds past J2000, and ISO-8601 UTC.
    exposure_s
        Exposure, None when unknown.
    bodies
        Everything solid that can be in or near the field, the Sun aside; nearest first.
    rings
        Of the one ringed planet whose rings can be in the field.
    """

    image_id: str
    mission: str
    camera: str
    et: float
    time_utc: str
    exposure_s: float | None
    camera_model: CameraModel
    detector: Detector
    attitude: Attitude
    spacecraft: Spacecraft
    settings: InstrumentSettings
    bodies: tuple[Body, ...] = ()
    rings: RingSystem | None = None


@dataclass(frozen=True, eq=False)
class StarTable(Record):
    """Catalogue stars as one struct of arrays.

    Attributes
    ----------
    star_id
        (n,) text.
    ra_deg, dec_deg
        (n,) ICRS at ``epoch``.
    mag
        (n,) magnitude in whatever band the catalogue keeps.
    pm_ra_masyr, pm_dec_masyr
        (n,) proper motion, mas per Julian year, with cos(dec); NaN where unknown.
    parallax_mas
        (n,) NaN where unknown.
    epoch
        (n,) Julian year of the place, NaN where the table does not say: then the image's own.
    apparent
        (n,) True where the place is as seen: then neither motion, parallax nor aberration applies.
    """

    star_id: NDArray[np.str_]
    ra_deg: FloatArray
    dec_deg: FloatArray
    mag: FloatArray
    pm_ra_masyr: FloatArray
    pm_dec_masyr: FloatArray
    parallax_mas: FloatArray
    epoch: FloatArray
    apparent: BoolArray

    def __post_init__(self) -> None:
        n = len(self.star_id)
        self._freeze(**{f.name: (n,) for f in fields(self)})

    def __len__(self) -> int:
        return len(self.star_id)

    def take(self, index: NDArray[np.generic]) -> "StarTable":
        """Rows of an index or mask."""
        return StarTable(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def concatenate(tables: "list[StarTable]") -> "StarTable":
        """All rows, in the order given."""
        return StarTable(*(np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(StarTable)))

    @staticmethod
    def empty() -> "StarTable":
        """No rows."""
        zero = np.zeros(0)
        return StarTable(np.zeros(0, "U1"), zero, zero, zero, zero, zero, zero, zero, np.zeros(0, bool))
