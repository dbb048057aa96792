"""Provider ``spice``: a State from kernels that are loaded in this process (CSPICE is not thread-safe)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import spiceypy
from pydantic import ValidationError
from spiceypy.utils.exceptions import NotFoundError, SpiceyError

from catalogs.bodies import BodyModels, nearest_first
from catalogs.geometry import first_problem, plausible, settings_of
from catalogs.instruments import InstrumentBlock, SpiceNames
from catalogs.kernels import Kernel, load, reason_of
from catalogs.ring_catalog import RingCatalog, rings_of
from pipeline.camera import field_of_view
from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.astrometry import SPEED_OF_LIGHT_KM_S
from pipeline.geometry.rotations import rotation_about
from pipeline.predict.body_view import may_shade
from pipeline.predict.stars import reach_px
from pipeline.records import Attitude, Body, FloatArray, RingSystem, Spacecraft, State
from pipeline.status import StatusReason

# Converged light time and stellar aberration: what the camera saw (NAIF's required reading on SPK).
CORRECTION = "CN+S"
_J2000 = "J2000"
_SUN = 10
# Codes up to here are barycentres and the Sun; spacecraft and structures are negative.
_LAST_BARYCENTRE = 10
# Frame classes of C-kernels and of constant offsets (NAIF's required reading on frames).
CK_CLASS, TK_CLASS = 3, 4
_LONGEST_CHAIN = 20
# Share of its largest radius to which a body with a shape file may reach.
_MESH_REACH = 2.0
# Scale heights by which a haze reaches beyond the ellipsoid and may still be seen.
_HAZE_REACH = 10.0
# An instrument kernel that differs by more than this from the camera's block means another camera or unit.
_FOCAL_LENGTH_TOLERANCE = 0.01


class Exposed(Protocol):
    """What a label must tell."""

    @property
    def mid_utc(self) -> str | None:
        """Middle of the exposure, ISO-8601 UTC."""

    @property
    def exposure_s(self) -> float | None:
        """Exposure."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A body of which the kernels know the size and, at some time, the place.

    Attributes
    ----------
    naif_id, name
        Identity.
    radii_km
        (3,) semi-axes.
    frame
        Body-fixed frame, None where only rotation constants are known.
    """

    naif_id: int
    name: str
    radii_km: FloatArray
    frame: str | None


def load_bodies(kernels: Sequence[Kernel]) -> tuple[Candidate, ...]:
    """Load kernels into this process and list the bodies that they know.

    Parameters
    ----------
    kernels
        Of the archive, checked.

    Returns
    -------
    tuple of Candidate
        By NAIF code.

    Raises
    ------
    ConfigurationError
        If CSPICE refuses a kernel.
    """
    load(kernels)
    codes: set[int] = set()
    for kernel in kernels:
        if not kernel.is_meta and spiceypy.getfat(kernel.path) == ("DAF", "SPK"):
            codes |= set(spiceypy.spkobj(kernel.path))
    found = (_candidate(code) for code in sorted(codes) if code > _LAST_BARYCENTRE)
    return tuple(candidate for candidate in found if candidate is not None)


def _candidate(code: int) -> Candidate | None:
    """Body of a code, None without usable radii."""
    if not spiceypy.bodfnd(code, "RADII"):
        return None
    try:
        radii = np.array(spiceypy.gdpool(f"BODY{code}_RADII", 0, 4), dtype=float)
    except (NotFoundError, SpiceyError):
        return None
    if radii.shape != (3,) or not (np.isfinite(radii).all() and (radii > 0).all()):
        return None
    return Candidate(code, _found(lambda: spiceypy.bodc2n(code)) or str(code), radii, _frame_of(code))


def _frame_of(code: int) -> str | None:
    frame = _found(lambda: spiceypy.cidfrm(code)[1])
    return frame or None


def _found(ask: Callable[[], str]) -> str:
    """Answer of CSPICE, empty where it knows none."""
    try:
        return str(ask()).strip()
    except NotFoundError:
        return ""


def focal_length_notes(blocks: Mapping[str, InstrumentBlock]) -> list[str]:
    """What loaded instrument kernels say otherwise than the camera blocks, which are used nevertheless.

    Parameters
    ----------
    blocks
        Configured cameras.

    Returns
    -------
    list of str
        One line per camera whose focal lengths differ by more than a hundredth.
    """
    notes = []
    for name, block in blocks.items():
        variable = f"INS{block.spice.instrument_id}_FOCAL_LENGTH" if block.spice else ""
        if not variable:
            continue
        try:
            said = float(spiceypy.gdpool(variable, 0, 1)[0])
        except (NotFoundError, SpiceyError):
            continue
        used = next(iter(block.modes.values())).focal_length_mm
        if not abs(said / used - 1.0) <= _FOCAL_LENGTH_TOLERANCE:
            notes.append(f"{name}: focal length {used:g} mm is used, the instrument kernel says {said:g}")
    return notes


def state_from_spice(
    label: Exposed, image_id: str, camera: tuple[InstrumentBlock, str | None], overrides: Mapping[str, object],
    known: Sequence[Candidate], models: BodyModels, rings: Sequence[RingCatalog] = (),
) -> State:  # fmt: skip
    """State of one image from the loaded kernels.

    Parameters
    ----------
    label
        Time and exposure.
    image_id
        Id under which the image runs.
    camera
        Block, and the name of its mode, None where the image has none.
    overrides
        The archive's settings, which win.
    known
        Bodies of the loaded kernels.
    models
        What catalogues say of bodies.
    rings
        Ring catalogues; of one planet the last wins.

    Returns
    -------
    State
        With every body whose disc can come into the field.

    Raises
    ------
    GeometryError
        If the kernels do not cover the image, or the camera is not known to SPICE.
    """
    block, mode_name = camera
    mode = block.modes.get(mode_name or "")
    name = f"{block.mission} {block.camera}"
    if block.spice is None:
        raise GeometryError(StatusReason.CAMERA_UNKNOWN, f"camera {name} has no SPICE names in its block")
    if mode is None:
        raise GeometryError(StatusReason.CAMERA_UNKNOWN, f"camera {name} has no mode for an image like this")
    if label.mid_utc is None:
        raise GeometryError(StatusReason.GEOMETRY_MISSING, "the label gives no time")
    try:
        et = _et(label.mid_utc)
        state = State(
            image_id=image_id, mission=block.mission, camera=block.camera, et=et, time_utc=label.mid_utc,
            exposure_s=label.exposure_s, camera_model=mode.camera_model(), detector=mode.detector(),
            attitude=_attitude(block.spice, et, label), spacecraft=_spacecraft(block.spice, et, label.mid_utc),
            settings=settings_of(block, mode, overrides),
        )  # fmt: skip
        bodies = list(_bodies_in_field(state, block.spice, known, models))
        system, planet = _rings_in_field(state, block.spice, known, rings)
        if planet is not None and all(body.name != planet.name for body in bodies):
            # A planet beside the field still hides its rings and throws its shadow on them.
            bodies += [body for body in [_seen(planet, state, block.spice, models)] if body is not None]
        return plausible(replace(state, bodies=nearest_first(bodies), rings=system))
    except ValidationError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"settings: {first_problem(error)}") from error
    except ContractError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"kernels: {error}") from error
    except SpiceyError as error:
        raise _unavailable(f"at {label.mid_utc}", error) from error


def _unavailable(what: str, error: SpiceyError) -> GeometryError:
    return GeometryError(StatusReason.KERNELS_UNAVAILABLE, f"kernels: {what}: {reason_of(error)}")


def _et(utc: str) -> float:
    try:
        return float(spiceypy.str2et(utc.removesuffix("Z")))
    except SpiceyError as error:
        raise GeometryError(StatusReason.GEOMETRY_INVALID, f"label: {utc!r} is no time: {reason_of(error)}") from error


def _attitude(names: SpiceNames, et: float, label: Exposed) -> Attitude:
    """Attitude of the camera at mid-exposure, with its angular rate where the kernels tell it."""
    try:
        instrument_from_j2000 = instrument_attitude(names, et)
    except SpiceyError as error:
        raise _unavailable(f"no pointing of {names.frame} at {label.mid_utc}", error) from error
    camera_from_j2000 = names.rotation() @ instrument_from_j2000
    try:
        # Angular velocity of the instrument's frame with respect to J2000, in J2000 axes.
        _, rate = spiceypy.xf2rav(spiceypy.sxform(_J2000, names.frame, et))
    except SpiceyError:
        return Attitude(camera_from_j2000)
    return Attitude(camera_from_j2000, None, camera_from_j2000 @ np.array(rate))


def instrument_attitude(names: SpiceNames, et: float) -> FloatArray:
    """Rotation from J2000 to the instrument's frame.

    C-kernels of discrete pointings (type 1, as of Voyager) hold none at the very time; there the nearest one within the
    block's tolerance is taken.

    Parameters
    ----------
    names
        The camera.
    et
        TDB seconds past J2000.

    Returns
    -------
    numpy.ndarray
        (3, 3).

    Raises
    ------
    spiceypy.utils.exceptions.SpiceyError
        If the kernels give no pointing.
    """
    try:
        return np.array(spiceypy.pxform(_J2000, names.frame, et))
    except SpiceyError:
        if names.ck_tolerance_s == 0.0:
            raise
    structure, instrument_from_structure = structure_of(names.frame, et)
    clock = int(spiceypy.ckmeta(structure, "SCLK"))
    ticks = [float(spiceypy.sce2c(clock, t)) for t in (et, et + names.ck_tolerance_s)]
    pointing, _ = spiceypy.ckgp(structure, ticks[0], ticks[1] - ticks[0], _J2000)
    return np.asarray(instrument_from_structure @ np.array(pointing))


def structure_of(frame: str, et: float) -> tuple[int, FloatArray]:
    """Structure whose C-kernel turns a frame, down its chain of constant offsets.

    Parameters
    ----------
    frame
        Name.
    et
        TDB seconds past J2000; offsets do not depend on it.

    Returns
    -------
    tuple
        Code of the structure in C-kernels; (3, 3) rotation from it to the frame.

    Raises
    ------
    GeometryError
        If the chain ends in no structure.
    """
    name = frame
    for _ in range(_LONGEST_CHAIN):
        code = spiceypy.namfrm(name)
        if code == 0:
            break
        _, kind, class_id = spiceypy.frinfo(code)
        if kind == CK_CLASS:
            return int(class_id), np.array(spiceypy.pxform(name, frame, et))
        if kind != TK_CLASS:
            break
        name = _relative_of(code, name)
    raise GeometryError(StatusReason.KERNELS_UNAVAILABLE, f"kernels: {frame} hangs on no frame of a C-kernel")


def _relative_of(code: int, name: str) -> str:
    """Frame to which a constant-offset frame is relative; keywords may hold its code or its name."""
    for key in (str(code), name):
        relative = _found(lambda key=key: spiceypy.gcpool(f"TKFRAME_{key}_RELATIVE", 0, 1)[0])  # type: ignore[misc]
        if relative:
            return relative
    return ""


def _spacecraft(names: SpiceNames, et: float, utc: str) -> Spacecraft:
    try:
        state = np.array(spiceypy.spkssb(names.spacecraft_id, et, _J2000))
    except SpiceyError as error:
        raise _unavailable(f"no ephemeris of spacecraft {names.spacecraft_id} at {utc}", error) from error
    return Spacecraft(state[:3], state[3:])


def _bodies_in_field(
    state: State, names: SpiceNames, known: Sequence[Candidate], models: BodyModels
) -> Iterator[Body]:
    """Bodies whose disc reaches into the field widened by the search margin, and those that may shade one of them."""
    axis, half = field_of_view(state.camera_model, reach_px(state))
    direction = state.attitude.camera_from_j2000.T @ axis
    bodies = [body for candidate in known if (body := _seen(candidate, state, names, models)) is not None]
    inside = [body for body in bodies if _reaches(body, direction, half)]
    for body in bodies:
        if any(body is other for other in inside) or any(may_shade(body, other) for other in inside):
            yield body


def _seen(candidate: Candidate, state: State, names: SpiceNames, models: BodyModels) -> Body | None:
    """Body as the spacecraft sees it, None where the kernels do not cover it then: those of moons often cover less."""
    try:
        place, light_time = spiceypy.spkezp(candidate.naif_id, state.et, _J2000, CORRECTION, names.spacecraft_id)
    except SpiceyError:
        return None
    orientation = _orientation(candidate, state.et - light_time)
    if orientation is None:
        return None
    block = models.block_of(candidate.name).model_copy(update={"naif_id": candidate.naif_id})
    sun = _direction_to_sun(candidate.naif_id, state.et - light_time)
    return block.body(candidate.name, np.array(place), orientation, sun, candidate.radii_km, models.mesh_of(block))


def _rings_in_field(
    state: State, names: SpiceNames, known: Sequence[Candidate], catalogs: Sequence[RingCatalog]
) -> tuple[RingSystem | None, Candidate | None]:
    """Rings, and their planet, of the nearest planet whose outermost ring reaches into the field."""
    axis, half = field_of_view(state.camera_model, reach_px(state))
    direction = state.attitude.camera_from_j2000.T @ axis
    found: list[tuple[float, RingSystem, Candidate]] = []
    for candidate in known:
        catalog = rings_of(catalogs, candidate.name)
        system = None if catalog is None else _ring_system(candidate, catalog, state, names, direction)
        if system is None:
            continue
        distance = float(np.linalg.norm(system.position_km))
        size = max(f.a_km + f.ae_km + f.width_km for f in system.features)
        reaches = distance <= size or (
            _separation(direction, system.position_km) <= half + float(np.arcsin(size / distance))
        )
        if reaches:
            found.append((distance, system, candidate))
    if not found:
        return None, None
    _, system, candidate = min(found, key=lambda entry: entry[0])
    return system, candidate


def _ring_system(
    candidate: Candidate, catalog: RingCatalog, state: State, names: SpiceNames, boresight: FloatArray
) -> RingSystem | None:
    """Rings as seen: plane of the planet's equator, longitudes from its ascending node on the J2000 equator.

    Light time and aberration differ between the planet and rings far from it. In the planet's frame of rest a point at
    X is seen along ``X - v |X| / c`` with v the planet's velocity past the spacecraft. Near a ring point at X0, in the
    direction s, that is a shift by that of X0 and a turn by ``(v x s) / c`` about it, which moves what lies deeper
    aside; what the turn changes along the line of sight is not seen.
    """
    try:
        moving, _ = spiceypy.spkezr(str(candidate.naif_id), state.et, _J2000, "NONE", str(names.spacecraft_id))
    except SpiceyError:
        return None
    position, velocity = np.array(moving[:3]), np.array(moving[3:])
    left = state.et - float(np.linalg.norm(position)) / SPEED_OF_LIGHT_KM_S
    orientation = _orientation(candidate, left)
    if orientation is None:
        return None
    pole = catalog.pole_sign * orientation[2]
    node = np.cross([0.0, 0.0, 1.0], pole)
    length = float(np.linalg.norm(node))
    node = node / length if length > 0 else np.array([1.0, 0.0, 0.0])
    plane = np.stack([node, np.cross(pole, node), pole])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = float((pole @ position) / (pole @ boresight))
    distance = float(np.linalg.norm(position))
    if not 0.0 < reach < 2.0 * distance:
        reach = max(float(boresight @ position), 0.0)
    sun = _direction_to_sun(candidate.naif_id, left)
    middle = reach * boresight
    axis = np.cross(velocity, boresight) / SPEED_OF_LIGHT_KM_S
    angle = float(np.linalg.norm(axis))
    turn = rotation_about(axis, angle) if angle > 0 else np.eye(3)
    seen = middle - velocity * (reach / SPEED_OF_LIGHT_KM_S) + turn @ (position - middle)
    return RingSystem(
        candidate.name, seen, plane @ turn.T,
        float(np.arcsin(np.clip(pole @ sun, -1.0, 1.0))), sun, catalog.at(left),
    )  # fmt: skip


def _reaches(body: Body, direction: FloatArray, half_rad: float) -> bool:
    """Whether a body's disc comes into a cone."""
    reach = _MESH_REACH if body.mesh is not None else 1.0
    size = reach * float(body.radii_km.max()) + _HAZE_REACH * body.haze_km
    distance = float(np.linalg.norm(body.position_km))
    inside = distance <= size
    return inside or _separation(direction, body.position_km) <= half_rad + float(np.arcsin(size / distance))


def _separation(a: FloatArray, b: FloatArray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _orientation(candidate: Candidate, et: float) -> FloatArray | None:
    """body_from_j2000 when the light left; None where a body that is no sphere has none."""
    try:
        if candidate.frame is not None:
            return np.array(spiceypy.pxform(_J2000, candidate.frame, et))
        return np.array(spiceypy.tipbod(_J2000, candidate.naif_id, et))
    except SpiceyError:
        return np.eye(3) if np.ptp(candidate.radii_km) == 0.0 else None


def _direction_to_sun(code: int, et: float) -> FloatArray:
    """Unit vector to where the Sun is seen from a body, as SPICE's illumination routines take it."""
    place, _ = spiceypy.spkezp(_SUN, et, _J2000, CORRECTION, code)
    position = np.array(place)
    return np.asarray(position / np.linalg.norm(position))
