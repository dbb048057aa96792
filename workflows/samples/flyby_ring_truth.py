"""What is known of a frame of rings of the flyby sample, and how well anyone could find its offset."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from workflows.samples.attitude import wxyz_from_matrix
from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_expose import Scene, Taken
from workflows.samples.flyby_plan import Shot
from workflows.samples.flyby_rays import approach
from workflows.samples.flyby_render import BORDER_PX, directions
from workflows.samples.flyby_ring_plan import true_radii
from workflows.samples.flyby_ring_rays import (
    RingDisc,
    edge_at,
    first_edge,
    in_plane,
    lit_share,
    scattered,
    turned_longitude,
)
from workflows.samples.flyby_ring_render import radius_grid, radius_slopes
from workflows.samples.flyby_ring_scene import plane_from_j2000, sorted_edges
from workflows.samples.flyby_ring_system import FEATURES
from workflows.samples.flyby_system import see
from workflows.samples.flyby_truth import PRIOR_ROTATION_RAD, WEAKEST, rounded
from workflows.samples.write import Json

SHARED = 8
"""Unknowns that are no radii: three of the whole scene, three of the rings alone, brightness and background."""
CONVENTION = (
    "kind ring: cramer_rao_*: of the rings' edges and of smooth bodies, rings_alone: of the edges without bodies; "
    "both with an unknown radius of every feature within its sigma_a_km, an unknown brightness and background, and, "
    "where a rotation is fitted, its prior. observable_dv, observable_du: unit vector of the direction that is known "
    "best, whose sigma is *_along_px, the other direction's *_across_px; observable_directions: how many of them are "
    "below 0.5 px, of rings alone one at most where none of the edges departs from a straight line by a pixel "
    "(widest_bow_px); null: nothing is known. n_edges: edges whose own place could be found to 0.25 px; features: true "
    "a_km of theirs, that of a moved one included. opening_deg: from the ring plane to the spacecraft, "
    "opening_sun_deg: to the Sun, both positive to the north. kind ring_radius_trap: moved_feature lies moved_km "
    "beyond its own error"
)
WHOLE, RINGS = (0, 1, 2), (3, 4, 5)
BODIES_AND_LEVELS = (0, 1, 2, 6, 7)
REACH_SIGMA = 4.0
SEEN_PX = 0.25
"""An edge counts as seen if its own place along its normal could be found to this."""
OBSERVABLE_PX = 0.5
"""Directions whose Cramér-Rao sigma is smaller count as observable."""
STRAIGHT_PX = 1.0
"""Edges that depart less than this from a straight line tell one direction, as the navigator has it by its contract."""
NEAR_PX = 0.5
"""Distance from an edge of the pixels that tell its course."""
MOST = 24
"""Edges that are followed in one pixel."""


@numba.njit(cache=True)
def _hidden(spheres, way, x, y):  # type: ignore[no-untyped-def]
    """Whether a body stands before a point of the ring plane on a line of sight."""
    for k in range(len(spheres.law)):
        _, _, _, angle, edge = approach(spheres, k, x, y, 1.0)
        if angle < edge:
            m, eye = spheres.from_camera[k], spheres.eye[k]
            length = np.sqrt(x * x + y * y + 1.0)
            a = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / length
            b = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / length
            c = (m[2, 0] * x + m[2, 1] * y + m[2, 2]) / length
            if -(eye[0] * a + eye[1] * b + eye[2] * c) / (a * a + b * b + c * c) < way:
                return True
    return False


@numba.njit(cache=True)
def edge_slopes(s, d, here, radius, slope, sigma_px, factor, index, value):  # type: ignore[no-untyped-def]
    """Derivatives (DN per km) of a pixel's light with respect to the radii of the edges near.

    Edges' indices and derivatives are left in two arrays (MOST,); returns how many there are. slope is the change of
    the radius, km per pixel.
    """
    way, a, b, mu = in_plane(d, here[0], here[1], 1.0)
    longitude, reach = turned_longitude(a, b), REACH_SIGMA * sigma_px * slope
    k, found = first_edge(d, longitude, radius - reach), 0
    while k < d.edges.shape[1] and found < MOST:
        beyond = (radius - edge_at(d, longitude, k)) / slope
        if beyond < -REACH_SIGMA * sigma_px:
            break
        mu0, lit = abs(d.sun[2]), d.sun[2] * d.eye[2] > 0.0
        inside = scattered(d.tau[k], d.scatter[k], mu, mu0, lit)
        outside = scattered(d.tau[k + 1], d.scatter[k + 1], mu, mu0, lit)
        density = np.exp(-0.5 * (beyond / sigma_px) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_px)
        index[found], value[found] = k, factor * (inside - outside) * density / slope
        found += 1
        k += 1
    if found:
        light = 0.0 if _hidden(s, way, here[0], here[1]) else lit_share(d, a, b, slope)
        value[:found] *= light
    return found


@numba.njit(cache=True)
def _slope(radii, weight, i, j):  # type: ignore[no-untyped-def]
    """Change of the radius along v, along u and in all, km per pixel; the last is zero where a pixel does not count."""
    slope_v, slope_u, _ = radius_slopes(radii, i, j)
    return slope_v, slope_u, np.sqrt(slope_v * slope_v + slope_u * slope_u) if weight > 0.0 else 0.0


@numba.njit(cache=True)
def gather_information(s, d, across, radii, columns, weight, owner, sigma_px, factor, middle, features):  # type: ignore[no-untyped-def]
    """Information (n, n) on the shared unknowns and on the features' radii, and (edges,) on each edge's own place.

    columns are the derivatives (5, rows, columns) with respect to dv, du and rotation of the bodies, and brightness
    and background of the scene; their information among themselves is left out. weight is one over the variance, zero
    where a pixel does not count.
    """
    information = np.zeros((SHARED + features, SHARED + features))
    alone = np.zeros(d.edges.shape[1])
    index, value = np.zeros(MOST, np.int64), np.zeros(MOST)
    places, numbers = np.arange(SHARED + MOST), np.zeros(SHARED + MOST)
    for row in range(weight.shape[0]):
        for column in range(weight.shape[1]):
            i, j = row + BORDER_PX + 1, column + BORDER_PX + 1
            slope_v, slope_u, slope = _slope(radii, weight[row, column], i, j)
            if slope <= 0.0:
                continue
            found = edge_slopes(s, d, across[i, j], radii[i, j], slope, sigma_px, factor, index, value)
            if found == 0:
                continue
            own = 0.0
            for k in range(found):
                own += value[k]
                alone[index[k]] += weight[row, column] * (value[k] * slope) ** 2
                places[SHARED + k], numbers[SHARED + k] = SHARED + owner[index[k]], value[k]
            for k in range(5):
                numbers[BODIES_AND_LEVELS[k]] = columns[k, row, column]
            # The light depends on the radius less the edge's: rings that move along v carry it against the gradient.
            numbers[3], numbers[4] = own * slope_v, own * slope_u
            numbers[5] = numbers[3] * (column - middle[1]) - numbers[4] * (row - middle[0])
            for a in range(SHARED + found):
                whole = a < 3 or 6 <= a < SHARED
                for b in range(SHARED + found):
                    if not (whole and (b < 3 or 6 <= b < SHARED)):
                        information[places[a], places[b]] += weight[row, column] * numbers[a] * numbers[b]
    return information, alone


@numba.njit(cache=True)
def edge_places(s, d, across, radii, weight, places):  # type: ignore[no-untyped-def]
    """Points (n, 3: edge, row, column) of the edges in sight, one per pixel near them; returns their number."""
    count = 0
    for row in range(weight.shape[0]):
        for column in range(weight.shape[1]):
            i, j = row + BORDER_PX + 1, column + BORDER_PX + 1
            slope_v, slope_u, slope = _slope(radii, weight[row, column], i, j)
            if slope <= 0.0:
                continue
            here = across[i, j]
            way, a, b, _ = in_plane(d, here[0], here[1], 1.0)
            longitude = turned_longitude(a, b)
            k = first_edge(d, longitude, radii[i, j] - NEAR_PX * slope)
            while k < d.edges.shape[1] and count < len(places):
                beyond = (radii[i, j] - edge_at(d, longitude, k)) / slope
                if beyond < -NEAR_PX or _hidden(s, way, here[0], here[1]) or lit_share(d, a, b, slope) <= 0.5:
                    break
                places[count, 0] = k
                places[count, 1] = row - beyond * slope_v / slope
                places[count, 2] = column - beyond * slope_u / slope
                count += 1
                k += 1
    return count


def widest_bow(
    shot: Shot, scene: Scene, disc: RingDisc, useless: NDArray[np.bool_], edges: list[int]
) -> float:
    """Return the largest width (px) of the strips that just hold what is in sight of one of some edges each."""
    across = directions(shot.seen_with)
    places = np.zeros((useless.size, 3))
    count = edge_places(
        scene.spheres, disc, across, radius_grid(disc, across), np.where(useless, 0.0, 1.0), places
    )  # fmt: skip
    widest = 0.0
    for k in edges:
        own = places[:count][places[:count, 0] == k, 1:]
        if len(own) > 2:
            aside = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)[2][1]
            widest = max(widest, float(np.ptp(own @ aside)))
    return widest


def bound(information: FloatArray, moved: tuple[int, ...], prior: FloatArray) -> FloatArray:
    """Return the information (n, n) on some of the first unknowns that is left when all others have to be found too.

    Parameters
    ----------
    information
        As `gather_information` has it.
    moved
        Which of the first six unknowns are asked for; the others of these do not exist.
    prior
        (n,) information beforehand, in the order of all unknowns.
    """
    others = [k for k in range(6, len(information)) if information[k, k] > WEAKEST]
    full = information + np.diag(prior)
    keep = list(moved)
    cross, rest = full[np.ix_(keep, others)], full[np.ix_(others, others)]
    size = np.sqrt(np.diag(rest))
    inverse = np.linalg.pinv(rest / np.outer(size, size), rcond=1e-12, hermitian=True) / np.outer(size, size)
    left: FloatArray = full[np.ix_(keep, keep)] - cross @ inverse @ cross.T
    return left


def _translation(information: FloatArray, fits_rotation: bool) -> tuple[FloatArray, float | None]:
    """Return the information (2, 2) on the offset and the sigma (rad) of the rotation from that on all three."""
    if not fits_rotation:
        return information[:2, :2], None
    full = information + np.diag([0.0, 0.0, 1.0 / PRIOR_ROTATION_RAD**2])
    offset = full[:2, :2] - np.outer(full[:2, 2], full[:2, 2]) / full[2, 2]
    left = full[2, 2] - float(full[2, :2] @ np.linalg.pinv(full[:2, :2], rcond=1e-9, hermitian=True) @ full[:2, 2])
    return offset, float(1.0 / np.sqrt(max(left, WEAKEST)))


def _told(information: FloatArray, fits_rotation: bool, most: int) -> Json:
    """Return sigmas of the offset and which of its directions can be seen; a sigma is null where nothing is known."""
    offset, rotation = _translation(information, fits_rotation)
    values, vectors = np.linalg.eigh(offset)
    sigma = [float(1.0 / np.sqrt(v)) if v > 1e-8 else None for v in values]
    seen = sum(s is not None and s < OBSERVABLE_PX for s in sigma)
    # Where one direction is unknown so are both axes, unless it happens to be one of them.
    covariance = np.linalg.inv(offset) if all(s is not None for s in sigma) else None
    axes = [None, None] if covariance is None else [float(np.sqrt(x)) for x in np.diag(covariance)]
    return {
        "cramer_rao_sigma_dv_px": axes[0],
        "cramer_rao_sigma_du_px": axes[1],
        "cramer_rao_sigma_rotation_deg": None if rotation is None else float(np.degrees(rotation)),
        "observable_directions": min(int(seen), most),
        "observable_dv": round(float(vectors[0, 1]), 6),
        "observable_du": round(float(vectors[1, 1]), 6),
        "cramer_rao_sigma_along_px": sigma[1],
        "cramer_rao_sigma_across_px": sigma[0],
    }


def ring_information(shot: Shot, scene: Scene, disc: RingDisc, useless: NDArray[np.bool_]) -> tuple[FloatArray, ...]:
    """Return the information on all unknowns, that on each edge's own place (px^-2), and the prior."""
    optics = shot.camera.optics
    variance = optics.read_noise_dn**2 + np.maximum(scene.expected, 0.0) / optics.gain_e_per_dn
    v = np.arange(optics.shape_vu[0])[:, None] - optics.centre_vu[0]
    u = np.arange(optics.shape_vu[1])[None, :] - optics.centre_vu[1]
    turned = scene.shift_v * u - scene.shift_u * v
    columns = np.stack([scene.shift_v, scene.shift_u, turned, scene.scale, np.ones(optics.shape_vu)])
    owner = np.array([k for _, k in sorted_edges()])
    sigma = float(np.sqrt(optics.psf_sigma_px**2 + 1.0 / 12.0))
    factor = scene.factor * (1.0 - shot.camera.wings[0])
    across, weight = directions(shot.seen_with), np.where(useless, 0.0, 1.0 / variance)
    information, alone = gather_information(
        scene.spheres, disc, across, radius_grid(disc, across), columns, weight, owner, sigma, factor,
        optics.centre_vu, len(FEATURES),
    )  # fmt: skip
    flat = columns.reshape(len(columns), -1)
    information[np.ix_(BODIES_AND_LEVELS, BODIES_AND_LEVELS)] = (flat * weight.ravel()) @ flat.T
    # The whole scene moves as one: its derivatives are the bodies' and the rings' together.
    together = np.eye(len(information))
    together[:3, 3:6] = np.eye(3)
    information = together @ information @ together.T
    prior = np.concatenate([np.zeros(SHARED), [1.0 / f.sigma_a_km**2 for f in FEATURES]])
    return information, alone, prior


