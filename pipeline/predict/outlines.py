"""Lines that a body draws in the image: its lit limb and its terminator, with normals and what hides them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.camera import project, unproject
from pipeline.geometry.ellipsoid import is_visible, limb_points, silhouette_form, surface_normal, terminator_points
from pipeline.imaging.render import Template
from pipeline.predict.body_view import BodyView
from pipeline.records import BoolArray, CameraModel, FloatArray, Record

_FEWEST, _MOST = 48, 4000
# Cosine of incidence from which a limb counts as lit: nearer to the cusps slopes of the surface decide what shines.
_LEAST_MU0 = 0.1
# Pixels by which a place is moved to see what lies on either side of a mesh's outline.
_BESIDE_PX = 2.0
# Facets around a place of which the nearest to the camera is taken for the one that is seen there.
_FACETS_AROUND = 6


@dataclass(frozen=True, eq=False)
class Outline(Record):
    """Vertices about a pixel apart.

    Attributes
    ----------
    vertices_vu
        (n, 2) pixels under the pointing of the views.
    normal_vu
        (n, 2) unit vectors toward the dark side.
    direction
        (n, 3) unit vectors from the body's centre to the vertex: how far apart two are on the body.
    body
        (n,) index of the view.
    usable
        (n,) True where lit, unhidden and inside the array.
    reason
        (n,) why not: ``dark``, ``hidden``, ``outside``; empty where usable.
    """

    vertices_vu: FloatArray
    normal_vu: FloatArray
    direction: FloatArray
    body: NDArray[np.int64]
    usable: BoolArray
    reason: NDArray[np.str_]

    def __post_init__(self) -> None:
        n = len(self.vertices_vu)
        self._freeze(vertices_vu=(n, 2), normal_vu=(n, 2), direction=(n, 3), body=(n,), usable=(n,), reason=(n,))

    def __len__(self) -> int:
        return len(self.vertices_vu)

    @staticmethod
    def joined(parts: "list[Outline]") -> "Outline":
        """All parts, in the order given."""
        if not parts:
            none = np.zeros(0)
            return Outline(
                none.reshape(0, 2), none.reshape(0, 2), none.reshape(0, 3), none.astype(int), none.astype(bool),
                none.astype("U8"),
            )  # fmt: skip
        return Outline(*(np.concatenate([getattr(p, name) for p in parts]) for name in Outline.__dataclass_fields__))


def limb_outline(views: tuple[BodyView, ...], camera: CameraModel, template: Template | None = None) -> Outline:
    """Lit limbs of bodies.

    Parameters
    ----------
    views
        Bodies, farthest first.
    camera
        Model.
    template
        Drawing of the same views, from which the outlines of meshes are taken; without it meshes have none.

    Returns
    -------
    Outline
        All limbs; the dark and hidden parts are in it, with their reason.
    """
    parts = []
    for index, view in enumerate(views):
        if view.body.mesh is not None:
            parts += _mesh_outline(view, index, template, camera, at_limb=True)
            continue
        angle = _angles(view)
        points = limb_points(view.body.radii_km, view.observer_km, angle)
        lit = surface_normal(view.body.radii_km, points) @ view.sun_from_body > _LEAST_MU0
        parts.append(_outline(view, index, points, lit, views, camera, outward_from=view.centre_vu))
    return Outline.joined([part for part in parts if len(part)])


def terminator_outline(
    views: tuple[BodyView, ...], camera: CameraModel, template: Template | None = None, clear_px: float = 0.0
) -> Outline:
    """Terminators of bodies, where the camera sees them.

    Parameters
    ----------
    views, camera, template
        As for :func:`limb_outline`.
    clear_px
        Distance from the limb, in the image, within which a terminator is left out.

    Returns
    -------
    Outline
        Normals point to the night.
    """
    parts = []
    for index, view in enumerate(views):
        if view.body.mesh is not None:
            parts += _mesh_outline(view, index, template, camera, at_limb=False)
            continue
        points = terminator_points(view.body.radii_km, view.sun_from_body, _angles(view))
        seen = is_visible(view.body.radii_km, view.observer_km, points)
        # Near the limb the line is foreshortened into it, and a band around it would measure the limb.
        toward = view.observer_km - points
        cosine = (surface_normal(view.body.radii_km, points) * toward).sum(axis=1) / np.linalg.norm(toward, axis=1)
        clear = np.sqrt(1.0 - np.clip(cosine, 0.0, 1.0) ** 2) < 1.0 - clear_px / max(view.diameter_px / 2, 1e-9)
        seen &= clear & (cosine > 0)
        sunward = project(camera, (view.centre_km + view.body.radii_km.min() * 1e-3 * view.sun)[None])[0][0]
        part = _outline(view, index, points[seen], np.ones(int(seen.sum()), bool), views, camera, sunward)
        parts.append(part)
    return Outline.joined([part for part in parts if len(part)])


def _angles(view: BodyView) -> FloatArray:
    count = int(np.clip(np.ceil(np.pi * view.diameter_px), _FEWEST, _MOST))
    return np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)


def _outline(
    view: BodyView,
    index: int,
    points_km: FloatArray,
    lit: BoolArray,
    views: tuple[BodyView, ...],
    camera: CameraModel,
    outward_from: FloatArray,
) -> Outline:
    """Project points of a body; normals are across the line, away from a place."""
    if len(points_km) < 3:
        return Outline.joined([])
    in_camera = points_km @ view.camera_from_body.T + view.centre_km
    places, ahead = project(camera, in_camera)
    tangent = np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    length = np.linalg.norm(normal, axis=1)
    good = ahead & np.isfinite(places).all(axis=1) & (length > 0) & np.isfinite(length)
    normal = normal / np.where(good, length, 1.0)[:, None]
    inward = ((places - outward_from) * normal).sum(axis=1) < 0
    normal[inward] *= -1.0
    # Of an arc's ends the neighbours are not known.
    step = np.linalg.norm(tangent, axis=1)
    good &= step < 8.0 * np.nanmedian(np.where(good, step, np.nan)) if good.any() else good
    rows, cols = camera.shape_vu
    inside = good & (places >= 0).all(axis=1) & (places[:, 0] <= rows - 1) & (places[:, 1] <= cols - 1)
    hidden = _hidden(in_camera, view, views)
    reason = np.where(~lit, "dark", np.where(~inside, "outside", np.where(hidden, "hidden", ""))).astype("U8")
    direction = (points_km / np.linalg.norm(points_km, axis=1)[:, None]) @ view.camera_from_body.T
    keep = good
    return Outline(
        places[keep], normal[keep], direction[keep], np.full(int(keep.sum()), index), reason[keep] == "", reason[keep]
    )


def _hidden(in_camera: FloatArray, view: BodyView, views: tuple[BodyView, ...]) -> BoolArray:
    """Points behind a nearer body, by that body's ellipsoid."""
    hidden = np.zeros(len(in_camera), bool)
    for other in views:
        if other is view or np.linalg.norm(other.centre_km) >= np.linalg.norm(view.centre_km):
            continue
        rays = in_camera @ other.camera_from_body
        form = silhouette_form(other.body.radii_km, other.observer_km)
        hidden |= np.einsum("ni,ij,nj->n", rays, form, rays) > 0
    return hidden


