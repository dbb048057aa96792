"""Pointing from shifts along outlines: generalised least squares with a body's relief as a random field.

Heights of a surface about its shape are a Gaussian field on the body whose covariance falls by 1/e over some degrees.
Its rms comes from the catalogue, where there is one, and from the residuals by restricted maximum likelihood; a second
field of long wavelength stands for an altogether wrong shape, and a common height of a whole outline for a wrong radius
or a hazy limb.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from pipeline.options import Options
from pipeline.records import FloatArray, Record
from pipeline.techniques.contour_fit import Segments
from pipeline.techniques.lm import tukey_weight

_ROUNDS = 3
_FACTORS = np.array([0.3, 0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0, 2.8, 4.0, 8.0, 16.0, 32.0])
_LONG_FACTORS = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
_LONG_REACH_DEG = 40.0
# Factor on the expected relief from which a wrong shape is thought of.
_ODD_FACTOR = 1.3
# Long-wave error of a shape over its relief.
_UNKNOWN_LONG = 1.0
# The same over the relief that an outline shows itself: part of its long waves is in that already.
_SHOWN_LONG = 0.5
_SHORT_ARC_DEG = 100.0
# A weight this small is an outlier's; it keeps the covariance finite.
_LEAST_WEIGHT = 1e-4


class ReliefOptions(Options):
    """What is believed of reliefs before the image is looked at."""

    known_width: float = Field(0.3, gt=0, le=3, description="1-sigma of ln(rms) where a catalogue tells it")
    unknown_width: float = Field(1.2, gt=0, le=5, description="the same where it is guessed from the radius")
    wrong_shape_chance: float = Field(0.05, gt=0, lt=1, description="chance of a long-wave error of the shape")
    radius_sigmas: float = Field(3.0, gt=0, le=20, description="common height, in its sigmas, that frees the radius")


@dataclass(frozen=True, eq=False)
class Field_(Record):
    """Prior of one body's relief.

    Attributes
    ----------
    rms_px
        Expected rms.
    reach_deg
        E-folding angle of the covariance.
    known
        Whether a catalogue says so.
    common_px
        1 sigma of a height that the whole outline shares.
    haze_px
        1 sigma of a height that a good part of the outline shares, as a haze lends it to where the Sun is high.
    of_shape
        Whether heights of the body's shape are meant, and not the wandering of a terminator.
    """

    rms_px: float
    reach_deg: float
    known: bool
    common_px: float
    haze_px: float = 0.0
    of_shape: bool = True


@dataclass(frozen=True, eq=False)
class ReliefFit(Record):
    """Answer of the fit.

    Attributes
    ----------
    step
        (2,) or (3,) change of (dv, du[, theta]) about the pivot.
    information
        Same size, squared.
    residual_px, weight
        (m,) shifts that are left; robust weights.
    rms_px
        Relief found.
    long_px
        Long-wave error found, zero where there is none.
    common_px
        (bodies,) height of whole outlines.
    chi2_per_segment
        With all errors.
    """

    step: FloatArray
    information: FloatArray
    residual_px: FloatArray
    weight: FloatArray
    rms_px: float
    long_px: float
    common_px: FloatArray
    chi2_per_segment: float

    def __post_init__(self) -> None:
        size = len(self.step)
        self._freeze(step=(size,), information=(size, size), residual_px=(None,), weight=(None,), common_px=(None,))


def fit_relief(
    segments: Segments, lever: FloatArray | None, fields: dict[int, Field_], options: ReliefOptions
) -> ReliefFit:
    """Fit a pointing to segments' shifts.

    Parameters
    ----------
    segments
        Measured ones only.
    lever
        (m, 2) derivative of the places with respect to theta, None where it is no parameter.
    fields
        Prior of each body's relief, by its index.
    options
        Beliefs.

    Returns
    -------
    ReliefFit
        Of all bodies together.
    """
    design = segments.normal_vu
    if lever is not None:
        design = np.column_stack([design, (segments.normal_vu * lever).sum(axis=1)])
    bodies = sorted(set(segments.body.tolist()))
    near, far, haze = _correlations(segments, fields)
    fixed = _albedo(segments) + haze
    span = float(np.degrees(np.arccos(np.clip((segments.direction @ segments.direction.T).min(), -1.0, 1.0))))
    common = {b: fields[b].common_px for b in bodies}
    weight = np.ones(len(segments))
    short, long_ = 1.0, 0.0
    for _ in range(_ROUNDS):
        noise = segments.sigma_px**2 / np.maximum(weight, _LEAST_WEIGHT)
        base = np.diag(noise) + _common(segments, common) + fixed
        short, long_ = _likeliest(segments.shift_px, design, base, near, far, (short, long_), fields, span, options)
        covariance = base + short**2 * near + long_**2 * far
        step, information, solved = _solve(segments.shift_px, design, covariance)
        residual = segments.shift_px - design @ step
        heights = np.array([common[b] ** 2 * float(solved[segments.body == b].sum()) for b in bodies])
        free = [b for b, h in zip(bodies, heights, strict=True) if abs(h) > options.radius_sigmas * common[b]]
        if any(common[b] < 1e3 for b in free):
            common |= dict.fromkeys(free, 1e3)
            continue
        lifted = residual - sum(np.where(segments.body == b, h, 0.0) for b, h in zip(bodies, heights, strict=True))
        spread = np.sqrt(segments.sigma_px**2 + short**2 * np.diag(near) + long_**2 * np.diag(far))
        weight = tukey_weight(lifted / spread, 1.0)
    rms = float(np.sqrt(np.mean(np.diag(near)))) * short
    long_px = float(np.sqrt(np.mean(np.diag(far)))) * long_
    chi2 = float(residual @ solved) / max(len(segments) - design.shape[1], 1)
    return ReliefFit(step, information, residual, weight, rms, long_px, heights, chi2)


def _correlations(segments: Segments, fields: dict[int, Field_]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances of relief and of a wrong shape, both for factor one, and of a haze."""
    angle = np.arccos(np.clip(segments.direction @ segments.direction.T, -1.0, 1.0))
    rms = np.array([fields[b].rms_px for b in segments.body.tolist()])
    reach = np.radians([fields[b].reach_deg for b in segments.body.tolist()])
    same = segments.body[:, None] == segments.body[None, :]
    haze = np.array([fields[b].haze_px for b in segments.body.tolist()])
    scale, wide = np.where(same, np.outer(rms, rms), 0.0), np.exp(-angle / np.radians(_LONG_REACH_DEG))
    return scale * np.exp(-angle / reach[:, None]), scale * wide, np.where(same, np.outer(haze, haze), 0.0) * wide


