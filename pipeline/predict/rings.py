"""Rings in or near the field: which edges the camera should see, how bright their sides are, and their lines."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.camera import project
from pipeline.geometry.pointing import corrected_attitude
from pipeline.geometry.rings import TURN, edges_of, meets, ring_forms, seen_curve
from pipeline.imaging.render import RayGrid, Window, ray_grid
from pipeline.imaging.ring_light import profile_image
from pipeline.options import Options
from pipeline.predict.bodies import reach_px
from pipeline.records import BoolArray, FloatArray, Image, Record, RingFeature, RingKind, RingSystem, State

_SAMPLES = 2048
# Optical depth of a ring of which nobody says it, and least optical depth that counts as a ring.
_USUAL_TAU, _LEAST_TAU = 1.0, 1e-4
_SMALL_CHANGE = 1e-3
_CANVAS_SKY_PX = 24
# Nearer to the plane than this (sine of the opening) the rings are a line.
_EDGE_ON = 2e-3
# Samples of a turn; samples inside a window that are enough, and pixels between them that are fine enough.
_COARSE, _ENOUGH, _FINE_PX = 720, 120, 2.0
_STRAIGHT_PX = 1.0
# Share of edges before the sky that is enough to judge places by them alone: discs have structure of their own.
_SKY_ENOUGH = 0.25
# Pixels kept free around planets, moons and shadows.
_BODY_PAD_PX = 5.0


class RingPredictionOptions(Options):
    """Which edges are worth predicting."""

    max_sigma_px: float = Field(
        10.0, gt=0, le=1000, description="catalogue 1 sigma of an edge's radius, in pixels, beyond which it is left out"
    )
    min_separation_sigma: float = Field(
        0.15, ge=0, le=10, description="separation of edges, in sigmas of the point spread, below which they are merged"
    )


@dataclass(frozen=True)
class RingFate:
    """One feature of the State's rings and why it is not used; ``reason`` is empty where it is.

    Attributes
    ----------
    name, kind
        Feature.
    visible_px
        Length of its edges inside the array under the a-priori pointing.
    straight
        Whether all of that departs from a straight line by less than a pixel.
    reason
        Empty, ``outside_field``, ``hidden``, ``radius_unknown``, ``merged``, ``too_fine`` or ``edge_on``.
    """

    name: str
    kind: str
    visible_px: float
    straight: bool
    reason: str


@dataclass(frozen=True, eq=False)
class RingPose(Record):
    """Camera and ring plane under one pointing.

    Attributes
    ----------
    turn
        (3, 3) ring frame from camera frame.
    observer_km
        (3,) camera, ring frame.
    camera_from_ring
        (3, 3).
    """

    turn: FloatArray
    observer_km: FloatArray

    @property
    def camera_from_ring(self) -> FloatArray:
        """(3, 3)."""
        return self.turn.T


@dataclass(frozen=True, eq=False)
class RingScene:
    """Edges of an image, sorted by radius.

    Attributes
    ----------
    state, rings
        Geometry.
    reach_vu
        Farthest that an edge can be from its prediction.
    sigma_px
        Core of the point spread.
    feature
        (n,) index of the feature of each edge.
    names, outer
        Per edge: feature's name; whether it is its outer edge.
    sigma_km
        (n,) catalogue 1 sigma of its feature's radius.
    curves
        (n, 2048) radius as seen in the plane over longitude.
    contrasts
        (n,) predicted light outside less inside, in units of the largest.
    unevenness
        (n,) how much of its contrast the light beside an edge changes by for a relative change of the optical depth.
    fates
        Every feature.
    rays
        Over the array widened by the reach.
    forms
        (m, 13) planet and moons, padded; empty without any near the rings.
    sun
        (3,) ring frame; zero where unknown.
    before_discs
        Whether nearly all that is in sight of the edges lies before a disc.
    """

    state: State
    rings: RingSystem | None
    reach_vu: tuple[int, int]
    sigma_px: float
    feature: NDArray[np.int64]
    names: tuple[str, ...]
    outer: BoolArray
    sigma_km: FloatArray
    curves: FloatArray
    contrasts: FloatArray
    unevenness: FloatArray
    fates: tuple[RingFate, ...]
    rays: RayGrid | None
    forms: FloatArray = field(default_factory=lambda: np.zeros((0, 13)))
    sun: FloatArray = field(default_factory=lambda: np.zeros(3))
    before_discs: bool = False

    def __len__(self) -> int:
        return len(self.curves)

    @property
    def means(self) -> FloatArray:
        """(n,) km, middle of each curve's range."""
        return np.asarray((self.curves.max(axis=1) + self.curves.min(axis=1)) / 2.0)

    @property
    def spread(self) -> FloatArray:
        """(n,) km, half of each curve's range."""
        return np.asarray((self.curves.max(axis=1) - self.curves.min(axis=1)) / 2.0)

    @property
    def origin(self) -> FloatArray:
        """(2,) pixel of the first ray of the grid."""
        assert self.rays is not None
        return np.array([self.rays.window.v0 - 16.0, self.rays.window.u0 - 16.0])

    def pose(self, offset_vu: FloatArray, rotation_rad: float) -> RingPose:
        """Camera and plane for a correction at the array centre."""
        assert self.rings is not None
        prior = self.state.attitude.camera_from_j2000
        attitude = corrected_attitude(self.state.camera_model, prior, offset_vu, rotation_rad)
        return RingPose(self.rings.plane_from_j2000 @ attitude.T, self.rings.observer_km)

    def draw(self, pose: RingPose, first_vu: FloatArray, step: float, shape: tuple[int, int], sigma: float) -> Image:
        """Predicted light at pixels ``first + step * (i, j)`` blurred by ``sigma`` pixels, unit contrast."""
        assert self.rays is not None
        out = np.zeros(shape)
        profile_image(
            self.rays.slopes, self.origin, pose.turn, pose.observer_km, first_vu, step, self.curves, self.means,
            self.spread, self.contrasts, sigma, self.forms, self.sun, out,
        )  # fmt: skip
        return np.asarray(out, np.float32)

    def radius_km(self, edge: int, longitude_rad: FloatArray) -> FloatArray:
        """(n,) radius of an edge's curve."""
        return self.radii_km(np.full(len(longitude_rad), edge), longitude_rad)

    def radii_km(self, edge: NDArray[np.int64], longitude_rad: FloatArray) -> FloatArray:
        """(n,) radii of edges' curves, each at a longitude."""
        count = self.curves.shape[1]
        at = longitude_rad * (count / TURN)
        low = np.floor(at).astype(np.int64)
        share = at - low
        return np.asarray(
            self.curves[edge, low % count] * (1.0 - share) + self.curves[edge, (low + 1) % count] * share
        )

    def place(self, pose: RingPose, edge: int, longitude_rad: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels of an edge's curve at longitudes, and which lie in front of the camera."""
        radius = self.radius_km(edge, longitude_rad)
        flat = np.zeros(len(radius))
        points = np.stack([radius * np.cos(longitude_rad), radius * np.sin(longitude_rad), flat], axis=1)
        return project(self.state.camera_model, (points - pose.observer_km) @ pose.turn)

    def project_points(self, pose: RingPose, points_km: FloatArray) -> FloatArray:
        """(n, 2) pixels of points of the ring frame, not-a-number behind the camera."""
        return project(self.state.camera_model, (points_km - pose.observer_km) @ pose.turn)[0]

    def hidden(self, pose: RingPose, edge: int, longitude_rad: FloatArray) -> BoolArray:
        """Which points of an edge lie behind a body or in a shadow."""
        radius = self.radius_km(edge, longitude_rad)
        points = np.stack([radius * np.cos(longitude_rad), radius * np.sin(longitude_rad), 0.0 * radius], axis=1)
        covered = meets(self.forms, pose.observer_km, points - pose.observer_km, np.ones(len(points)))
        if self.sun.any():
            covered |= meets(self.forms, points, np.broadcast_to(self.sun, points.shape))
        return covered


def single_scattering(tau: FloatArray, mu: float, mu0: float, lit: bool) -> FloatArray:
    """Light of a ring to first order of scattering, up to albedo and phase function.

    Chandrasekhar 1960, Radiative Transfer, section 9: reflected and transmitted light of a plane-parallel layer.

    Parameters
    ----------
    tau
        (n,) normal optical depth.
    mu, mu0
        Sines of the observer's and the Sun's elevation over the plane.
    lit
        Whether both are on the same side.

    Returns
    -------
    numpy.ndarray
        (n,).
    """
    if lit:
        return np.asarray(mu0 / (mu + mu0) * (1.0 - np.exp(-tau * (1.0 / mu + 1.0 / mu0))))
    if abs(mu - mu0) < 1e-4 * mu:
        return np.asarray(tau / mu * np.exp(-tau / mu))
    return np.asarray(mu0 / (mu - mu0) * (np.exp(-tau / mu) - np.exp(-tau / mu0)))


def predict_rings(state: State, sigma_px: float, options: RingPredictionOptions) -> RingScene:
    """Edges of the State's rings that can be in the field.

    Parameters
    ----------
    state
        Geometry.
    sigma_px
        Core of the point spread.
    options
        Limits.

    Returns
    -------
    RingScene
        Possibly without any.
    """
    rings, reach = state.rings, reach_px(state)
    nothing = RingScene(
        state, rings, reach, sigma_px, np.zeros(0, np.int64), (), np.zeros(0, bool), np.zeros(0),
        np.zeros((0, _SAMPLES)), np.zeros(0), np.zeros(0), (), None,
    )  # fmt: skip
    if rings is None or not rings.features:
        return nothing
    observer = rings.observer_km
    if abs(observer[2]) < _EDGE_ON * float(np.linalg.norm(observer)):
        fates = tuple(RingFate(f.name, f.kind.value, 0.0, True, "edge_on") for f in rings.features)
        return replace(nothing, fates=fates)
    scene = _all_edges(state, rings, reach, sigma_px)
    scene = _culled(_with_bodies(scene), options)
    return replace(scene, before_discs=_before_discs(scene))


def _all_edges(state: State, rings: RingSystem, reach: tuple[int, int], sigma_px: float) -> RingScene:
    rows, cols = state.camera_model.shape_vu
    canvas = Window(0, 0, rows, cols).grown(reach[0] + _CANVAS_SKY_PX, reach[1] + _CANVAS_SKY_PX)
    pairs = [(k, outer) for k, feature in enumerate(rings.features) for outer in edges_of(feature)]
    curves = np.array([seen_curve(rings.features[k], outer, rings.observer_km, _SAMPLES) for k, outer in pairs])
    order = np.argsort(curves.mean(axis=1), kind="stable")
    feature = np.array([k for k, _ in pairs])[order]
    outer = np.array([pairs[n][1] for n in order])
    sigma = np.array([rings.features[k].sigma_a_km or 0.0 for k in feature])
    contrasts, unevenness = (values[order] for values in _contrasts(rings))
    names = tuple(rings.features[k].name for k in feature)
    return RingScene(
        state, rings, reach, sigma_px, feature, names, outer, sigma, curves[order], contrasts, unevenness, (),
        ray_grid(state.camera_model, canvas),
    )  # fmt: skip


def _contrasts(rings: RingSystem) -> tuple[FloatArray, FloatArray]:
    """(n,) light outside less inside of every edge, in the order of features, and what texture does to it.

    What surrounds a gap is the narrowest ring around it, else the usual ring; what surrounds a ringlet the same, else
    nothing. An edge alone has its ring on one side and, likewise, what surrounds it on the other. A ring begins at an
    inner edge, and ends at the next single edge.
    """
    observer = rings.observer_km
    mu = abs(float(observer[2])) / float(np.linalg.norm(observer))
    mu0 = max(abs(float(np.sin(rings.opening_sun_rad))), 1e-3)
    lit = np.sign(observer[2]) == np.sign(rings.opening_sun_rad) or rings.opening_sun_rad == 0.0
    result: list[float] = []
    uneven: list[float] = []
    for feature in rings.features:
        gap = feature.kind is RingKind.GAP
        around = _around(rings, feature, _USUAL_TAU if gap else 0.0)
        own = feature.tau if feature.tau is not None else (0.0 if gap else max(_USUAL_TAU, 2.0 * around))
        tau = np.array([own, around])
        light = single_scattering(tau, mu, mu0, bool(lit))
        denser = single_scattering(tau * (1.0 + _SMALL_CHANGE), mu, mu0, bool(lit))
        step = float(light[0] - light[1])
        if abs(step) < 1e-6:
            step = -1e-3 if gap else 1e-3
        signs = {RingKind.EDGE_INNER: (1.0,), RingKind.EDGE_OUTER: (-1.0,)}.get(feature.kind, (1.0, -1.0))
        result += [sign * step for sign in signs]
        uneven += [float(np.abs(denser - light).max()) / _SMALL_CHANGE / abs(step)] * len(signs)
    values = np.array(result)
    return np.asarray(values / np.abs(values).max()), np.array(uneven)


def _around(rings: RingSystem, feature: RingFeature, default: float) -> float:
    """Optical depth around a feature: of the narrowest ringlet that holds it, else of the ring that it lies in."""
    low, high = feature.a_km, feature.a_km + feature.width_km
    holders = [
        f for f in rings.features
        if f.kind is RingKind.RINGLET and f.width_km > feature.width_km
        and f.a_km <= low and high <= f.a_km + f.width_km
    ]  # fmt: skip
    if holders:
        tau = min(holders, key=lambda f: f.width_km).tau
        return default if tau is None else tau
    alone = [f for f in rings.features if f is not feature and f.kind in (RingKind.EDGE_INNER, RingKind.EDGE_OUTER)]
    before = max((f for f in alone if f.a_km <= low), key=lambda f: f.a_km, default=None)
    after = min((f for f in alone if f.a_km >= high), key=lambda f: f.a_km, default=None)
    ring = None
    if before is not None and before.kind is RingKind.EDGE_INNER and feature.kind is not RingKind.EDGE_OUTER:
        ring = before
    elif after is not None and after.kind is RingKind.EDGE_OUTER and feature.kind is not RingKind.EDGE_INNER:
        ring = after
    if ring is None:
        return default
    return _USUAL_TAU if ring.tau is None else ring.tau


def _with_bodies(scene: RingScene) -> RingScene:
    """Planet and moons that may hide or shade rings, with a few pixels around them."""
    rings, camera = scene.rings, scene.state.camera_model
    assert rings is not None
    scale = camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm)))
    pad = _BODY_PAD_PX * float(np.linalg.norm(rings.position_km)) / scale
    largest = float(scene.curves.max())
    near = []
    for body in scene.state.bodies:
        gap = body.position_km - rings.position_km
        if float(np.linalg.norm(gap)) < 1e-6 * float(np.linalg.norm(rings.position_km)) + 4.0 * largest or (
            float(np.linalg.norm(body.position_km)) < float(np.linalg.norm(rings.position_km))
        ):
            near.append(body)
    sun = rings.sun_direction_j2000
    if sun is None:
        sun = next((b.sun_direction_j2000 for b in near if b.name.upper() == rings.planet.upper()), None)
    direction = np.zeros(3) if sun is None else rings.plane_from_j2000 @ sun
    return replace(scene, forms=ring_forms(rings, tuple(near), pad), sun=np.asarray(direction))


