"""One planet or moon in the camera frame: its place, size, light, and what the renderer needs of it."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera import project
from pipeline.geometry.ellipsoid import intersect, limb_points, surface_normal
from pipeline.geometry.rotations import rotation_about
from pipeline.imaging.illumination import law_of
from pipeline.imaging.mesh import MeshSolid
from pipeline.imaging.render import Solid, Window
from pipeline.records import Body, CameraModel, FloatArray

_LIMB_SAMPLES = 96
_AREA_SAMPLES = 32


@dataclass(frozen=True, eq=False)
class BodyView:
    """A body in the camera frame of one attitude.

    Attributes
    ----------
    body
        The record.
    centre_km
        (3,) camera frame.
    camera_from_body
        (3, 3).
    sun
        (3,) camera frame.
    centre_vu
        (2,) pixel of the centre.
    box
        Pixels that it can touch.
    diameter_px, phase_rad, px_per_km
        Size; phase; scale at the body's distance.
    """

    body: Body
    centre_km: FloatArray
    camera_from_body: FloatArray
    sun: FloatArray
    centre_vu: FloatArray
    box: Window
    diameter_px: float
    phase_rad: float
    px_per_km: float

    def lit_area_px2(
        self, camera: CameraModel, window: Window, others: "tuple[BodyView, ...]"
    ) -> tuple[float, set[str]]:
        """Lit area inside a window and not hidden by nearer bodies, and the names of those that hide some of it.

        From a grid of rays; distortion, which hardly changes an area, is left out.
        """
        part = self.box.intersection(window)
        if not part.pixels:
            return 0.0, set()
        v = part.v0 - 0.5 + part.rows * (np.arange(_AREA_SAMPLES) + 0.5) / _AREA_SAMPLES
        u = part.u0 - 0.5 + part.cols * (np.arange(_AREA_SAMPLES) + 0.5) / _AREA_SAMPLES
        uv = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2) - camera.principal_point_vu[::-1]
        slopes = uv @ np.linalg.inv(camera.k_px_per_mm).T / camera.focal_length_mm
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ self.camera_from_body
        points, hit = intersect(self.body.radii_km, self.observer_km, rays)
        lit = np.zeros(len(rays), bool)
        lit[hit] = surface_normal(self.body.radii_km, points[hit]) @ self.sun_from_body > 0
        in_camera = rays @ self.camera_from_body.T
        hiders = set()
        for other in others:
            if other is not self and np.linalg.norm(other.centre_km) < np.linalg.norm(self.centre_km):
                hidden = intersect(other.body.radii_km, other.observer_km, in_camera @ other.camera_from_body)[1]
                if (hidden & hit).any():
                    hiders.add(other.body.name)
                lit &= ~hidden
        return float(np.count_nonzero(lit)) / _AREA_SAMPLES**2 * part.pixels, hiders

    @property
    def observer_km(self) -> FloatArray:
        """(3,) the camera from the body's centre, body-fixed."""
        return np.asarray(-self.camera_from_body.T @ self.centre_km)

    @property
    def sun_from_body(self) -> FloatArray:
        """(3,) unit vector toward the Sun, body-fixed."""
        return np.asarray(self.camera_from_body.T @ self.sun)

    @property
    def lit_px(self) -> float:
        """Widest extent of the lit part across the terminator."""
        return float(self.diameter_px * (1.0 + np.cos(self.phase_rad)) / 2.0)


