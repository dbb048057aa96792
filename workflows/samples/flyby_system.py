"""An invented planet of the flyby sample, its moons and their Sun: places, orientations and how they are seen.

Everything is closed-form: Kepler orbits about a planet on a circle about the Sun, even rotation about fixed poles. The
kernels of the sample are made from these functions, never read by them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, pi, radians, sin, sqrt

import numpy as np

from workflows.samples.attitude import turn_about
from workflows.samples.cameras import FloatArray
from workflows.samples.sky import AU_KM, SPEED_OF_LIGHT_KMS, aberrate

SUN_ID = 10
PLANET_ID = 1099
"""Below 10 000, so that SPICE takes the id for no comet, asteroid or extended planetary code."""
SUN_GM_KM3_S2 = 1.32712440018e11
"""IAU 2015 nominal value, as in DE430."""
SUN_RADIUS_KM = 695_700.0
DAY_S = 86_400.0


@dataclass(frozen=True)
class System:
    """A planet's place among the others and what its moons share.

    Attributes
    ----------
    planet_id
        NAIF id.
    gm_km3_s2
        Of the planet.
    distance_au, start_rad
        Radius of its circle about the Sun, and its longitude at J2000.
    pole_deg
        (RA, Dec) of its pole and of the moons' common orbital plane.
    """

    planet_id: int
    gm_km3_s2: float
    distance_au: float
    start_rad: float
    pole_deg: tuple[float, float]


POLE_DEG = (214.0, 52.0)
SYSTEM = System(PLANET_ID, 6.8e6, 9.3, 1.3, POLE_DEG)


@dataclass(frozen=True)
class Surface:
    """How a body's surface departs from a smooth grey ellipsoid.

    Attributes
    ----------
    roughness
        Rms of the height field over the mean radius.
    lowest_degree, slope
        Heights hold spherical-harmonic degrees from the lowest on, with variance per degree falling as degree^-slope.
    albedo_rms
        Rms of the relative albedo.
    law, parameter
        ``lambert``, ``lommel_seeliger`` or ``lunar_lambert`` with the weight of its Lommel-Seeliger part.
    banded
        Whether the albedo follows parallels, as clouds do.
    """

    roughness: float
    lowest_degree: int
    slope: float
    albedo_rms: float
    law: str
    parameter: float = 0.0
    banded: bool = False


@dataclass(frozen=True)
class SampleBody:
    """One invented body.

    Attributes
    ----------
    orbit_km, eccentricity, inclination_deg, anomaly_deg
        Semi-major axis about the planet, and mean anomaly at J2000 counted from the node; a planet has none of them.
    pole_deg, prime_deg, spin_deg_day
        Pole (RA, Dec) and prime meridian of J2000, and the rotation rate.
    """

    name: str
    naif_id: int
    radii_km: tuple[float, float, float]
    surface: Surface
    pole_deg: tuple[float, float] = POLE_DEG
    prime_deg: float = 0.0
    spin_deg_day: float = 0.0
    orbit_km: float = 0.0
    eccentricity: float = 0.0
    inclination_deg: float = 0.0
    anomaly_deg: float = 0.0
    system: System = SYSTEM

    @property
    def mean_radius_km(self) -> float:
        """Radius of the sphere of the same volume."""
        return float(np.prod(self.radii_km) ** (1.0 / 3.0))

    @property
    def motion_rad_s(self) -> float:
        """Mean motion about the planet."""
        return sqrt(self.system.gm_km3_s2 / self.orbit_km**3)


PLANET = SampleBody(
    "VARUNDA", PLANET_ID, (25_400.0, 25_400.0, 24_700.0),
    Surface(2e-5, 12, 2.0, 0.06, "lambert", banded=True), spin_deg_day=810.0, prime_deg=33.0,
)  # fmt: skip


def _moon(
    number: int,
    name: str,
    radii_km: tuple[float, float, float],
    orbit: tuple[float, float, float, float],
    *surface: float,
) -> SampleBody:
    """Return a moon that turns with its orbit: semi-major axis (km), eccentricity, inclination and anomaly (deg)."""
    roughness, lowest, slope, albedo, weight = surface
    law = "lunar_lambert" if 0.0 < weight < 1.0 else "lommel_seeliger" if weight else "lambert"
    parameter = weight if law == "lunar_lambert" else 0.0
    moon = SampleBody(
        name, 1000 + number, radii_km, Surface(roughness, int(lowest), slope, albedo, law, parameter),
        (POLE_DEG[0] + 0.7 * number, POLE_DEG[1] - 0.4 * number), 360.0 * (0.618 * number % 1.0),
        0.0, *orbit,
    )  # fmt: skip
    return replace(moon, spin_deg_day=float(np.degrees(moon.motion_rad_s) * DAY_S))


# roughness, lowest degree, slope, albedo rms, Lommel-Seeliger weight
MOONS = (
    _moon(1, "ALTHEDRA", (1250.0, 1250.0, 1250.0), (620e3, 0.004, 0.4, 10.0), 3.0e-4, 8, 2.6, 0.12, 0.45),
    _moon(2, "BREYNIS", (563.0, 557.0, 553.0), (377e3, 0.002, 0.2, 75.0), 7.0e-4, 7, 2.4, 0.08, 0.6),
    _moon(3, "CORVETH", (254.0, 250.5, 248.0), (190e3, 0.0, 0.1, 140.0), 1.2e-3, 6, 2.2, 0.05, 0.5),
    _moon(4, "DOLMIRA", (742.0, 742.0, 742.0), (527e3, 0.006, 0.9, 200.0), 4.0e-4, 10, 3.0, 0.20, 1.0),
    _moon(5, "ESKARYN", (131.0, 117.0, 109.0), (151e3, 0.001, 0.3, 250.0), 2.0e-3, 6, 2.2, 0.03, 1.0),
    _moon(6, "FENWYCK", (83.0, 73.0, 65.0), (139e3, 0.001, 0.1, 305.0), 2.5e-3, 6, 2.0, 0.02, 1.0),
    _moon(7, "GILDORA", (2080.0, 2080.0, 2080.0), (1_221e3, 0.02, 0.6, 330.0), 2.0e-4, 14, 2.0, 0.04, 0.0),
    _moon(8, "HALVREN", (254.0, 250.5, 248.0), (190e3, 0.0, 0.1, 140.9), 1.2e-3, 6, 2.2, 0.05, 0.5),
)  # fmt: skip
"""The third and the eighth are alike and follow each other closely."""
BODIES = (PLANET, *MOONS)


def body_named(name: str) -> SampleBody:
    """Return a body by its name."""
    return next(body for body in BODIES if body.name == name)


def equator_from_pole(pole_deg: tuple[float, float]) -> FloatArray:
    """Return the matrix whose columns are node, its normal and pole in J2000; the node is the pole's IAU node Q."""
    ra, dec = radians(pole_deg[0]), radians(pole_deg[1])
    pole = np.array([cos(dec) * cos(ra), cos(dec) * sin(ra), sin(dec)])
    node = np.array([-sin(ra), cos(ra), 0.0])
    return np.stack([node, np.cross(pole, node), pole], axis=1)