def _culled(scene: RingScene, options: RingPredictionOptions) -> RingScene:
    """Leave out features that no pointing within the reach brings into the array, or that nothing can be told from."""
    rings = scene.rings
    assert rings is not None
    pose = scene.pose(np.zeros(2), 0.0)
    rows, cols = scene.state.camera_model.shape_vu
    canvas = Window(0, 0, rows, cols).grown(*scene.reach_vu)
    reasons: dict[int, str] = {}
    lengths: dict[int, float] = {}
    straight: dict[int, bool] = {}
    for edge in range(len(scene)):
        k = int(scene.feature[edge])
        near, inside, hidden, bow = _course(scene, pose, edge, canvas)
        lengths[k] = lengths.get(k, 0.0) + inside
        straight[k] = straight.get(k, True) and bow < _STRAIGHT_PX
        reason = "outside_field" if near == 0.0 else ("hidden" if hidden else "")
        # Where the plane is seen foreshortened the same kilometres are fewer pixels.
        narrow = _px_per_km(scene) * abs(float(pose.observer_km[2])) / float(np.linalg.norm(pose.observer_km))
        if not reason and scene.sigma_km[edge] * narrow > options.max_sigma_px:
            reason = "radius_unknown"
        reasons[k] = reasons.get(k) or reason
    reasons |= dict.fromkeys(_too_near(scene, reasons, options), "merged")
    fates = tuple(
        RingFate(f.name, f.kind.value, lengths[k], straight[k], reasons[k]) for k, f in enumerate(rings.features)
    )
    keep = np.array([not reasons[int(k)] for k in scene.feature], bool)
    return replace(
        scene, feature=scene.feature[keep], names=tuple(n for n, kept in zip(scene.names, keep, strict=True) if kept),
        outer=scene.outer[keep], sigma_km=scene.sigma_km[keep], curves=np.ascontiguousarray(scene.curves[keep]),
        contrasts=scene.contrasts[keep], unevenness=scene.unevenness[keep], fates=fates,
    )  # fmt: skip


