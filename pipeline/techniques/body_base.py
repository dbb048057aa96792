"""What the techniques on bodies share: pixels around them, composed corrections, and information about a pivot."""

from dataclasses import dataclass

import numpy as np

from pipeline.frame import Frame
from pipeline.geometry.pointing import move_pivot
from pipeline.geometry.rotations import plane_rotation, plane_rotation_derivative
from pipeline.imaging.render import Template, Window
from pipeline.predict.bodies import BodyScene
from pipeline.predict.body_view import BodyView
from pipeline.records import BoolArray, FloatArray, Image
from pipeline.techniques.base import NavContext, TechniqueOptions, edge_flags

# A rotation whose own sigma is above this share of its bound's is told by the bound, not by the image.
_ROTATION_SEEN = 1.0 / 3.0
# Lit area in the frame over a body's own below which the direction of its light is not believed.
_CORNER_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Cutout:
    """Image and prediction on the same pixels.

    Attributes
    ----------
    views, template
        Bodies under the pointing at which the template was drawn.
    primary
        The one of them that shows most of itself.
    pivot_vu
        (2,) centroid of their centres, held inside the array.
    offset_vu, rotation_rad
        That pointing, at the array centre.
    sigma_px
        Core of the point spread that it was drawn with.
    data
        (rows, cols) DN.
    good
        (rows, cols) True where measured.
    corner
        Whether too little of each body is seen for its shading to tell the camera's rotation.
    """

    views: tuple[BodyView, ...]
    primary: BodyView
    pivot_vu: FloatArray
    template: Template
    offset_vu: FloatArray
    rotation_rad: float
    sigma_px: float
    data: Image
    good: BoolArray
    corner: bool

    @property
    def window(self) -> Window:
        """Pixels of the cutout."""
        return self.template.window

    def places_vu(self) -> tuple[FloatArray, FloatArray]:
        """Row numbers (rows, 1) and column numbers (1, cols) of the array."""
        v = self.window.v0 + np.arange(self.window.rows, dtype=float)[:, None]
        u = self.window.u0 + np.arange(self.window.cols, dtype=float)[None, :]
        return v, u


def cut_out(scene: BodyScene, frame: Frame, offset_vu: FloatArray, rotation_rad: float) -> Cutout | None:
    """Template near a pointing, with the image's pixels under it.

    Parameters
    ----------
    scene
        Bodies.
    frame
        Image.
    offset_vu, rotation_rad
        At the array centre; the template is drawn at the nearest place of the scene's grid.

    Returns
    -------
    Cutout or None
        None where no body reaches the array, or where a fit has lost all sense.
    """
    if not np.isfinite([*offset_vu, rotation_rad]).all():
        return None
    offset, rotation = scene.quantised(offset_vu, rotation_rad)
    views, template = scene.template(offset, rotation)
    if not views or not template.window.pixels:
        return None
    rows, cols = template.window.slices_in(Window(0, 0, *frame.raw.shape))
    primary, pivot = scene.primary(views), scene.centroid(views)
    corner = scene.state.settings.fit_camera_rotation and _only_corners(scene, views)
    return Cutout(
        views, primary, pivot, template, offset, rotation, scene.sigma_px, frame.raw[rows, cols],
        ~frame.bad[rows, cols], corner,
    )  # fmt: skip


def _only_corners(scene: BodyScene, views: tuple[BodyView, ...]) -> bool:
    """Whether all bodies show so little of themselves that albedo passes for a Sun from elsewhere.

    A body with a known relief tells the rotation by that.
    """
    if any(view.body.mesh is not None for view in views):
        return False
    camera = scene.state.camera_model
    inside = [area for area, _ in scene.lit_areas(views)]
    whole = [view.lit_area_px2(camera, view.box, ())[0] for view in views]
    return all(part < _CORNER_SHARE * all_of_it for part, all_of_it in zip(inside, whole, strict=True))


@dataclass(frozen=True)
class Levels:
    """Brightness of a template's unit, of the sky, and of night sides, DN."""

    scale: float
    sky: float
    night: float


def rough_levels(cutout: Cutout) -> Levels:
    """Brightness and sky by a plain regression of the image on the template.

    Parameters
    ----------
    cutout
        Both.

    Returns
    -------
    Levels
        Night sides count as dark.
    """
    x = cutout.template.image[cutout.good].astype(float)
    y = cutout.data[cutout.good].astype(float)
    dx = x - x.mean()
    power = float(dx @ dx)
    slope = float(dx @ (y - y.mean())) / power if power > 0 else 0.0
    return Levels(slope, float(y.mean() - slope * x.mean()), 0.0)


