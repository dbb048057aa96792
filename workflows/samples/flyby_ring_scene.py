"""The rings of one frame of the flyby sample, made ready for its rays."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from workflows.samples.attitude import turn_about
from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_plan import Shot
from workflows.samples.flyby_ring_rays import LONGITUDES, RingDisc
from workflows.samples.flyby_ring_system import (
    FEATURES,
    RINGED,
    RINGED_SYSTEM,
    SINGLE,
    RingFeature,
    RingScene,
    edge_radii,
    radius_errors,
)
from workflows.samples.flyby_system import SUN_RADIUS_KM, body_state, equator_from_pole, see
from workflows.samples.sky import AU_KM, SPEED_OF_LIGHT_KMS

BACK_EXPONENT, BACK_PEAK = 3.092, 7.0
"""Phase function of macroscopic particles: peak (1 - phase / pi)^3.092, as Dones et al. (1993) found for ring A."""
DUST_ASYMMETRY = 0.6
"""Of Henyey and Greenstein's phase function for dust."""
ALBEDO, DUST_ALBEDO = 0.6, 0.9
UNDULATION_STEP_KM = 2.0
UNDULATION_REACH_KM = 90_000.0
UNDULATION_KM = (12.0, 2500.0)
"""Shortest and longest wavelength of the undulations."""
WAVES = (
    (59_320.0, 6, 30.0), (60_750.0, 8, 22.0), (61_640.0, 5, 26.0), (63_580.0, 9, 20.0), (64_440.0, 7, 24.0),
    (65_210.0, 11, 17.0), (46_050.0, 2, 50.0),
)  # fmt: skip
"""Radius (km), arms and scale (km) of density waves, whose phase grows as half the square of the distance in it."""
SPOKES_KM = (43_000.0, 53_000.0)


def plane_from_j2000() -> FloatArray:
    """Return the rotation (3, 3) to ring-plane axes: node, its normal, pole."""
    turned: FloatArray = equator_from_pole(RINGED_SYSTEM.pole_deg).T
    return turned


def phase_function(phase_rad: float, dust: float) -> float:
    """Return albedo times phase function over four of a mixture of particles and dust."""
    big = ALBEDO * BACK_PEAK * (1.0 - phase_rad / np.pi) ** BACK_EXPONENT
    g = DUST_ASYMMETRY
    small = DUST_ALBEDO * (1.0 - g * g) / (1.0 + g * g + 2.0 * g * np.cos(phase_rad)) ** 1.5
    return float((1.0 - dust) * big + dust * small) / 4.0


def sorted_edges() -> list[tuple[float, int]]:
    """Return (semi-major axis in km, index of the feature) of all edges, inward out."""
    return sorted((edge, k) for k, feature in enumerate(FEATURES) for edge in feature.edges_km)


def _regions() -> list[RingFeature | None]:
    """Return what lies inside each edge and, last, beyond all: the innermost feature there, None for nothing."""
    base: RingFeature | None = None
    opened: list[RingFeature] = []
    regions: list[RingFeature | None] = [None]
    for _, k in sorted_edges():
        feature = FEATURES[k]
        if feature.kind in SINGLE:
            base = feature if feature.kind == "edge_inner" else None
        elif feature in opened:
            opened.remove(feature)
        else:
            opened.append(feature)
        regions.append(opened[-1] if opened else base)
    return regions


def true_radius_error(shot: Shot, feature: RingFeature) -> float:
    """Return by how much (km) a feature of a frame lies outside its catalogue's radius."""
    extra = shot.ring.moved_km if shot.ring is not None and shot.ring.moved == feature.name else 0.0
    return radius_errors(shot.seed)[feature.name] + extra


def edge_table(shot: Shot, emission_et: float) -> FloatArray:
    """Return the radii (LONGITUDES + 1, n) of all edges, km, as they really are."""
    longitudes = 2.0 * np.pi * np.arange(LONGITUDES + 1) / LONGITUDES
    columns = []
    for edge, k in sorted_edges():
        feature = FEATURES[k]
        columns.append(edge_radii(feature, edge + true_radius_error(shot, feature), longitudes, emission_et))
    return np.ascontiguousarray(np.stack(columns, axis=1))


