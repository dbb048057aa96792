"""What the providers of a State share: times, settings, the camera's recognition, and a last look at the figures."""

import warnings
from collections.abc import Mapping

import numpy as np
from astropy.time import Time
from astropy.utils import iers
from erfa import ErfaWarning
from pydantic import ValidationError

from catalogs.instruments import InstrumentBlock
from pipeline.camera import unproject
from pipeline.errors import ContractError, GeometryError
from pipeline.geometry.astrometry import SPEED_OF_LIGHT_KM_S, julian_year
from pipeline.options import InstrumentSettings
from pipeline.records import Body, FloatArray, State
from pipeline.status import StatusReason

# Beyond these no figure can be meant: camera in space, inside the heliosphere's surroundings, not tumbling.
_YEARS = (1950.0, 2150.0)
_FARTHEST_KM = 1e12
_FASTEST_TURN_RAD_S = 10.0


def plausible(state: State) -> State:
    """The state, refused where a figure is out of this world and would only end in overflows.

    Parameters
    ----------
    state
        From any provider.

    Returns
    -------
    State
        The same.

    Raises
    ------
    ContractError
        One line with the figure.
    """
    position, velocity, rate = state.spacecraft.position_km, state.spacecraft.velocity_km_s, state.attitude.rate_rad_s
    year = julian_year(state.et)
    rows, columns = state.camera_model.shape_vu
    corners = np.array([[0.0, 0.0], [0.0, columns - 1.0], [rows - 1.0, 0.0], [rows - 1.0, columns - 1.0]])
    with np.errstate(all="ignore"):
        problem = next((text for text, wrong in (
            (f"year {year:.6g} lies outside {_YEARS[0]:.0f} to {_YEARS[1]:.0f}", not _YEARS[0] < year < _YEARS[1]),
            (f"spacecraft farther than {_FARTHEST_KM:g} km", _exceeds(position, _FARTHEST_KM)),
            ("spacecraft as fast as light", _exceeds(velocity, 0.1 * SPEED_OF_LIGHT_KM_S)),
            (f"camera turns faster than {_FASTEST_TURN_RAD_S:g} rad/s", _exceeds(rate, _FASTEST_TURN_RAD_S)),
            ("camera model cannot be inverted over its array", not unproject(state.camera_model, corners)[1].all()),
        ) if wrong), None)  # fmt: skip
    problem = problem or next((text for text in map(_body_problem, state.bodies) if text is not None), None)
    if problem is not None:
        raise ContractError(problem)
    return state


def _body_problem(body: Body) -> str | None:
    if _exceeds(body.position_km, _FARTHEST_KM) or _exceeds(body.radii_km, _FARTHEST_KM):
        return f"{body.name} is farther or larger than {_FARTHEST_KM:g} km"
    # The ellipsoid around a mesh may hold a camera that the mesh itself does not.
    inside = float(np.linalg.norm(body.body_from_j2000 @ body.position_km / body.radii_km)) <= 1.0
    return f"the camera is inside {body.name}" if inside and body.mesh is None else None


def _exceeds(vector: FloatArray | None, limit: float) -> bool:
    return vector is not None and not bool(np.abs(vector).max() < limit)


def first_problem(error: ValidationError) -> str:
    """One line for the first of a validation's complaints.

    Parameters
    ----------
    error
        Pydantic's error.

    Returns
    -------
    str
        ``key: what is wrong``.
    """
    # Of alternatives the one that got furthest is the one that was meant.
    problem = max(error.errors(include_url=False), key=lambda problem: len(problem["loc"]))
    where = ".".join(str(part) for part in problem["loc"] if not _is_alternative(part)) or "document"
    return f"{where}: {problem['msg']}"


def _is_alternative(part: int | str) -> bool:
    """Whether a step of a problem's place is pydantic's name for one of several types."""
    return isinstance(part, str) and (part in ("str", "constrained-str", "StarTableRef", "IndexRef") or "[" in part)


def settings_of(block: InstrumentBlock | None, source: object, overrides: Mapping[str, object]) -> InstrumentSettings:
    """Instrument's settings, then those of the sidecar or mode, then the archive's.

    Parameters
    ----------
    block
        Camera block, if there is one.
    source
        Anything with attributes of the settings' names; None stands for not said.
    overrides
        The archive's settings, which win.

    Returns
    -------
    InstrumentSettings
        Checked.
    """
    names = InstrumentSettings.model_fields
    values: dict[str, object] = {name: getattr(block, name) for name in names} if block else {}
    for name in names:
        own = getattr(source, name, None)
        if own is not None:
            values[name] = own
    return InstrumentSettings.model_validate({**values, **overrides})


def et_of_utc(text: str) -> float:
    """TDB seconds past J2000 of a UTC time.

    Parameters
    ----------
    text
        ISO-8601.

    Returns
    -------
    float
        Seconds; leap seconds from the table that astropy ships, nothing is downloaded.

    Raises
    ------
    GeometryError
        If the text is no time.
    """
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        # Before 1972 and in the far future UTC is approximate, which no star notices.
        warnings.simplefilter("ignore", ErfaWarning)
        try:
            time = Time(text.removesuffix("Z"), scale="utc")
        except ValueError as error:
            raise GeometryError(StatusReason.GEOMETRY_INVALID, f"{text!r} is not an ISO-8601 time") from error
        tdb = time.tdb
    return float(((tdb.jd1 - 2451545.0) + tdb.jd2) * 86400.0)
