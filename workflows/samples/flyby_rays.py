"""Compiled loops of the flyby sample: what one line of sight meets, and the samples of every pixel.

Each body is seen in its own scaled axes, in which the ellipsoid is the unit sphere and the surface stands at
1 + h(latitude, longitude) from the centre. Every line of sight from the eye lies in a half-plane through the axis
eye - centre, and in each half-plane the outermost direction that touches the surface is looked up in a table: the
silhouette is that of the rough body itself. Inside it the point that is met is found by substitution.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from workflows.samples.cameras import FloatArray

MapArray = NDArray[np.float32]

STEP_DEG = 0.25
"""Cells of the maps of heights and albedo."""
PAD = 2
"""Rows and columns of the maps beyond their edges, as cubic interpolation wants them."""
LAWS = ("lambert", "lommel_seeliger", "lunar_lambert")
SILHOUETTE = 2048
"""Position angles of a table, 0.18 deg apart: eleven to the shortest wavelength of the heights."""
GRAZING_STEP_RAD = np.radians(0.2)
SUB = 8
"""Samples per pixel and axis where something ends inside the pixel."""
HAZE_HEIGHTS = 12.0
"""Scale heights above which an atmosphere is not followed."""
SHALLOWEST = 0.02
"""Least cosine of emission that a bent surface shows."""


class Spheres(NamedTuple):
    """Bodies, ready for the loops, nearest first; arrays begin with one entry per body.

    Attributes
    ----------
    eye
        (n, 3) spacecraft in the body's scaled axes.
    from_camera
        (n, 3, 3) turns camera-frame directions into scaled axes.
    axes
        (n, 3, 3) rows: two directions across the line of sight, and the one toward the centre.
    sun
        (n, 3) direction of the Sun in body-fixed axes.
    inverse_radii
        (n, 3) 1/km.
    silhouette
        (n, SILHOUETTE + 3) largest angle from the line to the centre at which the body is met, by position angle.
    centre_vu, radius_px, reach_px
        (n, 2) pixel of the centre, (n,) apparent mean radius, and (n,) how far from the centre any of its light falls.
    highest
        (n,) largest height.
    law, parameter, brightness
        (n,) index into `LAWS`, the law's parameter, and a factor.
    haze
        (n, 3) scale height over the radius, slant depth at the limb, and its brightness.
    shades, shade_centres
        (n, m, 3, 3) and (n, m, 3): bodies that may shade this one, each by the matrix that takes km of the body-fixed
        axes to its own unit sphere and by its centre there; zero where there are fewer than m.
    heights, albedo
        (n, rows, columns) maps.
    target
        Index of the body that the frame is about.
    """

    eye: FloatArray
    from_camera: FloatArray
    axes: FloatArray
    sun: FloatArray
    inverse_radii: FloatArray
    silhouette: FloatArray
    centre_vu: FloatArray
    radius_px: FloatArray
    reach_px: FloatArray
    highest: FloatArray
    law: NDArray[np.int64]
    parameter: FloatArray
    brightness: FloatArray
    haze: FloatArray
    shades: FloatArray
    shade_centres: FloatArray
    heights: MapArray
    albedo: MapArray
    target: int


@numba.njit(cache=True, inline="always")
def _dot(m, x, y, z):  # type: ignore[no-untyped-def]
    """Scalar product of a row (3,) with a vector."""
    return m[0] * x + m[1] * y + m[2] * z


@numba.njit(cache=True, inline="always")
def _turned(m, x, y, z):  # type: ignore[no-untyped-def]
    """Matrix (3, 3) times a vector; vectors are three numbers here, since small arrays cost more than the work."""
    return _dot(m[0], x, y, z), _dot(m[1], x, y, z), _dot(m[2], x, y, z)


@numba.njit(cache=True, inline="always")
def _normal(inverse, x, y, z):  # type: ignore[no-untyped-def]
    """Unit normal in body-fixed axes of a surface whose normal in scaled axes is (x, y, z)."""
    x, y, z = x * inverse[0], y * inverse[1], z * inverse[2]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@numba.njit(cache=True, inline="always")
def _cell(x, y, z):  # type: ignore[no-untyped-def]
    """Row and column of a direction on the padded maps, and the cosine of its latitude."""
    across = np.sqrt(x * x + y * y)
    latitude, longitude = np.arctan2(z, across), np.arctan2(y, x)
    if longitude < 0.0:
        longitude += 2.0 * np.pi
    scale = 180.0 / np.pi / STEP_DEG
    return (latitude + 0.5 * np.pi) * scale + PAD, longitude * scale + PAD, across / np.sqrt(across**2 + z**2)


@numba.njit(cache=True, inline="always")
def _cubic(f):  # type: ignore[no-untyped-def]
    """Weights of four neighbours: Catmull-Rom's spline."""
    return (
        0.5 * f * (-1.0 + f * (2.0 - f)),
        1.0 + 0.5 * f * f * (-5.0 + 3.0 * f),
        0.5 * f * (1.0 + f * (4.0 - 3.0 * f)),
        0.5 * f * f * (f - 1.0),
    )


