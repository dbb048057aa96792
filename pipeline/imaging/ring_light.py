"""Loops over pixels of rings: light of a radial profile, pixels near edges, and the equations of blurred steps.

A look through a pixel meets the ring plane at (X, Y); the signed distance to an edge, in pixels and positive outward,
is ``(R - r(longitude)) / |gradient|`` with one more Newton step where it decides. A blurred step is the normal integral
of that distance; on a curved edge the blur shifts it by ``sigma^2 / (2 radius of curvature)``.
"""

from math import atan2, erf, exp, floor, pi, sqrt

import numba
import numpy as np

# Spacing of the grid of rays, see ``imaging/render.py``.
_SPACING = 16.0
# Edges of one unit.
MOST_EDGES = 10
_FAR_SIGMAS = 4.0
# Where a blurred step is over to a part in ten million.
_OVER_SIGMAS = 5.2
_ROOT2, _ROOT2PI = sqrt(2.0), sqrt(2.0 * pi)
# Residuals beyond so many sigmas are stars and struck pixels.
_CLIP_SIGMAS, _LEAST_CLIP = 6.0, 0.7
# Departure of an edge from a straight line, over the fit's reach, up to which its curvature is one number.
_FLAT_PX = 0.0125
# Distance over which a unit's light changes by one slope.
_SLOPE_PX = 8.0


@numba.njit(cache=True, nogil=True)
def look(slopes, origin, turn, observer, v, u, out):  # type: ignore[no-untyped-def]
    """Point of the plane seen through a pixel and its derivatives: X, Y, dX/dv, dX/du, dY/dv, dY/du."""
    y, x = (v - origin[0]) / _SPACING, (u - origin[1]) / _SPACING
    i = min(max(floor(y), 0), slopes.shape[0] - 2)
    j = min(max(floor(x), 0), slopes.shape[1] - 2)
    y -= i
    x -= j
    d = 0.0
    for k in range(3):
        a, b = turn[k, 0], turn[k, 1]
        p = a * slopes[i, j, 0] + b * slopes[i, j, 1]
        q = a * slopes[i, j + 1, 0] + b * slopes[i, j + 1, 1]
        r = a * slopes[i + 1, j, 0] + b * slopes[i + 1, j, 1]
        s = a * slopes[i + 1, j + 1, 0] + b * slopes[i + 1, j + 1, 1]
        out[6 + k] = (1 - y) * ((1 - x) * p + x * q) + y * ((1 - x) * r + x * s) + turn[k, 2]
        out[9 + k] = ((1 - x) * (r - p) + x * (s - q)) / _SPACING
        out[12 + k] = ((1 - y) * (q - p) + y * (s - r)) / _SPACING
    d = out[8]
    if d == 0.0 or not (-observer[2] / d > 0.0):
        return False
    share = -observer[2] / d
    for k in range(2):
        out[k] = observer[k] + share * out[6 + k]
        out[2 + 2 * k] = share * (out[9 + k] - out[6 + k] / d * out[11])
        out[3 + 2 * k] = share * (out[12 + k] - out[6 + k] / d * out[14])
    return True


@numba.njit(cache=True, nogil=True)
def _radial(place, polar):  # type: ignore[no-untyped-def]
    """Radius and its derivatives along v and u; returns km per pixel along the gradient."""
    x, y = place[0], place[1]
    radius = max(sqrt(x * x + y * y), 1e-9)
    polar[0] = radius
    polar[1] = (x * place[2] + y * place[4]) / radius
    polar[2] = (x * place[3] + y * place[5]) / radius
    return sqrt(polar[1] * polar[1] + polar[2] * polar[2])


@numba.njit(cache=True, nogil=True)
def _angular(place, count, polar):  # type: ignore[no-untyped-def]
    """Derivatives of the longitude, and the place in a table of ``count`` longitudes; after :func:`_radial`."""
    x, y, square = place[0], place[1], polar[0] * polar[0]
    polar[3] = (x * place[4] - y * place[2]) / square
    polar[4] = (x * place[5] - y * place[3]) / square
    at = atan2(y, x) / (2.0 * pi) * count
    polar[5] = at + count if at < 0 else at