def _openings(shot: Shot) -> tuple[float, float, float, float]:
    """Return opening seen and lit (deg), phase (deg) and km per pixel at the point that the camera looks at."""
    planet = see(shot.bodies[0], shot.et, shot.position_km, shot.velocity_kms)
    turn = plane_from_j2000()
    aim = np.zeros(3) if shot.ring is None else shot.ring.aim_km
    back = -(turn @ planet.place_km + aim)
    distance = float(np.linalg.norm(back))
    sun = turn @ planet.sun
    phase = np.arccos(np.clip(back @ sun / distance, -1.0, 1.0))
    opening, lit = np.arcsin(back[2] / distance), np.arcsin(sun[2])
    scale = distance * shot.camera.optics.rad_per_px
    return float(np.degrees(opening)), float(np.degrees(lit)), float(np.degrees(phase)), scale


def ring_truth_entry(shot: Shot, scene: Scene, disc: RingDisc, taken: Taken) -> Json:
    """Return the entry of truth.json of a frame of rings."""
    information, alone, prior = ring_information(shot, scene, disc, taken.useless)
    edges = sorted_edges()
    seen = [n for n, info in enumerate(alone) if info > 1.0 / SEEN_PX**2]
    names = list(dict.fromkeys(FEATURES[edges[n][1]].name for n in seen))
    opening, lit, phase, scale = _openings(shot)
    fits = shot.camera.optics.fit_camera_rotation
    radii = true_radii(shot.seed)
    entry: Json = {
        "offset_dv_px": float(shot.offset_vu[0]),
        "offset_du_px": float(shot.offset_vu[1]),
        "rotation_deg": float(np.degrees(shot.rotation_rad)),
        "camera": shot.camera.name,
        "target": shot.target,
        "kind": shot.kind,
        "opening_deg": round(opening, 3),
        "opening_sun_deg": round(lit, 3),
        "lit_side": opening * lit > 0.0,
        "phase_deg": round(phase, 3),
        "km_per_px": round(scale, 4),
        "snr": round(scene.snr, 3),
    }
    bow = widest_bow(shot, scene, disc, taken.useless, seen)
    most = 1 if bow < STRAIGHT_PX else 2
    entry |= _told(bound(information, WHOLE, prior), fits, 2 if scene.bodies else most)
    entry["rings_alone"] = _told(bound(information, RINGS, prior), fits, most)
    entry["widest_bow_px"] = round(bow, 3)
    entry |= {
        "n_edges": len(seen),
        "n_features": len(names),
        "features": {
            name: round(radii[name] + (shot.ring.moved_km if shot.ring and shot.ring.moved == name else 0.0), 4)
            for name in names
        },
        "moved_feature": shot.ring.moved if shot.ring and shot.ring.moved else None,
        "moved_km": shot.ring.moved_km if shot.ring else 0.0,
        "n_bodies_in_frame": len(scene.bodies),
        "bodies": {
            name: {"centre_vu": rounded(place), "diameter_px": round(diameter, 3)}
            for name, (place, diameter) in sorted(scene.bodies.items())
        },
        "n_stars": 0,
        "exposure_s": shot.exposure_s,
        "missing_lines": taken.missing_lines,
        "useless_px": int(taken.useless.sum()),
        "true_camera_from_j2000_wxyz": [float(x) for x in wxyz_from_matrix(shot.truth)],
    }
    return entry


def told_features(seed: int) -> Json:
    """Return catalogue radius, its sigma and the true radius (km) of every feature."""
    radii = true_radii(seed)
    return {f.name: {"a_km": f.a_km, "sigma_a_km": f.sigma_a_km, "true_a_km": radii[f.name]} for f in FEATURES}