@numba.njit(cache=True, inline="always")
def _cubic_slope(f):  # type: ignore[no-untyped-def]
    """Derivatives of those weights."""
    return (
        0.5 * (-1.0 + f * (4.0 - 3.0 * f)),
        0.5 * f * (-10.0 + 9.0 * f),
        0.5 * (1.0 + f * (8.0 - 9.0 * f)),
        0.5 * f * (3.0 * f - 2.0),
    )


@numba.njit(cache=True)
def look_up(field, x, y, z):  # type: ignore[no-untyped-def]
    """Value of a map in a direction."""
    row, column, _ = _cell(x, y, z)
    i, j = min(int(row), field.shape[0] - 3), min(int(column), field.shape[1] - 3)
    wr, wc = _cubic(row - i), _cubic(column - j)
    total = 0.0
    for a in range(4):
        line = 0.0
        for b in range(4):
            line += wc[b] * field[i - 1 + a, j - 1 + b]
        total += wr[a] * line
    return total


@numba.njit(cache=True)
def look_up_slope(field, x, y, z):  # type: ignore[no-untyped-def]
    """Slopes northward and eastward, per radian, of a map in a direction."""
    row, column, cosine = _cell(x, y, z)
    i, j = min(int(row), field.shape[0] - 3), min(int(column), field.shape[1] - 3)
    wr, wc = _cubic(row - i), _cubic(column - j)
    dr, dc = _cubic_slope(row - i), _cubic_slope(column - j)
    north, east = 0.0, 0.0
    for a in range(4):
        line, slope = 0.0, 0.0
        for b in range(4):
            value = field[i - 1 + a, j - 1 + b]
            line += wc[b] * value
            slope += dc[b] * value
        north += dr[a] * line
        east += wr[a] * slope
    scale = 180.0 / np.pi / STEP_DEG
    return north * scale, east * scale / max(cosine, 2e-3)


def axes_of_sight(eye: FloatArray) -> FloatArray:
    """Return rows (3, 3): two directions across the line from an eye to the centre, and the one along it."""
    ahead = -eye / np.linalg.norm(eye)
    beside = np.eye(3)[int(np.argmin(np.abs(ahead)))]
    across = np.cross(beside, ahead)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(ahead, across), ahead])


@numba.njit(cache=True)
def trace_silhouette(eye, axes, heights, highest):  # type: ignore[no-untyped-def]
    """Largest angle from the line to the centre, by position angle, at which a line of sight touches the surface."""
    distance = np.sqrt(eye[0] ** 2 + eye[1] ** 2 + eye[2] ** 2)
    table = np.empty(SILHOUETTE + 3)
    tangent = np.arccos(1.0 / distance)
    reach = 2.0 * np.sqrt(max(highest, 0.0)) * 1.2 + 2.0 * GRAZING_STEP_RAD
    steps = int(np.ceil(reach / GRAZING_STEP_RAD)) if highest > 0.0 else 0
    for k in range(SILHOUETTE):
        angle = 2.0 * np.pi * k / SILHOUETTE
        c, d = np.cos(angle), np.sin(angle)
        best, before, after, last, top = -1.0, 0.0, 0.0, 0.0, -1
        for s in range(-steps, steps + 1):
            psi = tangent + s * GRAZING_STEP_RAD
            out, back = np.sin(psi), -np.cos(psi)
            x = out * (c * axes[0, 0] + d * axes[1, 0]) + back * axes[2, 0]
            y = out * (c * axes[0, 1] + d * axes[1, 1]) + back * axes[2, 1]
            z = out * (c * axes[0, 2] + d * axes[1, 2]) + back * axes[2, 2]
            rho = 1.0 + (look_up(heights, x, y, z) if highest > 0.0 else 0.0)
            seen = np.arctan2(rho * np.sin(psi), distance - rho * np.cos(psi))
            if top == s - 1 and s > -steps:
                after = seen
            if seen > best:
                best, before, top, after = seen, last, s, seen
            last = seen
        if -steps < top < steps:
            # The vertex of the parabola through the highest step and its neighbours.
            bend = before - 2.0 * best + after
            if bend < 0.0:
                best -= 0.125 * (after - before) ** 2 / bend
        table[k + 1] = best if steps else np.arcsin(1.0 / distance)
    table[0] = table[SILHOUETTE]
    table[SILHOUETTE + 1], table[SILHOUETTE + 2] = table[1], table[2]
    return table