def _before_discs(scene: RingScene) -> bool:
    """Whether of the samples of edges that are in sight only a small part lies before the sky."""
    if not len(scene.forms):
        return False
    pose = scene.pose(np.zeros(2), 0.0)
    rows, cols = scene.state.camera_model.shape_vu
    canvas = Window(0, 0, rows, cols).grown(*scene.reach_vu)
    sky = disc = 0
    for edge in range(len(scene)):
        longitude = visible_longitudes(scene, pose, edge, canvas)
        longitude = longitude[~scene.hidden(pose, edge, longitude)]
        radius = scene.radius_km(edge, longitude)
        points = np.stack([radius * np.cos(longitude), radius * np.sin(longitude), 0.0 * radius], axis=1)
        before = meets(scene.forms, pose.observer_km, points - pose.observer_km)
        sky, disc = sky + int((~before).sum()), disc + int(before.sum())
    return sky < _SKY_ENOUGH * (sky + disc)


def _px_per_km(scene: RingScene) -> float:
    camera, rings = scene.state.camera_model, scene.rings
    assert rings is not None
    scale = camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm)))
    return float(scale / np.linalg.norm(rings.position_km))


def _too_near(scene: RingScene, reasons: dict[int, str], options: RingPredictionOptions) -> set[int]:
    """Of features whose nearest edges cannot be told apart at any longitude, the one with the weaker contrast."""
    limit = options.min_separation_sigma * scene.sigma_px / _px_per_km(scene)
    left: set[int] = set()
    for n in range(len(scene) - 1):
        a, b = int(scene.feature[n]), int(scene.feature[n + 1])
        if a == b or reasons[a] or reasons[b]:
            continue
        if float(np.abs(scene.curves[n + 1] - scene.curves[n]).max()) < limit:
            left.add(a if abs(scene.contrasts[n]) < abs(scene.contrasts[n + 1]) else b)
    return left


