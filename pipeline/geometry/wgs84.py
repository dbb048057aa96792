"""Planetodetic coordinates on any ellipsoid, WGS 84 among them, and local tangent planes."""

from dataclasses import dataclass

import numpy as np

from pipeline.errors import ContractError
from pipeline.records import FloatArray, Record

# Semi-major axis and inverse flattening: NIMA TR8350.2 (third edition), table 3.1.
WGS84_A_KM = 6378.137
WGS84_INVERSE_FLATTENING = 298.257223563
_MAX_STEPS = 50
# Of the scaled multiplier; a double keeps about 2e-16, and one step more changes nothing.
_SETTLED = 1e-15


@dataclass(frozen=True, eq=False)
class Datum(Record):
    """Reference ellipsoid of a body.

    Attributes
    ----------
    name
        What outputs call it.
    radii_km
        (3,) semi-axes along the body-fixed axes.
    """

    name: str
    radii_km: FloatArray

    def __post_init__(self) -> None:
        self._freeze(radii_km=(3,))
        if not (np.isfinite(self.radii_km).all() and (self.radii_km > 0).all()):
            raise ContractError(f"{self.name}: radii {self.radii_km.tolist()} km must be positive")


def wgs84() -> Datum:
    """The Earth's ellipsoid.

    Returns
    -------
    Datum
        WGS 84.
    """
    polar = WGS84_A_KM * (1.0 - 1.0 / WGS84_INVERSE_FLATTENING)
    return Datum("WGS84", np.array([WGS84_A_KM, WGS84_A_KM, polar]))


@dataclass(frozen=True, eq=False)
class Geoid(Record):
    """Heights of mean sea level over the ellipsoid, on a regular grid of the user's.

    Attributes
    ----------
    lat_deg, lon_deg
        (rows,), (cols,) ascending; longitudes cover a full turn or only a region.
    height_m
        (rows, cols).
    """

    lat_deg: FloatArray
    lon_deg: FloatArray
    height_m: FloatArray

    def __post_init__(self) -> None:
        rows, cols = len(self.lat_deg), len(self.lon_deg)
        self._freeze(lat_deg=(rows,), lon_deg=(cols,), height_m=(rows, cols))
        if rows < 2 or cols < 2 or (np.diff(self.lat_deg) <= 0).any() or (np.diff(self.lon_deg) <= 0).any():
            raise ContractError("a geoid needs a grid of ascending latitudes and longitudes")

    def height_at(self, lat_deg: float, lon_deg: float) -> float | None:
        """Bilinear height of the geoid, metres; None beyond the grid."""
        lon = self.lon_deg[0] + (lon_deg - self.lon_deg[0]) % 360.0
        if not (self.lat_deg[0] <= lat_deg <= self.lat_deg[-1] and lon <= self.lon_deg[-1]):
            return None
        i = min(int(np.searchsorted(self.lat_deg, lat_deg, "right")) - 1, len(self.lat_deg) - 2)
        j = min(int(np.searchsorted(self.lon_deg, lon, "right")) - 1, len(self.lon_deg) - 2)
        y = (lat_deg - self.lat_deg[i]) / (self.lat_deg[i + 1] - self.lat_deg[i])
        x = (lon - self.lon_deg[j]) / (self.lon_deg[j + 1] - self.lon_deg[j])
        cell = self.height_m[i : i + 2, j : j + 2]
        return float(np.array([1 - y, y]) @ cell @ np.array([1 - x, x]))


