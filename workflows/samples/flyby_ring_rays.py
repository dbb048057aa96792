"""Compiled loops of the flyby sample's rings: what a line of sight meets in the ring plane, and how bright it is.

Ring-plane axes are node, its normal and pole. Everything that changes with the radius is averaged over the stretch of
radii that a sample covers, in closed form: an edge inside the stretch counts with the share on either side, so that
few samples per pixel place edges to a thousandth of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from workflows.samples.cameras import FloatArray

LONGITUDES = 4096
"""Rows of the table of edges: linear between them, twelve waves of a kilometre are good to 5e-5 km."""
GRAZING = 1e-4
"""Cosines nearer than this take the limit of light that goes in and out at one angle."""


class RingDisc(NamedTuple):
    """The rings of a frame, ready for the loops.

    Attributes
    ----------
    eye
        (3,) spacecraft in ring-plane axes, km, at the time of the exposure.
    from_camera, from_planet
        (3, 3) turn directions of the camera, and of the planet's body-fixed axes, into ring-plane axes.
    drift
        (3,) velocity of the spacecraft from the planet over that of light: by this aberration every point is displaced.
    sun
        (3,) unit vector to the Sun.
    inverse_radii, sun_radius
        (3,) of the planet, 1/km, and the Sun's apparent radius, rad.
    edges
        (LONGITUDES + 1, n) radii of all edges, km, rising; the last row repeats the first.
    tau, scatter, grain, broad
        (n + 1,) between them: normal optical depth, albedo times phase function over four, rms of undulations, and
        whether spokes can be there.
    undulation, undulation_step
        (m,) integral over the radius of undulations of unit rms, from zero on, in steps of so many km.
    waves
        (k, 5) radius, arms, phase, scale (km, after which a phase has gained half a radian) and relative amplitude of
        density waves that run outward.
    spokes
        (k, 6) inner and outer radius, longitude, half width (rad), shear (rad/km) and relative brightness.
    propellers
        (k, 5) radius, longitude, half width and half length (km), and relative strength.
    """

    eye: FloatArray
    from_camera: FloatArray
    from_planet: FloatArray
    drift: FloatArray
    sun: FloatArray
    inverse_radii: FloatArray
    sun_radius: float
    edges: FloatArray
    tau: FloatArray
    scatter: FloatArray
    grain: FloatArray
    broad: FloatArray
    undulation: FloatArray
    undulation_step: float
    waves: FloatArray
    spokes: FloatArray
    propellers: FloatArray


@numba.njit(cache=True, inline="always")
def in_plane(d, x, y, z):  # type: ignore[no-untyped-def]
    """Distance (km) along a line of sight (camera frame) to the ring plane, the point (x, y) there, and the cosine.

    The distance is negative where the plane is not met.
    """
    length = np.sqrt(x * x + y * y + z * z)
    m = d.from_camera
    a = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / length - d.drift[0]
    b = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / length - d.drift[1]
    c = (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z) / length - d.drift[2]
    if c * d.eye[2] >= 0.0:
        return -1.0, 0.0, 0.0, 1.0
    way = -d.eye[2] / c
    return way, d.eye[0] + way * a, d.eye[1] + way * b, abs(c)


@numba.njit(cache=True, inline="always")
def lit_share(d, x, y, spread):  # type: ignore[no-untyped-def]
    """Share of the Sun that a point of the ring plane sees past the planet, averaged over so many km."""
    i = d.inverse_radii
    px, py = x * i[0], y * i[1]
    wx, wy, wz = d.sun[0] * i[0], d.sun[1] * i[1], d.sun[2] * i[2]
    along = -(px * wx + py * wy) / (wx * wx + wy * wy + wz * wz)
    if along <= 0.0:
        return 1.0
    px, py, pz = px + along * wx, py + along * wy, along * wz
    beyond = (np.sqrt(px * px + py * py + pz * pz) - 1.0) / i[0]
    half = along * d.sun_radius + 0.5 * spread
    return min(max(0.5 + 0.5 * beyond / half, 0.0), 1.0)


@numba.njit(cache=True, inline="always")
def scattered(tau, scatter, mu, mu0, lit):  # type: ignore[no-untyped-def]
    """Brightness of a layer that scatters once, seen from its lit or its unlit side."""
    if lit:
        return scatter * mu0 / (mu + mu0) * (1.0 - np.exp(-tau * (1.0 / mu + 1.0 / mu0)))
    if abs(mu - mu0) < GRAZING:
        return scatter * tau / mu * np.exp(-tau / mu)
    return scatter * mu0 / (mu - mu0) * (np.exp(-tau / mu) - np.exp(-tau / mu0))


@numba.njit(cache=True, inline="always")
def edge_at(d, longitude, k):  # type: ignore[no-untyped-def]
    """Radius of an edge at a longitude in [0, 2 pi)."""
    place = longitude * (LONGITUDES / (2.0 * np.pi))
    row = min(int(place), LONGITUDES - 1)
    share = place - row
    return (1.0 - share) * d.edges[row, k] + share * d.edges[row + 1, k]


@numba.njit(cache=True, inline="always")
def first_edge(d, longitude, radius):  # type: ignore[no-untyped-def]
    """Index of the innermost edge outside a radius; the number of edges if there is none."""
    low, high = 0, d.edges.shape[1]
    while low < high:
        middle = (low + high) // 2
        if edge_at(d, longitude, middle) > radius:
            high = middle
        else:
            low = middle + 1
    return low


@numba.njit(cache=True)
def _undulation(d, low, high):  # type: ignore[no-untyped-def]
    """Mean of the undulations over a stretch of radii."""
    step, last = d.undulation_step, len(d.undulation) - 2
    i, j = min(int(low / step), last), min(int(high / step), last)
    a = d.undulation[i] + (low / step - i) * (d.undulation[i + 1] - d.undulation[i])
    b = d.undulation[j] + (high / step - j) * (d.undulation[j + 1] - d.undulation[j])
    return (b - a) / (high - low)


@numba.njit(cache=True, inline="always")
def _wrapped(angle):  # type: ignore[no-untyped-def]
    """An angle between -3 pi and 3 pi brought to within pi of zero."""
    return angle - 2.0 * np.pi if angle > np.pi else angle + 2.0 * np.pi if angle < -np.pi else angle


@numba.njit(cache=True)
def _texture(d, region, low, high, longitude):  # type: ignore[no-untyped-def]
    """Factors on optical depth and on brightness between two radii that no catalogue tells."""
    depth, shade = 1.0, 1.0
    if d.grain[region] <= 0.0:
        return depth, shade
    depth += d.grain[region] * _undulation(d, low, high)
    radius, width = 0.5 * (low + high), high - low
    for k in range(len(d.waves)):
        out = (radius - d.waves[k, 0]) / d.waves[k, 3]
        if 0.0 < out < 5.0:
            # A wave shorter than the stretch of radii averages out.
            blur = out * width / d.waves[k, 3]
            damped = d.waves[k, 4] * min(2.0 * out, 1.0) * np.exp(-out * out / 6.25 - blur * blur / 24.0)
            depth += damped * np.cos(d.waves[k, 1] * longitude + d.waves[k, 2] + 0.5 * out * out)
    for k in range(len(d.propellers)):
        out, size = radius - d.propellers[k, 0], d.propellers[k, 2]
        if abs(out) < 4.0 * (size + width):
            out /= np.sqrt(size * size + width * width / 12.0)
            ahead = _wrapped(longitude - d.propellers[k, 1]) * radius / d.propellers[k, 3]
            # Two lobes: ahead on the inner side, behind on the outer one.
            lobe = np.exp(-0.5 * ((out + 1.2) ** 2 + (ahead - 1.0) ** 2))
            lobe += np.exp(-0.5 * ((out - 1.2) ** 2 + (ahead + 1.0) ** 2))
            depth += d.propellers[k, 4] * lobe * size / max(size, width)
    if d.broad[region] > 0.0:
        for k in range(len(d.spokes)):
            inner, outer = d.spokes[k, 0], d.spokes[k, 1]
            if inner < radius < outer:
                middle = 0.5 * (inner + outer)
                turn = _wrapped(longitude - d.spokes[k, 2] - d.spokes[k, 4] * (radius - middle)) / d.spokes[k, 3]
                if abs(turn) < 5.0:
                    near = (radius - inner) * (outer - radius) / (middle - inner) ** 2
                    shade += d.spokes[k, 5] * near * near * np.exp(-0.5 * turn * turn)
    return max(depth, 0.0), max(shade, 0.0)


@numba.njit(cache=True)
def ring_light(d, radius, longitude, width, mu, mu0, lit, behind):  # type: ignore[no-untyped-def]
    """Light of a stretch of radii under the whole Sun, and the share of what lies behind that they let through.

    The share is worked out only if something lies behind.
    """
    low, high = radius - 0.5 * width, radius + 0.5 * width
    count = d.edges.shape[1]
    light, through = 0.0, 0.0
    k, start = first_edge(d, longitude, low), low
    while True:
        stop = high if k == count else min(edge_at(d, longitude, k), high)
        share = (stop - start) / width
        if share > 0.0 and d.tau[k] > 0.0:
            tau = d.tau[k]
            depth, shade = _texture(d, k, start, stop, longitude)
            light += share * shade * scattered(tau * depth, d.scatter[k], mu, mu0, lit)
            through += share * np.exp(-tau * depth / mu) if behind else 0.0
        else:
            through += share
        start = stop
        if k == count or stop >= high:
            return light, through
        k += 1


@numba.njit(cache=True)
def turned_longitude(x, y):  # type: ignore[no-untyped-def]
    """Longitude in [0, 2 pi) of a point in the ring plane."""
    longitude = np.arctan2(y, x)
    longitude = longitude + 2.0 * np.pi if longitude < 0.0 else longitude
    return min(longitude, 2.0 * np.pi * (1.0 - 1e-15))


@numba.njit(cache=True)
def sun_through_rings(d, x, y, z, spread):  # type: ignore[no-untyped-def]
    """Share of sunlight that reaches a point of the planet, body-fixed axes in km, through the rings."""
    m = d.from_planet
    a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
    b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
    c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
    way = -c / d.sun[2]
    if way <= 0.0:
        return 1.0
    a, b = a + way * d.sun[0], b + way * d.sun[1]
    mu0 = abs(d.sun[2])
    spread += 2.0 * way * d.sun_radius
    _, through = ring_light(d, np.sqrt(a * a + b * b), turned_longitude(a, b), spread, mu0, mu0, True, True)
    return through