def _course(scene: RingScene, pose: RingPose, edge: int, canvas: Window) -> tuple[float, float, bool, float]:
    """Of an edge: pixels inside the canvas, inside the array; whether all is hidden; its bow inside the array."""
    longitude = visible_longitudes(scene, pose, edge, canvas)
    if not len(longitude):
        return 0.0, 0.0, False, 0.0
    pixels, _ = scene.place(pose, edge, longitude)
    rows, cols = scene.state.camera_model.shape_vu
    inside = np.asarray(((pixels >= -0.5) & (pixels <= np.array([rows, cols]) - 0.5)).all(axis=1))
    steps = np.hypot(*np.diff(pixels, axis=0).T)
    near = float(steps[steps < 64.0].sum()) + 1.0
    hidden = scene.hidden(pose, edge, longitude)
    both = inside[1:] & inside[:-1] & ~hidden[1:] & ~hidden[:-1]
    within = float(steps[both].sum()) if len(steps) else 0.0
    return near, within, bool(hidden.all()), bow_px(pixels[inside])


def bow_px(places_vu: FloatArray) -> float:
    """Width of the narrowest strip along the main direction of places that holds them.

    Parameters
    ----------
    places_vu
        (n, 2) along a line.

    Returns
    -------
    float
        Pixels; zero for fewer than three.
    """
    if len(places_vu) < 3:
        return 0.0
    centred = places_vu - places_vu.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][1]
    return float(np.ptp(centred @ across))