class WgsConverter:
    """Body-fixed kilometres, planetodetic coordinates and local tangent planes of one datum.

    Latitude and longitude are those of the ellipsoid's outward normal, longitude positive east in (-180, 180];
    height is along that normal. On a triaxial body the normal's longitude is not that of the position vector.

    Parameters
    ----------
    datum
        Ellipsoid; WGS 84 by default.
    """

    def __init__(self, datum: Datum | None = None) -> None:
        self.datum = wgs84() if datum is None else datum

    def geodetic(self, points_km: FloatArray) -> FloatArray:
        """Latitude, longitude and height.

        The foot of the normal is ``x_i = a_i^2 p_i / (a_i^2 + t)`` for the largest root t of
        ``sum (a_i p_i / (a_i^2 + t))^2 = 1``, a function that Newton's method descends monotonically from the left
        (Eberly, "Distance from a point to an ellipsoid").

        Parameters
        ----------
        points_km
            (n, 3) body-fixed.

        Returns
        -------
        numpy.ndarray
            (n, 3): degrees, degrees, metres; NaN at the centre, where no normal is nearest.
        """
        unit = float(self.datum.radii_km.min())
        axes2 = (self.datum.radii_km / unit) ** 2
        p = np.asarray(points_km, dtype=float) / unit
        root = self._multiplier(p, axes2)
        foot = axes2 * p / (axes2 + root[:, None])
        normal = foot / axes2
        length = np.linalg.norm(normal, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal = normal / np.where(length > 0, length, np.nan)[:, None]
        height = ((p - foot) * normal).sum(axis=1)
        lat = np.degrees(np.arctan2(normal[:, 2], np.hypot(normal[:, 0], normal[:, 1])))
        lon = np.degrees(np.arctan2(normal[:, 1], normal[:, 0]))
        lon = np.where(np.isfinite(lat), lon, np.nan)
        return np.stack([lat, lon, height * unit * 1e3], axis=1)

    @staticmethod
    def _multiplier(p: FloatArray, axes2: FloatArray) -> FloatArray:
        """Largest root t > -1 for points and squared axes in units of the smallest axis."""
        # Left of the root: one term alone already reaches one there.
        weighted = np.abs(p) * np.sqrt(axes2)
        root = np.asarray((weighted - axes2).max(axis=1))
        root = np.maximum(root, -1.0 + 1e-12)
        for _ in range(_MAX_STEPS):
            ratio = weighted / (axes2 + root[:, None])
            value = (ratio**2).sum(axis=1) - 1.0
            slope = -2.0 * (ratio**2 / (axes2 + root[:, None])).sum(axis=1)
            step = np.where(value > 0, -value / np.where(slope < 0, slope, -1.0), 0.0)
            root = root + step
            if (np.abs(step) <= _SETTLED * (1.0 + np.abs(root))).all():
                break
        return np.asarray(root)

    def body_fixed(self, geodetic: FloatArray) -> FloatArray:
        """Inverse of :meth:`geodetic`.

        Parameters
        ----------
        geodetic
            (n, 3) latitude and longitude in degrees, height in metres.

        Returns
        -------
        numpy.ndarray
            (n, 3) km, body-fixed.
        """
        geodetic = np.asarray(geodetic, dtype=float)
        normal = self._normal(geodetic)
        axes2 = self.datum.radii_km**2
        foot = axes2 * normal / np.sqrt((axes2 * normal**2).sum(axis=1))[:, None]
        return np.asarray(foot + geodetic[:, 2:] * 1e-3 * normal)

    @staticmethod
    def _normal(geodetic: FloatArray) -> FloatArray:
        lat, lon = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
        return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)

    def local_from_body(self, lat_deg: float, lon_deg: float) -> FloatArray:
        """Axes of the local tangent plane.

        Parameters
        ----------
        lat_deg, lon_deg
            Planetodetic place.

        Returns
        -------
        numpy.ndarray
            (3, 3) rotation onto (east, north, up).
        """
        lat, lon = np.radians(lat_deg), np.radians(lon_deg)
        return np.array(
            [
                [-np.sin(lon), np.cos(lon), 0.0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )

    def to_local(self, points_km: FloatArray, origin: FloatArray) -> FloatArray:
        """Points in the tangent plane at an origin.

        Parameters
        ----------
        points_km
            (n, 3) body-fixed.
        origin
            (3,) latitude, longitude (degrees) and height (metres).

        Returns
        -------
        numpy.ndarray
            (n, 3) east, north, up, metres.
        """
        rotation = self.local_from_body(float(origin[0]), float(origin[1]))
        return np.asarray((points_km - self.body_fixed(np.asarray(origin)[None])) @ rotation.T * 1e3)

    def from_local(self, local_m: FloatArray, origin: FloatArray) -> FloatArray:
        """Inverse of :meth:`to_local`.

        Parameters
        ----------
        local_m
            (n, 3) east, north, up, metres.
        origin
            (3,) latitude, longitude (degrees) and height (metres).

        Returns
        -------
        numpy.ndarray
            (n, 3) km, body-fixed.
        """
        rotation = self.local_from_body(float(origin[0]), float(origin[1]))
        return np.asarray(local_m @ rotation * 1e-3 + self.body_fixed(np.asarray(origin)[None]))
