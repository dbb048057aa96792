"""Planets and moons: what of them the camera should see, their limbs and terminators, and their rendered image.

A body that cannot be used says why: its :class:`BodyFate` stands in the record. Rendering is repeated under corrected
attitudes; :class:`BodyScene` keeps the few templates that techniques share.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from pydantic import Field

from pipeline.geometry.ellipsoid import intersect
from pipeline.geometry.pointing import corrected_attitude
from pipeline.imaging.mesh import render_meshes
from pipeline.imaging.render import (
    Cells,
    RayGrid,
    Template,
    Window,
    blur,
    blur_image,
    cells_per_pixel,
    ray_grid,
    render_cells,
)
from pipeline.options import Options
from pipeline.predict.body_view import BodyView, mesh_solid_of, solid_of, turned_view, view_body
from pipeline.records import Body, CameraModel, FloatArray, Image, State

# Pixels of sky that a template keeps around a body, beyond the reach of the point spread.
_SKY_PX = 6
# Sky around everything that a search may look at.
_CANVAS_SKY_PX = 24
# Templates are drawn at offsets on this grid (pixels, and pixels at half the array's diagonal for a rotation), so that
# techniques that agree share one; what is left is small enough for a linear model.
QUANTUM_PX = 0.125
# Within so little the derivative of the bodies' turns is the same but for its place.
_SAME_SPIN_PX = 3.0
_SAME_SPIN_RAD = 0.035
# Half the rotation between two renderings of which the difference is the derivative.
SPIN_STEP_RAD = 0.01
# A body whose lit area in the frame is below this share of the largest one's does not help to find it.
MINOR_SHARE = 0.12


class BodyPredictionOptions(Options):
    """Which bodies are worth predicting."""

    min_diameter_px: float = Field(3.0, ge=1, le=100, description="apparent diameter below which a body is a point")
    min_lit_px: float = Field(0.3, gt=0, le=100, description="width of the lit part below which a body is dark")


@dataclass(frozen=True)
class BodyFate:
    """One body of the State and why it is not used; ``reason`` is empty where it is.

    Attributes
    ----------
    name
        Body.
    centre_vu
        Predicted pixel of its centre, None behind the camera.
    diameter_px, phase_deg
        Apparent size (geometric mean of the outline's axes) and phase angle.
    reason
        Empty, ``behind_camera``, ``outside_field``, ``too_small``, ``unlit``, ``around_camera`` or
        ``fills_frame``.
    """

    name: str
    centre_vu: tuple[float, float] | None
    diameter_px: float
    phase_deg: float
    reason: str


@dataclass(frozen=True, eq=False)
class _Spin:
    """Derivative of an image with respect to the bodies' turns, and where they were when it was drawn."""

    places: dict[str, FloatArray]
    rotation_rad: float
    window: Window
    image: Image

    def carried(self, gap_vu: FloatArray, window: Window) -> Image:
        """Moved by a part of a pixel or a few, into another window."""
        down, right = gap_vu + np.array([self.window.v0 - window.v0, self.window.u0 - window.u0])
        move = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
        # A body cut by the border goes on beyond it.
        moved = cv2.warpAffine(self.image, move, (window.cols, window.rows), borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.float32)


@dataclass(frozen=True, eq=False)
class BodyScene:
    """All usable bodies of an image, and templates of them under any pointing.

    Attributes
    ----------
    state
        Geometry.
    reach_vu
        Farthest that a body can be from its prediction, whole pixels: the search margin and what a rotation adds.
    told_sigma_px
        Core of the point spread as the camera's record tells it.
    sigma_px
        The one that templates are drawn with: the image may show another.
    views
        Under the a-priori attitude, farthest first.
    fates
        Every body of the State.
    canvas
        The array widened by the reach and some sky.
    rays
        Over the canvas, None without bodies.
    """

    state: State
    reach_vu: tuple[int, int]
    told_sigma_px: float
    sigma_px: float
    views: tuple[BodyView, ...]
    fates: tuple[BodyFate, ...]
    canvas: Window
    rays: RayGrid | None
    _templates: dict[tuple[int, int, int], tuple[tuple[BodyView, ...], Template]] = field(default_factory=dict)
    _spins: list[_Spin] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.views)

    @property
    def names(self) -> tuple[str, ...]:
        """Bodies in the scene."""
        return tuple(view.body.name for view in self.views)

    @property
    def pivot_vu(self) -> FloatArray:
        """(2,) centroid of the predicted centres (seed 000), each held inside the array: a giant's lever is absurd."""
        return self.centroid(self.views)

    def centroid(self, views: tuple[BodyView, ...]) -> FloatArray:
        """(2,) centroid of bodies' centres, held inside the array."""
        last = np.array(self.state.camera_model.shape_vu) - 1.0
        return np.asarray(np.mean([np.clip(view.centre_vu, 0.0, last) for view in views], axis=0))

    def attitude(self, offset_vu: FloatArray, rotation_rad: float) -> FloatArray:
        """(3, 3) camera_from_j2000 for a correction at the array centre."""
        prior = self.state.attitude.camera_from_j2000
        return corrected_attitude(self.state.camera_model, prior, offset_vu, rotation_rad)

    def quantised(self, offset_vu: FloatArray, rotation_rad: float) -> tuple[FloatArray, float]:
        """Nearest pointing at which templates are drawn."""
        step = QUANTUM_PX / (np.hypot(*self.state.camera_model.shape_vu) / 2)
        offset = QUANTUM_PX * np.rint(np.asarray(offset_vu) / QUANTUM_PX)
        return offset, float(step * np.rint(rotation_rad / step))

    def template(self, offset_vu: FloatArray, rotation_rad: float) -> tuple[tuple[BodyView, ...], Template]:
        """Bodies under a corrected pointing, in the array, blurred.

        Parameters
        ----------
        offset_vu, rotation_rad
            Correction at the array centre; drawn exactly there, see :meth:`quantised`.

        Returns
        -------
        tuple
            Views; template over those of the array's pixels that bodies (with some sky) can touch.
        """
        step = QUANTUM_PX / (np.hypot(*self.state.camera_model.shape_vu) / 2)
        key = (round(offset_vu[0] / QUANTUM_PX), round(offset_vu[1] / QUANTUM_PX), round(rotation_rad / step))
        if key not in self._templates:
            views = self.views_at(self.attitude(offset_vu, rotation_rad))
            rows, cols = self.state.camera_model.shape_vu
            array = Window(0, 0, rows, cols)
            window = self.around(views, array)
            # The blur carries light into the array from beyond its border.
            blur_px = min(int(np.ceil(4.0 * self.sigma_px)) + 1, _CANVAS_SKY_PX)
            wide = self.around(views, array.grown(blur_px, blur_px)) if window.pixels else window
            drawn = self._with_spin(self._render(views, wide), views, rotation_rad)
            self._templates[key] = views, drawn.part(window)
        return self._templates[key]

    def views_at(self, attitude: FloatArray) -> tuple[BodyView, ...]:
        """The scene's bodies under another attitude."""
        views = (view_body(view.body, self.state.camera_model, attitude) for view in self.views)
        return tuple(view for view in views if isinstance(view, BodyView))

    def around(self, views: tuple[BodyView, ...], limit: Window, sky_px: int | None = None) -> Window:
        """Smallest window inside a limit that holds the bodies and some sky around them."""
        sky = sky_px if sky_px is not None else _SKY_PX + int(np.ceil(4.0 * self.sigma_px))
        boxes = [view.box.grown(sky, sky).intersection(limit) for view in views]
        boxes = [box for box in boxes if box.pixels]
        if not boxes:
            return Window(limit.v0, limit.u0, 0, 0)
        top, left = min(b.v0 for b in boxes), min(b.u0 for b in boxes)
        bottom, right = max(b.v0 + b.rows for b in boxes), max(b.u0 + b.cols for b in boxes)
        return Window(top, left, bottom - top, right - left)

    def render(self, views: tuple[BodyView, ...], window: Window) -> Template:
        """Draw bodies into a window.

        Parameters
        ----------
        views
            Farthest first.
        window
            Pixels inside the canvas.

        Returns
        -------
        Template
            Blurred, with derivatives; that of the bodies' own turn where a rotation is fitted.
        """
        template = self._render(views, window)
        turns = self.state.settings.fit_camera_rotation
        return replace(template, spin=self._spin(views, window)) if turns else template

    def picture(self, views: tuple[BodyView, ...], window: Window) -> Image:
        """The image of :meth:`render` alone, without its derivatives."""
        return blur_image(self._cells(views, window, *self._fineness(views)), window, self.sigma_px)

    def _render(self, views: tuple[BodyView, ...], window: Window) -> Template:
        """Image and its derivatives with respect to shift and width of the point spread."""
        return blur(self._cells(views, window, *self._fineness(views)), window, self.sigma_px)

    def _fineness(self, views: tuple[BodyView, ...]) -> tuple[int, int]:
        """Cells along a pixel's side, and samples along that of a cell that no limb crosses."""
        largest = max((view.diameter_px for view in views), default=0.0)
        over = cells_per_pixel(self.sigma_px, largest)
        if any(view.body.mesh is not None for view in views):
            over = max(over, 2)
        return over, 1 if largest > 60.0 else 2

    def _spin(self, views: tuple[BodyView, ...], window: Window) -> Image:
        """Derivative with respect to a turn of every body about its own centre.

        A difference of renderings: along a limb the gradient times a long lever would be all rounding.
        """
        more, less = (self.picture(self._spun(views, sign * SPIN_STEP_RAD), window) for sign in (1.0, -1.0))
        return np.asarray((more - less) / np.float32(2.0 * SPIN_STEP_RAD))

    def _with_spin(self, template: Template, views: tuple[BodyView, ...], rotation_rad: float) -> Template:
        """Add the derivative of the turn: that of a pointing nearby, carried along, where there is one."""
        if not self.state.settings.fit_camera_rotation or not views:
            return template
        places = {view.body.name: view.centre_vu for view in views}
        lead = max(views, key=lambda view: view.diameter_px).body.name
        for spin in self._spins:
            if places.keys() != spin.places.keys() or abs(rotation_rad - spin.rotation_rad) > _SAME_SPIN_RAD:
                continue
            gap = places[lead] - spin.places[lead]
            aside = [np.hypot(*(place - spin.places[name] - gap)) for name, place in places.items()]
            if max(float(np.hypot(*gap)), *aside) < _SAME_SPIN_PX:
                return replace(template, spin=spin.carried(gap, template.window))
        drawn = self._spin(views, template.window)
        self._spins.append(_Spin(places, rotation_rad, template.window, drawn))
        return replace(template, spin=drawn)

    def _spun(self, views: tuple[BodyView, ...], theta: float) -> tuple[BodyView, ...]:
        """Bodies turned in the image, each about its own centre; +u goes toward +v."""
        angle = self.state.camera_model.handedness * theta
        return tuple(turned_view(view, angle) for view in views)

    def render_coarse(self, window: Window) -> Image:
        """A-priori bodies in a window, one cell a pixel: good enough to find them by."""
        cells = self._cells(self.views, window, 1, 1)
        # A coarse template is never sharper than its pixels can show.
        return blur_image(cells, window, max(self.sigma_px, 0.5))

    def _cells(self, views: tuple[BodyView, ...], window: Window, over: int, inner: int) -> Cells:
        cells = Cells.blank(window, over)
        if not window.pixels or self.rays is None:
            return cells
        for run, is_mesh in _runs(views):
            if is_mesh:
                render_meshes(cells, [mesh_solid_of(view, self.state.camera_model) for view in run], window)
            else:
                solids = [solid_of(view, self.state.bodies) for view in run]
                render_cells(cells, solids, self.rays, window, [view.box for view in run], inner)
        return cells

    def major(self) -> "BodyScene":
        """The scene without bodies that show much less of themselves than another one, unless they hide some of it."""
        areas = self.lit_areas(self.views)
        least = MINOR_SHARE * max((area for area, _ in areas), default=0.0)
        kept = [k for k, (area, _) in enumerate(areas) if area >= least and area > 0]
        names = {self.views[k].body.name for k in kept}.union(*(areas[k][1] for k in kept))
        return self.only(tuple(name for name in self.names if name in names)) if names else self

    def lit_areas(self, views: tuple[BodyView, ...]) -> list[tuple[float, set[str]]]:
        """Lit areas in the array, or in the canvas where none of them reaches into the array; and who hides them."""
        camera = self.state.camera_model
        array = Window(0, 0, *camera.shape_vu)
        areas = [view.lit_area_px2(camera, array, views) for view in views]
        if max((area for area, _ in areas), default=0.0) > 0:
            return areas
        return [view.lit_area_px2(camera, self.canvas, views) for view in views]

    def primary(self, views: tuple[BodyView, ...]) -> BodyView:
        """The body that shows most of itself."""
        if len(views) == 1:
            return views[0]
        return views[int(np.argmax([area for area, _ in self.lit_areas(views)]))]

    def minor(self) -> "BodyScene":
        """What :meth:`major` leaves out."""
        kept = set(self.major().names)
        return self.only(tuple(name for name in self.names if name not in kept))

    def only(self, names: tuple[str, ...]) -> "BodyScene":
        """The scene with some of its bodies."""
        return replace(self, views=tuple(v for v in self.views if v.body.name in names), _templates={}, _spins=[])

    def with_sigma(self, sigma_px: float) -> "BodyScene":
        """The same scene through another point spread."""
        return replace(self, sigma_px=sigma_px, _templates={}, _spins=[])


