"""Providers of a State: the product's own header, or a ``geometry/1`` sidecar."""

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from astropy.time import Time
from astropy.utils import iers
from erfa import ErfaWarning
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from catalogs.images import CardValue, RawImage
from catalogs.instruments import CameraMode, InstrumentBlock
from pipeline.camera import unproject
from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.astrometry import SPEED_OF_LIGHT_KM_S, julian_year
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.options import InstrumentSettings
from pipeline.records import Attitude, CameraModel, Detector, FloatArray, Spacecraft, State
from pipeline.status import StatusReason

# LORRI's instrument frame looks along -Z (nh_lorri_v201.ti); Pilotage's camera frame looks along +z.
_CAMERA_FROM_LORRI = np.diag([1.0, -1.0, -1.0])
# A header writes this where SPICE had nothing to say.
_LORRI_UNKNOWN = -1.0e31
# Beyond these no figure can be meant: camera in space, inside the heliosphere's surroundings, not tumbling.
_YEARS = (1950.0, 2150.0)
_FARTHEST_KM = 1e12
_FASTEST_TURN_RAD_S = 10.0

Vector = tuple[float, float, float]


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
    camera_from_j2000_wxyz: tuple[float, float, float, float]
    sigma_rad: Vector | None = None
    rate_rad_s: Vector | None = None


class _SpacecraftBlock(_Block):
    position_km_ssb: Vector | None = None
    velocity_kms_ssb: Vector | None = None


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
        return _plausible(State(
            image_id=image_id, mission=sidecar.mission, camera=sidecar.camera, et=et_of_utc(sidecar.mid_time_utc),
            time_utc=sidecar.mid_time_utc, exposure_s=sidecar.exposure_s, camera_model=camera, detector=detector,
            attitude=_sidecar_attitude(sidecar.attitude),
            spacecraft=Spacecraft(_vector(spacecraft.position_km_ssb), _vector(spacecraft.velocity_kms_ssb)),
            settings=_settings(block, sidecar, overrides),
        ))  # fmt: skip
    except ValidationError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"sidecar: {first_problem(error)}") from error
    except ContractError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"sidecar: {error}") from error


def _plausible(state: State) -> State:
    """The state, refused where a figure is out of this world and would only end in overflows."""
    position, velocity, rate = state.spacecraft.position_km, state.spacecraft.velocity_km_s, state.attitude.rate_rad_s
    year = julian_year(state.et)
    rows, columns = state.camera_model.shape_vu
    corners = np.array([[0.0, 0.0], [0.0, columns - 1.0], [rows - 1.0, 0.0], [rows - 1.0, columns - 1.0]])
    with np.errstate(all="ignore"):
        problem = next((text for text, wrong in (
            (f"year {year:.6g} lies outside {_YEARS[0]:.0f} to {_YEARS[1]:.0f}", not _YEARS[0] < year < _YEARS[1]),
            (f"spacecraft farther than {_FARTHEST_KM:g} km", _exceeds(position, _FARTHEST_KM)),
            ("spacecraft as fast as light", _exceeds(velocity, 0.1 * SPEED_OF_LIGHT_KM_S)),
            (f"camera turns faster than {_FASTEST_TURN_RAD_S:g} rad/s", _exceeds(rate, _FASTEST_TURN_RAD_S)),
            ("camera model cannot be inverted over its array", not unproject(state.camera_model, corners)[1].all()),
        ) if wrong), None)  # fmt: skip
    if problem is not None:
        raise ContractError(problem)
    return state


def _exceeds(vector: FloatArray | None, limit: float) -> bool:
    return vector is not None and not bool(np.abs(vector).max() < limit)


def first_problem(error: ValidationError) -> str:
    """One line for the first of a validation's complaints.

    Parameters
    ----------
    error
        Pydantic's error.

    Returns
    -------
    str
        ``key: what is wrong``.
    """
    # Of alternatives the one that got furthest is the one that was meant.
    problem = max(error.errors(include_url=False), key=lambda problem: len(problem["loc"]))
    where = ".".join(str(part) for part in problem["loc"] if not _is_alternative(part)) or "document"
    return f"{where}: {problem['msg']}"


def _is_alternative(part: int | str) -> bool:
    """Whether a step of a problem's place is pydantic's name for one of several types."""
    return isinstance(part, str) and (part in ("str", "StarTableRef") or "[" in part)


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
    quaternion = np.array(block.camera_from_j2000_wxyz)
    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-3:
        raise ContractError(f"attitude quaternion has length {np.linalg.norm(quaternion):.6f}")
    return Attitude(matrix_from_quaternion(quaternion), _vector(block.sigma_rad), _vector(block.rate_rad_s))


def _vector(values: Vector | None) -> FloatArray | None:
    return None if values is None else np.array(values)


def _settings(
    block: InstrumentBlock | None, source: Sidecar | CameraMode | None, overrides: Mapping[str, object]
) -> InstrumentSettings:
    """Instrument's settings, then those of the sidecar or mode, then the archive's."""
    names = InstrumentSettings.model_fields
    values: dict[str, object] = {name: getattr(block, name) for name in names} if block else {}
    for name in names:
        own = getattr(source, name, None)
        if own is not None:
            values[name] = own
    return InstrumentSettings.model_validate({**values, **overrides})


