"""Provider ``header``: a State from the pointing cards of the product itself."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from catalogs.geometry import first_problem, plausible, settings_of
from catalogs.images import RawImage
from catalogs.instruments import CameraMode, CardValue, InstrumentBlock
from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.records import Attitude, Detector, FloatArray, Spacecraft, State
from pipeline.status import StatusReason

# LORRI's instrument frame looks along -Z (nh_lorri_v201.ti); Pilotage's camera frame looks along +z.
_CAMERA_FROM_LORRI = np.diag([1.0, -1.0, -1.0])
# A header writes this where SPICE had nothing to say.
_LORRI_UNKNOWN = -1.0e31


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
        return plausible(_state_from_lorri(raw, image_id, block, overrides))
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
        settings=settings_of(block, mode, overrides),
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
