"""Provider ``sidecar``: the serialised State beside an image, format ``geometry/1``."""

import json
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from catalogs.bodies import NO_MODELS, BodyBlock, BodyModels, nearest_first
from catalogs.geometry import et_of_utc, first_problem, plausible, settings_of
from catalogs.instruments import InstrumentBlock
from catalogs.ring_catalog import RingBlock
from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.records import (
    Attitude,
    Body,
    CameraModel,
    Detector,
    FloatArray,
    Photometry,
    RingKind,
    RingSystem,
    Spacecraft,
    State,
    TriangleMesh,
)
from pipeline.status import StatusReason

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
# The outskirts of the heliosphere, which also keeps squares finite.
_Coordinate = Annotated[float, Field(ge=-1e12, le=1e12)]
Place = tuple[_Coordinate, _Coordinate, _Coordinate]
ELLIPSOID = "ellipsoid"
# Unit vectors and quaternions that somebody rounded to three digits are still meant.
_LENGTH_TOLERANCE = 1e-3


class _Block(BaseModel):
    """Part of a sidecar; keys that this version does not know are another tool's business."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class _CameraBlock(_Block):
    shape_vu: tuple[int, int]
    focal_length_mm: float = Field(gt=0)
    k_px_per_mm: tuple[tuple[float, float], tuple[float, float]]
    principal_point_vu: tuple[float, float]
    distortion_eps: tuple[float, float, float, float, float, float] = (0.0,) * 6
    psf_sigma_px: float | None = Field(None, gt=0.1, le=50)
    model_residual_px: float = Field(0.0, ge=0)
    read_noise_dn: float | None = Field(None, ge=0)
    gain_e_per_dn: float | None = Field(None, gt=0)
    bias_dn: float | None = None
    saturation_dn: float | None = None
    # Calibrated products mark what was never received by not-a-number, and say so.
    missing_value: float | None = Field(None, allow_inf_nan=True)
    star_dn_per_s_mag0: float | None = Field(None, gt=0)


class _AttitudeBlock(_Block):
    camera_from_j2000_wxyz: Quaternion
    sigma_rad: Vector | None = None
    rate_rad_s: Vector | None = None


class _SpacecraftBlock(_Block):
    position_km_ssb: Vector | None = None
    velocity_kms_ssb: Vector | None = None


class _SidecarBody(_Block):
    name: str = Field(min_length=1)
    naif_id: int | None = None
    position_km: Place
    radii_km: Place | None = None
    shape: str | None = Field(None, pattern=r"^[^\x00]+$")
    body_from_j2000_wxyz: Quaternion
    sun_direction_j2000: Vector
    photometry: Photometry | None = None
    photometry_parameter: float | None = Field(None, ge=0, le=2)
    shape_sigma_km: float | None = Field(None, ge=0)
    shape_correlation_deg: float | None = Field(None, gt=0, le=180)
    haze_km: float | None = Field(None, ge=0)


class _SidecarMode(_Block):
    m: int
    amplitude_km: float
    longitude_deg: float = 0.0


class _SidecarFeature(_Block):
    name: str = Field(min_length=1)
    kind: RingKind
    a_km: float = Field(gt=0, le=1e9)
    ae_km: float = Field(0.0, ge=0)
    long_peri_deg: float = 0.0
    width_km: float | None = Field(0.0, ge=0, le=1e9)
    tau: float | None = Field(None, ge=0)
    sigma_a_km: float | None = Field(None, ge=0)
    modes: tuple[_SidecarMode, ...] = ()
    a_sin_i_km: float = Field(0.0, ge=0)
    long_node_deg: float = 0.0


class _SidecarRings(_Block):
    planet: str = Field(min_length=1)
    position_km: Place
    plane_from_j2000_wxyz: Quaternion
    opening_sun_deg: float = Field(ge=-90, le=90)
    sun_direction_j2000: Vector | None = None
    features: tuple[_SidecarFeature, ...] = ()


class Sidecar(_Block):
    """The serialised State, format ``geometry/1``."""

    schema_name: Literal["geometry/1"] = Field(alias="schema")
    image_id: str | None = None
    mission: str = "UNKNOWN"
    camera: str = "UNKNOWN"
    mid_time_utc: str
    exposure_s: float | None = Field(None, ge=0)
    camera_model: _CameraBlock | None = None
    gain_e_per_dn: float | None = Field(None, gt=0)
    bias_dn: float | None = None
    fit_camera_rotation: bool | None = None
    max_rotation_deg: float | None = Field(None, ge=0, le=45)
    search_margin_vu: tuple[float, float] | None = None
    attitude: _AttitudeBlock
    spacecraft: _SpacecraftBlock | None = None
    bodies: tuple[_SidecarBody, ...] | None = None
    rings: _SidecarRings | None = None


def sidecar_image_id(data: bytes) -> str | None:
    """Image id that a sidecar claims, None where it claims none or cannot be read (which the run will report).

    Parameters
    ----------
    data
        The sidecar's bytes.

    Returns
    -------
    str or None
        The id.
    """
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return None
    claimed = content.get("image_id") if isinstance(content, dict) else None
    return claimed if isinstance(claimed, str) and claimed else None


def state_from_sidecar(
    data: bytes,
    image_id: str,
    block: InstrumentBlock | None,
    overrides: Mapping[str, object],
    shape_vu: tuple[int, ...] = (),
    models: BodyModels = NO_MODELS,
) -> State:
    """State of a ``geometry/1`` sidecar.

    Parameters
    ----------
    data
        The sidecar's bytes.
    image_id
        Id under which the image runs.
    block
        Camera to use where the sidecar brings none of its own.
    overrides
        The archive's settings, which win.
    shape_vu
        Of the image, which tells a block's modes apart.
    models
        What catalogues say of bodies, and the reader of shapes; shapes that the sidecar names lie beside it.

    Returns
    -------
    State
        Of this image.

    Raises
    ------
    GeometryError
        If the sidecar is not valid or names no camera.
    """
    try:
        sidecar = Sidecar.model_validate_json(data)
        camera, detector = _sidecar_camera(sidecar, block, shape_vu)
        spacecraft = sidecar.spacecraft or _SpacecraftBlock()
        return plausible(State(
            image_id=image_id, mission=sidecar.mission, camera=sidecar.camera, et=et_of_utc(sidecar.mid_time_utc),
            time_utc=sidecar.mid_time_utc, exposure_s=sidecar.exposure_s, camera_model=camera, detector=detector,
            attitude=_sidecar_attitude(sidecar.attitude),
            spacecraft=Spacecraft(_vector(spacecraft.position_km_ssb), _vector(spacecraft.velocity_kms_ssb)),
            settings=settings_of(block, sidecar, overrides),
            bodies=nearest_first(_body(body, models) for body in sidecar.bodies or ()), rings=_rings(sidecar.rings),
        ))  # fmt: skip
    except ValidationError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"sidecar: {first_problem(error)}") from error
    except ContractError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"sidecar: {error}") from error


def _sidecar_camera(
    sidecar: Sidecar, block: InstrumentBlock | None, shape_vu: tuple[int, ...]
) -> tuple[CameraModel, Detector]:
    own = sidecar.camera_model
    if own is None:
        if block is None:
            raise GeometryError(StatusReason.CAMERA_UNKNOWN, "the sidecar brings no camera and the archive names none")
        modes = list(block.modes.values())
        mode = next((mode for mode in modes if mode.shape_vu == shape_vu), modes[0])
        return mode.camera_model(), mode.detector()
    model = CameraModel(
        own.shape_vu, own.focal_length_mm, np.array(own.k_px_per_mm), np.array(own.principal_point_vu),
        np.array(own.distortion_eps),
    )  # fmt: skip
    detector = Detector(
        psf_sigma_px=own.psf_sigma_px, model_residual_px=own.model_residual_px, read_noise_dn=own.read_noise_dn,
        gain_e_per_dn=sidecar.gain_e_per_dn or own.gain_e_per_dn, bias_dn=sidecar.bias_dn or own.bias_dn or 0.0,
        saturation_dn=own.saturation_dn, missing_value=own.missing_value, star_dn_per_s_mag0=own.star_dn_per_s_mag0,
    )  # fmt: skip
    return model, detector


def _sidecar_attitude(block: _AttitudeBlock) -> Attitude:
    rotation = _rotation(block.camera_from_j2000_wxyz, "attitude quaternion")
    return Attitude(rotation, _vector(block.sigma_rad), _vector(block.rate_rad_s))


def _rotation(wxyz: Quaternion, name: str) -> FloatArray:
    with np.errstate(all="ignore"):
        length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) <= _LENGTH_TOLERANCE:
        raise ContractError(f"{name} has length {length:.6f}")
    return matrix_from_quaternion(np.array(wxyz))


def _body(said: _SidecarBody, models: BodyModels) -> Body:
    """What the sidecar says, and the catalogue's word where it is silent."""
    sun = np.array(said.sun_direction_j2000)
    with np.errstate(all="ignore"):
        length = float(np.linalg.norm(sun))
    if not abs(length - 1.0) <= _LENGTH_TOLERANCE:
        raise ContractError(f"{said.name}: sun_direction_j2000 has length {length:.6f}")
    names = BodyBlock.model_fields.keys() & type(said).model_fields.keys() - {"shape"}
    own = {name: getattr(said, name) for name in names if getattr(said, name) is not None}
    block = models.block_of(said.name).model_copy(update=own)
    return block.body(
        said.name, np.array(said.position_km), _rotation(said.body_from_j2000_wxyz, f"{said.name}: quaternion"),
        sun / length, *_figure(said, block, models),
    )  # fmt: skip


