"""Where ring edges of an image were expected, from its document and the catalogues of rings."""

from collections.abc import Mapping, Sequence

import numpy as np

from catalogs.ring_catalog import RingCatalog, rings_of
from pipeline.camera import project
from pipeline.errors import ContractError
from pipeline.geometry.astrometry import SPEED_OF_LIGHT_KM_S
from pipeline.geometry.rings import TURN, edge_points, edges_of, meets
from pipeline.geometry.rotations import matrix_from_quaternion
from pipeline.json_values import Json
from pipeline.records import BoolArray, CameraModel, FloatArray, RingFeature

# Around the ring, and at most as many between two of these where they come near the image; pixels between points.
_COARSE, _FINEST = 360, 64
_STEP_PX = 6.0


def expected_edges(document: Mapping[str, Json], catalogs: Sequence[RingCatalog]) -> list[tuple[str, FloatArray]]:
    """Lines along which the edges of features that were looked for were expected.

    Aberration and light time are the planet's: near enough for a line in a picture.

    Parameters
    ----------
    document
        The image's JSON document, with its geometry and the fates of ring features.
    catalogs
        Ring catalogues, the archive's own last.

    Returns
    -------
    list of tuple
        Name of the feature and (n, 2) pixels (v, u) in the order of longitude, per edge; NaN where it is hidden by
        the planet or not near the image. Empty where no catalogue knows rings of a body of the document.
    """
    fates, geometry, pointing = document.get("rings"), document.get("geometry"), document.get("pointing")
    sought = {fate["name"] for fate in _dicts(fates) if not fate["left_out"]}
    if not sought or not isinstance(geometry, dict) or not isinstance(pointing, dict):
        return []
    for body in _dicts(geometry["bodies"]):
        catalog = rings_of(catalogs, str(body["name"]))
        if catalog is not None:
            camera = _camera(geometry["camera_model"])
            turn = matrix_from_quaternion(_array(pointing["a_priori_camera_from_j2000_wxyz"]))
            view = _View(camera, turn, body, catalog.pole_sign)
            left = float(_array(document["et"])) - float(np.linalg.norm(view.observer_km)) / SPEED_OF_LIGHT_KM_S
            features = [feature for feature in catalog.at(left) if feature.name in sought]
            return [
                (feature.name, view.line(feature, outer)) for feature in features for outer in edges_of(feature)
            ]  # fmt: skip
    return []


class _View:
    """Camera, plane of the rings, and the planet before them."""

    def __init__(
        self, camera: CameraModel, camera_from_j2000: FloatArray, planet: Mapping[str, Json], pole_sign: int
    ) -> None:
        pole = pole_sign * _axes(planet)[2]
        node = np.cross([0.0, 0.0, 1.0], pole)
        length = float(np.linalg.norm(node))
        node = node / length if length > 0 else np.array([1.0, 0.0, 0.0])
        plane = np.stack([node, np.cross(pole, node), pole])
        centre = -_axes(planet).T @ _array(planet["camera_in_body_km"])
        self.camera, self.observer_km = camera, -plane @ centre
        self._camera_from_ring = camera_from_j2000 @ plane.T
        turn = plane @ _axes(planet).T
        shape = turn @ np.diag(1.0 / _array(planet["radii_km"]) ** 2) @ turn.T
        # As rays are asked whether they meet it: centre and quadratic form in the ring frame.
        self._planet = np.concatenate([np.zeros(3), shape.ravel()])[None]

    def line(self, feature: RingFeature, outer: bool) -> FloatArray:
        """Pixels along an edge where it comes near the image."""
        coarse = TURN * np.arange(_COARSE) / _COARSE
        places = self._pixels(edge_points(feature, outer, coarse))
        near = np.flatnonzero(self._is_near(places))
        if not len(near):
            return np.empty((0, 2))
        longest = float(np.hypot(*(places[(near + 1) % _COARSE] - places[near]).T).max())
        fine = int(np.clip(np.ceil(longest / _STEP_PX), 1, _FINEST))
        # Each stands for itself and the way to the next; a gap in the numbers is a gap in the line.
        steps = np.arange(fine) / fine
        longitude = (coarse[near, None] + TURN / _COARSE * steps).ravel()
        points = edge_points(feature, outer, longitude)
        places = self._pixels(points)
        places[meets(self._planet, self.observer_km, points - self.observer_km, np.ones(len(points)))] = np.nan
        ends = np.flatnonzero(np.diff(near) > 1) + 1
        return np.asarray(np.insert(places, ends * fine, np.nan, axis=0))

    def _pixels(self, points_km: FloatArray) -> FloatArray:
        places, valid = project(self.camera, (points_km - self.observer_km) @ self._camera_from_ring.T)
        return np.asarray(np.where(valid[:, None], places, np.nan))

    def _is_near(self, places: FloatArray) -> BoolArray:
        """Which points, with the next one, span a box that touches the image: the line between may enter it."""
        after = np.roll(places, -1, axis=0)
        size = np.array(self.camera.shape_vu)
        lowest, highest = np.minimum(places, after), np.maximum(places, after)
        # An arc bows out of the box of its ends by less than this share of it.
        pad = 1.0 + 0.01 * np.hypot(*(highest - lowest).T)[:, None]
        return np.asarray(((highest >= -pad) & (lowest <= size + pad)).all(axis=1))


def _axes(body: Mapping[str, Json]) -> FloatArray:
    return matrix_from_quaternion(_array(body["body_from_j2000_wxyz"]))


def _camera(block: Json) -> CameraModel:
    if not isinstance(block, dict):
        raise ContractError("the document's camera model is none")
    rows, columns = (int(side) for side in _array(block["shape_vu"]))
    return CameraModel(
        (rows, columns), float(_array(block["focal_length_mm"])), _array(block["k_px_per_mm"]),
        _array(block["principal_point_vu"]), _array(block["distortion_eps"]), _array(block["k_xy_px_per_mm2"]),
    )  # fmt: skip


def _array(value: Json) -> FloatArray:
    return np.asarray(value, dtype=float)


def _dicts(value: Json) -> list[dict[str, Json]]:
    return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []
