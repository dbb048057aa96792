"""Measured radii along ring edges, for people who study the edges themselves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import unproject
from pipeline.geometry.rings import plane_points
from pipeline.predict.rings import RingScene
from pipeline.records import BoolArray, FloatArray, Record
from pipeline.techniques.ring_fit import RingFit


@dataclass(frozen=True, eq=False)
class RingEdgeTable(Record):
    """Samples of edges, one row each.

    Attributes
    ----------
    feature
        (n,) name.
    outer
        (n,) True for the outer edge of a ringlet or gap.
    radius_km, longitude_deg, sigma_km
        (n,) measured under the navigated pointing; sigma of the sample's own place in the image.
    predicted_km
        (n,) of the catalogue at that longitude, as seen in the plane.
    v_px, u_px, sigma_px
        (n,) measured place in the image, and its sigma across the edge.
    contrast_dn
        (n,) brightness outside less inside.
    weight
        (n,) robust weight in the fit, zero where the sample was not believed.
    """

    feature: NDArray[np.str_]
    outer: BoolArray
    radius_km: FloatArray
    longitude_deg: FloatArray
    sigma_km: FloatArray
    predicted_km: FloatArray
    v_px: FloatArray
    u_px: FloatArray
    sigma_px: FloatArray
    contrast_dn: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        self._freeze(**{name: (len(self.feature),) for name in self.__dataclass_fields__})

    def __len__(self) -> int:
        return len(self.feature)


def ring_edge_table(
    scene: RingScene, fit: RingFit, offset_vu: FloatArray, rotation_rad: float, free_brightness: bool = True
) -> RingEdgeTable:
    """Radii at which the image shows edges.

    Parameters
    ----------
    scene
        Edges.
    fit
        Of them.
    offset_vu, rotation_rad
        Pointing under which pixels are turned into radii, at the array centre.
    free_brightness
        Whether the fit's contrasts are the edges' own.

    Returns
    -------
    RingEdgeTable
        Rows by edge, then longitude.
    """
    units = fit.units
    told = units.present & np.isfinite(fit.shift_sigma_px)
    row, column = np.nonzero(told)
    edge = units.edges[row, 0] + column
    order = np.lexsort((units.longitude_rad[row], edge))
    row, column, edge = row[order], column[order], edge[order]
    scale = units.px_per_km[row, column]
    # What the fit has given to the radius is a measurement here.
    radius_shift = fit.radius_km[scene.feature[edge]] + fit.edge_km[edge]
    shift = fit.shift_px[row, column] + radius_shift * scale
    places = units.places_vu[row, column] + shift[:, None] * units.normal_vu[row, column]
    pose = scene.pose(offset_vu, rotation_rad)
    rays = unproject(scene.state.camera_model, places)[0] @ pose.turn.T
    points, _ = plane_points(pose.observer_km, rays)
    longitude = np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi)
    at = longitude / (2.0 * np.pi) * scene.curves.shape[1]
    index = np.arange(scene.curves.shape[1] + 1)
    predicted = np.array(
        [np.interp(x, index, np.append(scene.curves[e], scene.curves[e, 0])) for x, e in zip(at, edge, strict=True)]
    )
    sigma = fit.shift_sigma_px[row, column]
    contrast = fit.contrast_dn[row, column] if free_brightness else np.full(len(row), np.nan)
    return RingEdgeTable(
        np.array([scene.names[e] for e in edge], dtype=np.str_), scene.outer[edge],
        np.hypot(points[:, 0], points[:, 1]), np.degrees(longitude), sigma / np.maximum(scale, 1e-300),
        predicted.reshape(len(row)), places[:, 0], places[:, 1], sigma, contrast, fit.weight[row],
    )  # fmt: skip
