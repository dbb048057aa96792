"""Where a star is seen from a moving spacecraft: proper motion, parallax, aberration.

All three act on unit vectors in J2000/ICRS axes (the frame bias of 23 mas between the two is common to every star
and far below a pixel; attitudes from star trackers are ICRS anyway).
"""

import numpy as np

from pipeline.records import FloatArray, Spacecraft, StarTable

SPEED_OF_LIGHT_KM_S = 299792.458  # SI definition of the metre
ASTRONOMICAL_UNIT_KM = 149597870.7  # IAU 2012 Resolution B2
SECONDS_PER_JULIAN_YEAR = 365.25 * 86400.0
RAD_PER_MAS = np.pi / (180.0 * 3600.0e3)


def julian_year(et: float) -> float:
    """Julian year of TDB seconds past J2000.

    Parameters
    ----------
    et
        Seconds.

    Returns
    -------
    float
        For example 2000.0 at et = 0.
    """
    return 2000.0 + et / SECONDS_PER_JULIAN_YEAR


def unit_vectors(ra_deg: FloatArray, dec_deg: FloatArray) -> FloatArray:
    """Unit vectors of spherical coordinates.

    Parameters
    ----------
    ra_deg, dec_deg
        (n,) degrees.

    Returns
    -------
    numpy.ndarray
        (n, 3).
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def apply_proper_motion(
    directions: FloatArray, pm_ra_masyr: FloatArray, pm_dec_masyr: FloatArray, years: FloatArray
) -> FloatArray:
    """Move stars along their tangent vectors (Hipparcos Catalogue vol. 1, eq. 1.2.16 without radial velocity).

    Parameters
    ----------
    directions
        (n, 3) unit vectors at the catalogue epoch.
    pm_ra_masyr, pm_dec_masyr
        (n,) mas per Julian year, the first with cos(dec); NaN counts as zero.
    years
        (n,) Julian years from the catalogue epoch.

    Returns
    -------
    numpy.ndarray
        (n, 3) unit vectors.
    """
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    # At a pole east is undefined; any direction will do since cos(dec) is already inside pm_ra.
    safe = np.where(horizontal > 0, horizontal, 1.0)
    east = np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(directions))], axis=1) / safe[:, None]
    east[horizontal == 0] = (0.0, 1.0, 0.0)
    north = np.cross(directions, east)
    rate_east = np.nan_to_num(pm_ra_masyr) * RAD_PER_MAS
    rate_north = np.nan_to_num(pm_dec_masyr) * RAD_PER_MAS
    moved = directions + years[:, None] * (rate_east[:, None] * east + rate_north[:, None] * north)
    result: FloatArray = moved / np.linalg.norm(moved, axis=1)[:, None]
    return result


def apply_parallax(directions: FloatArray, parallax_mas: FloatArray, position_km: FloatArray) -> FloatArray:
    """Shift stars to where an observer away from the barycentre sees them.

    Parameters
    ----------
    directions
        (n, 3) barycentric unit vectors.
    parallax_mas
        (n,) NaN or negative counts as zero.
    position_km
        (3,) observer from the barycentre.

    Returns
    -------
    numpy.ndarray
        (n, 3) unit vectors; exact for any distance: ``u - parallax * position``.
    """
    parallax_rad = np.clip(np.nan_to_num(parallax_mas), 0.0, None) * RAD_PER_MAS
    shifted = directions - parallax_rad[:, None] * (position_km / ASTRONOMICAL_UNIT_KM)
    result: FloatArray = shifted / np.linalg.norm(shifted, axis=1)[:, None]
    return result


def apply_aberration(directions: FloatArray, velocity_km_s: FloatArray) -> FloatArray:
    """Relativistic stellar aberration (Explanatory Supplement 1992, eq. 3.252-3).

    Parameters
    ----------
    directions
        (n, 3) unit vectors toward the stars in the barycentre's rest frame.
    velocity_km_s
        (3,) observer's velocity in that frame.

    Returns
    -------
    numpy.ndarray
        (n, 3) unit vectors as the moving observer sees them.
    """
    beta = velocity_km_s / SPEED_OF_LIGHT_KM_S
    inverse_gamma = np.sqrt(1.0 - beta @ beta)
    along = directions @ beta
    seen = inverse_gamma * directions + (1.0 + along / (1.0 + inverse_gamma))[:, None] * beta
    result: FloatArray = seen / np.linalg.norm(seen, axis=1)[:, None]
    return result


def apparent_directions(stars: StarTable, et: float, spacecraft: Spacecraft) -> FloatArray:
    """J2000 directions in which the spacecraft sees the stars at an instant.

    Parameters
    ----------
    stars
        Catalogue places; those marked apparent are taken as they are.
    et
        TDB seconds past J2000.
    spacecraft
        Position (for parallax) and velocity (for aberration), each used if known.

    Returns
    -------
    numpy.ndarray
        (n, 3) unit vectors.
    """
    catalogue = unit_vectors(stars.ra_deg, stars.dec_deg)
    years = np.nan_to_num(julian_year(et) - stars.epoch)
    place = apply_proper_motion(catalogue, stars.pm_ra_masyr, stars.pm_dec_masyr, years)
    if spacecraft.position_km is not None:
        place = apply_parallax(place, stars.parallax_mas, spacecraft.position_km)
    if spacecraft.velocity_km_s is not None:
        place = apply_aberration(place, spacecraft.velocity_km_s)
    return np.where(stars.apparent[:, None], catalogue, place)
