"""The ringed planet of the flyby sample: its moons, and its rings as a catalogue has them and as they really are.

The rings are invented in the manner of Saturn's and Uranus's: broad rings with plateaus, gaps and wavy edges within
70 000 km, narrow eccentric ringlets beyond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from math import radians, sqrt

import numpy as np

from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_system import DAY_S, SampleBody, Surface, System
from workflows.samples.flyby_time import calendar_text, et_from_utc
from workflows.samples.write import Json, JsonValue

RINGED_ID = 1199
RINGED_SYSTEM = System(RINGED_ID, 7.2e6, 12.6, 4.1, (200.0, 63.0))
OBLATENESS_J2 = 0.013
"""Second zonal harmonic, from which pericentres and patterns get plausible rates."""
RINGED = SampleBody(
    "SOLVANE", RINGED_ID, (26_000.0, 26_000.0, 24_400.0),
    Surface(2e-5, 12, 2.0, 0.05, "lambert", banded=True), RINGED_SYSTEM.pole_deg, 71.0, 790.0, system=RINGED_SYSTEM,
)  # fmt: skip
EPOCH_UTC = datetime(1998, 1, 1)
"""Of pericentres and patterns."""
SINGLE = ("edge_inner", "edge_outer")


def _moon(
    number: int, name: str, radii_km: tuple[float, float, float], orbit: tuple[float, float, float, float], rough: float
) -> SampleBody:
    """Return a moon that turns with its orbit: semi-major axis (km), eccentricity, inclination and anomaly (deg)."""
    pole = RINGED_SYSTEM.pole_deg
    moon = SampleBody(
        name, 1100 + number, radii_km, Surface(rough, 6, 2.2, 0.06, "lunar_lambert", 0.5), pole, 61.0 * number, 0.0,
        *orbit, system=RINGED_SYSTEM,
    )  # fmt: skip
    return replace(moon, spin_deg_day=float(np.degrees(moon.motion_rad_s) * DAY_S))


GAP_MOONS = (
    _moon(1, "PELLAN", (17.0, 15.0, 12.0), (62_872.5, 0.0, 0.0, 20.0), 1.5e-3),
    _moon(2, "DAVRIN", (4.5, 4.0, 3.5), (65_839.0, 0.0, 0.0, 215.0), 1.5e-3),
)
OUTER_MOONS = (
    _moon(3, "MIRETH", (52.0, 44.0, 38.0), (67_600.0, 0.001, 0.05, 130.0), 2.0e-3),
    _moon(4, "QUILON", (310.0, 306.0, 302.0), (112_000.0, 0.004, 9.0, 301.0), 1.0e-3),
    _moon(5, "RHOSSA", (720.0, 717.0, 715.0), (204_000.0, 0.003, 1.2, 84.0), 5.0e-4),
)
RING_BODIES = (RINGED, *GAP_MOONS, *OUTER_MOONS)


@dataclass(frozen=True)
class Mode:
    """A normal mode of an edge: radius - amplitude_km cos(m (longitude - longitude_deg - speed t))."""

    m: int
    amplitude_km: float
    longitude_deg: float
    speed_deg_day: float


@dataclass(frozen=True)
class RingFeature:
    """One entry of the ring catalogue, and what the catalogue does not tell.

    Attributes
    ----------
    kind
        ``ringlet`` or ``gap`` with two edges, ``edge_inner`` or ``edge_outer`` of a broad ring with one.
    a_km, width_km
        Semi-major axis of the inner, or only, edge and the distance to the outer one.
    tau
        Normal optical depth in a ringlet or gap, or on the denser side of a single edge.
    sigma_a_km
        Standard deviation of the catalogue's radius, common to both edges.
    ae_km, peri_deg
        Semi-major axis times eccentricity of the inner edge, and longitude of the pericentre at the epoch.
    dust
        Share of particles that scatter forward.
    grain
        Rms of undulations of the optical depth that no catalogue holds, of itself.
    """

    name: str
    kind: str
    a_km: float
    width_km: float
    tau: float
    sigma_a_km: float
    ae_km: float = 0.0
    peri_deg: float = 0.0
    modes: tuple[Mode, ...] = ()
    dust: float = 0.02
    grain: float = 0.08

    @property
    def peri_rate_deg_day(self) -> float:
        """Apsidal precession, rounded as the catalogue has it."""
        return round(_precession(self.a_km), 4) if self.ae_km else 0.0

    @property
    def edges_km(self) -> tuple[float, ...]:
        """Semi-major axes of its edges."""
        return (self.a_km,) if self.kind in SINGLE else (self.a_km, self.a_km + self.width_km)


@dataclass(frozen=True)
class RingScene:
    """What is special about a frame of rings.

    Attributes
    ----------
    aim_km
        (3,) point that the camera looks at, ring-plane axes from the planet's centre.
    moved, moved_km
        Name of a feature whose radius is off by so much more than its catalogue's error, empty for none.
    """

    aim_km: FloatArray
    moved: str = ""
    moved_km: float = 0.0


def _mean_motion(a_km: float) -> float:
    """Return degrees per day of a particle."""
    return float(np.degrees(sqrt(RINGED_SYSTEM.gm_km3_s2 / a_km**3)) * DAY_S)


def _precession(a_km: float) -> float:
    """Return degrees per day of a pericentre: 3/2 J2 (R/a)^2 n."""
    return 1.5 * OBLATENESS_J2 * (RINGED.radii_km[0] / a_km) ** 2 * _mean_motion(a_km)


def _mode(a_km: float, m: int, amplitude_km: float, longitude_deg: float) -> Mode:
    """Return a mode with the speed of a Lindblad resonance at its edge: ((m - 1) n + precession) / m."""
    speed = ((m - 1) * _mean_motion(a_km) + _precession(a_km)) / m
    return Mode(m, amplitude_km, longitude_deg, round(speed, 4))


def _features() -> tuple[RingFeature, ...]:
    """Return the catalogue, inward out; ringlets may lie in gaps, and gaps in rings, but no edges cross."""
    f = RingFeature
    return (
        f("C inner edge", "edge_inner", 34_150.0, 0.0, 0.07, 1.5),
        f("C plateau 1", "ringlet", 35_480.0, 160.0, 0.35, 0.6),
        f("C plateau 2", "ringlet", 36_310.0, 95.0, 0.30, 0.4),
        f("C gap 1", "gap", 36_900.0, 150.0, 0.0, 0.3),
        f("C ringlet 1", "ringlet", 36_955.0, 24.0, 1.2, 0.5, 18.0, 77.0),
        f("C plateau 3", "ringlet", 37_920.0, 220.0, 0.40, 0.5),
        f("C plateau 4", "ringlet", 38_640.0, 60.0, 0.25, 0.3),
        f("C plateau 5", "ringlet", 39_510.0, 340.0, 0.33, 0.8),
        f("C gap 2", "gap", 40_420.0, 230.0, 0.0, 0.4),
        f("C ringlet 2", "ringlet", 40_520.0, 60.0, 0.9, 0.8, 22.0, 301.0, (_mode(40_520.0, 2, 6.0, 40.0),)),
        f("C plateau 6", "ringlet", 41_000.0, 130.0, 0.30, 0.5),
        f("B inner edge", "edge_inner", 41_830.0, 0.0, 1.2, 1.0, grain=0.20),
        f("B plateau 1", "ringlet", 44_210.0, 610.0, 2.2, 1.2, grain=0.15),
        f("B plateau 2", "ringlet", 47_300.0, 1_240.0, 2.8, 1.5, grain=0.15),
        f("B plateau 3", "ringlet", 51_600.0, 420.0, 1.9, 0.9, grain=0.15),
        f("B outer edge", "edge_outer", 55_630.0, 0.0, 1.2, 1.0, 3.0, 210.0,
          (_mode(55_630.0, 2, 34.0, 15.0), _mode(55_630.0, 3, 9.0, 100.0))),
        f("Division ringlet 1", "ringlet", 55_790.0, 25.0, 1.0, 0.7, 27.0, 144.0),
        f("Division inner edge", "edge_inner", 56_035.0, 0.0, 0.11, 0.4),
        f("Division gap 1", "gap", 56_420.0, 45.0, 0.0, 0.3),
        f("Division gap 2", "gap", 56_880.0, 90.0, 0.0, 0.3),
        f("Division gap 3", "gap", 57_350.0, 30.0, 0.0, 0.2),
        f("Division gap 4", "gap", 57_700.0, 140.0, 0.0, 0.3, 2.0, 60.0),
        f("Division ringlet 2", "ringlet", 57_750.0, 12.0, 0.5, 0.4, 8.0, 10.0),
        f("A inner edge", "edge_inner", 58_270.0, 0.0, 0.6, 0.6, grain=0.08),
        f("A gap 1", "gap", 62_710.0, 325.0, 0.0, 0.4),
        f("A ringlet 1", "ringlet", 62_760.0, 14.0, 0.1, 0.8, 4.0, 333.0, dust=0.8),
        f("A gap 2", "gap", 65_820.0, 38.0, 0.0, 0.3, modes=(_mode(65_820.0, 12, 0.9, 8.0),)),
        f("A outer edge", "edge_outer", 66_420.0, 0.0, 0.6, 0.5, modes=(
            _mode(66_420.0, 7, 8.0, 20.0), _mode(66_420.0, 5, 3.0, 55.0), _mode(66_420.0, 3, 1.5, 5.0))),
        f("F ringlet", "ringlet", 68_750.0, 70.0, 0.25, 2.5, 130.0, 24.0, dust=0.7, grain=0.15),
        f("Ringlet 1", "ringlet", 70_110.0, 6.0, 0.9, 0.5, 55.0, 242.0),
        f("Ringlet 2", "ringlet", 70_840.0, 10.0, 1.1, 0.6, 140.0, 5.0),
        f("Ringlet 3", "ringlet", 71_520.0, 4.0, 1.4, 0.4, 8.0, 170.0, (_mode(71_520.0, 2, 2.5, 30.0),)),
        f("Ringlet 4", "ringlet", 72_610.0, 22.0, 1.5, 0.8, 310.0, 95.0),
        f("Ringlet 5", "ringlet", 73_480.0, 5.0, 2.0, 0.4, 12.0, 318.0),
        f("Ringlet 6", "ringlet", 74_390.0, 60.0, 1.6, 1.0, 420.0, 190.0),
        f("Ringlet 7", "ringlet", 75_560.0, 8.0, 1.0, 0.5),
        f("Ringlet 8", "ringlet", 76_750.0, 300.0, 0.05, 3.0, dust=0.8),
        f("Ringlet 9", "ringlet", 78_020.0, 16.0, 1.2, 0.7, 90.0, 266.0, (_mode(78_020.0, 3, 1.2, 70.0),)),
    )  # fmt: skip


FEATURES = _features()
INNERMOST_KM, OUTERMOST_KM = FEATURES[0].a_km, 78_200.0


@lru_cache(maxsize=16)
def radius_errors(seed: int) -> dict[str, float]:
    """Return by how much (km) each feature really lies outside its catalogue's radius; the same seed gives the same."""
    drawn = np.random.default_rng([seed, RINGED_ID, 31]).standard_normal(len(FEATURES))
    return {f.name: round(f.sigma_a_km * float(x), 4) for f, x in zip(FEATURES, drawn, strict=True)}


