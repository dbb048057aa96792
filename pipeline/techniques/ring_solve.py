"""Equations of pieces of ring edges, put together in the unknowns of a fit, and solved."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.imaging.ring_light import MOST_EDGES, assemble
from pipeline.records import FloatArray
from pipeline.techniques.lm import tukey_weight
from pipeline.techniques.ring_units import RingUnits
from pipeline.techniques.ring_unknowns import Layout, Levers, Radii

# Prior of the blur's variance, relative to itself.
_WIDTH_SHARE = 0.3
# A feature is left out from so many sigmas on, if also by so many pixels, and if enough others agree.
_OUTLIER_SIGMAS, _LEAST_OTHERS, _LEAST_TROUBLE_PX = 4.0, 2, 0.25
# Degrees of freedom from which on a unit's residuals tell the noise.
_SOUND_FREEDOM = 10.0
# A free radius has this share of its prior's weight.
_FREE = 1e-12
# Standard deviation over median absolute value of a normal variable.
_MEDIAN_TO_SIGMA = 1.4826
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations of the units in their edges' shifts and the blur's variance, which comes behind the last edge.

    Attributes
    ----------
    gram, pull
        (n, 11, 11), (n, 11).
    fit
        (n, 13) chi-square, pixels, light told by the steps, contrasts.
    freedom
        (n,) degrees of freedom, zero where a unit tells nothing.
    """

    gram: FloatArray
    pull: FloatArray
    fit: FloatArray
    freedom: FloatArray


def calibrated(gram: FloatArray, pull: FloatArray, fit: FloatArray, steps: FloatArray) -> Equations:
    """Equations weighted by the units' own residuals.

    Contrasts that are noise make the squares of the slopes as large as their errors do; that part tells nothing.

    Parameters
    ----------
    gram, pull, fit
        Of :func:`pipeline.imaging.ring_light.unit_equations`.
    steps
        (n,) number of free contrasts.

    Returns
    -------
    Equations
        Of the same units.
    """
    freedom = np.where(fit[:, 1] > 0, fit[:, 1] - 2.0 - steps, 0.0)
    scatter = fit[:, 0] / np.maximum(freedom, 1.0)
    # Crowded rings look like noise to an image's own estimate of it; what the units leave shows when it is less.
    sound = freedom >= _SOUND_FREEDOM
    noise = np.maximum(scatter, min(1.0, float(np.median(scatter[sound]))) if sound.any() else 1.0)
    told = fit[:, 2] / noise
    sure = np.clip(1.0 - 2.0 * steps / np.maximum(told, _TINY), 0.0, 1.0) / noise
    return Equations(gram * sure[:, None, None], pull * sure[:, None], fit, np.where(sure > 0, freedom, 0.0))


def scaled(equations: Equations, factor: float) -> Equations:
    """The same with all variances multiplied."""
    return replace(equations, gram=equations.gram / factor, pull=equations.pull / factor)


def misfit(equations: Equations) -> tuple[FloatArray, FloatArray]:
    """(n,) chi-square by which each unit's own shifts would lower its misfit, and their number."""
    size = told_size(equations.gram)
    gram, pull = equations.gram[:, :size, :size], equations.pull[:, :size]
    diagonal = np.diagonal(gram, axis1=1, axis2=2)
    largest = diagonal.max(axis=1, keepdims=True)
    empty = diagonal <= 1e-9 * largest
    ridge = np.where(empty, np.where(largest > 0, largest, 1.0), 1e-6 * diagonal)
    own = np.linalg.solve(gram + ridge[:, :, None] * np.eye(size), pull[:, :, None])[:, :, 0]
    rank = (~empty).sum(axis=1) * (largest[:, 0] > 0)
    return np.maximum((own * pull).sum(axis=1), 0.0), rank.astype(float)


def told_size(gram: FloatArray) -> int:
    """Unknowns of the largest unit: behind them all matrices are zero."""
    told = np.nonzero((np.diagonal(gram, axis1=1, axis2=2) > 0).any(axis=0))[0]
    return int(told.max(initial=0)) + 1


