"""Light of one frame of rings of the flyby sample, with planet and moons before, in and behind them.

Every pixel has four cells. The light of a cell is an average over its area; the optics and the pixels then spread it
from the cell's middle by a Gaussian that is narrower by the cell's own variance, so that the sum has the width of the
camera's point spread function.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy.special import ndtr

from workflows.samples.cameras import FloatArray, SampleCamera
from workflows.samples.flyby_rays import Spheres, approach, meet, surface_light
from workflows.samples.flyby_render import BORDER_PX, EDGE_PX, Light, directions, with_wings
from workflows.samples.flyby_ring_rays import (
    RingDisc,
    edge_at,
    first_edge,
    in_plane,
    lit_share,
    ring_light,
    sun_through_rings,
    turned_longitude,
)

CELL_VARIANCE = 0.25 / 12.0
"""Of an even cell half a pixel wide, px^2."""
BENT, VERY_BENT = 0.1, 0.5
"""Second over first difference of the radius across a pixel above which pixels get 4, and 8, samples a side."""
SMALL_PX = 30.0
"""Bodies of a smaller radius get all samples everywhere."""


class Cells(NamedTuple):
    """Light (2, 2, rows, columns) of the cells of a bordered canvas: all of it, and of smooth grey bodies alone.

    rings (rows, columns) is the light of the rings alone, by pixels.
    """

    total: FloatArray
    bodies: FloatArray
    rings: FloatArray


def cell_kernels(sigma_px: float) -> tuple[FloatArray, FloatArray]:
    """Return what the two cells of a pixel give its neighbours along one axis, (2, taps), and its derivatives."""
    sigma = np.sqrt(sigma_px**2 - CELL_VARIANCE)
    reach = int(np.ceil(4.2 * sigma_px + 1.0))
    place, pixel = np.array([-0.25, 0.25])[:, None], np.arange(-reach, reach + 1)[None, :]
    upper, lower = (pixel + 0.5 - place) / sigma, (pixel - 0.5 - place) / sigma
    share = ndtr(upper) - ndtr(lower)
    share /= share.sum(axis=1, keepdims=True)
    slope = -(np.exp(-0.5 * upper**2) - np.exp(-0.5 * lower**2)) / (np.sqrt(2.0 * np.pi) * sigma)
    # Each cell is half of its pixel along an axis.
    return 0.5 * share, 0.5 * slope


@numba.njit(cache=True)
def body_at(s, d, near, planet, x, y, z, spread):  # type: ignore[no-untyped-def]
    """Distance (km) to the middle of the first body's chord on a line of sight, -1 for none; its light, and smooth."""
    for k in range(len(near)):
        if not near[k]:
            continue
        qx, qy, qz, angle, edge = approach(s, k, x, y, z)
        if angle > edge:
            continue
        rough, smooth, mu0 = surface_light(s, k, qx, qy, qz, angle, edge)
        inverse = s.inverse_radii[k]
        if k == planet and mu0 > -0.5:
            ux, uy, uz = meet(s, k, qx, qy, qz, angle, edge)
            sun = sun_through_rings(d, ux / inverse[0], uy / inverse[1], uz / inverse[2], spread)
            rough, smooth = rough * sun, smooth * sun
        m = s.from_camera[k]
        length = np.sqrt(x * x + y * y + z * z)
        a = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / length
        b = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / length
        c = (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z) / length
        along = -(s.eye[k, 0] * a + s.eye[k, 1] * b + s.eye[k, 2] * c) / (a * a + b * b + c * c)
        return along, rough, smooth
    return -1.0, 0.0, 0.0


@numba.njit(cache=True)
def bodies_near(s, v, u, x, y, z, near):  # type: ignore[no-untyped-def]
    """Mark the bodies that a pixel may show; whether any is met, and whether a limb runs near."""
    met, limb = False, False
    for k in range(len(s.law)):
        near[k] = (v - s.centre_vu[k, 0]) ** 2 + (u - s.centre_vu[k, 1]) ** 2 <= s.reach_px[k] ** 2
        if near[k]:
            _, _, _, angle, edge = approach(s, k, x, y, z)
            outside = (angle / edge - 1.0) * s.radius_px[k]
            near[k] = outside < EDGE_PX
            met = met or outside < EDGE_PX
            limb = limb or (near[k] and (abs(outside) < EDGE_PX or s.radius_px[k] < SMALL_PX))
    return met, limb