@lru_cache(maxsize=4)
def _undulation(seed: int) -> FloatArray:
    """Return the integral over the radius of a random profile of unit rms, equally strong in every octave."""
    rng = np.random.default_rng([seed, RINGED.naif_id, 41])
    count = int(UNDULATION_REACH_KM / UNDULATION_STEP_KM)
    frequency = np.fft.rfftfreq(count, UNDULATION_STEP_KM)
    inside = (frequency > 1.0 / UNDULATION_KM[1]) & (frequency < 1.0 / UNDULATION_KM[0])
    size = np.where(inside, 1.0 / np.sqrt(np.maximum(frequency, 1e-9)), 0.0)
    spectrum = size * (rng.standard_normal(len(size)) + 1j * rng.standard_normal(len(size)))
    profile = np.fft.irfft(spectrum, count)
    return np.concatenate([[0.0], np.cumsum(profile / profile.std()) * UNDULATION_STEP_KM])


def _spokes(aim_rad: float, phase_rad: float, rng: np.random.Generator) -> FloatArray:
    """Draw spokes around the longitude in view: dark against the ring at small phase, bright at large."""
    count = int(rng.integers(0, 9))
    inner = rng.uniform(SPOKES_KM[0], SPOKES_KM[1] - 5000.0, count)
    outer = inner + rng.uniform(2000.0, 5000.0, count)
    longitude = (aim_rad + rng.normal(0.0, 0.5, count)) % (2.0 * np.pi)
    strength = rng.uniform(0.05, 0.2, count) * (1.0 if phase_rad > np.radians(60.0) else -1.0)
    width, shear = rng.uniform(0.004, 0.03, count), rng.uniform(-1.0, 1.0, count) * 1.5e-5
    return np.stack([inner, outer, longitude, width, shear, strength], axis=1)


def _propellers(aim_rad: float, rng: np.random.Generator) -> FloatArray:
    """Draw propellers in the outer part of ring A, at the longitude in view."""
    count = int(rng.integers(0, 4))
    spread = 200.0 / 65_000.0
    return np.stack(
        [
            rng.uniform(64_500.0, 66_300.0, count),
            (aim_rad + rng.normal(0.0, spread, count)) % (2.0 * np.pi),
            rng.uniform(0.8, 3.0, count),
            rng.uniform(15.0, 150.0, count),
            rng.uniform(-0.7, 0.7, count),
        ],
        axis=1,
    )


def _waves(rng: np.random.Generator) -> FloatArray:
    """Return the density waves with a phase each, their patterns being where they may."""
    return np.array([[r, m, rng.uniform(0.0, 2.0 * np.pi), length, rng.uniform(0.2, 0.5)] for r, m, length in WAVES])


def prepare_rings(shot: Shot, scene: RingScene, rng: np.random.Generator) -> RingDisc:
    """Return the rings of a frame as its camera sees them; the same draws make the same texture."""
    planet = see(RINGED, shot.et, shot.position_km, shot.velocity_kms)
    place, velocity = body_state(RINGED, shot.et)
    turn = plane_from_j2000()
    emission_et = shot.et - planet.range_km / SPEED_OF_LIGHT_KMS
    regions = _regions()
    tau = np.array([0.0 if region is None else region.tau for region in regions])
    grain = np.array([0.0 if region is None or shot.smooth else region.grain for region in regions])
    # The rings are seen about as the planet is; near by, the aimed point tells the phase better.
    back = turn @ (shot.position_km - place) - scene.aim_km
    phase = float(np.arccos(np.clip(back @ (turn @ planet.sun) / np.linalg.norm(back), -1.0, 1.0)))
    scatter = np.array([0.0 if region is None else phase_function(phase, region.dust) for region in regions])
    spin = np.radians(RINGED.prime_deg) + np.radians(RINGED.spin_deg_day) / 86_400.0 * emission_et
    aim = float(np.arctan2(scene.aim_km[1], scene.aim_km[0]))
    waves, spokes, propellers = _waves(rng), _spokes(aim, phase, rng), _propellers(aim, rng)
    return RingDisc(
        eye=turn @ (shot.position_km - place),
        from_camera=np.ascontiguousarray(turn @ shot.truth.T),
        from_planet=turn_about(np.array([0.0, 0.0, 1.0]), spin % (2.0 * np.pi)),
        drift=turn @ (shot.velocity_kms - velocity) / SPEED_OF_LIGHT_KMS,
        sun=turn @ planet.sun,
        inverse_radii=1.0 / np.array(RINGED.radii_km),
        sun_radius=SUN_RADIUS_KM / (RINGED_SYSTEM.distance_au * AU_KM),
        edges=edge_table(shot, emission_et),
        tau=tau,
        scatter=scatter,
        grain=grain,
        broad=np.array([float(r is not None and r.name.startswith("B ")) for r in regions]),
        undulation=_undulation(shot.seed),
        undulation_step=UNDULATION_STEP_KM,
        waves=waves,
        spokes=spokes,
        propellers=propellers,
    )
