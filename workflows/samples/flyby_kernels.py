"""The SPICE kernels of the flyby sample: time, clocks, frames, cameras, bodies, ephemerides and a-priori attitudes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from textwrap import dedent

import numpy as np
import spiceypy

from workflows.samples.attitude import wxyz_from_matrix
from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_cameras import SPACECRAFT, FlybyCamera, Spacecraft, flyby_cameras
from workflows.samples.flyby_plan import Shot, planet_relative
from workflows.samples.flyby_system import (
    BODIES,
    SUN_ID,
    SUN_RADIUS_KM,
    SampleBody,
    moon_state,
    planet_state,
    sun_state,
)
from workflows.samples.flyby_time import (
    LEAP_SECONDS,
    MEAN_ANOMALY,
    ORBIT_ECCENTRICITY,
    TDB_AMPLITUDE_S,
    TT_MINUS_TAI_S,
    Clock,
)

META_KERNEL = "meta.tm"
BARYCENTRE_ID = 0
COVER_S = 86_400.0
"""Ephemerides begin and end this long before and after a spacecraft's frames: light takes hours."""
PASS_S = 600.0
"""The spacecraft's path is known this long before and after each exposure."""
POINTING_S = 60.0
"""Its attitude is known this long before and after."""
NODES_PER_ORBIT = 160
"""States that the ephemeris holds per revolution: Hermite's seventh degree is then good to 1e-12."""
SLOW_STEP_S = 43_200.0
HERMITE_DEGREE = 7
LINE_DEGREE = 3
MILLION = 1_000_000
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")

State = Callable[[float], tuple[FloatArray, FloatArray]]


def _number(value: float) -> str:
    """Return a number that reads back to the last bit."""
    return repr(float(value))


def _text_kernel(kind: str, comment: str, *assignments: str) -> str:
    """Return the text of a kernel with one comment and one block of data."""
    data = "\n".join(f"   {line}" for entry in assignments for line in dedent(entry).strip().splitlines())
    return f"KPL/{kind}\n\n{comment}\n\n\\begindata\n\n{data}\n\n\\begintext\n"


def leap_seconds_kernel() -> str:
    """Return the text of the kernel of leap seconds."""
    steps = [f"{seconds}, @{year}-{_MONTHS[month - 1]}-1" for seconds, year, month in LEAP_SECONDS]
    return _text_kernel(
        "LSK",
        "Leap seconds of the sample, as announced by the IERS.",
        f"DELTET/DELTA_T_A = {TT_MINUS_TAI_S}",
        f"DELTET/K = {_number(TDB_AMPLITUDE_S)}",
        f"DELTET/EB = {_number(ORBIT_ECCENTRICITY)}",
        f"DELTET/M = ( {_number(MEAN_ANOMALY[0])}, {_number(MEAN_ANOMALY[1])} )",
        "DELTET/DELTA_AT = ( " + "\n                    ".join(steps) + " )",
    )


def clock_kernel(clock: Clock) -> str:
    """Return the text of a spacecraft clock's kernel: type 1, one partition, an even rate in TDB."""
    n = -clock.spacecraft_id
    return _text_kernel(
        "SCLK",
        f"Clock of spacecraft {clock.spacecraft_id}, as even as no real one is.",
        "SCLK_KERNEL_ID = ( @2000-JAN-1 )",
        f"SCLK_DATA_TYPE_{n} = ( 1 )",
        f"SCLK01_TIME_SYSTEM_{n} = ( 1 )",
        f"SCLK01_N_FIELDS_{n} = ( {len(clock.moduli)} )",
        f"SCLK01_MODULI_{n} = ( {' '.join(map(str, clock.moduli))} )",
        f"SCLK01_OFFSETS_{n} = ( {' '.join(map(str, clock.offsets))} )",
        f"SCLK01_OUTPUT_DELIM_{n} = ( 2 )",
        f"SCLK_PARTITION_START_{n} = ( 0 )",
        f"SCLK_PARTITION_END_{n} = ( {clock.moduli[0] * clock.ticks_per_count - 1} )",
        f"SCLK01_COEFFICIENTS_{n} = ( 0 {_number(clock.zero_et)} {_number(clock.seconds_per_count)} )",
    )


