"""Point sources: a Gaussian integrated over pixels and smeared along a trail, fitted with its covariance."""

from dataclasses import dataclass
from math import erf, sqrt

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.records import BoolArray, FloatArray, Image, Record

_MAX_STEPS = 15
# Newton's steps shrink at least tenfold near the end: after one this short, in pixels, what is left is below 1e-4.
_CONVERGED_PX = 1e-3
_MIN_PIXELS = 9
# Sums may be reordered for speed; not-a-number and infinity keep their meaning.
_REORDER = {"contract", "reassoc", "nsz", "arcp"}


@dataclass(frozen=True)
class PointSpread:
    """Shape of a point source on the array.

    Attributes
    ----------
    sigma_px
        Gaussian core.
    trail_vu
        Straight trail from start to end of the exposure, pixels.
    misfit
        Share of a real star's light by which it may miss the Gaussian; a worse fit is no star.
    """

    sigma_px: float
    trail_vu: tuple[float, float] = (0.0, 0.0)
    misfit: float = 0.15

    @property
    def trail_px(self) -> float:
        """Length of the trail."""
        return float(np.hypot(*self.trail_vu))

    @property
    def substeps(self) -> int:
        """Positions along the trail that the model adds up: half a sigma apart is a continuous trail to 1e-4."""
        return max(1, int(np.ceil(2.0 * self.trail_px / self.sigma_px)))

    @property
    def radius_px(self) -> int:
        """Half-width of the fitting window."""
        return int(np.ceil(3.0 * self.sigma_px + self.trail_px / 2)) + 1