def et_of_utc(text: str) -> float:
    """TDB seconds past J2000 of a UTC time.

    Parameters
    ----------
    text
        ISO-8601.

    Returns
    -------
    float
        Seconds; leap seconds from the table that astropy ships, nothing is downloaded.

    Raises
    ------
    GeometryError
        If the text is no time.
    """
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        # Before 1972 and in the far future UTC is approximate, which no star notices.
        warnings.simplefilter("ignore", ErfaWarning)
        try:
            time = Time(text.removesuffix("Z"), scale="utc")
        except ValueError as error:
            raise GeometryError(StatusReason.GEOMETRY_INVALID, f"{text!r} is not an ISO-8601 time") from error
        tdb = time.tdb
    return float(((tdb.jd1 - 2451545.0) + tdb.jd2) * 86400.0)


def identify(header: Mapping[str, CardValue], blocks: Mapping[str, InstrumentBlock]) -> InstrumentBlock | None:
    """Camera whose identifying cards a header carries.

    Parameters
    ----------
    header
        Cards.
    blocks
        Configured cameras.

    Returns
    -------
    InstrumentBlock or None
        None where no camera claims the header.
    """
    for block in blocks.values():
        cards = block.identify.items()
        if cards and all(str(header.get(key, "")).strip().lower() == value.lower() for key, value in cards):
            return block
    return None


def state_from_header(raw: RawImage, image_id: str, block: InstrumentBlock, overrides: Mapping[str, object]) -> State:
    """State from the pointing cards of the product itself.

    Parameters
    ----------
    raw
        Image with its header.
    image_id
        Id under which the image runs.
    block
        Camera, which says which cards to read.
    overrides
        The archive's settings, which win.

    Returns
    -------
    State
        Of this image.

    Raises
    ------
    GeometryError
        If the camera has no header reader, or a card is missing or unknown.
    """
    if block.header != "lorri":
        raise GeometryError(
            StatusReason.GEOMETRY_MISSING, f"headers of {block.mission} {block.camera} carry no pointing"
        )
    try:
        return _plausible(_state_from_lorri(raw, image_id, block, overrides))
    except ValidationError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"settings: {first_problem(error)}") from error
    except ContractError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"header: {error}") from error


def _state_from_lorri(raw: RawImage, image_id: str, block: InstrumentBlock, overrides: Mapping[str, object]) -> State:
    header = raw.header
    mode = _lorri_mode(header, block)
    quaternion = _numbers(header, "SPCQA", "SPCQX", "SPCQY", "SPCQZ")
    if quaternion is None or abs(np.linalg.norm(quaternion) - 1.0) > 1e-3:
        raise GeometryError(
            StatusReason.GEOMETRY_MISSING, "header has no attitude quaternion (SPCQA, SPCQX, SPCQY, SPCQZ)"
        )
    # SPICE's quaternion maps instrument vectors to J2000.
    attitude = _CAMERA_FROM_LORRI @ matrix_from_quaternion(quaternion).T
    rate = _numbers(header, "RATEX", "RATEY", "RATEZ")
    sun = _numbers(header, "SPCSSCX", "SPCSSCY", "SPCSSCZ")
    sun_rate = _numbers(header, "SPCSSCVX", "SPCSSCVY", "SPCSSCVZ")
    et = _numbers(header, "SPCSCET")
    if et is None:
        raise GeometryError(StatusReason.GEOMETRY_MISSING, "header has no mid-exposure time (SPCSCET)")
    exposure = _numbers(header, "EXPTIME")
    return State(
        image_id=image_id, mission=block.mission, camera=block.camera, et=float(et[0]),
        time_utc=str(header.get("SPCUTCAL", "")), exposure_s=None if exposure is None else float(exposure[0]),
        camera_model=mode.camera_model(), detector=_lorri_detector(header, mode),
        attitude=Attitude(attitude, None, None if rate is None else _CAMERA_FROM_LORRI @ rate * 1e-6),
        spacecraft=Spacecraft(None if sun is None else -sun, None if sun_rate is None else -sun_rate),
        settings=_settings(block, mode, overrides),
    )  # fmt: skip


def _lorri_mode(header: Mapping[str, CardValue], block: InstrumentBlock) -> CameraMode:
    name = str(header.get("SFORMAT", "")).strip().upper()
    if name not in block.modes:
        allowed = ", ".join(block.modes)
        raise GeometryError(StatusReason.CAMERA_UNKNOWN, f"SFORMAT is {name or 'missing'!r}, known modes are {allowed}")
    return block.modes[name]


def _lorri_detector(header: Mapping[str, CardValue], mode: CameraMode) -> Detector:
    """Mode's detector with the calibration figures that the header brings."""
    detector = mode.detector()
    noise, gain, zero = (_numbers(header, key) for key in ("RDNOISE", "CCDGAIN", "PHOTZPT"))
    if noise is not None and noise[0] > 0:
        detector = replace(detector, read_noise_dn=float(noise[0]))
    if gain is not None and gain[0] > 0:
        detector = replace(detector, gain_e_per_dn=float(gain[0]))
    if zero is not None:
        detector = replace(detector, star_dn_per_s_mag0=float(10.0 ** (0.4 * zero[0])))
    return detector


def _numbers(header: Mapping[str, CardValue], *keys: str) -> FloatArray | None:
    """Values of cards, None where any is missing, not a number, or marked unknown."""
    values = [header.get(key) for key in keys]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return None
    array = np.array(values, dtype=float)
    return array if np.isfinite(array).all() and (array > _LORRI_UNKNOWN).all() else None