@numba.njit(cache=True, inline="always")
def _in_reach(centre_vu, reach_px, v, u):  # type: ignore[no-untyped-def]
    """Whether any body's light can fall on a pixel; handing all of the bodies to a function costs more than this."""
    for k in range(len(reach_px)):
        if (v - centre_vu[k, 0]) ** 2 + (u - centre_vu[k, 1]) ** 2 <= reach_px[k] ** 2:
            return True
    return False


@numba.njit(cache=True)
def radius_grid(d, across):  # type: ignore[no-untyped-def]
    """Radius (rows, columns) at which each of some directions (x/z, y/z) meets the ring plane, -1 where it does not."""
    radii = np.empty(across.shape[:2])
    for i in range(radii.shape[0]):
        for j in range(radii.shape[1]):
            way, a, b, _ = in_plane(d, across[i, j, 0], across[i, j, 1], 1.0)
            radii[i, j] = np.sqrt(a * a + b * b) if way > 0.0 else -1.0
    return radii


@numba.njit(cache=True, inline="always")
def radius_slopes(radii, i, j):  # type: ignore[no-untyped-def]
    """Change of the radius (km) along v and u across an element of a grid, and the largest second difference.

    All are zero where a neighbour does not meet the plane.
    """
    here, up, down, left, right = radii[i, j], radii[i - 1, j], radii[i + 1, j], radii[i, j - 1], radii[i, j + 1]
    if min(here, up, down, left, right) < 0.0:
        return 0.0, 0.0, 0.0
    bend = max(abs(up - 2.0 * here + down), abs(left - 2.0 * here + right))
    return 0.5 * (down - up), 0.5 * (right - left), bend


@numba.njit(cache=True, inline="always")
def _sample(d, x, y, width, reached, body):  # type: ignore[no-untyped-def]
    """Light of one line of sight, of its smooth body alone, and of the rings alone; body is what it meets."""
    distance, rough, smooth = body
    if not reached:
        return rough, smooth, 0.0
    way, a, b, mu = in_plane(d, x, y, 1.0)
    if way <= 0.0 or 0.0 < distance < way:
        return rough, smooth, 0.0
    mu0, lit = abs(d.sun[2]), d.sun[2] * d.eye[2] > 0.0
    radius, longitude, behind = np.sqrt(a * a + b * b), turned_longitude(a, b), distance > 0.0
    light, through = ring_light(d, radius, longitude, width, mu, mu0, lit, behind)
    sun = lit_share(d, a, b, width)
    return sun * light + through * rough, through * smooth, sun * light


@numba.njit(cache=True, inline="always")
def _is_even(d, here, radius, reach):  # type: ignore[no-untyped-def]
    """Whether neither an edge nor the shadow's rim comes nearer to a pixel than a stretch of radii."""
    _, a, b, _ = in_plane(d, here[0], here[1], 1.0)
    longitude = turned_longitude(a, b)
    k = first_edge(d, longitude, radius - reach)
    if k < d.edges.shape[1] and edge_at(d, longitude, k) < radius + reach:
        return False
    sun = lit_share(d, a, b, 2.0 * reach)
    return sun <= 0.0 or sun >= 1.0