def compose(
    context: NavContext,
    offset_vu: FloatArray,
    rotation_rad: float,
    pivot_vu: FloatArray,
    step: FloatArray,
) -> tuple[FloatArray, float]:
    """Correction at the array centre after a further small similarity about a pivot.

    Parameters
    ----------
    context
        Camera.
    offset_vu, rotation_rad
        Correction so far.
    pivot_vu
        (2,) pivot of the step.
    step
        (3,) dv, du, theta.

    Returns
    -------
    tuple
        (2,) offset, rotation.
    """
    centre = context.camera_model.centre_vu
    landed = pivot_vu + plane_rotation(step[2]) @ (centre + offset_vu - pivot_vu) + step[:2]
    return landed - centre, rotation_rad + float(step[2])


def about(
    context: NavContext, offset_vu: FloatArray, rotation_rad: float, pivot_vu: FloatArray
) -> FloatArray:
    """(2,) offset about a pivot of the prediction, of a correction known at the array centre."""
    return move_pivot(offset_vu, rotation_rad, context.camera_model.centre_vu, pivot_vu)[0]


def predicted_place(context: NavContext, offset_vu: FloatArray, rotation_rad: float, seen_vu: FloatArray) -> FloatArray:
    """Where the a-priori prediction puts what a corrected one puts at ``seen_vu``: the pivot that a result reports."""
    centre = context.camera_model.centre_vu
    return np.asarray(centre + (seen_vu - centre - offset_vu) @ plane_rotation(rotation_rad))


def turn_lever(places_vu: FloatArray, pivot_vu: FloatArray) -> FloatArray:
    """(n, 2) derivative of places with respect to a rotation about a pivot, at zero rotation."""
    return np.asarray((places_vu - pivot_vu) @ plane_rotation_derivative(0.0).T)


@dataclass(frozen=True, eq=False)
class Settled:
    """Information about a pivot, with a rotation that the image does not show taken out of it.

    Attributes
    ----------
    information
        (2, 2) or (3, 3); row and column of theta are exact zeros where it is not observed.
    pivot_vu
        (2,) the given pivot, or where theta is not observed the point about which a rotation changes nothing: the
        centre of a round disc, say, whose limb binds rotation and translation together about any other.
    observed
        Whether theta is.
    """

    information: FloatArray
    pivot_vu: FloatArray
    observed: bool


def rotation_shows(information: FloatArray, context: NavContext) -> bool:
    """Whether an image tells a rotation far better than its bound does, the translation being free.

    Parameters
    ----------
    information
        (2, 2) or (3, 3).
    context
        Bound.

    Returns
    -------
    bool
        Never for two parameters.
    """
    if len(information) == 2:
        return False
    own = float(information[2, 2] - information[:2, 2] @ rotation_lever(information))
    bound = context.max_rotation_rad / np.sqrt(3.0)
    return own > 0 and 1.0 / np.sqrt(own) < _ROTATION_SEEN * bound


def rotation_lever(information: FloatArray) -> FloatArray:
    """(2,) offset that goes with a rotation of -1 and leaves the image as like as it can be."""
    return np.asarray(np.linalg.pinv(information[:2, :2], rcond=1e-12, hermitian=True) @ information[:2, 2])


def body_edge_flags(
    settled: Settled, offset_vu: FloatArray, rotation_rad: float, context: NavContext, options: TechniqueOptions
) -> tuple[bool, bool]:
    """Whether an answer has run into the search's bounds.

    Parameters
    ----------
    settled
        Its information and pivot in the image.
    offset_vu, rotation_rad
        At the array centre, where the margin is defined; without a rotation the offset is known at the pivot alone, and
        the margin there is wider by what the largest rotation adds.
    context, options
        Bounds, and fractions that count as their edge.

    Returns
    -------
    tuple
        Any bound reached; the rotation's reached.
    """
    if settled.observed or not context.fit_camera_rotation:
        return edge_flags(offset_vu, rotation_rad, context, options)
    pivot = predicted_place(context, offset_vu, rotation_rad, settled.pivot_vu)
    there = np.abs(about(context, offset_vu, rotation_rad, pivot))
    arm = np.abs(pivot - context.camera_model.centre_vu)[::-1]
    bound = np.asarray(context.search_margin_vu) + context.max_rotation_rad * arm
    return bool((there >= options.margin_at_edge_fraction * bound).any()), False


def settle(information: FloatArray, pivot_vu: FloatArray, context: NavContext) -> Settled:
    """Keep a rotation that is observed; else move the pivot to where the rotation does not matter.

    Parameters
    ----------
    information
        (2, 2) or (3, 3) about the pivot.
    pivot_vu
        (2,).
    context
        Bound of the rotation.

    Returns
    -------
    Settled
        Ready for a result.
    """
    if len(information) == 2 or rotation_shows(information, context):
        return Settled(information, pivot_vu, len(information) == 3)
    # d + lever * theta is what is known; about p + R'^-1 lever it is the offset alone.
    moved = pivot_vu + np.linalg.inv(plane_rotation_derivative(0.0)) @ rotation_lever(information)
    known = np.zeros((3, 3))
    known[:2, :2] = information[:2, :2]
    return Settled(known, moved, False)
