"""How bright a surface is under a scattering law, for arrays and for compiled loops.

``mu0`` and ``mu`` are the cosines of incidence and emission. All laws are normalised to 1 at zero incidence, emission
and phase; a template's scale is fitted anyway.

Sources: Lambert; Lommel-Seeliger and lunar-Lambert (McEwen 1991, Icarus 92, 298, with the weight L(phase) of his
table for the Moon-like case, the cubic that ISIS uses); Minnaert 1941.
"""

import numba
import numpy as np

from pipeline.records import FloatArray, Photometry

LAMBERT, LOMMEL_SEELIGER, LUNAR_LAMBERT, MINNAERT = range(4)
_KIND = {
    Photometry.LAMBERT: LAMBERT, Photometry.LOMMEL_SEELIGER: LOMMEL_SEELIGER, Photometry.LUNAR_LAMBERT: LUNAR_LAMBERT,
    Photometry.MCEWEN: LUNAR_LAMBERT, Photometry.MINNAERT: MINNAERT,
}  # fmt: skip
# McEwen 1996 (LPSC 27, 841): L = 1 + A g + B g^2 + C g^3, g in degrees.
_MCEWEN = (1.0, -0.019, 2.42e-4, -1.46e-6)
_MINNAERT_K = 0.7


def law_of(photometry: Photometry, parameter: float | None, phase_rad: float) -> tuple[int, float]:
    """Law and its parameter for compiled loops.

    Parameters
    ----------
    photometry
        Law.
    parameter
        Lunar-Lambert weight or Minnaert exponent; None takes McEwen's weight for the phase, or 0.7.
    phase_rad
        Sun - body - observer.

    Returns
    -------
    tuple
        Number of the law; its parameter.
    """
    kind = _KIND[photometry]
    if kind == LUNAR_LAMBERT:
        weight = float(np.polynomial.polynomial.polyval(np.degrees(phase_rad), _MCEWEN))
        return kind, float(np.clip(weight, 0.0, 1.0)) if parameter is None else parameter
    return kind, _MINNAERT_K if parameter is None else parameter


@numba.njit(cache=True, nogil=True, inline="always")
def reflectance(kind, parameter, mu0, mu):  # type: ignore[no-untyped-def]
    """Reflectance of one surface element; zero where the Sun is down. See :func:`brightness`."""
    if mu0 <= 0.0:
        return 0.0
    if kind == LAMBERT:
        return mu0
    mu = max(mu, 1e-6)
    if kind == LOMMEL_SEELIGER:
        return 2.0 * mu0 / (mu0 + mu)
    if kind == LUNAR_LAMBERT:
        return parameter * 2.0 * mu0 / (mu0 + mu) + (1.0 - parameter) * mu0
    return mu0**parameter * mu ** (parameter - 1.0)


@numba.vectorize(["float64(int64, float64, float64, float64)"], cache=True)
def _reflectance(kind, parameter, mu0, mu):  # type: ignore[no-untyped-def]
    return reflectance(kind, parameter, mu0, mu)


def brightness(
    photometry: Photometry, parameter: float | None, phase_rad: float, mu0: FloatArray, mu: FloatArray
) -> FloatArray:
    """Relative brightness of surface elements.

    Parameters
    ----------
    photometry, parameter
        Law and its parameter, as in :class:`pipeline.records.Body`.
    phase_rad
        Phase angle.
    mu0, mu
        Cosines of incidence and emission, same shape.

    Returns
    -------
    numpy.ndarray
        Same shape; zero where the Sun is below the horizon.
    """
    kind, value = law_of(photometry, parameter, phase_rad)
    return np.asarray(_reflectance(kind, value, mu0, mu))