@numba.njit(cache=True, nogil=True)
def _to_edge(curve, polar, found):  # type: ignore[no-untyped-def]
    """Signed distance in pixels, unit normal (v, u) outward, and km per pixel along it."""
    count = curve.shape[0]
    i = int(polar[5])
    share = polar[5] - i
    i = i % count
    low, high = curve[i], curve[(i + 1) % count]
    bend = (high - low) * count / (2.0 * pi)
    gv = polar[1] - bend * polar[3]
    gu = polar[2] - bend * polar[4]
    length = sqrt(gv * gv + gu * gu)
    found[0] = (polar[0] - (low + share * (high - low))) / length
    found[1], found[2], found[3] = gv / length, gu / length, length


@numba.njit(cache=True, nogil=True)
def _normal_integral(z):  # type: ignore[no-untyped-def]
    if z > _OVER_SIGMAS:
        return 1.0
    return 0.5 * (1.0 + erf(z / _ROOT2)) if z > -_OVER_SIGMAS else 0.0


@numba.njit(cache=True, nogil=True)
def _covered(forms, place, observer, sun):  # type: ignore[no-untyped-def]
    """0 free, 1 a body in the line of sight before the plane, 2 behind it, 4 its outline there, 3 in a shadow."""
    state = 0
    for k in range(forms.shape[0]):
        f = forms[k]
        for beam in range(2):
            if beam == 0:
                sx, sy, sz = observer[0] - f[0], observer[1] - f[1], observer[2] - f[2]
                dx, dy, dz = place[0] - observer[0], place[1] - observer[1], -observer[2]
            else:
                if sun[0] == 0.0 and sun[1] == 0.0 and sun[2] == 0.0:
                    continue
                sx, sy, sz = place[0] - f[0], place[1] - f[1], -f[2]
                dx, dy, dz = sun[0], sun[1], sun[2]
            bx = f[3] * dx + f[4] * dy + f[5] * dz
            by = f[6] * dx + f[7] * dy + f[8] * dz
            bz = f[9] * dx + f[10] * dy + f[11] * dz
            a = bx * dx + by * dy + bz * dz
            b = bx * sx + by * sy + bz * sz
            c = (
                sx * (f[3] * sx + f[4] * sy + f[5] * sz)
                + sy * (f[6] * sx + f[7] * sy + f[8] * sz)
                + sz * (f[9] * sx + f[10] * sy + f[11] * sz)
                - 1.0
            )
            root2 = b * b - a * c
            if root2 < 0:
                continue
            far = (-b + sqrt(root2)) / a
            near = (-b - sqrt(root2)) / a
            if beam == 0 and near > 0:
                if near < 1.0:
                    return 1
                within = f[12] * f[12] * b * b - f[12] * a * (f[12] * (c + 1.0) - 1.0)
                if within < 0.0:
                    state = 4
                elif state == 0:
                    state = 2
            elif beam == 1 and far > 0 and (state == 0 or state == 2):
                state = 3
    return state


@numba.njit(cache=True, nogil=True)
def profile_image(  # type: ignore[no-untyped-def]
    slopes, origin, turn, observer, first, step, curves, means, spread, contrasts, sigma, forms, sun, out,
):  # fmt: skip
    """Light of the rings at pixels ``first + step * (i, j)``, blurred by ``sigma`` pixels across every edge."""
    place, polar, found = np.zeros(15), np.zeros(6), np.zeros(4)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0.0
            if not look(slopes, origin, turn, observer, first[0] + step * i, first[1] + step * j, place):
                continue
            scale = _radial(place, polar)
            radius, turned = polar[0], False
            if forms.shape[0]:
                hidden = _covered(forms, place, observer, sun)
                if hidden == 1 or hidden == 3:
                    continue
            light = 0.0
            reach = _FAR_SIGMAS * sigma * scale
            for k in range(curves.shape[0]):
                if radius > means[k] + spread[k] + reach:
                    light += contrasts[k]
                elif radius > means[k] - spread[k] - reach:
                    if not turned:
                        _angular(place, curves.shape[1], polar)
                        turned = True
                    _to_edge(curves[k], polar, found)
                    light += contrasts[k] * _normal_integral(found[0] / sigma)
            out[i, j] = light