@dataclass(frozen=True, eq=False)
class PointSources(Record):
    """Fitted sources, one row each.

    Attributes
    ----------
    position_vu
        (n, 2) pixels.
    covariance_vu
        (n, 2, 2) px^2, flux and background marginalised.
    flux_dn, flux_sigma_dn
        (n,).
    chi2, dof
        (n,) weighted squared residual and its degrees of freedom.
    saturated_pixels
        (n,) saturated pixels in the window, which the fit leaves out.
    ok
        (n,) False where the fit failed.
    """

    position_vu: FloatArray
    covariance_vu: FloatArray
    flux_dn: FloatArray
    flux_sigma_dn: FloatArray
    chi2: FloatArray
    dof: NDArray[np.int64]
    saturated_pixels: NDArray[np.int64]
    ok: BoolArray

    def __post_init__(self) -> None:
        n = len(self.position_vu)
        self._freeze(
            position_vu=(n, 2), covariance_vu=(n, 2, 2), flux_dn=(n,), flux_sigma_dn=(n,), chi2=(n,), dof=(n,),
            saturated_pixels=(n,), ok=(n,),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.position_vu)

    @property
    def snr(self) -> FloatArray:
        """(n,) flux over its sigma."""
        return self.flux_dn / self.flux_sigma_dn

    def take(self, index: NDArray[np.generic]) -> "PointSources":
        """Rows of an index or mask."""
        return PointSources(
            self.position_vu[index], self.covariance_vu[index], self.flux_dn[index], self.flux_sigma_dn[index],
            self.chi2[index], self.dof[index], self.saturated_pixels[index], self.ok[index],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _axis_profile(centre, first, count, sigma, share, slope):  # type: ignore[no-untyped-def]
    """Share of a 1-D Gaussian in each pixel of a row, and its derivative with respect to the centre."""
    scale = 1.0 / (sigma * sqrt(2.0))
    norm = 1.0 / (sigma * sqrt(2.0 * np.pi))
    left = (first - 0.5 - centre) * scale
    left_cdf, left_pdf = erf(left), np.exp(-left * left)
    for k in range(count):
        right = (first + k + 0.5 - centre) * scale
        right_cdf, right_pdf = erf(right), np.exp(-right * right)
        share[k] = 0.5 * (right_cdf - left_cdf)
        slope[k] = norm * (left_pdf - right_pdf)
        left_cdf, left_pdf = right_cdf, right_pdf


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _unit_model(v, u, v0, u0, nv, nu, sigma, trail_v, trail_u, substeps, model, model_v, model_u):  # type: ignore[no-untyped-def]
    """Unit-flux model over a window and its derivatives with respect to the centre."""
    share_v, slope_v = np.empty(nv), np.empty(nv)
    share_u, slope_u = np.empty(nu), np.empty(nu)
    model[:nv, :nu] = 0.0
    model_v[:nv, :nu] = 0.0
    model_u[:nv, :nu] = 0.0
    for step in range(substeps):
        along = (step + 0.5) / substeps - 0.5
        _axis_profile(v + along * trail_v, v0, nv, sigma, share_v, slope_v)
        _axis_profile(u + along * trail_u, u0, nu, sigma, share_u, slope_u)
        for i in range(nv):
            for j in range(nu):
                model[i, j] += share_v[i] * share_u[j] / substeps
                model_v[i, j] += slope_v[i] * share_u[j] / substeps
                model_u[i, j] += share_v[i] * slope_u[j] / substeps


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _solve_posdef(a, b, x):  # type: ignore[no-untyped-def]
    """Solve a 4x4 symmetric positive-definite system by Cholesky; False when it is not one."""
    n = 4
    low = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            if i == j:
                if s <= 0.0:
                    return False
                low[i, i] = sqrt(s)
            else:
                low[i, j] = s / low[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= low[i, k] * x[k]
        x[i] = s / low[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= low[k, i] * x[k]
        x[i] = s / low[i, i]
    return True


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _normal_equations(image, others, bad, sigma_map, v0, u0, nv, nu, p, m, mv, mu, inv_gain, a, g):  # type: ignore[no-untyped-def]
    """Weighted normal matrix and gradient for (flux, v, u, background); returns chi2 and the pixels used."""
    a[:] = 0.0
    g[:] = 0.0
    chi2, count = 0.0, 0
    row = np.empty(4)
    for i in range(nv):
        for j in range(nu):
            v, u = v0 + i, u0 + j
            if bad[v, u]:
                continue
            star = p[0] * m[i, j]
            bright = max(star, 0.0)
            sigma = sigma_map[v, u]
            weight = 1.0 / (sigma * sigma + bright * inv_gain)
            residual = image[v, u] - others[i, j] - star - p[3]
            row[0], row[1], row[2], row[3] = m[i, j], p[0] * mv[i, j], p[0] * mu[i, j], 1.0
            for k in range(4):
                g[k] += weight * row[k] * residual
                for col in range(k + 1):
                    a[k, col] += weight * row[k] * row[col]
            chi2 += weight * residual * residual
            count += 1
    for k in range(4):
        for col in range(k):
            a[col, k] = a[k, col]
    return chi2, count


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _fit_one(image, others, bad, sigma_map, start, v0, u0, nv, nu, shape, inv_gain, p, cov):  # type: ignore[no-untyped-def]
    """Damped Gauss-Newton with the variance re-computed from the model at every step."""
    sigma, trail_v, trail_u, substeps, reach = shape
    m, mv, mu = np.empty((nv, nu)), np.empty((nv, nu)), np.empty((nv, nu))
    a, g, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    p[:] = start
    chi2, count, done = 0.0, 0, False
    for _ in range(_MAX_STEPS):
        _unit_model(p[1], p[2], v0, u0, nv, nu, sigma, trail_v, trail_u, int(substeps), m, mv, mu)
        chi2, count = _normal_equations(image, others, bad, sigma_map, v0, u0, nv, nu, p, m, mv, mu, inv_gain, a, g)
        if count < _MIN_PIXELS or not _solve_posdef(a, g, step):
            return chi2, count, False
        shift = sqrt(step[1] ** 2 + step[2] ** 2)
        damp = min(1.0, 0.5 * sigma / shift) if shift > 0 else 1.0
        if p[0] + damp * step[0] <= 0:
            damp = min(damp, -0.5 * p[0] / step[0])
        for k in range(4):
            p[k] += damp * step[k]
        if abs(p[1] - start[1]) > reach or abs(p[2] - start[2]) > reach:
            return chi2, count, False
        if damp == 1.0 and shift < _CONVERGED_PX:
            done = True
            break
    unit = np.zeros(4)
    for k in range(4):
        unit[:] = 0.0
        unit[k] = 1.0
        if not _solve_posdef(a, unit, step):
            return chi2, count, False
        cov[:, k] = step
    return chi2, count, done


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _add_star(canvas, p, radius, shape):  # type: ignore[no-untyped-def]
    """Add one fitted star (without background) to a canvas, over a window as wide as the fit's."""
    rows, cols = canvas.shape
    sigma, trail_v, trail_u, substeps = shape[0], shape[1], shape[2], int(shape[3])
    v0, u0 = max(0, round(p[1]) - radius), max(0, round(p[2]) - radius)
    nv = min(rows - 1, round(p[1]) + radius) - v0 + 1
    nu = min(cols - 1, round(p[2]) + radius) - u0 + 1
    if nv <= 0 or nu <= 0:
        return
    m, mv, mu = np.empty((nv, nu)), np.empty((nv, nu)), np.empty((nv, nu))
    _unit_model(p[1], p[2], v0, u0, nv, nu, sigma, trail_v, trail_u, substeps, m, mv, mu)
    for i in range(nv):
        for j in range(nu):
            canvas[v0 + i, u0 + j] += p[0] * m[i, j]


@numba.njit(cache=True, nogil=True, fastmath=_REORDER)
def _fit_all(image, bad, saturated, sigma_map, starts, radius, shape, inv_gain, params, covs, stats, ok):  # type: ignore[no-untyped-def]
    """Fit every star, the brighter ones taken away before, then again those with a neighbour in reach."""
    rows, cols = image.shape
    n = len(starts)
    side = 2 * radius + 1
    canvas = np.zeros(image.shape, dtype=np.float32)
    others = np.zeros((side, side), dtype=np.float64)
    own = np.zeros((side, side), dtype=np.float32)
    for sweep in range(2):
        for s in range(n):
            begin = starts[s]
            if sweep == 1:
                crowded = False
                for t in range(n):
                    near_v = abs(params[t, 1] - params[s, 1]) <= 2 * radius
                    if t != s and ok[t] and near_v and abs(params[t, 2] - params[s, 2]) <= 2 * radius:
                        crowded = True
                        break
                if not crowded:
                    continue
                if ok[s]:
                    begin = params[s].copy()
            v0, u0 = max(0, round(begin[1]) - radius), max(0, round(begin[2]) - radius)
            nv = min(rows - 1, round(begin[1]) + radius) - v0 + 1
            nu = min(cols - 1, round(begin[2]) + radius) - u0 + 1
            if nv < 3 or nu < 3:
                ok[s] = False
                continue
            own[:] = 0.0
            if sweep == 1 and ok[s]:
                shifted = params[s].copy()
                shifted[1] -= v0
                shifted[2] -= u0
                _add_star(own, shifted, radius, shape)
            for i in range(nv):
                for j in range(nu):
                    others[i, j] = canvas[v0 + i, u0 + j] - own[i, j]
            chi2, count, good = _fit_one(
                image, others, bad, sigma_map, begin, v0, u0, nv, nu, shape, inv_gain, params[s], covs[s]
            )
            full = 0
            for i in range(nv):
                for j in range(nu):
                    full += saturated[v0 + i, u0 + j]
            stats[s, 0], stats[s, 1], stats[s, 2] = chi2, count - 4, full
            ok[s] = good
            if sweep == 0 and good:
                _add_star(canvas, params[s], radius, shape)


def fit_point_sources(
    image: Image,
    bad: BoolArray,
    saturated: BoolArray,
    sigma: Image,
    gain_e_per_dn: float | None,
    spread: PointSpread,
    starts_vu: FloatArray,
    reach_px: float | None = None,
) -> PointSources:
    """Fit flux, position and local background of point sources.

    Weights are the background noise and the shot noise of the model, never of the data, which would bias them.
    Saturated pixels are left out, so that the wings place a bright star.

    Parameters
    ----------
    image
        (rows, cols) background-subtracted DN.
    bad
        (rows, cols) True where a pixel is not to be used; includes the saturated ones.
    saturated
        (rows, cols) True where saturated.
    sigma
        (rows, cols) background noise, DN.
    gain_e_per_dn
        For shot noise; None leaves it out.
    spread
        Shape of a point source.
    starts_vu
        (n, 2) first guesses, brightest first: a star is fitted after the brighter ones are taken away.
    reach_px
        A fit that moves farther than this from its start has failed; by default the window's half-width.

    Returns
    -------
    PointSources
        In the order of ``starts_vu``.
    """
    n = len(starts_vu)
    radius = spread.radius_px
    params, covs, stats = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.zeros((n, 3))
    ok = np.zeros(n, bool)
    starts = np.zeros((n, 4))
    starts[:, 1:3] = starts_vu
    rows, cols = image.shape
    at = np.clip(np.rint(starts_vu).astype(int), 0, [rows - 1, cols - 1])
    peak_share = min(1.0, 1.0 / (2 * np.pi * spread.sigma_px**2 + 1) / (1 + spread.trail_px / (2.5 * spread.sigma_px)))
    starts[:, 0] = np.maximum(image[at[:, 0], at[:, 1]], sigma[at[:, 0], at[:, 1]]) / peak_share
    reach = float(radius) if reach_px is None else float(reach_px)
    shape = (
        float(spread.sigma_px), float(spread.trail_vu[0]), float(spread.trail_vu[1]), float(spread.substeps),
        reach,
    )  # fmt: skip
    inv_gain = 1.0 / gain_e_per_dn if gain_e_per_dn else 0.0
    _fit_all(image, bad, saturated, sigma, starts, radius, shape, inv_gain, params, covs, stats, ok)
    flux_sigma = np.sqrt(np.where(ok, covs[:, 0, 0], np.inf))
    covariance = np.where(ok[:, None, None], covs[:, 1:3, 1:3], np.nan)
    return PointSources(
        params[:, 1:3], covariance, params[:, 0], flux_sigma, stats[:, 0], stats[:, 1].astype(np.int64),
        stats[:, 2].astype(np.int64), ok,
    )  # fmt: skip
