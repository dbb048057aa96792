"""Matches of many views and the cameras that saw them: ``MATCHES.parquet`` and ``cameras.json``."""

import json
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.errors import ConfigurationError, ContractError
from pipeline.geometry.wgs84 import Datum, Geoid, wgs84
from pipeline.pose.normalise import pinhole_camera
from pipeline.pose.records import CameraCalibration, MatchError, Pose
from pipeline.records import CameraModel, FloatArray, Record

_REQUIRED = ("view_id", "point_id", "v_px", "u_px")
# Beyond, a floating-point column cannot hold every whole number.
_LARGEST_ID = 2**53
_PIXEL_COVARIANCE = ("cov_vv", "cov_vu", "cov_uu")
_PLACE = ("x_km", "y_km", "z_km")
_POINT_COVARIANCE = ("cov_xx_km2", "cov_xy_km2", "cov_xz_km2", "cov_yy_km2", "cov_yz_km2", "cov_zz_km2")


@dataclass(frozen=True, eq=False)
class MatchTable(Record):
    """All matches of a file as one struct of arrays; values are checked where a view is solved.

    Attributes
    ----------
    view_id, point_id
        (n,).
    pixels_vu
        (n, 2).
    pixel_covariance_px2
        (n, 2, 2) in the order (v, u); None where the file has none.
    points_km
        (n, 3); None where the file has none.
    point_covariance_km2
        (n, 3, 3); None where the file has none.
    """

    view_id: NDArray[np.int64]
    point_id: NDArray[np.int64]
    pixels_vu: FloatArray
    pixel_covariance_px2: FloatArray | None
    points_km: FloatArray | None
    point_covariance_km2: FloatArray | None

    def __post_init__(self) -> None:
        n = len(self.view_id)
        self._freeze(
            view_id=(n,), point_id=(n,), pixels_vu=(n, 2), pixel_covariance_px2=(n, 2, 2), points_km=(n, 3),
            point_covariance_km2=(n, 3, 3),
        )  # fmt: skip

    def take(self, which: NDArray[np.generic]) -> "MatchTable":
        """Rows of an index or mask."""
        return MatchTable(
            self.view_id[which], self.point_id[which], self.pixels_vu[which],
            *(None if a is None else a[which] for a in (
                self.pixel_covariance_px2, self.points_km, self.point_covariance_km2
            )),
        )  # fmt: skip


@dataclass(frozen=True)
class ArcView:
    """One view of an arc: its time, what was believed of its pose, and whether its compute budget was short."""

    view_id: int
    et: float
    prior: Pose
    throttled: bool


@dataclass(frozen=True)
class Arc:
    """Views of one orbit, flyby or flight.

    Attributes
    ----------
    arc_id
        Name.
    options
        Fields of ``pipeline.pose.arcs.ArcOptions``.
    views
        In the order of time.
    """

    arc_id: str
    options: dict[str, float]
    views: tuple[ArcView, ...]


@dataclass(frozen=True)
class Cameras:
    """What ``cameras.json`` says.

    Attributes
    ----------
    calibration
        The one camera of all views, its mounting, the datum of the body and, where the file brings one, its geoid.
    poses
        Given poses by view id, in the order of the file.
    arcs
        Arcs, if the file has any.
    """

    calibration: CameraCalibration
    poses: dict[int, Pose]
    arcs: tuple[Arc, ...] = ()