def sun_state(et: float) -> tuple[FloatArray, FloatArray]:
    """Return position (km) and velocity (km/s) of the Sun from the barycentre, a straight line."""
    velocity = np.array([0.008, -0.009, 0.004])
    return np.array([4.1e5, -3.3e5, 1.2e5]) + velocity * et, velocity


def planet_state(et: float, system: System = SYSTEM) -> tuple[FloatArray, FloatArray]:
    """Return position (km) and velocity (km/s) of a planet from the barycentre, a circle about the Sun."""
    sun, sun_velocity = sun_state(et)
    radius = system.distance_au * AU_KM
    rate = sqrt(SUN_GM_KM3_S2 / radius**3)
    angle = system.start_rad + rate * et
    # The ecliptic, near enough: obliquity 23.44 deg.
    tilt = turn_about(np.array([1.0, 0.0, 0.0]), radians(23.44))
    out = tilt @ np.array([cos(angle), sin(angle), 0.0])
    ahead = tilt @ np.array([-sin(angle), cos(angle), 0.0])
    return sun + radius * out, sun_velocity + radius * rate * ahead


def moon_state(moon: SampleBody, et: float) -> tuple[FloatArray, FloatArray]:
    """Return position (km) and velocity (km/s) of a moon from its planet: Kepler's ellipse."""
    e, motion = moon.eccentricity, moon.motion_rad_s
    mean = radians(moon.anomaly_deg) + motion * et
    anomaly = mean
    for _ in range(10):  # with e <= 0.02 a turn gains nearly two digits
        anomaly = mean + e * sin(anomaly)
    flat = sqrt(1.0 - e * e)
    rate = motion / (1.0 - e * cos(anomaly))
    tilt = turn_about(np.array([1.0, 0.0, 0.0]), radians(moon.inclination_deg))
    plane = equator_from_pole(moon.system.pole_deg) @ tilt
    position = plane @ np.array([cos(anomaly) - e, flat * sin(anomaly), 0.0])
    velocity = plane @ np.array([-sin(anomaly), flat * cos(anomaly), 0.0])
    return moon.orbit_km * position, moon.orbit_km * rate * velocity


