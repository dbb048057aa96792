"""What an image's document brings to an arc: its matches, its offset, and what was believed of its pose."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from pipeline.curate import Json
from pipeline.errors import ContractError
from pipeline.geometry.pointing import attitude_information
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.geometry.wgs84 import Datum, wgs84
from pipeline.pose.arc_factors import AttitudeFix, DirectionFix
from pipeline.pose.records import CameraCalibration, MatchError, MatchResult, Pose
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

_STARS, _LANDMARKS = "Star", "SurfaceFeatureNav"
# Of what an offset leaves open, rad^-2: nothing beside any other source, but it lets information be inverted.
_NOTHING_KNOWN = np.eye(3)
_EARTH = 399
_UNIT = 1e-9


@dataclass(frozen=True, eq=False)
class DocumentedImage(Record):
    """One image as an arc sees it.

    Attributes
    ----------
    image_id, mission, camera, et
        Identity, and TDB seconds past J2000.
    calibration
        Camera, and the body as datum.
    prior
        Pose that was believed before the image was navigated, in the body's frame.
    matches
        Landmarks found in it; None without any.
    trouble
        What is wrong with the matches; None where nothing is.
    offset
        What its navigated offset says of attitude or direction; None without one, or where landmarks alone made it.
    """

    image_id: str
    mission: str
    camera: str
    et: float
    calibration: CameraCalibration
    prior: Pose
    matches: MatchResult | None
    trouble: str | None
    offset: AttitudeFix | DirectionFix | None


def body_names(document: Mapping[str, Json]) -> tuple[str, ...]:
    """Bodies in whose frames an image has a believed pose: the one with landmarks first, then the nearest first.

    Parameters
    ----------
    document
        An image's document.

    Returns
    -------
    tuple of str
        Empty for an image without a time or geometry.
    """
    geometry, state = document.get("geometry"), document.get("landmark_state")
    bodies = geometry.get("bodies") if isinstance(geometry, dict) else None
    if not isinstance(bodies, list) or document.get("et") is None:
        return ()
    names = [str(body["name"]) for body in bodies if isinstance(body, dict)]
    seen = state.get("body") if isinstance(state, dict) else None
    return tuple(sorted(names, key=lambda name: name != seen))


def documented_image(document: Mapping[str, Json], body: str) -> DocumentedImage:
    """Read an image's document.

    Parameters
    ----------
    document
        The document.
    body
        One of :func:`body_names`.
    Returns
    -------
    DocumentedImage
        What it says.

    Raises
    ------
    MatchError
        If the document is not as Pilotage writes it.
    """
    image_id = str(document.get("image_id"))
    try:
        geometry, pointing = _block(document["geometry"]), _block(document["pointing"])
        place = next(b for b in map(_block, _list(geometry["bodies"])) if b["name"] == body)
        calibration = CameraCalibration.of(_camera(_block(geometry["camera_model"])), _datum(place))
        turn = _rotation(place["body_from_j2000_wxyz"])
        believed = _rotation(pointing["a_priori_camera_from_j2000_wxyz"])
        prior = Pose(believed @ turn.T, _array(place["camera_in_body_km"]))
        image = DocumentedImage(
            image_id, str(document["mission"]), str(document["camera"]), float(_array(document["et"])), calibration,
            prior, None, None, _offset(document, calibration.camera, prior, turn),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, StopIteration, ContractError) as error:
        raise MatchError(f"{image_id}: its document is not one of this version ({error!r})") from error
    state = document.get("landmark_state")
    columns = document.get("landmarks")
    if not isinstance(columns, dict) or not isinstance(state, dict) or state.get("body") != body:
        return image
    try:
        return replace(image, matches=landmark_matches(image_id, columns))
    except MatchError as error:
        return replace(image, trouble=str(error))


def landmark_matches(image_id: str, columns: Mapping[str, Json]) -> MatchResult:
    """Matches of the landmarks that were found in an image.

    Parameters
    ----------
    image_id
        The image.
    columns
        Columns of table ``landmarks``: ``observed_v_px, observed_u_px, sigma_dv_px, sigma_du_px, cov_dv_du_px2, x_km,
        y_km, z_km`` and, where the landmarks' places have errors, ``cov_xx_km2`` ... ``cov_zz_km2``.

    Returns
    -------
    MatchResult
        One match per landmark found; a point's number is that of its landmark's name, the same in all images.

    Raises
    ------
    MatchError
        If a column is missing, or a value is none.
    """
    try:
        observed = _stack(columns, "observed_v_px", "observed_u_px")
        found = np.isfinite(observed).all(axis=1)
        sigma = _stack(columns, "sigma_dv_px", "sigma_du_px", "cov_dv_du_px2")[found]
        places = _stack(columns, "x_km", "y_km", "z_km")[found]
        upper = None
        if "cov_xx_km2" in columns:
            upper = _stack(columns, *(f"cov_{axes}_km2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")))[found]
    except (KeyError, TypeError, ValueError) as error:
        raise MatchError(f"{image_id}: no landmarks as the table has them ({error!r})") from error
    covariance = np.zeros((len(sigma), 2, 2))
    # A negative sigma stays one, to be refused.
    covariance[:, 0, 0], covariance[:, 1, 1] = (sigma[:, :2] * np.abs(sigma[:, :2])).T
    covariance[:, 0, 1] = covariance[:, 1, 0] = sigma[:, 2]
    spread = None
    if upper is not None and upper.any():
        spread = np.zeros((len(upper), 3, 3))
        for k, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
            spread[:, i, j] = spread[:, j, i] = upper[:, k]
    numbers = _numbers_of(columns.get("landmark"), np.asarray(found))
    return MatchResult(image_id, numbers, observed[found], places, covariance, spread)


def _numbers_of(names: Json, found: BoolArray) -> NDArray[np.int64]:
    """Numbers of the landmarks found, of their names; rows where these are missing or come twice."""
    rows = np.flatnonzero(found)
    if not isinstance(names, list) or len(names) != len(found):
        return rows
    told = [str(names[row]) for row in rows]
    if len(set(told)) < len(told):
        return rows
    # 63 bits: two of a million names meet with a chance of 1e-7.
    digests = [blake2b(name.encode(), digest_size=8).digest() for name in told]
    return np.array([int.from_bytes(digest) >> 1 for digest in digests], dtype=np.int64)


def _stack(columns: Mapping[str, Json], *names: str) -> FloatArray:
    """(n, k) of columns, not-a-number for null."""
    return np.stack([_array(columns[name]) for name in names], axis=1)


def _block(value: Json) -> dict[str, Json]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r:.40} where a block of keys belongs")
    return value


def _list(value: Json) -> list[Json]:
    if not isinstance(value, list):
        raise TypeError(f"{value!r:.40} where a list belongs")
    return value


def _array(value: Json) -> FloatArray:
    """Numbers of a document; null is not a number."""
    return np.array(value, dtype=float)


def _rotation(value: Json) -> FloatArray:
    """(3, 3) of a unit quaternion."""
    wxyz = _array(value)
    if wxyz.shape != (4,) or not abs(float(np.linalg.norm(wxyz)) - 1.0) < _UNIT:
        raise ValueError(f"{value!r} is no unit quaternion")
    return matrix_from_quaternion(wxyz)


def _camera(model: Mapping[str, Json]) -> CameraModel:
    rows, cols = _array(model["shape_vu"])
    names = ("k_px_per_mm", "principal_point_vu", "distortion_eps", "k_xy_px_per_mm2")
    return CameraModel(
        (int(rows), int(cols)), float(_array(model["focal_length_mm"])), *(_array(model[name]) for name in names)
    )


def _datum(body: Mapping[str, Json]) -> Datum:
    return wgs84() if body["naif_id"] == _EARTH else Datum(str(body["name"]), _array(body["radii_km"]))


def _offset(
    document: Mapping[str, Json], camera: CameraModel, prior: Pose, body_from_j2000: FloatArray
) -> AttitudeFix | DirectionFix | None:
    """Stars fix an attitude; a body or its rings, where the body's centre is seen.

    An offset in which landmarks have a part repeats what their matches say, and is left out.
    """
    pointing = _block(document["pointing"])
    corrected, covariance = pointing["camera_from_j2000_wxyz"], pointing["covariance"]
    answers = [t for t in map(_block, _list(document["techniques"])) if t.get("in_ensemble")]
    fused = [str(t["technique"]) for t in answers]
    if corrected is None or covariance is None or not fused or _LANDMARKS in fused:
        return None
    after = _rotation(corrected) @ body_from_j2000.T
    theta = float(np.radians(_array(document.get("rotation_deg") or 0.0)))
    information = attitude_information(camera, _array(document["offset_px"]), theta, _array(covariance))
    spread = np.linalg.inv(information + _NOTHING_KNOWN)
    if any(name.startswith(_STARS) for name in fused):
        return AttitudeFix(after, after.T @ spread @ after)
    centre = after @ -prior.position_km
    unit = centre / np.linalg.norm(centre)
    across = np.array([[0.0, -unit[2], unit[1]], [unit[2], 0.0, -unit[0]], [-unit[1], unit[0], 0.0]])
    return DirectionFix(unit, across @ spread @ across.T)