def _text(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(names)


def read_matches(data: bytes, name: str, one_view: bool = False) -> MatchTable:
    """Read and check a table of matches.

    Parameters
    ----------
    data
        A Parquet file: ``view_id, point_id, v_px, u_px``; optionally ``cov_vv, cov_vu, cov_uu`` (px^2),
        ``x_km, y_km, z_km`` and ``cov_xx_km2`` ... ``cov_zz_km2``.
    name
        For messages.
    one_view
        Whether all rows are of one view, which then need not be named.

    Returns
    -------
    MatchTable
        Its rows in their order.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, a column is missing or of the wrong kind, it has no rows, or more views than one.
    """
    try:
        table = pd.read_parquet(BytesIO(data))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise ConfigurationError(f"{name}: no Parquet table ({str(error).splitlines()[0]})") from error
    if one_view:
        if "view_id" in table and table["view_id"].nunique() > 1:
            raise ConfigurationError(f"{name}: matches of more than one view")
        table = table.assign(view_id=0)
    missing = [column for column in _REQUIRED if column not in table]
    if missing:
        raise ConfigurationError(f"{name}: no column {_text(missing)}; matches need {_text(_REQUIRED)}")
    if not len(table):
        raise ConfigurationError(f"{name}: no rows")
    ids = [_integers(table, column, name) for column in _REQUIRED[:2]]
    pixel = _columns(table, _PIXEL_COVARIANCE, name)
    point = _columns(table, _POINT_COVARIANCE, name)
    places = _columns(table, _PLACE, name)
    if point is not None and places is None:
        raise ConfigurationError(f"{name}: covariances of points without {_text(_PLACE)}")
    pixels = _columns(table, _REQUIRED[2:], name)
    assert pixels is not None
    return MatchTable(
        ids[0], ids[1], pixels, None if pixel is None else _symmetric(pixel, 2), places,
        None if point is None else _symmetric(point, 3),
    )  # fmt: skip


def read_image_matches(data: bytes, name: str) -> MatchTable:
    """Read the matches of one image, which lie beside it or come from another program.

    Parameters
    ----------
    data
        A Parquet file as for :func:`read_matches`; ``view_id`` is not needed, places of the points are.
    name
        For messages.

    Returns
    -------
    MatchTable
        Its rows in their order, all of view 0.

    Raises
    ------
    ConfigurationError
        If it is no such file, or of several views.
    """
    found = read_matches(data, name, one_view=True)
    if found.points_km is None:
        raise ConfigurationError(f"{name}: no column {_text(_PLACE)}; matches of one image need places of its points")
    return found


def _integers(table: pd.DataFrame, column: str, name: str) -> NDArray[np.int64]:
    values = pd.to_numeric(table[column], errors="coerce")
    whole = values.notna() & (values % 1 == 0) & (values.abs() < _LARGEST_ID)
    if not whole.all():
        raise ConfigurationError(f"{name}: {column} of row {int(np.flatnonzero(~whole)[0])} is no whole number")
    return values.to_numpy(np.int64)


def _columns(table: pd.DataFrame, names: tuple[str, ...], name: str) -> FloatArray | None:
    """(n, k) of columns that come together or not at all."""
    have = [column for column in names if column in table]
    if not have:
        return None
    if len(have) < len(names):
        raise ConfigurationError(f"{name}: {_text(have)} without the others of {_text(names)}")
    kinds = [column for column in names if not pd.api.types.is_numeric_dtype(table[column])]
    if kinds:
        raise ConfigurationError(f"{name}: {_text(kinds)} hold no numbers")
    return table[list(names)].to_numpy(np.float64)


def _symmetric(upper: FloatArray, size: int) -> FloatArray:
    full = np.zeros((len(upper), size, size))
    for k, (i, j) in enumerate(zip(*np.triu_indices(size), strict=True)):
        full[:, i, j] = full[:, j, i] = upper[:, k]
    return full


def read_cameras(data: bytes, name: str) -> Cameras:
    """Read ``cameras.json``.

    Parameters
    ----------
    data
        ``{K, shape_vu, views: [{view_id, position_km, camera_from_body}], datum: {name, radii_km}}``; K maps (x, y, 1)
        to (u, v, 1). In the place of K, ``camera_model`` as in a sidecar. Without a datum WGS 84 is meant. Optional
        ``arcs: [{arc_id, options, views: [{view_id, et, position_km, camera_from_body, throttled}]}]`` with what was
        believed of each pose; ``vehicle: {camera_from_vehicle, camera_in_vehicle_m}``, the mounting; and
        ``geoid: {lat_deg, lon_deg, height_m}``, a grid of heights of mean sea level above the ellipsoid.
    name
        For messages.

    Returns
    -------
    Cameras
        The camera and the poses given.

    Raises
    ------
    ConfigurationError
        If it is no such file.
    """
    try:
        content = json.loads(data)
        views = content["views"]
        poses = {_whole(view["view_id"]): _pose(view) for view in views}
        doubled = len(poses) < len(views)
        datum = Datum(content["datum"]["name"], content["datum"]["radii_km"]) if "datum" in content else wgs84()
        mounting, geoid = content.get("vehicle", {}), content.get("geoid")
        calibration = CameraCalibration(
            _camera(content), datum, mounting.get("camera_from_vehicle", np.eye(3)),
            mounting.get("camera_in_vehicle_m", np.zeros(3)),
            None if geoid is None else Geoid(geoid["lat_deg"], geoid["lon_deg"], geoid["height_m"]),
        )  # fmt: skip
        arcs = tuple(_arc(arc) for arc in content.get("arcs", []))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else f"cannot be read as cameras: {error}"
        raise ConfigurationError(f"{name}: {what}") from error
    except (MatchError, ContractError) as error:
        # A record's own check, of what the file says.
        raise ConfigurationError(f"{name}: {error}") from error
    if doubled:
        raise ConfigurationError(f"{name}: a view is given twice")
    if len({arc.arc_id for arc in arcs}) < len(arcs):
        raise ConfigurationError(f"{name}: an arc is given twice")
    return Cameras(calibration, poses, arcs)


def _pose(view: dict[str, FloatArray]) -> Pose:
    turn = np.asarray(view["camera_from_body"], dtype=float)
    place = np.asarray(view["position_km"], dtype=float)
    if turn.shape != (3, 3) or place.shape != (3,):
        raise MatchError(f"view {view['view_id']}: camera_from_body is 3 by 3, position_km has three numbers")
    try:
        return Pose(turn, place)
    except MatchError as error:
        raise MatchError(f"view {view['view_id']}: {error}") from error


def _arc(arc: dict[str, FloatArray]) -> Arc:
    views: list[dict[str, FloatArray]] = arc["views"]  # type: ignore[assignment]
    options: dict[str, float] = dict(arc.get("options", {}))
    name = str(arc["arc_id"])
    members: list[ArcView] = []
    for view in views:
        et = float(view["et"])
        if not np.isfinite(et) or (members and not et > members[-1].et):
            raise MatchError(f"arc {name}: view {view['view_id']} has no time, or one that is not later than the last")
        members.append(ArcView(_whole(view["view_id"]), et, _pose(view), bool(view.get("throttled", False))))
    if not members:
        raise MatchError(f"arc {name} has no views")
    return Arc(name, options, tuple(members))


def _whole(value: object) -> int:
    """A view's number; anything else is refused, not rounded."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"view_id {value!r} is no whole number")
    return value


def _camera(content: dict[str, FloatArray]) -> CameraModel:
    if "camera_model" not in content:
        rows, cols = (int(n) for n in content["shape_vu"])
        return pinhole_camera(np.asarray(content["K"], dtype=float), (rows, cols))
    model: dict[str, FloatArray] = content["camera_model"]  # type: ignore[assignment]
    rows, cols = (int(n) for n in model["shape_vu"])
    return CameraModel(
        (rows, cols), float(model["focal_length_mm"]), model["k_px_per_mm"], model["principal_point_vu"],
        model.get("distortion_eps", np.zeros(6)),
    )  # fmt: skip