@numba.njit(cache=True)
def gather_cells(s, d, planet, across, radii, cells):  # type: ignore[no-untyped-def]
    """Sample every pixel of the canvas into its four cells.

    across holds the directions (x/z, y/z) of the canvas's pixels and of one more around it, (rows + 2, columns + 2, 2),
    and radii where they meet the ring plane.
    """
    near = np.zeros(len(s.law), np.bool_)
    inner, outer = d.edges[:, 0].min(), d.edges[:, -1].max()
    for row in range(cells.rings.shape[0]):
        for column in range(cells.rings.shape[1]):
            here, radius = across[row + 1, column + 1], radii[row + 1, column + 1]
            met, limb = False, False
            if _in_reach(s.centre_vu, s.reach_px, row - BORDER_PX, column - BORDER_PX):
                met, limb = bodies_near(s, row - BORDER_PX, column - BORDER_PX, here[0], here[1], 1.0, near)
            slope_v, slope_u, bend = radius_slopes(radii, row + 1, column + 1)
            slope = max(np.sqrt(slope_v * slope_v + slope_u * slope_u), 1e-9)
            reach = slope + 0.5 * bend
            reached = radius > 0.0 and inner - reach < radius < outer + reach
            if not (met or reached):
                continue
            n = 8
            if not limb:
                n = 2 if bend < BENT * slope else 4 if bend < VERY_BENT * slope else 8
                if not reached or _is_even(d, here, radius, 0.6 * slope + 0.5 * bend):
                    n = 1
            down = 0.5 * (across[row + 2, column + 1] - across[row, column + 1])
            right = 0.5 * (across[row + 1, column + 2] - across[row + 1, column])
            body = (-1.0, 0.0, 0.0)
            if met and not limb:
                body = body_at(s, d, near, planet, here[0], here[1], 1.0, slope)
            for i in range(n):
                for j in range(n):
                    pv, pu = (i + 0.5) / n - 0.5, (j + 0.5) / n - 0.5
                    x = here[0] + pv * down[0] + pu * right[0]
                    y = here[1] + pv * down[1] + pu * right[1]
                    if limb:
                        body = body_at(s, d, near, planet, x, y, 1.0, slope)
                    light, smooth, own = _sample(d, x, y, slope / n, reached, body)
                    cells.rings[row, column] += own / (n * n)
                    if n == 1:
                        cells.total[:, :, row, column] = light
                        cells.bodies[:, :, row, column] = smooth
                    else:
                        cells.total[2 * i // n, 2 * j // n, row, column] += 4.0 / (n * n) * light
                        cells.bodies[2 * i // n, 2 * j // n, row, column] += 4.0 / (n * n) * smooth


@numba.njit(cache=True)
def _spread_along_u(cells, kernel):  # type: ignore[no-untyped-def]
    """Spread cells (2, 2, rows, columns) along u through a kernel (2, taps); (2, rows, columns) are left."""
    _, _, rows, columns = cells.shape
    out = np.zeros((2, rows, columns))
    reach = kernel.shape[1] // 2
    for a in range(2):
        for i in range(rows):
            for b in range(2):
                for tap in range(kernel.shape[1]):
                    step, weight = tap - reach, kernel[b, tap]
                    for j in range(max(0, step), min(columns, columns + step)):
                        out[a, i, j] += weight * cells[a, b, i, j - step]
    return out


@numba.njit(cache=True)
def _spread_along_v(halves, kernel):  # type: ignore[no-untyped-def]
    """Spread half-pixel rows (2, rows, columns) along v through a kernel (2, taps)."""
    _, rows, columns = halves.shape
    out = np.zeros((rows, columns))
    reach = kernel.shape[1] // 2
    for a in range(2):
        for tap in range(kernel.shape[1]):
            step, weight = tap - reach, kernel[a, tap]
            for i in range(max(0, step), min(rows, rows + step)):
                for j in range(columns):
                    out[i, j] += weight * halves[a, i - step, j]
    return out


def gather_ring_light(camera: SampleCamera, wings: tuple[float, float], spheres: Spheres, disc: RingDisc) -> Light:
    """Return the light that a camera gathers from rings and bodies; its target is the rings, its shifts the bodies'.

    Parameters
    ----------
    wings
        Share and sigma (px) of the broad part of the point spread function.
    spheres
        Planet and moons as the camera sees them, the planet being their target.
    disc
        The rings.
    """
    canvas = (camera.shape_vu[0] + 2 * BORDER_PX, camera.shape_vu[1] + 2 * BORDER_PX)
    cells = Cells(np.zeros((2, 2, *canvas)), np.zeros((2, 2, *canvas)), np.zeros(canvas))
    across = directions(camera)
    gather_cells(spheres, disc, spheres.target, across, radius_grid(disc, across), cells)
    share, slope = cell_kernels(camera.psf_sigma_px)
    total = _spread_along_v(_spread_along_u(cells.total, share), share)
    shift_v, shift_u = np.zeros_like(total), np.zeros_like(total)
    if cells.bodies.any():
        shift_v = _spread_along_v(_spread_along_u(cells.bodies, share), slope)
        shift_u = _spread_along_v(_spread_along_u(cells.bodies, slope), share)
    frame = tuple(slice(BORDER_PX, BORDER_PX + size) for size in camera.shape_vu)
    core = 1.0 - wings[0]
    return Light(
        with_wings(total, wings)[frame], core * shift_v[frame], core * shift_u[frame], cells.rings[frame].copy()
    )
