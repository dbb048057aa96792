"""A small set of real SPICE kernels: Cassini's narrow-angle camera near a Saturn with moons of made-up orbits."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import spiceypy

from pipeline.records import FloatArray

# Names and codes as in Cassini's frame kernel; the offset of the camera is made up.
SPACECRAFT, STRUCTURE, FRAME = -82, -82000, "CASSINI_ISS_NAC"
START_ET = 300_000_000.0
SPAN_S = 4_000.0
# Pointings and ephemerides stand this far apart.
STEP_S = 20.0
# A body of no built-in frame, and one of no rotation constants.
ROCK, PEBBLE = 2999001, 2999002
CAMERA_ANGLES_DEG = (0.7, -89.5, 12.0)

LSK = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = ( 32, @1999-JAN-1  33, @2006-JAN-1  34, @2009-JAN-1  35, @2012-JUL-1
                    36, @2015-JUL-1  37, @2017-JAN-1 )
\begintext
"""
SCLK = r"""KPL/SCLK
\begindata
SCLK_KERNEL_ID = ( @2009-01-01/00:00:00 )
SCLK_DATA_TYPE_82 = ( 1 )
SCLK01_TIME_SYSTEM_82 = ( 1 )
SCLK01_N_FIELDS_82 = ( 2 )
SCLK01_MODULI_82 = ( 4294967296 256 )
SCLK01_OFFSETS_82 = ( 0 0 )
SCLK01_OUTPUT_DELIM_82 = ( 1 )
SCLK_PARTITION_START_82 = ( 0.0 )
SCLK_PARTITION_END_82 = ( 1.0E+12 )
SCLK01_COEFFICIENTS_82 = ( 0.0  0.0  1.0 )
\begintext
"""
FK = rf"""KPL/FK
\begindata
FRAME_CASSINI_SC_COORD = -82000
FRAME_-82000_NAME = 'CASSINI_SC_COORD'
FRAME_-82000_CLASS = 3
FRAME_-82000_CLASS_ID = -82000
FRAME_-82000_CENTER = -82
CK_-82000_SCLK = -82
CK_-82000_SPK = -82
FRAME_CASSINI_ISS_NAC = -82360
FRAME_-82360_NAME = 'CASSINI_ISS_NAC'
FRAME_-82360_CLASS = 4
FRAME_-82360_CLASS_ID = -82360
FRAME_-82360_CENTER = -82
TKFRAME_-82360_SPEC = 'ANGLES'
TKFRAME_-82360_RELATIVE = 'CASSINI_SC_COORD'
TKFRAME_-82360_ANGLES = ( {" ".join(map(str, CAMERA_ANGLES_DEG))} )
TKFRAME_-82360_AXES = ( 3 2 3 )
TKFRAME_-82360_UNITS = 'DEGREES'
NAIF_BODY_NAME += ( 'ROCK' 'PEBBLE' )
NAIF_BODY_CODE += ( {ROCK} {PEBBLE} )
\begintext
"""
PCK = rf"""KPL/PCK
\begindata
BODY699_RADII = ( 60268 60268 54364 )
BODY699_POLE_RA = ( 40.589 -0.036 0.0 )
BODY699_POLE_DEC = ( 83.537 -0.004 0.0 )
BODY699_PM = ( 38.90 810.7939024 0.0 )
BODY601_RADII = ( 207.8 196.7 190.6 )
BODY601_POLE_RA = ( 40.66 -0.036 0.0 )
BODY601_POLE_DEC = ( 83.52 -0.004 0.0 )
BODY601_PM = ( 337.46 381.9945550 0.0 )
BODY{ROCK}_RADII = ( 30.0 20.0 10.0 )
BODY{ROCK}_POLE_RA = ( 10.0 0.0 0.0 )
BODY{ROCK}_POLE_DEC = ( 20.0 0.0 0.0 )
BODY{ROCK}_PM = ( 5.0 400.0 0.0 )
BODY{PEBBLE}_RADII = ( 3.0 3.0 3.0 )
\begintext
"""
FILES = ("naif.tls", "clock.tsc", "frames.tf", "bodies.tpc", "orbits.bsp", "pointing.bc")

Motion = Callable[[float], FloatArray]


def circle(radius_km: float, period_s: float, phase: float, tilt: float) -> Motion:
    """Uniform motion on a circle that is tilted about x."""

    def at(t: float) -> FloatArray:
        w = 2 * np.pi / period_s
        c, s = np.cos(w * t + phase), np.sin(w * t + phase)
        place = radius_km * np.array([c, s * np.cos(tilt), s * np.sin(tilt)])
        speed = radius_km * w * np.array([-s, c * np.cos(tilt), c * np.sin(tilt)])
        return np.concatenate([place, speed])

    return at


