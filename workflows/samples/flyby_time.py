"""Clocks of the flyby sample: UTC, TDB seconds past J2000 (et) and the spacecraft clocks, by their own formulas."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from math import prod, sin

J2000 = datetime(2000, 1, 1, 12)
LEAP_SECONDS: tuple[tuple[int, int, int], ...] = (
    (10, 1972, 1), (11, 1972, 7), (12, 1973, 1), (13, 1974, 1), (14, 1975, 1), (15, 1976, 1), (16, 1977, 1),
    (17, 1978, 1), (18, 1979, 1), (19, 1980, 1), (20, 1981, 7), (21, 1982, 7), (22, 1983, 7), (23, 1985, 7),
    (24, 1988, 1), (25, 1990, 1), (26, 1991, 1), (27, 1992, 7), (28, 1993, 7), (29, 1994, 7), (30, 1996, 1),
    (31, 1997, 7), (32, 1999, 1), (33, 2006, 1), (34, 2009, 1), (35, 2012, 7), (36, 2015, 7), (37, 2017, 1),
)  # fmt: skip
"""TAI - UTC in seconds from the first day of a month on: (seconds, year, month), IERS Bulletin C."""
TT_MINUS_TAI_S = 32.184
TDB_AMPLITUDE_S = 1.657e-3
ORBIT_ECCENTRICITY = 1.671e-2
MEAN_ANOMALY = (6.239996, 1.99096871e-7)
"""TDB - TT = K sin(M + EB sin M) with M linear in seconds past J2000: Moyer 1981, the form NAIF's time kernel takes."""


def tai_minus_utc(utc: datetime) -> int:
    """Return TAI - UTC, s, at a UTC after 1972."""
    return max(seconds for seconds, year, month in LEAP_SECONDS if datetime(year, month, 1) <= utc)


def et_from_utc(utc: datetime) -> float:
    """Return TDB seconds past J2000 of a UTC that is no leap second."""
    span = utc - J2000
    tt = span.days * 86400.0 + span.seconds + tai_minus_utc(utc) + TT_MINUS_TAI_S + span.microseconds * 1e-6
    anomaly = MEAN_ANOMALY[0] + MEAN_ANOMALY[1] * tt
    return tt + TDB_AMPLITUDE_S * sin(anomaly + ORBIT_ECCENTRICITY * sin(anomaly))


def whole_milliseconds(utc: datetime) -> datetime:
    """Return a UTC cut to the milliseconds that labels hold."""
    return utc - timedelta(microseconds=utc.microsecond % 1000)


def calendar_text(utc: datetime) -> str:
    """Return YYYY-MM-DDThh:mm:ss.sss."""
    return utc.isoformat(timespec="milliseconds")


def day_of_year_text(utc: datetime) -> str:
    """Return YYYY-DDDThh:mm:ss.sss, the form of Cassini's labels."""
    return utc.strftime("%Y-%jT%H:%M:%S.") + f"{utc.microsecond // 1000:03d}"


@dataclass(frozen=True)
class Clock:
    """A spacecraft clock that runs evenly in TDB.

    Attributes
    ----------
    spacecraft_id
        NAIF id; the clock's own id in SCLK kernels.
    moduli, offsets
        Of the counter's fields, the slowest first.
    seconds_per_count
        TDB seconds per count of the slowest field.
    known_utc, known_ticks
        One UTC and the ticks since zero that the clock shows then.
    """

    spacecraft_id: int
    moduli: tuple[int, ...]
    offsets: tuple[int, ...]
    seconds_per_count: float
    known_utc: datetime
    known_ticks: int

    @property
    def ticks_per_count(self) -> int:
        """Ticks of the fastest field in a count of the slowest."""
        return prod(self.moduli[1:])

    @property
    def zero_et(self) -> float:
        """TDB seconds past J2000 of the clock's zero."""
        return et_from_utc(self.known_utc) - self.known_ticks * self.seconds_per_count / self.ticks_per_count

    def ticks(self, et: float) -> float:
        """Return the continuous count of ticks at an et."""
        return (et - self.zero_et) * self.ticks_per_count / self.seconds_per_count

    def fields(self, et: float) -> tuple[int, ...]:
        """Return what the fields show at an et, rounded to the nearest tick."""
        left = round(self.ticks(et))
        shown: list[int] = []
        for modulus, offset in zip(reversed(self.moduli[1:]), reversed(self.offsets[1:]), strict=True):
            left, rest = divmod(left, modulus)
            shown.append(rest + offset)
        return (left + self.offsets[0], *reversed(shown))


CASSINI_CLOCK = Clock(
    -82, (4_294_967_296, 256), (0, 0), 1.0, datetime(2004, 9, 6, 14, 12, 43, 332_000), 1_473_172_656 * 256 + 118
)
"""Seconds since 1958 and 256ths of them; the pair is that of the label of N1473172656_1."""
VOYAGER_CLOCK = Clock(
    -32, (65_536, 60, 800), (0, 0, 1), 2880.0, datetime(1979, 7, 11, 1, 19, 58), 20_693 * 48_000 + 1_600
)
"""Flight data system count: images of 48 s, sixty to the slowest count, 800 lines of 0.06 s; the pair is C2069302's."""
NEW_HORIZONS_CLOCK = Clock(-98, (10_000_000_000, 50_000), (0, 0), 1.0, datetime(2006, 1, 19, 18, 8, 2), 0)
"""Mission elapsed time: seconds since about launch, ticks of 20 us."""
