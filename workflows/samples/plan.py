"""Where each frame of the star sample points, when, from where, and which catalogue stars surround it.

Planning is serial because frames must not overlap: each narrow field brings its own faint stars, and every one of them
has to show in every frame that covers it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from astropy.time import Time
from numpy.typing import NDArray

from workflows.samples.attitude import looking_at, pointing_error
from workflows.samples.camera_table import sample_cameras
from workflows.samples.cameras import FloatArray, SampleCamera, project, unproject
from workflows.samples.options import StarSampleOptions
from workflows.samples.photometry import DETECTION_SNR, Exposure, fluxes_dn, limit_mag, signal_to_noise
from workflows.samples.sky import Observer, RealSky, Stars, apparent_directions, join_stars, unit_vectors

FIELDS: tuple[tuple[str, float, float, float], ...] = (
    ("pleiades", 56.75, 24.12, 0.9),
    ("hyades", 66.75, 15.87, 2.5),
    ("carina", 161.0, -59.8, 1.5),
    ("praesepe", 130.1, 19.67, 0.8),
    ("scorpius", 253.5, -41.8, 1.2),
)
"""Crowded places of the sky: name, right ascension, declination and radius, deg."""
MAX_TRIES = 400
"""Pointings tried for one frame before the wanted number of stars is called impossible."""
EDGE_PX = 40.0
"""Stars are laid this far beyond the search margin, so that no catalogue ends inside a predicted field."""
COUNT_SLOPE = 0.35
"""d log10 N / d mag of the synthetic stars, a typical value of the galactic field at 10 to 14 mag."""
OFFSET_SHARE = 0.9
"""Share of the search margin that planted offsets fill."""
OBLIQUITY_RAD = np.radians(23.4393)


MET_OF_ET_S = 190_966_152.0
"""ET minus the mission elapsed time of New Horizons, s, to within a second, from the level 2 headers."""


@dataclass(frozen=True)
class FramePlan:
    """All that decides one frame, small enough to send to a worker.

    Attributes
    ----------
    apriori, truth
        camera_from_j2000 (3, 3) at mid-exposure: what the file says, and where the camera looked.
    offset_vu, rotation_rad
        The planted (dv, du), px, and rotation about the array centre.
    stars, directions
        Catalogue stars around the field and the J2000 unit vectors (n, 3) in which the spacecraft sees them.
    """

    index: int
    seed: int
    camera: SampleCamera
    field: str
    utc: str
    et: float
    exposure: Exposure
    observer: Observer
    apriori: FloatArray
    truth: FloatArray
    offset_vu: FloatArray
    rotation_rad: float
    stars: Stars
    directions: FloatArray
    false_fraction: float
    oddity_fraction: float

    @property
    def image_id(self) -> str:
        """Name of the frame and stem of its files."""
        if self.camera.is_lorri:
            # A LORRI product's name: mission elapsed time, application, and here the frame's number.
            apid = "0x633" if self.camera.name.endswith("4x4") else "0x631"
            return f"lor_{round(self.et - MET_OF_ET_S):010d}_{apid}_s{self.index:04d}"
        return f"star_{self.index:04d}_{self.camera.name}"


@dataclass(frozen=True)
class _Caps:
    """Patches of the sky that are taken: centres (n, 3) and angular radii, rad."""

    centres: FloatArray
    radii: FloatArray

    def clear_of(self, direction: FloatArray, radius: float) -> bool:
        apart = np.arccos(np.clip(self.centres @ direction, -1.0, 1.0))
        return bool(np.all(apart > self.radii + radius))

    def add(self, direction: FloatArray, radius: float) -> _Caps:
        return _Caps(np.vstack([self.centres, direction]), np.append(self.radii, radius))


def _uniform(rng: np.random.Generator, bounds: tuple[float, ...]) -> float:
    """Draw a float between the first and the last of some bounds."""
    return float(rng.uniform(bounds[0], bounds[-1]))


def _time_and_place(camera: SampleCamera, rng: np.random.Generator) -> tuple[str, float, Observer]:
    """Draw when and where a frame is taken; returns UTC, TDB seconds past J2000 and the observer, near the ecliptic."""
    utc = Time(round(_uniform(rng, camera.years), 6), format="jyear", scale="utc")
    utc = Time(utc.isot, format="isot", scale="utc")
    tdb = utc.tdb
    days = (tdb.jd1 - 2451545.0) + tdb.jd2
    longitude, latitude = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.1, 0.1)
    outward = unit_vectors(np.array([longitude]), np.array([latitude]))[0]
    heading = rng.uniform(-1.2, 1.2)
    sideways = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    c, s = np.cos(OBLIQUITY_RAD), np.sin(OBLIQUITY_RAD)
    equator_from_ecliptic = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    position = _uniform(rng, camera.distance_au) * outward
    velocity = _uniform(rng, camera.speed_kms) * (np.cos(heading) * outward + np.sin(heading) * sideways)
    observer = Observer(2000.0 + days / 365.25, equator_from_ecliptic @ position, equator_from_ecliptic @ velocity)
    return str(utc.isot), float(days * 86400.0), observer


def _exposure(camera: SampleCamera, smeared: bool, rng: np.random.Generator) -> Exposure:
    """Draw an exposure; a smeared one trails stars by one to four pixels, LORRI always drifts by a fraction of one."""
    seconds = float(rng.choice(camera.exposures_s))
    length = rng.uniform(1.0, 4.0) if smeared else rng.uniform(0.0, 0.3) * camera.is_lorri
    angle, roll = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0)
    rate = length * camera.rad_per_px / seconds
    return Exposure(seconds, rate * np.array([np.cos(angle), np.sin(angle), roll]))


def _direction(rng: np.random.Generator) -> tuple[str, FloatArray]:
    """Draw a crowded place or any place of the sky."""
    if rng.random() < 0.5:
        name, ra, dec, radius = FIELDS[int(rng.integers(len(FIELDS)))]
        reach = radius * np.sqrt(rng.random())
        angle = rng.uniform(0.0, 2.0 * np.pi)
        dec_deg = dec + reach * np.sin(angle)
        ra_deg = ra + reach * np.cos(angle) / np.cos(np.radians(dec_deg))
        return name, unit_vectors(np.radians([ra_deg]), np.radians([dec_deg]))[0]
    z, longitude = rng.uniform(-1.0, 1.0), rng.uniform(0.0, 2.0 * np.pi)
    return "sky", unit_vectors(np.array([longitude]), np.arcsin([z]))[0]


def _target(options: StarSampleOptions, rng: np.random.Generator) -> int:
    """Draw how many stars a narrow frame shall have: rarely none, sometimes one or two, mostly three to `max_stars`."""
    low, high = options.min_stars, options.max_stars
    draw, spread = rng.random(), rng.random()
    if low == 0 and (draw < 0.05 or high == 0):
        return 0
    if low <= 2 and (draw < 0.20 or high <= 2):
        return int(rng.integers(max(low, 1), min(high, 2) + 1))
    first = max(low, 3)
    return min(high, int(first * ((high + 1) / first) ** spread))


def inside(camera: SampleCamera, pixels_vu: FloatArray, margin: float = 0.0) -> NDArray[np.bool_]:
    """Tell which pixels (n, 2) lie on the array, widened by a margin, px."""
    last = np.array(camera.shape_vu) - 1.0
    on: NDArray[np.bool_] = np.all((pixels_vu >= -margin) & (pixels_vu <= last + margin), axis=1)
    return on


def detectable(plan: FramePlan) -> NDArray[np.bool_]:
    """Tell which stars of a plan lie in the frame and rise above five sigma."""
    pixels = project(plan.camera, plan.directions @ plan.truth.T)
    flux = fluxes_dn(plan.camera, plan.stars.mag, plan.exposure.seconds)
    return inside(plan.camera, pixels) & (signal_to_noise(plan.camera, flux, plan.exposure) >= DETECTION_SNR)


def _blank_plan(index: int, options: StarSampleOptions, rng: np.random.Generator) -> FramePlan:
    """Draw everything of a frame but where it points; `truth` is still relative to the a-priori attitude."""
    camera = sample_cameras()[options.cameras[index % len(options.cameras)]]
    utc, et, observer = _time_and_place(camera, rng)
    offset = OFFSET_SHARE * rng.uniform(-1.0, 1.0, 2) * np.array(camera.search_margin_vu)
    limit = np.radians(options.max_rotation_deg) if camera.fit_camera_rotation else 0.0
    rotation = float(rng.uniform(-limit, limit)) if limit else 0.0
    empty = np.zeros(0)
    return FramePlan(
        index=index,
        seed=options.seed,
        camera=camera,
        field="",
        utc=utc,
        et=et,
        exposure=_exposure(camera, bool(rng.random() < options.smeared_fraction), rng),
        observer=observer,
        apriori=np.eye(3),
        truth=pointing_error(camera, offset, rotation),
        offset_vu=offset,
        rotation_rad=rotation,
        stars=Stars(empty.astype(np.str_), empty, empty, empty, empty, empty, empty, empty),
        directions=np.zeros((0, 3)),
        false_fraction=options.false_fraction,
        oddity_fraction=options.oddity_fraction,
    )


def _patch_radius(camera: SampleCamera) -> float:
    """Return the radius, rad, of the sky around the a-priori axis whose stars a frame needs."""
    reach = np.hypot(*(np.array(camera.shape_vu) / 2.0 + 2.0 * np.array(camera.search_margin_vu) + EDGE_PX))
    return float(1.1 * np.arctan(reach * camera.rad_per_px))


def _point(blank: FramePlan, sky: RealSky, caps: _Caps, bounds: tuple[int, int], rng: np.random.Generator) -> FramePlan:
    """Point a frame at a free place of the sky where the number of detectable real stars is within bounds."""
    radius = _patch_radius(blank.camera)
    for _ in range(MAX_TRIES):
        name, axis = _direction(rng)
        roll = rng.uniform(0.0, 2.0 * np.pi)
        if not caps.clear_of(axis, radius):
            continue
        apriori = looking_at(axis, roll)
        stars = sky.near(axis, radius)
        plan = replace(
            blank,
            field=name,
            apriori=apriori,
            truth=blank.truth @ apriori,
            stars=stars,
            directions=apparent_directions(stars, blank.observer),
        )
        if bounds[0] <= int(detectable(plan).sum()) <= bounds[1]:
            return plan
    raise ValueError(
        f"no free place of the sky shows {bounds[0]} to {bounds[1]} real stars to {blank.camera.name} "
        f"in {blank.exposure.seconds} s"
    )


def _faint_pixels(plan: FramePlan, count: int, rng: np.random.Generator) -> tuple[FloatArray, int]:
    """Place count stars on the array, as many per area around it, then faint ones; also returns where these begin."""
    shape = np.array(plan.camera.shape_vu, dtype=np.float64)
    beyond = 2.0 * np.array(plan.camera.search_margin_vu) + EDGE_PX
    on = rng.uniform(1.0, shape - 2.0, (count, 2))
    area = np.prod(shape + 2.0 * beyond) / np.prod(shape)
    # A third as many again, spread over everything, lies below the limit; an empty frame has such stars too.
    around = rng.uniform(-beyond, shape - 1.0 + beyond, (int(rng.poisson(count * (area - 1.0) + 1.0)), 2))
    around = around[~inside(plan.camera, around, margin=1.0)]
    below = rng.uniform(-beyond, shape - 1.0 + beyond, (int(rng.poisson(area * (count / 3.0 + 0.5))), 2))
    return np.vstack([on, around, below]), len(on) + len(around)


def _draw_mags(low: float, high: float, count: int, rng: np.random.Generator) -> FloatArray:
    """Draw magnitudes between two limits with counts rising as 10^(slope m)."""
    a, b = 10.0 ** (COUNT_SLOPE * low), 10.0 ** (COUNT_SLOPE * high)
    mags: FloatArray = np.log10(rng.uniform(a, b, count)) / COUNT_SLOPE
    return mags


def _faint_stars(plan: FramePlan, count: int, rng: np.random.Generator) -> Stars:
    """Invent catalogue stars fainter than the real ones such that count of them are detectable in the frame."""
    camera = plan.camera
    pixels, n_bright = _faint_pixels(plan, count, rng)
    n = len(pixels)
    limit = limit_mag(camera, plan.exposure) - 0.02
    bright = _draw_mags(min(camera.faint_mags[0], limit - 1.5), min(camera.faint_mags[1], limit), n_bright, rng)
    below = rng.uniform(limit + 0.04, limit + 1.0, n - n_bright)
    # One star in fifty is a near one, whose motion and parallax cannot be neglected.
    near = np.where(rng.random(n) < 0.02, 30.0, 1.0)
    stars = Stars(
        star_id=np.array([f"faint-{plan.index:04d}-{k:03d}" for k in range(n)], dtype=np.str_),
        ra_deg=np.zeros(n),
        dec_deg=np.zeros(n),
        mag=np.concatenate([bright, below]),
        pm_ra_masyr=rng.normal(0.0, 12.0, n) * near,
        pm_dec_masyr=rng.normal(0.0, 12.0, n) * near,
        parallax_mas=rng.exponential(1.5, n) * near,
        epoch=np.full(n, 2016.0),
    )
    return _placed_to_be_seen(stars, unproject(camera, pixels) @ plan.truth, plan.observer)


def _placed_to_be_seen(stars: Stars, wanted: FloatArray, observer: Observer) -> Stars:
    """Give stars the catalogue places from which the observer sees them in wanted directions (n, 3)."""
    place = wanted.copy()
    for _ in range(4):  # what is seen differs from the catalogue by 1e-4 rad, so each turn gains four digits
        ra, dec = np.arctan2(place[:, 1], place[:, 0]), np.arcsin(np.clip(place[:, 2], -1.0, 1.0))
        stars = replace(stars, ra_deg=np.degrees(ra) % 360.0, dec_deg=np.degrees(dec))
        place += wanted - apparent_directions(stars, observer)
        place /= np.linalg.norm(place, axis=1, keepdims=True)
    return stars


def plan_frames(options: StarSampleOptions, sky: RealSky) -> tuple[list[FramePlan], Stars | None]:
    """Plan every frame; returns the plans and the synthetic stars of all of them (None if there are to be none)."""
    caps = _Caps(np.zeros((0, 3)), np.zeros(0))
    plans: list[FramePlan] = []
    faint: list[Stars] = []
    for index in range(options.frames):
        rng = np.random.default_rng([options.seed, index, 0])
        blank = _blank_plan(index, options, rng)
        filled = options.deep and bool(blank.camera.faint_mags)
        target = _target(options, rng)
        most = options.max_stars if blank.camera.faint_mags else options.max_stars_wide
        plan = _point(blank, sky, caps, (0, target) if filled else (options.min_stars, most), rng)
        caps = caps.add(plan.apriori[2], _patch_radius(plan.camera))
        if filled:
            extra = _faint_stars(plan, target - int(detectable(plan).sum()), rng)
            faint.append(extra)
            stars = join_stars([plan.stars, extra])
            plan = replace(plan, stars=stars, directions=apparent_directions(stars, plan.observer))
        plans.append(plan)
    return plans, join_stars(faint) if faint else None