def _frame(name: str, number: int, kind: int, class_id: int, centre: int) -> str:
    """Return the keywords of a frame."""
    return f"""
        FRAME_{name} = {number}
        FRAME_{number}_NAME = '{name}'
        FRAME_{number}_CLASS = {kind}
        FRAME_{number}_CLASS_ID = {class_id}
        FRAME_{number}_CENTER = {centre}
        """


def _fixed(number: int, relative: str, frame_from_relative: FloatArray) -> str:
    """Return the keywords that tie a frame to another; SPICE keeps the matrix to the other frame, column by column."""
    rows = "\n   ".join(" ".join(_number(x) for x in row) for row in frame_from_relative)
    head = f"TKFRAME_{number}_RELATIVE = '{relative}'\nTKFRAME_{number}_SPEC = 'MATRIX'"
    return f"{head}\nTKFRAME_{number}_MATRIX = (\n   {rows} )"


def _mountings() -> list[tuple[str, int, FlybyCamera, FloatArray]]:
    """Return every camera frame once: name, id, a camera that uses it, and its rotation from the platform.

    LORRI's frame has a name for each of its formats in mission kernels, all of the same orientation.
    """
    cameras = {camera.frame: camera for camera in flyby_cameras().values()}
    found = [(c.frame, c.frame_id, c, c.instrument_from_platform) for c in cameras.values()]
    lorri = cameras["NH_LORRI"]
    return [*found, ("NH_LORRI_1X1", -98302, lorri, lorri.instrument_from_platform)]


def frames_kernel(bodies: Sequence[SampleBody] = BODIES) -> str:
    """Return the text of the frames: platforms that C-kernels turn, cameras fixed in them, axes of the bodies."""
    entries: list[str] = []
    for craft in SPACECRAFT:
        entries.append(_frame(craft.platform, craft.platform_id, 3, craft.platform_id, craft.naif_id))
        entries.append(f"CK_{craft.platform_id}_SCLK = {craft.naif_id}\nCK_{craft.platform_id}_SPK = {craft.naif_id}")
    for name, number, camera, rotation in _mountings():
        entries.append(_frame(name, number, 4, number, camera.spacecraft.naif_id))
        entries.append(_fixed(number, camera.spacecraft.platform, rotation))
    for body in bodies:
        name = f"IAU_{body.name}"
        entries.append(_frame(name, MILLION + body.naif_id, 2, body.naif_id, body.naif_id))
        entries.append(f"OBJECT_{body.naif_id}_FRAME = '{name}'")
    return _text_kernel("FK", "Frames of the sample.", *entries)


def camera_kernel() -> str:
    """Return the text of the instrument kernel: optics of every camera frame, unbinned."""
    entries: list[str] = []
    full = {c.frame: c for c in flyby_cameras().values() if c.summation == 1}
    for name, number, camera, _ in _mountings():
        optics = full[camera.frame].optics
        boresight = camera.camera_from_instrument.T @ np.array([0.0, 0.0, 1.0])
        half = [float(np.degrees(np.arctan(n * optics.rad_per_px / 2.0))) for n in optics.shape_vu]
        across = camera.camera_from_instrument.T @ np.array([1.0, 0.0, 0.0])
        entries.append(f"""
            INS{number}_FOV_FRAME = '{name}'
            INS{number}_FOV_SHAPE = 'RECTANGLE'
            INS{number}_BORESIGHT = ( {" ".join(_number(x) for x in boresight)} )
            INS{number}_FOV_CLASS_SPEC = 'ANGLES'
            INS{number}_FOV_REF_VECTOR = ( {" ".join(_number(x) for x in across)} )
            INS{number}_FOV_REF_ANGLE = ( {_number(half[1])} )
            INS{number}_FOV_CROSS_ANGLE = ( {_number(half[0])} )
            INS{number}_FOV_ANGLE_UNITS = 'DEGREES'
            INS{number}_FOCAL_LENGTH = ( {_number(optics.focal_length_mm)} )
            INS{number}_PIXEL_SAMPLES = ( {optics.shape_vu[1]} )
            INS{number}_PIXEL_LINES = ( {optics.shape_vu[0]} )
            INS{number}_PIXEL_SIZE = ( {_number(1000.0 * optics.focal_length_mm * optics.rad_per_px)} )
            """)
    return _text_kernel("IK", "Cameras of the sample; pixel sizes in micrometres.", *entries)