def body_state(body: SampleBody, et: float) -> tuple[FloatArray, FloatArray]:
    """Return position (km) and velocity (km/s) of planet or moon from the barycentre."""
    position, velocity = planet_state(et, body.system)
    if body.naif_id == body.system.planet_id:
        return position, velocity
    from_planet, its_velocity = moon_state(body, et)
    return position + from_planet, velocity + its_velocity


def body_from_j2000(body: SampleBody, et: float) -> FloatArray:
    """Return the rotation (3, 3) to the body-fixed axes: the prime meridian W east of the node along the equator."""
    angle = radians(body.prime_deg) + (radians(body.spin_deg_day) / DAY_S * et) % (2.0 * pi)
    turned: FloatArray = turn_about(np.array([0.0, 0.0, 1.0]), -angle) @ equator_from_pole(body.pole_deg).T
    return turned


@dataclass(frozen=True)
class Sighting:
    """A body as a spacecraft sees it.

    Attributes
    ----------
    place_km
        (3,) apparent place from the spacecraft, J2000: light time and stellar aberration are in it.
    from_j2000
        (3, 3) orientation when the light left.
    sun
        (3,) unit vector from the body to the Sun, J2000.
    """

    body: SampleBody
    place_km: FloatArray
    from_j2000: FloatArray
    sun: FloatArray

    @property
    def range_km(self) -> float:
        """Distance from the spacecraft."""
        return float(np.linalg.norm(self.place_km))

    @property
    def phase_rad(self) -> float:
        """Angle Sun - body - spacecraft."""
        cosine = -float(self.sun @ self.place_km) / self.range_km
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    @property
    def radius_rad(self) -> float:
        """Apparent mean radius."""
        return float(np.arcsin(min(1.0, self.body.mean_radius_km / self.range_km)))


def see(body: SampleBody, et: float, position_km: FloatArray, velocity_kms: FloatArray) -> Sighting:
    """Return how a body looks at an et from a place and motion that are relative to the barycentre.

    Light leaves the body at et - |r| / c, which is solved by substitution; the direction is then aberrated.
    """
    then = et
    for _ in range(6):  # each turn gains a factor c over the body's speed
        place, _ = body_state(body, then)
        apart = place - position_km
        distance = float(np.linalg.norm(apart))
        then = et - distance / SPEED_OF_LIGHT_KMS
    seen = aberrate(apart[None] / distance, velocity_kms)[0]
    sun = sun_state(then - body.system.distance_au * AU_KM / SPEED_OF_LIGHT_KMS)[0] - place
    return Sighting(body, distance * seen, body_from_j2000(body, then), sun / np.linalg.norm(sun))