def _runs(views: tuple[BodyView, ...]) -> list[tuple[list[BodyView], bool]]:
    """Consecutive bodies of one kind, so that nearer ones are drawn over farther ones."""
    runs: list[tuple[list[BodyView], bool]] = []
    for view in views:
        is_mesh = view.body.mesh is not None
        if runs and runs[-1][1] == is_mesh:
            runs[-1][0].append(view)
        else:
            runs.append(([view], is_mesh))
    return runs


def predict_bodies(state: State, sigma_px: float, options: BodyPredictionOptions) -> BodyScene:
    """Bodies in or near the field.

    Parameters
    ----------
    state
        Geometry.
    sigma_px
        Core of the point spread.
    options
        Limits.

    Returns
    -------
    BodyScene
        Possibly without any.
    """
    rows, cols = state.camera_model.shape_vu
    reach = reach_px(state)
    array = Window(0, 0, rows, cols)
    canvas = array.grown(*reach)
    views, dark, fates = [], [], []
    for body in state.bodies:
        view = view_body(body, state.camera_model, state.attitude.camera_from_j2000)
        reason = view if isinstance(view, str) else _cull(view, canvas, options)
        fates.append(_fate(body, view, reason))
        if isinstance(view, BodyView) and not reason:
            views.append(view)
        if isinstance(view, BodyView) and reason == "unlit":
            dark.append(view)
    views += [view for view in dark if _hides_any(view, views)]
    views, fates = _without_backgrounds(views, fates, state.camera_model, canvas)
    views.sort(key=lambda view: -float(np.linalg.norm(view.centre_km)))
    canvas = canvas.grown(_CANVAS_SKY_PX, _CANVAS_SKY_PX)
    rays = ray_grid(state.camera_model, canvas) if views else None
    return BodyScene(state, reach, sigma_px, sigma_px, tuple(views), tuple(fates), canvas, rays)