def bodies_kernel(bodies: Sequence[SampleBody] = BODIES) -> str:
    """Return the text of the bodies' names, sizes and rotations."""
    names = "\n".join(f"NAIF_BODY_NAME += ( '{b.name}' )\nNAIF_BODY_CODE += ( {b.naif_id} )" for b in bodies)
    entries = [names, f"BODY{SUN_ID}_RADII = ( {SUN_RADIUS_KM} {SUN_RADIUS_KM} {SUN_RADIUS_KM} )"]
    for body in bodies:
        n = body.naif_id
        entries.append(f"""
            BODY{n}_RADII = ( {" ".join(_number(x) for x in body.radii_km)} )
            BODY{n}_POLE_RA = ( {_number(body.pole_deg[0])} 0 0 )
            BODY{n}_POLE_DEC = ( {_number(body.pole_deg[1])} 0 0 )
            BODY{n}_PM = ( {_number(body.prime_deg)} {_number(body.spin_deg_day)} 0 )
            """)
    return _text_kernel(
        "PCK", "Bodies of the sample: names, radii in km, poles and prime meridians in degrees.", *entries
    )


def meta_kernel(names: list[str]) -> str:
    """Return the text of the meta-kernel; its paths are relative to its own folder."""
    listed = "\n                      ".join(f"'$HERE/{name}'" for name in names)
    return _text_kernel(
        "MK",
        "All kernels of the sample, to be loaded from this file's own folder.",
        "PATH_VALUES = ( '.' )",
        "PATH_SYMBOLS = ( 'HERE' )",
        f"KERNELS_TO_LOAD = ( {listed} )",
    )


@contextmanager
def _open_spk(path: Path) -> Iterator[int]:
    """Open a new ephemeris file and close it, complete, at the end."""
    handle = spiceypy.spkopn(str(path), "PILOTAGE SAMPLE", 0)
    try:
        yield handle
    finally:
        spiceypy.spkcls(handle)


def _write_orbit(handle: int, body: int, centre: int, state: State, span: tuple[float, float], step_s: float) -> None:
    """Write a body's path as states from which Hermite's polynomials run."""
    count = max(HERMITE_DEGREE + 1, int(np.ceil((span[1] - span[0]) / step_s)) + 1)
    epochs = np.linspace(span[0], span[1], count)
    states = np.array([np.concatenate(state(float(et))) for et in epochs])
    spiceypy.spkw13(
        handle, body, centre, "J2000", float(epochs[0]), float(epochs[-1]), f"BODY {body}", HERMITE_DEGREE, count,
        states, epochs,
    )  # fmt: skip


def bodies_of(shots: Sequence[Shot]) -> list[SampleBody]:
    """Return the bodies that some frames know, planets before their moons."""
    return list(dict.fromkeys(body for shot in shots for body in shot.bodies))


def _span(shots: list[Shot]) -> tuple[float, float]:
    times = [shot.et for shot in shots]
    return min(times) - COVER_S, max(times) + COVER_S