def visible_longitudes(scene: RingScene, pose: RingPose, edge: int, window: Window) -> FloatArray:
    """Longitudes of an edge inside a window, finer where few of a coarse set are.

    Parameters
    ----------
    scene, pose, edge
        What to look at.
    window
        Pixels.

    Returns
    -------
    numpy.ndarray
        (n,) radians, increasing within each stretch.
    """
    low = np.array([window.v0, window.u0]) - 0.5
    high = low + np.array([window.rows, window.cols])
    middle, half = (low + high) / 2, float(np.hypot(*(high - low))) / 2
    step = TURN / _COARSE
    longitude: FloatArray = step * np.arange(_COARSE, dtype=float)
    while True:
        pixels, ahead = scene.place(pose, edge, longitude)
        inside = ahead & ((pixels >= low) & (pixels <= high)).all(axis=1)
        # A stretch may pass through a corner between two samples: look at those next to the window too.
        speed = 2.0 * np.hypot(*(scene.place(pose, edge, np.asarray(longitude + 0.5 * step))[0] - pixels).T)
        close = ahead & ~(np.hypot(*(pixels - middle).T) > half + speed)
        if inside.sum() >= _ENOUGH or not close.any() or float(np.nanmax(speed[close])) < _FINE_PX:
            break
        longitude = np.asarray(np.sort((longitude[close][:, None] + step * (np.arange(4) - 1.5) / 4.0).ravel()))
        step /= 4.0
    return np.asarray(longitude[inside])