def _mesh_outline(
    view: BodyView, index: int, template: Template | None, camera: CameraModel, at_limb: bool
) -> list[Outline]:
    """Border of the lit part of a drawn mesh: against the sky its limb, against its own night the terminator."""
    if template is None or not template.window.pixels:
        return []
    lit = (template.image > 0.1 * float(template.image.max())).astype(np.uint8)
    contours, _ = cv2.findContours(lit, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    long = [c[:, 0, ::-1].astype(float) for c in contours if len(c) >= 2 * _BESIDE_PX * 4]
    if not long:
        return []
    smooth = cv2.GaussianBlur(lit.astype(np.float32), (0, 0), 2.0)
    down_v, down_u = cv2.Sobel(smooth, cv2.CV_32F, 0, 1), cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    places = np.concatenate(long)
    at = tuple(places.astype(int).T)
    normal = -np.stack([down_v[at], down_u[at]], axis=1).astype(float)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0, length, 1.0)[:, None]
    rows, cols = lit.shape
    beside = np.rint(places + _BESIDE_PX * normal).astype(int)
    inside = (length > 0) & (beside >= 0).all(axis=1) & (beside[:, 0] < rows) & (beside[:, 1] < cols)
    behind = np.zeros(len(places))
    behind[inside] = template.cover[beside[inside, 0], beside[inside, 1]]
    wanted = inside & ((behind < 0.5) if at_limb else (behind >= 0.5))
    seen = places[wanted] + [template.window.v0, template.window.u0]
    direction = _directions_on_mesh(view, camera, seen)
    count = len(seen)
    return [
        Outline(seen, normal[wanted], direction, np.full(count, index), np.ones(count, bool), np.full(count, "", "U8"))
    ]


def _directions_on_mesh(view: BodyView, camera: CameraModel, places_vu: FloatArray) -> FloatArray:
    """(n, 3) unit vectors from a mesh's centre to what is seen at places, camera axes.

    The range is that of the nearest facing facet by its image: on an elongated body pixels alone would not tell how far
    two places are apart on it.
    """
    mesh = view.body.mesh
    assert mesh is not None
    if not len(places_vu):
        return np.zeros((0, 3))
    corners = (mesh.vertices_km @ view.camera_from_body.T + view.centre_km)[mesh.facets]
    middle = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = middle[(normal * middle).sum(axis=1) < 0]
    pixels, ahead = project(camera, middle)
    ahead &= np.isfinite(pixels).all(axis=1)
    if not ahead.any():
        return np.tile([0.0, 0.0, -1.0], (len(places_vu), 1))
    depth = middle[ahead, 2]
    around = min(_FACETS_AROUND, len(depth))
    gap, facet = cKDTree(pixels[ahead], compact_nodes=False, balanced_tree=False).query(places_vu, k=around)
    gap, facet = gap.reshape(-1, around), facet.reshape(-1, around)
    seen = np.where(gap <= gap[:, :1] + _BESIDE_PX, depth[facet], np.inf).min(axis=1)
    rays, ok = unproject(camera, places_vu)
    points = np.where(ok[:, None], rays / rays[:, 2:] * seen[:, None], view.centre_km - [0.0, 0.0, 1.0])
    direction = points - view.centre_km
    return np.asarray(direction / np.linalg.norm(direction, axis=1)[:, None])
