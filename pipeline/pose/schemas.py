"""Arrow schemas of the tables ``poses`` and ``arcs``."""

import pyarrow as pa

UPPER = tuple((i, j) for i in range(6) for j in range(i, 6))

_COVARIANCE = (
    "upper triangle by rows of the errors (x, y, z, rx, ry, rz), km and rad, body-fixed: "
    "position estimated minus true, body_from_camera_true = Exp(r) body_from_camera_estimated"
)


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


_TEXT, _REAL, _WHOLE, _FLAG = pa.string(), pa.float64(), pa.int64(), pa.bool_()


def _pose_fields(prefix: str, what: str) -> list[pa.Field]:
    place = [_field(f"{prefix}{axis}_km", _REAL, "km", f"{what}: position of the camera, body-fixed") for axis in "xyz"]
    turn = [_field(f"{prefix}q{part}", _REAL, "", f"{what}: camera_from_body quaternion") for part in "wxyz"]
    axes = ("x", "y", "z", "rx", "ry", "rz")
    units = {(False, False): "km2", (False, True): "km rad", (True, True): "rad2"}
    spread = [
        _field(
            f"{prefix}cov_{i}{j}",
            _REAL,
            units[i > 2, j > 2],
            f"{what}: covariance of the errors of {axes[i]} and {axes[j]}",
        )
        for i, j in UPPER
    ]
    return [*place, *turn, *spread]


POSE_SCHEMA = pa.schema([
    _field("image_id", _TEXT, "", "image; of a file of matches its view's number"),
    _field("mission", _TEXT, "", "mission (partition); null in a file of matches"),
    _field("camera", _TEXT, "", "camera (partition); null in a file of matches"),
    _field("arc_id", _TEXT, "", "arc; null before arcs are smoothed"),
    _field("body", _TEXT, "", "body in whose frame the pose is"),
    _field("view_id", _WHOLE, "", "number of the view in a file of matches, else null"),
    _field("frame_id", _TEXT, "", "uuid5 of the image's id"),
    _field("et", _REAL, "s", "TDB seconds past J2000"),
    _field("label", _TEXT, "", "satellite_anchored, visual_propagated or dead_reckoned"),
    _field("last_satellite_anchor_age_ms", _WHOLE, "ms", "since the last anchored image; null before the first"),
    _field("covariance_mode", _TEXT, "", "marginals or jacobian, of the raw pose; null without one"),
    _field("method", _TEXT, "", "what started the raw pose: ippe, sqpnp, ransac, landmark_state"),
    _field("matches_used", _WHOLE, "count", "inliers of the raw pose"),
    _field("rms_px", _REAL, "px", "of their residuals, per axis"),
    _field("failure", _TEXT, "", "why there is no raw pose; null where there is one"),
    _field("outlier", _FLAG, "", "the raw pose contradicts the arc and does not hold it"),
    _field("offset_used", _FLAG, "", "the image's navigated offset holds it; null without one"),
    _field("lat_deg", _REAL, "deg", "planetodetic latitude of the vehicle, smoothed"),
    _field("lon_deg", _REAL, "deg", "longitude, positive east, smoothed"),
    _field("alt_m", _REAL, "m", "above mean sea level, smoothed; null without a geoid"),
    _field("ellipsoidal_m", _REAL, "m", "above the ellipsoid of the datum, smoothed"),
    _field("datum", _TEXT, "", "name of the ellipsoid"),
    *[_field(f"vehicle_q{part}", _REAL, "", "quaternion that turns vehicle axes onto body-fixed ones, smoothed")
      for part in "wxyz"],
    *_pose_fields("", "smoothed"),
    *_pose_fields("raw_", "image alone"),
], metadata={"frame": "body-fixed; x_camera = camera_from_body (X - position)", "covariance": _COVARIANCE})  # fmt: skip

ARC_SCHEMA = pa.schema([
    _field("arc_id", _TEXT, "", "arc"),
    _field("mission", _TEXT, "", "mission (partition); null of a file of matches"),
    _field("camera", _TEXT, "", "camera (partition); null of a file of matches"),
    _field("body", _TEXT, "", "body in whose frame the arc is"),
    _field("start_et", _REAL, "s", "first image, TDB seconds past J2000"),
    _field("stop_et", _REAL, "s", "last image"),
    _field("images", _WHOLE, "count", "images"),
    _field("anchored", _WHOLE, "count", "held by their own points"),
    _field("propagated", _WHOLE, "count", "held by neighbours"),
    _field("dead_reckoned", _WHOLE, "count", "held by the trajectory alone"),
    _field("outliers", _WHOLE, "count", "raw poses that contradict the arc"),
    _field("offsets_used", _WHOLE, "count", "images whose navigated offset holds them"),
    _field("landmarks_solved", _WHOLE, "count", "points that several images see, solved with the poses"),
    *[_field(f"bias_{name}_rad", _REAL, "rad", f"common {text} of the camera against its believed attitude")
      for name, text in (("x", "offset about x"), ("y", "offset about y"), ("twist", "twist about z"))],
    *[_field(f"sigma_bias_{name}_rad", _REAL, "rad", "1 sigma") for name in ("x", "y", "twist")],
    _field("position_sigma_km", _REAL, "km", "1 sigma of the trajectory at the start, as told or as the fixes show it"),
    _field("walk_km_per_sqrt_s", _REAL, "km s-1/2", "its random walk, told or shown"),
    _field("attitude_sigma_rad", _REAL, "rad", "1 sigma of one believed attitude, told or shown"),
    _field("boresight_sigma_rad", _REAL, "rad", "1 sigma of the common offset, told or shown"),
    _field("twist_sigma_rad", _REAL, "rad", "1 sigma of the common twist, told or shown"),
])  # fmt: skip
