"""Ring catalogues: one schema for the shipped ones, a user's own file, and sidecars."""

from collections.abc import Iterable
from functools import cache
from importlib.resources import files

import numpy as np
import yaml
from pydantic import Field, ValidationError, model_validator

from catalogs.geometry import et_of_utc, first_problem
from pipeline.errors import ConfigurationError, GeometryError
from pipeline.options import Options
from pipeline.records import RingFeature, RingKind

_SECONDS_PER_DAY = 86400.0


class RingMode(Options):
    """One normal mode: the radius loses ``amplitude cos(m (longitude - longitude_deg - speed t))``."""

    m: int = Field(ge=-200, le=200, description="azimuthal number; of 0 the phase is longitude_deg itself")
    amplitude_km: float = Field(description="radial amplitude, km")
    longitude_deg: float = Field(0.0, description="longitude of a minimum at the epoch, degrees")
    pattern_speed_deg_day: float = Field(0.0, description="motion of the pattern (of the phase if m = 0), deg/day")

    def at(self, days: float, shift_deg: float = 0.0) -> tuple[float, float, float]:
        """m, amplitude in km and phase in radians, days after the epoch; longitudes are shifted, phases are not."""
        shift = 0.0 if self.m == 0 else shift_deg
        angle = np.radians((self.longitude_deg + shift + self.pattern_speed_deg_day * days) % 360.0)
        return float(self.m), self.amplitude_km, float(angle if self.m == 0 else self.m * angle)


class RingBlock(Options):
    """One ringlet, gap or edge."""

    name: str = Field(min_length=1, description="unique in its system")
    kind: RingKind = Field(description="ringlet, gap, edge_outer (ring inside) or edge_inner (ring outside)")
    a_km: float = Field(gt=0, description="semi-major axis of the (inner) edge, km")
    ae_km: float = Field(0.0, ge=0, description="its eccentricity times that, km")
    long_peri_deg: float = Field(0.0, description="longitude of pericentre at the epoch, degrees")
    long_peri_rate_deg_day: float = Field(0.0, description="its motion, degrees per day")
    width_km: float = Field(0.0, ge=0, description="outer minus inner edge, km")
    tau: float | None = Field(None, ge=0, description="normal optical depth; of an edge that of its denser side")
    sigma_a_km: float | None = Field(None, ge=0, description="1 sigma of the radius, km")
    modes: tuple[RingMode, ...] = Field((), description="normal modes beside the ellipse")
    a_sin_i_km: float = Field(0.0, ge=0, description="largest height over the plane, km")
    long_node_deg: float = Field(0.0, description="longitude of the ascending node on the plane at the epoch, degrees")
    long_node_rate_deg_day: float = Field(0.0, description="its motion, degrees per day")
    source: str | None = Field(None, description="where the figures come from")

    @model_validator(mode="after")
    def _edges_make_sense(self) -> "RingBlock":
        wide = self.kind in (RingKind.RINGLET, RingKind.GAP)
        if wide and self.width_km == 0.0:
            raise ValueError(f"{self.name}: a {self.kind.value} needs a width_km")
        if self.ae_km >= self.a_km:
            raise ValueError(f"{self.name}: ae_km must be below a_km")
        return self

    def feature(self, days: float, shift_deg: float = 0.0) -> RingFeature:
        """Record of this feature some days after the epoch.

        Parameters
        ----------
        days
            From the catalogue's epoch to when the light left.
        shift_deg
            Added to every longitude.

        Returns
        -------
        RingFeature
            Checked.
        """
        peri = self.long_peri_deg + shift_deg + self.long_peri_rate_deg_day * days
        node = self.long_node_deg + shift_deg + self.long_node_rate_deg_day * days
        modes = np.array([mode.at(days, shift_deg) for mode in self.modes]).reshape(-1, 3)
        return RingFeature(
            self.name, self.kind, self.a_km, self.ae_km, float(np.radians(peri % 360.0)), self.width_km, self.tau,
            self.sigma_a_km, modes, self.a_sin_i_km, float(np.radians(node % 360.0)),
        )  # fmt: skip


class RingCatalog(Options):
    """Content of a catalogue file."""

    planet: str = Field(min_length=1, description="as the kernels name it")
    epoch_utc: str = Field(description="of longitudes and phases, ISO-8601")
    source: str | None = Field(None, description="where the figures come from")
    node_offset_deg: float = Field(
        0.0, description="added to every longitude to count from the plane's ascending node on the J2000 equator"
    )
    pole_sign: int = Field(
        1, ge=-1, le=1, description="-1 where longitudes are counted about the pole opposite to that of the kernels"
    )
    features: tuple[RingBlock, ...] = Field(min_length=1, description="ringlets, gaps and edges")

    @model_validator(mode="after")
    def _names_are_unique(self) -> "RingCatalog":
        names = [feature.name for feature in self.features]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"named twice: {', '.join(twice)}")
        if self.pole_sign == 0:
            raise ValueError("pole_sign must be 1 or -1")
        et_of_utc(self.epoch_utc)
        return self

    def at(self, et: float) -> tuple[RingFeature, ...]:
        """Features when the light left.

        Parameters
        ----------
        et
            TDB seconds past J2000 at the rings.

        Returns
        -------
        tuple of RingFeature
            In the order of the file.
        """
        days = (et - et_of_utc(self.epoch_utc)) / _SECONDS_PER_DAY
        return tuple(feature.feature(days, self.node_offset_deg) for feature in self.features)


def parse_rings(data: bytes | str, source: str) -> RingCatalog:
    """Read a ring catalogue.

    Parameters
    ----------
    data
        YAML.
    source
        Its name, for messages.

    Returns
    -------
    RingCatalog
        Checked.

    Raises
    ------
    ConfigurationError
        One line that names the file and the key.
    """
    try:
        return RingCatalog.model_validate(yaml.safe_load(data))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(f"{source} is not YAML: {' '.join(str(error).split())}") from error
    except ValidationError as error:
        raise ConfigurationError(f"{source}: {first_problem(error)}") from error
    except GeometryError as error:
        raise ConfigurationError(f"{source}: epoch_utc: {error.detail}") from error


@cache
def built_in_rings() -> tuple[RingCatalog, ...]:
    """Catalogues that come with the project.

    Returns
    -------
    tuple of RingCatalog
        One per planet.
    """
    folder = files("catalogs") / "rings"
    entries = sorted((e for e in folder.iterdir() if e.name.endswith(".yaml")), key=lambda e: e.name)
    return tuple(parse_rings(entry.read_text(encoding="utf-8"), entry.name) for entry in entries)


def rings_of(catalogs: Iterable[RingCatalog], planet: str) -> RingCatalog | None:
    """Catalogue of a planet; the last one wins.

    Parameters
    ----------
    catalogs
        Shipped ones first, the user's own on top.
    planet
        Name in any case.

    Returns
    -------
    RingCatalog or None
        None where nobody knows rings of it.
    """
    found = [catalog for catalog in catalogs if catalog.planet.upper() == planet.upper()]
    return found[-1] if found else None