@numba.njit(cache=True, inline="always")
def _reflect(law, parameter, mu0, mu):  # type: ignore[no-untyped-def]
    """Brightness of a surface under one of `LAWS`."""
    if mu0 <= 0.0:
        return 0.0
    if law == 0:
        return mu0
    mu = max(mu, SHALLOWEST)
    seeliger = 2.0 * mu0 / (mu0 + mu)
    return seeliger if law == 1 else parameter * seeliger + (1.0 - parameter) * mu0


@numba.njit(cache=True)
def _shaded(s, k, x, y, z):  # type: ignore[no-untyped-def]
    """Whether another body stands between the Sun and a point of body k's scaled surface."""
    x, y, z = x / s.inverse_radii[k, 0], y / s.inverse_radii[k, 1], z / s.inverse_radii[k, 2]
    for j in range(s.shades.shape[1]):
        m = s.shades[k, j]
        if m[0, 0] == 0.0 and m[0, 1] == 0.0 and m[0, 2] == 0.0:
            break
        px, py, pz = _turned(m, x, y, z)
        px, py, pz = px - s.shade_centres[k, j, 0], py - s.shade_centres[k, j, 1], pz - s.shade_centres[k, j, 2]
        wx, wy, wz = _turned(m, s.sun[k, 0], s.sun[k, 1], s.sun[k, 2])
        along = -(px * wx + py * wy + pz * wz) / (wx * wx + wy * wy + wz * wz)
        px, py, pz = px + along * wx, py + along * wy, pz + along * wz
        if along > 0.0 and px * px + py * py + pz * pz < 1.0:
            return True
    return False


@numba.njit(cache=True)
def approach(s, k, x, y, z):  # type: ignore[no-untyped-def]
    """Line of sight in body k's scaled axes, its angle from the line to the centre, and the silhouette's angle there.

    (x, y, z) is the line of sight in the camera frame; the one returned has unit length.
    """
    x, y, z = _turned(s.from_camera[k], x, y, z)
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    across, up, ahead = _turned(s.axes[k], x, y, z)
    turn = np.arctan2(up, across) / (2.0 * np.pi)
    place = (turn - np.floor(turn)) * SILHOUETTE
    i = min(int(place), SILHOUETTE - 1)
    w = _cubic(place - i)
    table = s.silhouette[k]
    edge = w[0] * table[i] + w[1] * table[i + 1] + w[2] * table[i + 2] + w[3] * table[i + 3]
    return x, y, z, np.arctan2(np.sqrt(across * across + up * up), ahead), edge


@numba.njit(cache=True)
def meet(s, k, x, y, z, angle, edge):  # type: ignore[no-untyped-def]
    """Direction from body k's centre of the point that a line of sight inside the silhouette meets, scaled axes."""
    ex, ey, ez = s.eye[k, 0], s.eye[k, 1], s.eye[k, 2]
    along = -(ex * x + ey * y + ez * z)
    distance2 = ex * ex + ey * ey + ez * ez
    miss2 = distance2 - along * along
    # At the silhouette the surface stands exactly as high as the line passes.
    rho2 = max(distance2 * np.sin(edge) ** 2, 1.0) if angle > 0.97 * edge else 1.0
    way = along - np.sqrt(max(rho2 - miss2, 0.0))
    px, py, pz = ex + way * x, ey + way * y, ez + way * z
    if s.highest[k] * s.radius_px[k] > 0.02:
        for _ in range(2):
            rho = 1.0 + look_up(s.heights[k], px, py, pz)
            way = along - np.sqrt(max(rho * rho - miss2, 0.0))
            px, py, pz = ex + way * x, ey + way * y, ez + way * z
    length = np.sqrt(px * px + py * py + pz * pz)
    return px / length, py / length, pz / length