def _hides_any(dark: BodyView, views: list[BodyView]) -> bool:
    """Whether a body without light stands before another one, whose limb it would cut."""
    distance = float(np.linalg.norm(dark.centre_km))
    behind = [view for view in views if float(np.linalg.norm(view.centre_km)) > distance]
    return any(dark.box.intersection(view.box).pixels for view in behind)


def _without_backgrounds(
    views: list[BodyView], fates: list[BodyFate], camera: CameraModel, canvas: Window
) -> tuple[list[BodyView], list[BodyFate]]:
    """Leave out a body that fills all of the canvas where others are before it: without a limb it tells no place."""
    corners = _outline_of(canvas)
    uv = corners[:, ::-1] - camera.principal_point_vu[::-1]
    slopes = uv @ np.linalg.inv(camera.k_px_per_mm).T / camera.focal_length_mm
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    filling = {
        view.body.name
        for view in views
        if intersect(view.body.radii_km, view.observer_km, rays @ view.camera_from_body)[1].all()
    }
    if not filling or len(filling) == len(views):
        return views, fates
    kept = [view for view in views if view.body.name not in filling]
    marked = [replace(f, reason="fills_frame") if f.name in filling and not f.reason else f for f in fates]
    return kept, marked


def _outline_of(window: Window) -> FloatArray:
    """(n, 2) corners and middles of the sides of a window: a body behind all of them shows no limb inside.

    Parameters
    ----------
    window
        Pixels.

    Returns
    -------
    numpy.ndarray
        Rows and columns.
    """
    v = window.v0 + window.rows * np.array([0.0, 0.5, 1.0])
    u = window.u0 + window.cols * np.array([0.0, 0.5, 1.0])
    return np.stack(np.meshgrid(v, u, indexing="ij"), axis=2).reshape(-1, 2)