@numba.njit(cache=True, nogil=True)
def near_edges(  # type: ignore[no-untyped-def]
    slopes, origin, turn, observer, shape, curves, means, spread, reach, stride, slant, flat,
):  # fmt: skip
    """Flat indices of pixels within ``reach`` of an edge; how many. Far from all edges the walk takes long steps.

    Only pixels are looked at whose ``u + slant * v`` is a multiple of ``stride``.
    """
    place, polar, found = np.zeros(15), np.zeros(6), np.zeros(4)
    count = 0
    for v in range(shape[0]):
        u = -slant * v % stride
        while u < shape[1]:
            nearest = 64.0
            if look(slopes, origin, turn, observer, float(v), float(u), place):
                scale = _radial(place, polar)
                radius, turned = polar[0], False
                for k in range(curves.shape[0]):
                    gap = (abs(radius - means[k]) - spread[k]) / scale
                    if gap < nearest:
                        if spread[k] > 0.02 * scale:
                            if not turned:
                                _angular(place, curves.shape[1], polar)
                                turned = True
                            _to_edge(curves[k], polar, found)
                            gap = abs(found[0])
                        if gap < nearest:
                            nearest = gap
            if nearest <= reach and count < flat.shape[0]:
                flat[count] = v * shape[1] + u
                count += 1
            u += max(1, int(0.4 * (nearest - reach)))
            u += (-slant * v - u) % stride
    return count


@numba.njit(cache=True, nogil=True)
def _curved(slopes, origin, turn, observer, v, u, curve, found, foot, footing, other):  # type: ignore[no-untyped-def]
    """Distance after a Newton step from :func:`_to_edge`'s, and the edge's curvature: how its normal turns along it."""
    count = curve.shape[0]
    s = found[0]
    if not look(slopes, origin, turn, observer, v - s * found[1], u - s * found[2], foot):
        return s, 0.0
    _radial(foot, footing)
    _angular(foot, count, footing)
    _to_edge(curve, footing, other)
    s += other[0]
    nv, nu = other[1], other[2]
    if not look(
        slopes, origin, turn, observer, v - found[0] * found[1] - nu, u - found[0] * found[2] + nv, foot
    ):
        return s, 0.0
    _radial(foot, footing)
    _angular(foot, count, footing)
    _to_edge(curve, footing, other)
    return s, -nu * (other[1] - nv) + nv * (other[2] - nu)