@numba.njit(cache=True)
def surface_light(s, k, x, y, z, angle, edge):  # type: ignore[no-untyped-def]
    """Light of body k's surface on a line of sight inside its silhouette, that of its smooth grey twin, and mu0."""
    x, y, z, inverse = -x, -y, -z, s.inverse_radii[k]
    ux, uy, uz = meet(s, k, -x, -y, -z, angle, edge)
    vx, vy, vz = x / inverse[0], y / inverse[1], z / inverse[2]
    length = np.sqrt(vx * vx + vy * vy + vz * vz)
    nx, ny, nz = _normal(inverse, ux, uy, uz)
    mu0 = _dot(s.sun[k], nx, ny, nz)
    if mu0 < -0.5 or _shaded(s, k, ux, uy, uz):
        return 0.0, 0.0, mu0
    mu = (nx * vx + ny * vy + nz * vz) / length
    smooth = s.brightness[k] * _reflect(s.law[k], s.parameter[k], mu0, mu)
    if s.highest[k] <= 0.0:
        return smooth * look_up(s.albedo[k], ux, uy, uz), smooth, mu0
    north, east = look_up_slope(s.heights[k], ux, uy, uz)
    across = max(np.sqrt(ux * ux + uy * uy), 1e-9)
    bx = ux + (north * uz * ux + east * uy) / across
    by = uy + (north * uz * uy - east * ux) / across
    nx, ny, nz = _normal(inverse, bx, by, uz - north * across)
    rough_mu0 = _dot(s.sun[k], nx, ny, nz)
    rough = _reflect(s.law[k], s.parameter[k], rough_mu0, (nx * vx + ny * vy + nz * vz) / length)
    return s.brightness[k] * rough * look_up(s.albedo[k], ux, uy, uz), smooth, mu0


@numba.njit(cache=True)
def haze_light(s, k, x, y, z, angle, edge):  # type: ignore[no-untyped-def]
    """Light of body k's atmosphere on a line of sight, and the share of what lies behind that it lets through.

    Its depth falls exponentially with the height of the line above the limb; in front of the disc it is near enough
    Chapman's function, half that of the whole passage at the limb.
    """
    scale, depth, bright = s.haze[k, 0], s.haze[k, 1], s.haze[k, 2]
    ex, ey, ez = s.eye[k, 0], s.eye[k, 1], s.eye[k, 2]
    along = -(ex * x + ey * y + ez * z)
    distance2 = ex * ex + ey * ey + ez * ez
    miss = np.sqrt(max(distance2 - along * along, 0.0))
    mu = 0.0
    if angle > edge:
        tau = depth * np.exp(-(miss - np.sqrt(distance2) * np.sin(edge)) / scale)
    else:
        mu = np.sqrt(max(1.0 - miss * miss, 0.0))
        tau = 0.5 * depth / np.sqrt(1.0 + np.pi * mu * mu / (2.0 * scale))
    way = along - mu
    nx, ny, nz = _normal(s.inverse_radii[k], ex + way * x, ey + way * y, ez + way * z)
    # Light gets round the terminator as far as the atmosphere is high.
    soft = np.sqrt(2.0 * scale)
    lit = min(max((_dot(s.sun[k], nx, ny, nz) + soft) / (1.0 + soft), 0.0), 1.0)
    through = np.exp(-tau)
    return s.brightness[k] * bright * lit * (1.0 - through), through


@numba.njit(cache=True)
def sight(s, x, y, z):  # type: ignore[no-untyped-def]
    """Light on one line of sight (camera frame): of all bodies, of their smooth grey twins, of the target alone."""
    light, smooth, own, through = 0.0, 0.0, 0.0, 1.0
    for k in range(len(s.law)):
        qx, qy, qz, angle, edge = approach(s, k, x, y, z)
        if angle > edge * (1.0 + HAZE_HEIGHTS * s.haze[k, 0]):
            continue
        if s.haze[k, 1] > 0.0:
            glow, left = haze_light(s, k, qx, qy, qz, angle, edge)
            light, smooth = light + through * glow, smooth + through * glow
            own += through * glow if k == s.target else 0.0
            through *= left
        if angle <= edge:
            rough, grey, _ = surface_light(s, k, qx, qy, qz, angle, edge)
            own += through * rough if k == s.target else 0.0
            return light + through * rough, smooth + through * grey, own
    return light, smooth, own