def write_bodies_spk(path: Path, groups: list[list[Shot]]) -> None:
    """Write Sun, planets and moons around the frames of each spacecraft (groups)."""
    with _open_spk(path) as handle:
        for shots in groups:
            span = _span(shots)
            _write_orbit(handle, SUN_ID, BARYCENTRE_ID, sun_state, span, SLOW_STEP_S)
            for body in bodies_of(shots):
                planet = body.system.planet_id
                if body.naif_id == planet:
                    _write_orbit(
                        handle, planet, BARYCENTRE_ID, partial(planet_state, system=body.system), span, SLOW_STEP_S
                    )
                    continue
                step = 2.0 * np.pi / body.motion_rad_s / NODES_PER_ORBIT
                _write_orbit(handle, body.naif_id, planet, partial(moon_state, body), span, step)


def write_spacecraft_spk(path: Path, craft: Spacecraft, shots: list[Shot]) -> None:
    """Write a spacecraft's straight passes by the planet."""
    with _open_spk(path) as handle:
        for shot in shots:
            place, velocity = planet_relative(shot)
            epochs = shot.et + np.array([-PASS_S, 0.0, PASS_S])
            states = np.array([np.concatenate([place + velocity * (t - shot.et), velocity]) for t in epochs])
            spiceypy.spkw13(
                handle, craft.naif_id, shot.bodies[0].naif_id, "J2000", float(epochs[0]), float(epochs[-1]),
                shot.image_id, LINE_DEGREE, len(epochs), states, epochs,
            )  # fmt: skip


def platform_from_j2000(shot: Shot, camera_from_j2000: FloatArray) -> FloatArray:
    """Return the platform's attitude (3, 3) that a camera's attitude means."""
    camera = shot.camera
    turned: FloatArray = (camera.camera_from_instrument @ camera.instrument_from_platform).T @ camera_from_j2000
    return turned


def write_attitudes(path: Path, craft: Spacecraft, shots: list[Shot]) -> None:
    """Write the a-priori attitude of a spacecraft's platform, constant about each exposure."""
    shots = sorted(shots, key=lambda shot: shot.et)
    clock = craft.clock
    ticks = np.array([clock.ticks(shot.et + s) for shot in shots for s in (-POINTING_S, 0.0, POINTING_S)])
    attitudes = np.array([wxyz_from_matrix(platform_from_j2000(shot, shot.apriori)) for shot in shots])
    handle = spiceypy.ckopn(str(path), "PILOTAGE SAMPLE", 0)
    try:
        spiceypy.ckw03(
            handle, float(ticks[0]), float(ticks[-1]), craft.platform_id, "J2000", True, "A-PRIORI ATTITUDE",
            len(ticks), ticks, np.repeat(attitudes, 3, axis=0), np.zeros((len(ticks), 3)), len(shots),
            ticks[::3].copy(),
        )  # fmt: skip
    finally:
        spiceypy.ckcls(handle)


def write_kernels(folder: Path, shots: list[Shot]) -> None:
    """Write all kernels of some frames and their meta-kernel into a folder.

    Parameters
    ----------
    folder
        Where; it must exist.
    shots
        Every frame of the archive.
    """
    bodies = bodies_of(shots)
    texts = {"sample.tls": leap_seconds_kernel(), "sample.tf": frames_kernel(bodies), "sample.ti": camera_kernel()}
    texts["sample.tpc"] = bodies_kernel(bodies)
    texts |= {f"{craft.short}.tsc": clock_kernel(craft.clock) for craft in SPACECRAFT}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii")
    flown = [(craft, [shot for shot in shots if shot.camera.spacecraft == craft]) for craft in SPACECRAFT]
    flown = [(craft, own) for craft, own in flown if own]
    write_bodies_spk(folder / "bodies.bsp", [own for _, own in flown])
    binaries = ["bodies.bsp"]
    for craft, own in flown:
        write_spacecraft_spk(folder / f"{craft.short}.bsp", craft, own)
        write_attitudes(folder / f"{craft.short}_apriori.bc", craft, own)
        binaries += [f"{craft.short}.bsp", f"{craft.short}_apriori.bc"]
    (folder / META_KERNEL).write_text(meta_kernel([*texts, *binaries]), encoding="ascii")