def _figure(said: _SidecarBody, block: BodyBlock, models: BodyModels) -> tuple[FloatArray | None, TriangleMesh | None]:
    """Radii and mesh: the sidecar's file, its ellipsoid, or the catalogue's file, in this order."""
    if said.shape is not None and said.shape != ELLIPSOID:
        return None, models.mesh_beside_sidecar(said.shape)
    if said.radii_km is not None:
        return np.array(said.radii_km), None
    mesh = models.mesh_of(block)
    if mesh is None:
        raise ContractError(f"{said.name}: neither radii_km nor a shape file")
    return None, mesh


def _rings(said: _SidecarRings | None) -> RingSystem | None:
    """Rings at the image's time, as the sidecar has them."""
    if said is None:
        return None
    features = tuple(
        RingBlock.model_validate({**entry.model_dump(), "width_km": entry.width_km or 0.0}).feature(0.0)
        for entry in said.features
    )
    return RingSystem(
        said.planet, np.array(said.position_km), _rotation(said.plane_from_j2000_wxyz, "rings: quaternion"),
        float(np.radians(said.opening_sun_deg)), _vector(said.sun_direction_j2000), features,
    )  # fmt: skip


def _vector(values: Vector | None) -> FloatArray | None:
    return None if values is None else np.array(values)