def _albedo(segments: Segments) -> FloatArray:
    """Covariance of the shifts that unknown albedo makes."""
    gap = segments.place_vu[:, None, :] - segments.place_vu[None, :, :]
    distance = np.hypot(gap[..., 0], gap[..., 1])
    covariance = np.asarray(np.interp(distance, segments.texture_lags_px, segments.texture_px2))
    try:
        cho_factor(covariance + np.diag(segments.sigma_px**2), lower=True)
    except LinAlgError:
        # A measured function of the distance along lines need not be a covariance in the plane: its nearest one.
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
    return covariance


def _common(segments: Segments, common: dict[int, float]) -> FloatArray:
    sigma = np.array([common[b] for b in segments.body.tolist()])
    return np.where(segments.body[:, None] == segments.body[None, :], np.outer(sigma, sigma), 0.0)


def _solve(shift: FloatArray, design: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Step, information, and C^-1 times the residual."""
    factor = cho_factor(covariance, lower=True)
    whitened = cho_solve(factor, design)
    information = design.T @ whitened
    step = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ (whitened.T @ shift)
    return step, information, cho_solve(factor, shift - design @ step)


def _restricted_likelihood(shift: FloatArray, design: FloatArray, covariance: FloatArray) -> float:
    factor = cho_factor(covariance, lower=True)
    whitened = cho_solve(factor, design)
    information = design.T @ whitened
    step = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ (whitened.T @ shift)
    residual = shift - design @ step
    determinant = 2.0 * float(np.log(np.diag(factor[0])).sum())
    values = np.linalg.eigvalsh(information)
    seen = values[values > 1e-10 * values.max()]
    return -0.5 * (determinant + float(np.log(seen).sum()) + float(residual @ cho_solve(factor, residual)))


def _likeliest(
    shift: FloatArray,
    design: FloatArray,
    base: FloatArray,
    near: FloatArray,
    far: FloatArray,
    start: tuple[float, float],
    fields: dict[int, Field_],
    span_deg: float,
    options: ReliefOptions,
) -> tuple[float, float]:
    """Factors of both fields by restricted likelihood and prior, one after the other."""
    width = options.known_width if all(f.known for f in fields.values()) else options.unknown_width
    # Heavy tails: a catalogue that is wrong may be very wrong.
    prior = -2.5 * np.log1p((np.log(_FACTORS) / width) ** 2 / 4.0)
    absent, present = np.log(1.0 - options.wrong_shape_chance), np.log(options.wrong_shape_chance)
    long_prior = np.where(_LONG_FACTORS > 0, present - np.log(len(_LONG_FACTORS) - 1), absent)

    known = all(f.known for f in fields.values())

    def long_wave(f: float, g: float) -> float:
        # A long-wave error is part of what is not known of any shape on a short arc, which cannot show it, and of a
        # line that nobody vouches for.
        if span_deg <= _SHORT_ARC_DEG and any(field.of_shape for field in fields.values()):
            return max(g, _UNKNOWN_LONG)
        return g if known else max(g, _SHOWN_LONG * f)

    def score(f: float, g: float) -> float:
        return _restricted_likelihood(shift, design, base + f**2 * near + long_wave(f, g) ** 2 * far)

    def best_short(g: float) -> tuple[float, float]:
        f = _climb(_FACTORS, start[0], lambda k: prior[k] + score(_FACTORS[k], g))
        k = int(np.argmin(np.abs(_FACTORS - f)))
        return float(prior[k]) + score(f, g), f

    plain = best_short(0.0)
    if plain[1] <= _ODD_FACTOR and start[1] <= long_wave(plain[1], 0.0):
        return plain[1], long_wave(plain[1], 0.0)
    # Reliefs far beyond what was expected: short waves and a wrong shape are weighed against each other.
    scored = [
        (float(p) + s, f, long_wave(f, float(g)))
        for g, p in zip(_LONG_FACTORS, long_prior, strict=True)
        for s, f in [best_short(float(g))]
    ]
    _, short, long_ = max(scored)
    return short, long_


def _climb(grid: FloatArray, start: float, score: Callable[[int], float]) -> float:
    """Highest point of a grid, uphill from the nearest one; two steps further are looked at, over a small dip."""
    known: dict[int, float] = {}

    def at(k: int) -> float:
        if k not in known:
            known[k] = score(k) if 0 <= k < len(grid) else -np.inf
        return known[k]

    here = int(np.argmin(np.abs(grid - start)))
    while True:
        best = max((here - 2, here - 1, here, here + 1, here + 2), key=at)
        if best == here:
            return float(grid[here])
        here = best