def edge_radii(feature: RingFeature, edge_km: float, longitudes: FloatArray, et: float) -> FloatArray:
    """Return an edge's radii (n,), km, at longitudes (n,), rad, prograde from the ring plane's node on the equator.

    Parameters
    ----------
    edge_km
        Semi-major axis of this edge.
    et
        When the light leaves, TDB seconds past J2000.
    """
    days = (et - et_from_utc(EPOCH_UTC)) / DAY_S
    e = feature.ae_km / feature.a_km
    pericentre = radians((feature.peri_deg + feature.peri_rate_deg_day * days) % 360.0)
    radius = edge_km * (1.0 - e * e) / (1.0 + e * np.cos(longitudes - pericentre))
    for mode in feature.modes:
        turned = radians((mode.longitude_deg + mode.speed_deg_day * days) % 360.0)
        radius = radius - mode.amplitude_km * np.cos(mode.m * (longitudes - turned))
    return np.asarray(radius)


def ring_catalogue() -> Json:
    """Return the catalogue that an archive publishes; it does not know the radii's errors."""
    features: list[JsonValue] = []
    for f in FEATURES:
        entry: Json = {
            "name": f.name, "kind": f.kind, "a_km": f.a_km, "ae_km": f.ae_km, "long_peri_deg": f.peri_deg,
            "long_peri_rate_deg_day": f.peri_rate_deg_day, "width_km": f.width_km, "tau": f.tau,
            "sigma_a_km": f.sigma_a_km,
        }  # fmt: skip
        entry["modes"] = [
            {
                "m": mode.m, "amplitude_km": mode.amplitude_km, "longitude_deg": mode.longitude_deg,
                "pattern_speed_deg_day": mode.speed_deg_day,
            }
            for mode in f.modes
        ]  # fmt: skip
        features.append(entry)
    return {"planet": RINGED.name, "epoch_utc": calendar_text(EPOCH_UTC), "features": features}