def unit_weights(equations: Equations) -> FloatArray:
    """(n,) Tukey weights by the units' misfit."""
    chi2, rank = misfit(equations)
    ratio = np.sqrt(chi2 / np.maximum(rank, 1.0))
    some = rank > 0
    if not some.any():
        return np.ones(len(ratio))
    # Root mean squares of a few normal variables have their median near 0.8.
    scale = max(1.0, float(np.median(ratio[some])) / 0.8)
    return tukey_weight(ratio, scale) * some


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations of all parameters without priors, about their present values."""

    gram: FloatArray
    pull: FloatArray
    values: FloatArray


def system_of(
    equations: Equations, weight: FloatArray, levers: Levers, layout: Layout, values: FloatArray
) -> System:
    """All units together.

    Parameters
    ----------
    equations
        Of the units.
    weight
        (n,) robust weights.
    levers, layout
        Parameters.
    values
        Present ones.

    Returns
    -------
    System
        Symmetric.
    """
    gram, pull = np.zeros((layout.count, layout.count)), np.zeros(layout.count)
    assemble(
        equations.gram, equations.pull, weight, levers.normal, levers.lever, levers.scale, levers.way, levers.edges,
        layout.column, layout.size, layout.features, gram, pull,
    )  # fmt: skip
    return System((gram + gram.T) / 2, pull, values)


def prior_of(layout: Layout, radii: Radii, hold_blur: bool) -> FloatArray:
    """(parameters,) precision of what is known beforehand; offset and rotation have none."""
    prior = np.zeros(layout.count)
    prior[layout.size] = 1e12 if hold_blur else 1.0 / (_WIDTH_SHARE * layout.blur2) ** 2
    prior[layout.radii] = np.where(radii.free, _FREE, 1.0) / radii.sigma**2
    return prior


def step_of(system: System, layout: Layout, radii: Radii, hold_blur: bool, base: FloatArray) -> FloatArray:
    """(parameters,) Gauss-Newton step; not-a-number where the equations are singular.

    ``base`` (size,) is the pointing that the values are added to: the search's bounds keep their sum where edges do not
    tell it.
    """
    prior = prior_of(layout, radii, hold_blur)
    pull = system.pull - prior * system.values
    pull[: layout.size] -= (base + system.values[: layout.size]) / layout.bounds**2
    if hold_blur:
        pull[layout.size] = 0.0
    damping = _TINY * np.diag(system.gram)
    damping[: layout.size] += 1.0 / layout.bounds**2
    matrix = system.gram + np.diag(prior + damping)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.linalg.solve(matrix * np.outer(scale, scale), pull * scale) * scale)


def marginal(total: FloatArray, size: int) -> FloatArray:
    """Information on the first parameters once the others are free."""
    rest = total[size:, size:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(rest), 1e-300))
    inverse = np.linalg.pinv(rest * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    cross = total[:size, size:]
    result = total[:size, :size] - cross @ inverse @ cross.T
    return np.asarray((result + result.T) / 2)


def without_outlier(system: System, layout: Layout, radii: Radii, px_per_km: FloatArray, texture: float) -> Radii:
    """Free the radius of the feature that contradicts all others, if one does by far.

    Parameters
    ----------
    system
        Without priors.
    layout, radii
        Parameters and their priors.
    px_per_km
        (features,) largest shift of each per kilometre, zero where it is not in the image.
    texture
        Relative unevenness of the rings.

    Returns
    -------
    Radii
        One more free at most.
    """
    count = layout.features
    if count <= _LEAST_OTHERS:
        return radii
    wide = radii.sigma.copy()
    wide[layout.shifts] = texture * layout.texture_px * np.sqrt(radii.wild)
    believed = replace(radii, sigma=wide)
    gap, ratio = _against_others(system, layout, believed)
    worst = int(np.argmax(ratio))
    off = abs(gap[worst]) * px_per_km[worst] > _LEAST_TROUBLE_PX
    if ratio[worst] <= _OUTLIER_SIGMAS or np.count_nonzero(ratio) - 1 < _LEAST_OTHERS or not off:
        return radii
    free = radii.free.copy()
    free[worst] = True
    # Where the others scatter more than the catalogue says once this one is free, all are less certain and none is to
    # blame; before, one that is wrong moves all.
    _, left = _against_others(system, layout, replace(believed, free=free))
    scale = max(1.0, _MEDIAN_TO_SIGMA * float(np.median(left[left > 0]))) if (left > 0).any() else 1.0
    return replace(radii, free=free) if ratio[worst] > _OUTLIER_SIGMAS * scale else radii


def _against_others(system: System, layout: Layout, radii: Radii) -> tuple[FloatArray, FloatArray]:
    """(features,) what all others would have each radius be, km; that over its sigma, zero where nothing is told."""
    count = layout.features
    prior = prior_of(layout, radii, False)
    prior[: layout.size] = 1.0 / layout.bounds**2
    inverse = inverse_of(system.gram + np.diag(prior))
    at = layout.size + 1 + np.arange(count)
    pull = system.pull - prior * system.values
    pull[: layout.size] = system.pull[: layout.size]
    value, variance = system.values[at] + (inverse @ pull)[at], inverse[at, at]
    # A prior of precision p taken away from one unknown of variance s^2: s^2 / (1 - p s^2), and the value likewise.
    left = np.maximum(1.0 - prior[at] * variance, 1e-9)
    gap = value / left
    sigma = np.sqrt(variance / left + radii.sigma[:count] ** 2)
    told = (np.diag(system.gram)[at] > 0) & ~radii.free[:count] & (left > 1e-6)
    return gap, np.where(told, np.abs(gap) / sigma, 0.0)


def inverse_of(matrix: FloatArray) -> FloatArray:
    """Inverse of a badly scaled positive (n, n) matrix."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))


def own_shifts(equations: Equations, units: RingUnits) -> tuple[FloatArray, FloatArray]:
    """(n, 10) shifts that the units want beyond the fit, and their sigmas; not-a-number where they tell nothing."""
    size = told_size(equations.gram)
    gram = equations.gram[:, :size, :size]
    diagonal = np.diagonal(gram, axis1=1, axis2=2)
    largest = diagonal.max(axis=1, keepdims=True)
    silent = diagonal <= 1e-6 * largest
    ridge = np.where(silent, np.where(largest > 0, largest, 1.0), 1e-6 * diagonal)
    inverse = np.linalg.inv(gram + ridge[:, :, None] * np.eye(size))
    shift, sigma = np.full((2, *units.present.shape), np.nan)
    count = min(size, MOST_EDGES)
    known = ~silent[:, :count] & units.present[:, :count]
    shift[:, :count][known] = (inverse @ equations.pull[:, :size, None])[:, :count, 0][known]
    sigma[:, :count][known] = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2)[:, :count], 0.0))[known]
    return shift, sigma