# Code: (centre, motion).
MOTIONS: dict[int, tuple[int, Motion]] = {
    10: (0, circle(8.0e5, 3.7e8, 1.0, 0.1)),
    6: (0, circle(1.43e9, 9.3e8, 0.3, 0.4)),
    699: (6, circle(300.0, 1.4e6, 0.0, 0.4)),
    601: (6, circle(185_539.0, 81_425.0, 2.0, 0.45)),
    ROCK: (6, circle(240_000.0, 120_000.0, 2.4, 0.45)),
    PEBBLE: (6, circle(241_000.0, 121_000.0, 2.4, 0.45)),
    SPACECRAFT: (699, circle(900_000.0, 900_000.0, 1.9, 0.5)),
}  # fmt: skip


def write_spk(path: Path, motions: dict[int, tuple[int, Motion]] = MOTIONS) -> None:
    """Ephemerides over the span, one segment per body."""
    handle = spiceypy.spkopn(str(path), "orbits", 0)
    ets = START_ET + np.arange(0.0, SPAN_S + STEP_S, STEP_S)
    # Light that arrives early in the span left Saturn before: everything but the spacecraft starts earlier.
    early = START_ET + np.arange(-12_000.0, SPAN_S + STEP_S, STEP_S)
    for code, (centre, motion) in motions.items():
        times = ets if code < 0 else early
        states = np.array([motion(float(et - START_ET)) for et in times])
        spiceypy.spkw13(handle, code, centre, "J2000", times[0], times[-1], f"{code}", 7, len(times), states, times)
    spiceypy.spkcls(handle)


def write_ck(path: Path, structure_from_j2000: Callable[[float], FloatArray], rate: FloatArray | None) -> None:
    """Pointing over the span; ``rate`` is the angular velocity in J2000 axes, None leaves it out."""
    ets = START_ET + np.arange(0.0, SPAN_S + STEP_S, STEP_S)
    ticks = np.array([spiceypy.sce2c(SPACECRAFT, et) for et in ets])
    quaternions = np.array([spiceypy.m2q(structure_from_j2000(float(et))) for et in ets])
    rates = np.zeros((len(ets), 3)) if rate is None else np.tile(rate, (len(ets), 1))
    handle = spiceypy.ckopn(str(path), "pointing", 0)
    spiceypy.ckw03(
        handle, ticks[0], ticks[-1], STRUCTURE, "J2000", rate is not None, "pointing", len(ets), ticks, quaternions,
        rates, 1, ticks[:1],
    )  # fmt: skip
    spiceypy.ckcls(handle)


def looking_at(direction: FloatArray) -> FloatArray:
    """instrument_from_j2000 with z along a direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, [0.1, 0.2, 0.9])
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def write_kernels(folder: Path, target: int = 601, rate_rad_s: float = 2e-5, with_rate: bool = True) -> Path:
    """All kernels and their meta-kernel; the camera looks at a body in mid-span and turns slowly about its z."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in zip(FILES, (LSK, SCLK, FK, PCK), strict=False):
        (folder / name).write_text(text)
    write_spk(folder / "orbits.bsp")
    spiceypy.kclear()
    for name in FILES[:5]:
        spiceypy.furnsh(str(folder / name))
    middle = START_ET + SPAN_S / 2
    direction = np.array(spiceypy.spkezp(target, middle, "J2000", "CN+S", SPACECRAFT)[0])
    instrument = looking_at(direction)
    structure_from_instrument = np.array(spiceypy.pxform(FRAME, "CASSINI_SC_COORD", middle))

    def attitude(et: float) -> FloatArray:
        turn = np.array(spiceypy.rotate(rate_rad_s * (et - middle), 3))
        return np.asarray(structure_from_instrument @ turn @ instrument)

    write_ck(folder / "pointing.bc", attitude, rate_rad_s * instrument[2] if with_rate else None)
    spiceypy.kclear()
    meta = folder / "meta.tm"
    files = "\n".join(f"  '$HERE/{name}'" for name in FILES)
    meta.write_text(
        f"KPL/MK\n\\begindata\nPATH_VALUES = ( '.' )\nPATH_SYMBOLS = ( 'HERE' )\nKERNELS_TO_LOAD = (\n{files}\n)\n"
    )
    return meta