def reach_px(state: State) -> tuple[int, int]:
    """Farthest that a body of the array can be from its prediction.

    Parameters
    ----------
    state
        Camera and settings.

    Returns
    -------
    tuple of int
        Pixels along v and u: the search margin, and the way that the largest rotation carries the array's corner.
    """
    settings = state.settings
    turn = np.radians(settings.max_rotation_deg) if settings.fit_camera_rotation else 0.0
    half_v, half_u = (n / 2 for n in state.camera_model.shape_vu)
    margin_v, margin_u = settings.search_margin_vu
    return int(np.ceil(margin_v + turn * half_u)), int(np.ceil(margin_u + turn * half_v))


def _cull(view: BodyView, canvas: Window, options: BodyPredictionOptions) -> str:
    if not view.box.intersection(canvas).pixels:
        return "outside_field"
    if view.diameter_px < options.min_diameter_px:
        return "too_small"
    return "unlit" if view.lit_px < options.min_lit_px else ""


def _fate(body: Body, view: BodyView | str, reason: str) -> BodyFate:
    if isinstance(view, str):
        return BodyFate(body.name, None, 0.0, 0.0, reason)
    centre = (float(view.centre_vu[0]), float(view.centre_vu[1]))
    return BodyFate(body.name, centre, view.diameter_px, float(np.degrees(view.phase_rad)), reason)