@numba.njit(cache=True, nogil=True)
def measure(  # type: ignore[no-untyped-def]
    slopes, origin, turn, observer, cols, flat, curves, means, spread, cell_of, span, unit_of, unit_edges, reach,
    sigma, forms, sun, unit, distance,
):  # fmt: skip
    """Unit of each pixel (-1 for none), and its distances in pixels to all edges of the unit."""
    place, found, foot, other = np.zeros(15), np.zeros(4), np.zeros(15), np.zeros(4)
    polar, footing = np.zeros(6), np.zeros(6)
    count = curves.shape[1]
    bins = cell_of.shape[0]
    # Second order of the distance and curvature of a unit's edges: one pixel's do for all where they are small.
    shape = np.zeros((unit_edges.shape[0], MOST_EDGES, 2))
    flat_enough = np.zeros((unit_edges.shape[0], MOST_EDGES), np.bool_)
    far2 = reach * reach
    for n in range(flat.shape[0]):
        unit[n] = -1
        v, u = float(flat[n] // cols), float(flat[n] % cols)
        if not look(slopes, origin, turn, observer, v, u, place):
            continue
        scale = _radial(place, polar)
        _angular(place, count, polar)
        angle = polar[5] / count * 2.0 * pi
        at = int((angle - span[0]) % (2.0 * pi) / span[1] * bins)
        cell = cell_of[at] if at < bins else -1
        if cell < 0:
            continue
        if forms.shape[0]:
            state = _covered(forms, place, observer, sun)
            if state != 0 and state != 2:
                continue
        best, nearest = -1, reach
        for k in range(curves.shape[0]):
            if unit_of[cell, k] >= 0 and abs(polar[0] - means[k]) - spread[k] < nearest * scale * 1.1:
                _to_edge(curves[k], polar, found)
                if abs(found[0]) < nearest:
                    best, nearest = k, abs(found[0])
        if best < 0:
            continue
        mine = unit_of[cell, best]
        sound = True
        for k in range(unit_edges[mine, 0], unit_edges[mine, 1]):
            slot = k - unit_edges[mine, 0]
            _to_edge(curves[k], polar, found)
            s, bend = found[0], 0.0
            # Beyond the reach a step is over, wherever exactly its edge lies.
            if abs(s) < reach:
                if flat_enough[mine, slot]:
                    s, bend = s + shape[mine, slot, 0] * s * s, shape[mine, slot, 1]
                else:
                    s, bend = _curved(slopes, origin, turn, observer, v, u, curves[k], found, foot, footing, other)
                    if abs(found[0]) > 1.0:
                        square = found[0] * found[0]
                        shape[mine, slot, 0], shape[mine, slot, 1] = (s - found[0]) / square, bend
                        flat_enough[mine, slot] = max(abs(s - found[0]) / square, abs(bend)) * far2 < _FLAT_PX
                if abs(bend) * (sigma + abs(found[0])) > 0.5:
                    sound = False
                s += 0.5 * sigma * sigma * bend
            distance[n, slot] = s
        if sound:
            unit[n] = mine


@numba.njit(cache=True, nogil=True)
def _eliminated(gram, pull, size, left, out_gram, out_pull):  # type: ignore[no-untyped-def]
    """Schur complement on the parameters from ``left`` on."""
    inner = np.linalg.solve(gram[:left, :left].copy(), np.ascontiguousarray(gram[:left, left:size]))
    first = np.linalg.solve(gram[:left, :left].copy(), pull[:left].copy())
    cross = np.ascontiguousarray(gram[left:size, :left])
    rest = size - left
    out_gram[:rest, :rest] = gram[left:size, left:size] - cross @ inner
    out_pull[:rest] = pull[left:size] - cross @ first


@numba.njit(cache=True, nogil=True)
def _brightness(distance, shifts, width, step, share, columns):  # type: ignore[no-untyped-def]
    """Level, slope and steps at a unit's pixels, per unit of each; edge k belongs to step ``step[k]`` by a share."""
    for p in range(distance.shape[0]):
        row = columns[p]
        row[0] = 1.0
        row[1] = (distance[p, 0] - shifts[0]) / _SLOPE_PX
        for k in range(len(step)):
            row[2 + step[k]] += share[k] * _normal_integral((distance[p, k] - shifts[k]) / width)


@numba.njit(cache=True, nogil=True)
def _hold(gram, left, amplitude):  # type: ignore[no-untyped-def]
    """Complete a symmetric matrix, with weak priors on the brightness in its first rows."""
    for a in range(gram.shape[0]):
        for b in range(a):
            gram[a, b] = gram[b, a]
        if a == 1:
            gram[a, a] += 1.0 / (0.2 * amplitude) ** 2
        if 2 <= a < left:
            gram[a, a] += 1.0 / (10.0 * amplitude) ** 2
        gram[a, a] *= 1.0 + 1e-10


@numba.njit(cache=True, nogil=True)
def _fit_brightness(data, variance, keep, columns, amplitude, gram, pull, chosen, miss):  # type: ignore[no-untyped-def]
    """Brightness by least squares into ``chosen``, residuals into ``miss``; chi-square and number of kept pixels."""
    left = len(chosen)
    gram[:, :], pull[:] = 0.0, 0.0
    for p in range(len(data)):
        w = keep[p] / variance[p]
        for a in range(left):
            pull[a] += w * columns[p, a] * data[p]
            for b in range(a, left):
                gram[a, b] += w * columns[p, a] * columns[p, b]
    _hold(gram, left, amplitude)
    if gram[0, 0] <= 0:
        return 0.0, 0.0
    chosen[:] = np.linalg.solve(gram, pull)
    chi2, used = 0.0, 0.0
    for p in range(len(data)):
        expected = 0.0
        for a in range(left):
            expected += chosen[a] * columns[p, a]
        miss[p] = data[p] - expected
        if keep[p] > 0:
            chi2 += miss[p] ** 2 / variance[p]
            used += 1.0
    return chi2, used


@numba.njit(cache=True, nogil=True)
def _drop(miss, variance, excess, tallest, keep):  # type: ignore[no-untyped-def]
    """Leave out stars and struck pixels; whether there were any."""
    # The flank of a sharp edge misses a blurred step by up to half of it and is no outlier.
    least = (_LEAST_CLIP * tallest) ** 2
    dropped = False
    for p in range(len(miss)):
        if miss[p] ** 2 > _CLIP_SIGMAS**2 * excess * variance[p] and miss[p] ** 2 > least:
            keep[p] = 0.0
            dropped = True
    return dropped


@numba.njit(cache=True, nogil=True)
def _derivatives(distance, shifts, width, contrast, slopes):  # type: ignore[no-untyped-def]
    """Change of a pixel's light with the shift of every edge and, behind them, with the blur's variance."""
    count = len(contrast)
    slopes[count] = 0.0
    for k in range(count):
        z = (distance[k] - shifts[k]) / width
        slopes[k] = 0.0
        if abs(z) > _OVER_SIGMAS:
            continue
        steep = contrast[k] * exp(-0.5 * z * z) / (_ROOT2PI * width)
        slopes[k] = -steep
        slopes[count] -= steep * z / (2.0 * width)


@numba.njit(cache=True, nogil=True)
def unit_equations(  # type: ignore[no-untyped-def]
    data, variance, distance, starts, edges, shifts, width, step, share, amplitude, gram_out, pull_out, fit_out,
):  # fmt: skip
    """Equations of every unit in its edges' shifts (px) and the blur's variance (px^2), brightness eliminated.

    Brightness of a unit: level, slope, and steps, to which its edges belong by a share. ``fit_out`` gets chi-square,
    pixels, significance of the steps, and the edges' contrasts.
    """
    for n in range(edges.shape[0]):
        own = slice(starts[n], starts[n + 1])
        pixels, count = starts[n + 1] - starts[n], edges[n, 1] - edges[n, 0]
        left = 3 + step[n, :count].max()
        size = left + count + 1
        gram_out[n] = 0.0
        pull_out[n] = 0.0
        fit_out[n] = 0.0
        if pixels < 2 * left + 6:
            continue
        columns, miss, keep = np.zeros((pixels, size)), np.zeros(pixels), np.ones(pixels)
        _brightness(distance[own], shifts[n], width, step[n, :count], share[n, :count], columns)
        gram, pull, chosen = np.zeros((left, left)), np.zeros(left), np.zeros(left)
        chi2, used = _fit_brightness(data[own], variance[own], keep, columns, amplitude, gram, pull, chosen, miss)
        excess = max(1.0, chi2 / max(used - left, 1.0))
        if used > 0.0 and _drop(miss, variance[own], excess, np.abs(chosen[2:]).max(), keep):
            chi2, used = _fit_brightness(data[own], variance[own], keep, columns, amplitude, gram, pull, chosen, miss)
        if used < 2 * left + 4:
            continue
        # Light that the steps explain over level and slope alone.
        block, aside = np.zeros((left, left)), np.zeros(left)
        _eliminated(gram, pull, left, 2, block, aside)
        for a in range(left - 2):
            for b in range(left - 2):
                fit_out[n, 2] += chosen[2 + a] * block[a, b] * chosen[2 + b]
        for k in range(count):
            fit_out[n, 3 + k] = share[n, k] * chosen[2 + step[n, k]]
        big, right = np.zeros((size, size)), np.zeros(size)
        for p in range(pixels):
            if keep[p] == 0.0:
                continue
            w, row = 1.0 / variance[starts[n] + p], columns[p]
            _derivatives(distance[starts[n] + p], shifts[n], width, fit_out[n, 3 : 3 + count], row[left:])
            for a in range(size):
                if row[a] == 0.0:
                    continue
                right[a] += w * row[a] * miss[p]
                for b in range(a, size):
                    big[a, b] += w * row[a] * row[b]
        _hold(big, left, amplitude)
        # Priors on brightness have done their part in the residuals already.
        right[:left] = 0.0
        _eliminated(big, right, size, left, gram_out[n], pull_out[n])
        fit_out[n, 0], fit_out[n, 1] = chi2, used


@numba.njit(cache=True, nogil=True)
def assemble(  # type: ignore[no-untyped-def]
    gram, pull, weight, normal, lever, scale, way, edges, column, size, features, total, right,
):  # fmt: skip
    """Add units' equations in shifts to those in offset, rotation, blur, features' radii, edges' shifts and drifts."""
    value, where = np.zeros((MOST_EDGES + 1, 6)), np.zeros((MOST_EDGES + 1, 6), np.int64)
    own = size + 1 + features
    filled = np.zeros(MOST_EDGES + 1, np.int64)
    for n in range(edges.shape[0]):
        if weight[n] <= 0.0:
            continue
        count = edges[n, 1] - edges[n, 0]
        for k in range(count):
            value[k, 0], where[k, 0] = normal[n, k, 0], 0
            value[k, 1], where[k, 1] = normal[n, k, 1], 1
            at = 2
            if size == 3:
                value[k, 2], where[k, 2] = lever[n, k], 2
                at = 3
            value[k, at], where[k, at] = scale[n, k], size + 1 + column[edges[n, 0] + k]
            value[k, at + 1], where[k, at + 1] = 1.0, own + edges[n, 0] + k
            filled[k] = at + 2
            if way[n, k] != 0.0:
                value[k, at + 2], where[k, at + 2] = way[n, k], own + len(column) + edges[n, 0] + k
                filled[k] = at + 3
        value[count, 0], where[count, 0], filled[count] = 1.0, size, 1
        for a in range(count + 1):
            for i in range(filled[a]):
                right[where[a, i]] += weight[n] * value[a, i] * pull[n, a]
                for b in range(count + 1):
                    share = weight[n] * value[a, i] * gram[n, a, b]
                    if share != 0.0:
                        for j in range(filled[b]):
                            total[where[a, i], where[b, j]] += share * value[b, j]


@numba.njit(cache=True, nogil=True)
def band_equations(  # type: ignore[no-untyped-def]
    slopes, origin, turn, observer, first, step, data, weight, curves, means, spread, sigma, forms, sun, discs, gram,
    pull,
):  # fmt: skip
    """Normal equations of an image in level, two slopes, and the brightness outside of every edge; power, pixels.

    With ``discs`` they come twice: for rings before the sky, and before a disc.
    """
    place, polar, found = np.zeros(15), np.zeros(6), np.zeros(4)
    count = curves.shape[0]
    share, which = np.zeros(count + 4), np.zeros(count + 4, np.int64)
    rows, cols = data.shape
    power, used = 0.0, 0
    for i in range(rows):
        for j in range(cols):
            w = weight[i, j]
            if w <= 0.0:
                continue
            if not look(slopes, origin, turn, observer, first[0] + step * i, first[1] + step * j, place):
                continue
            region = 0
            if forms.shape[0]:
                state = _covered(forms, place, observer, sun)
                if state != 0 and not (discs and state == 2):
                    continue
                # Over a disc level and bands are others.
                region = (count + 3) * (state // 2)
            scale = _radial(place, polar)
            radius, turned = polar[0], False
            reach = _FAR_SIGMAS * sigma * scale
            share[0], which[0] = 1.0, 0
            share[1], which[1] = 2.0 * i / rows - 1.0, 1
            share[2], which[2] = 2.0 * j / cols - 1.0, 2
            filled = 3
            before = 1.0
            for k in range(count):
                inside = 0.0
                if radius > means[k] + spread[k] + reach:
                    inside = 1.0
                elif radius > means[k] - spread[k] - reach:
                    if not turned:
                        _angular(place, curves.shape[1], polar)
                        turned = True
                    _to_edge(curves[k], polar, found)
                    inside = _normal_integral(found[0] / sigma)
                # Band k - 1 lies between the edges k - 1 and k; what is inside of all of them is the level's.
                if k > 0 and before - inside > 1e-6:
                    share[filled], which[filled] = before - inside, 3 + k - 1
                    filled += 1
                before = inside
                if inside < 1e-6:
                    break
            if count > 0 and before > 1e-6:
                share[filled], which[filled] = before, 3 + count - 1
                filled += 1
            power += w * data[i, j] ** 2
            used += 1
            if region > 0:
                for a in range(filled):
                    which[a] += region
            for a in range(filled):
                pull[which[a]] += w * share[a] * data[i, j]
                for b in range(filled):
                    gram[which[a], which[b]] += w * share[a] * share[b]
    return power, used