def view_body(body: Body, camera: CameraModel, camera_from_j2000: FloatArray) -> BodyView | str:
    """Place a body in the camera frame.

    Parameters
    ----------
    body
        Body.
    camera
        Model.
    camera_from_j2000
        (3, 3) attitude.

    Returns
    -------
    BodyView or str
        Or the reason why there is none.
    """
    centre = camera_from_j2000 @ body.position_km
    rotation = camera_from_j2000 @ body.body_from_j2000.T
    distance = float(np.linalg.norm(centre))
    observer = -rotation.T @ centre
    if np.linalg.norm(observer / body.radii_km) <= 1.0:
        return "around_camera"
    if centre[2] <= 0 and distance > 2.0 * body.radii_km.max():
        return "behind_camera"
    sun = camera_from_j2000 @ body.sun_direction_j2000
    phase = float(np.arccos(np.clip(-centre @ sun / distance, -1.0, 1.0)))
    outline = limb_points(body.radii_km, observer, np.linspace(0, 2 * np.pi, _LIMB_SAMPLES, endpoint=False))
    pixels, ahead = project(camera, outline @ rotation.T + centre)
    middle = project(camera, centre[None])[0][0]
    if not ahead.any() or not np.isfinite(middle).all():
        return "behind_camera"
    scale = float(camera.focal_length_mm * np.sqrt(abs(np.linalg.det(camera.k_px_per_mm))) / distance)
    diameter = 2.0 * float(np.cbrt(np.prod(body.radii_km))) * scale
    seen = pixels[ahead]
    low, high = np.floor(seen.min(axis=0)) - 1, np.ceil(seen.max(axis=0)) + 2
    if not ahead.all():
        low, high = np.full(2, -1e6), np.full(2, 1e6)
    low, high = np.clip(low, -1e6, 1e6), np.clip(high, -1e6, 1e6)
    box = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return BodyView(body, centre, rotation, sun, middle, box, diameter, phase, scale)


def turned_view(view: BodyView, angle_rad: float) -> BodyView:
    """A body and the Sun turned about the line of sight to the body.

    Parameters
    ----------
    view
        Body.
    angle_rad
        Right-handed about the direction from the camera to the body's centre.

    Returns
    -------
    BodyView
        At the same place.
    """
    turn = rotation_about(view.centre_km / np.linalg.norm(view.centre_km), angle_rad)
    return replace(view, camera_from_body=turn @ view.camera_from_body, sun=turn @ view.sun)


def form_of(view: BodyView) -> FloatArray:
    """(3, 3) B in the camera frame with ``x B x = 1`` on the surface.

    Parameters
    ----------
    view
        Body.

    Returns
    -------
    numpy.ndarray
        Per km^2.
    """
    rotation = view.camera_from_body
    return np.asarray(rotation @ np.diag(1.0 / view.body.radii_km**2) @ rotation.T)


def solid_of(view: BodyView, bodies: tuple[Body, ...]) -> Solid:
    """Ellipsoid for the renderer, with whatever may shade it, in the field or not.

    Parameters
    ----------
    view
        Body.
    bodies
        All of the State.

    Returns
    -------
    Solid
        In the camera frame.
    """
    law, parameter = law_of(view.body.photometry, view.body.photometry_parameter, view.phase_rad)
    shading = [
        _occluder(other, view) for other in bodies if other.name != view.body.name and may_shade(other, view.body)
    ]
    occluders = np.array(shading).reshape(-1, 12)
    return Solid(view.centre_km, form_of(view), view.sun, law, parameter, occluders)


def may_shade(other: Body, body: Body) -> bool:
    """Whether a body stands between another and the Sun, by their spheres.

    Parameters
    ----------
    other
        The one that may throw a shadow.
    body
        The one that it may fall upon.

    Returns
    -------
    bool
        Never of a body and itself.
    """
    gap = other.position_km - body.position_km
    along = float(gap @ body.sun_direction_j2000)
    aside = float(np.linalg.norm(gap - along * body.sun_direction_j2000))
    return other is not body and along > 0 and aside < float(other.radii_km.max() + body.radii_km.max())


def _occluder(other: Body, view: BodyView) -> FloatArray:
    """(12,) centre and rows of the form of a shading body, in the frame of the body that it shades."""
    camera_from_j2000 = view.camera_from_body @ view.body.body_from_j2000
    rotation = camera_from_j2000 @ other.body_from_j2000.T
    form = rotation @ np.diag(1.0 / other.radii_km**2) @ rotation.T
    return np.concatenate([camera_from_j2000 @ other.position_km, form.ravel()])


def mesh_solid_of(view: BodyView, camera: CameraModel) -> MeshSolid:
    """Triangle mesh for the renderer.

    Parameters
    ----------
    view
        Body with a mesh.
    camera
        Model.

    Returns
    -------
    MeshSolid
        In the camera frame.
    """
    mesh = view.body.mesh
    assert mesh is not None
    law, parameter = law_of(view.body.photometry, view.body.photometry_parameter, view.phase_rad)
    points = mesh.vertices_km @ view.camera_from_body.T + view.centre_km
    pixels, _ = project(camera, points)
    return MeshSolid(points, pixels, mesh.facets, view.sun, law, parameter)
