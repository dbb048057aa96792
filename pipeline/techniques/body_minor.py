"""Small bodies beside a large one show the rotation that a round disc cannot, once they are found on their arcs."""

import numpy as np

from pipeline.frame import Frame
from pipeline.geometry.rotations import plane_rotation
from pipeline.imaging.render import Window
from pipeline.predict.bodies import BodyScene
from pipeline.predict.body_view import BodyView
from pipeline.records import FloatArray
from pipeline.techniques.base import NavContext
from pipeline.techniques.body_base import compose
from pipeline.techniques.template_fit import TemplateFit

_STEP_PX = 0.5
# Where the large bodies show the rotation themselves, so many of its sigmas are searched.
_SIGMAS = 5.0
# Logarithm of the odds by which the best rotation must beat the next one, and no rotation at all.
_SURE = 9.0


def find_rotation(scene: BodyScene, fit: TemplateFit, frame: Frame, context: NavContext) -> float | None:
    """Rotation about a found body at which small bodies lie where the image shows light.

    Parameters
    ----------
    scene
        All bodies.
    fit
        Of the large ones.
    frame
        Image.
    context
        Bound.

    Returns
    -------
    float or None
        Change of the rotation, radians; None where no rotation stands out.
    """
    views = scene.views_at(scene.attitude(*scene.quantised(fit.offset_vu, fit.rotation_rad)))
    small = [view for view in views if view.body.name in scene.minor().names]
    stamped = [(view, stamp) for view in small if (stamp := _stamp(view, scene)) is not None]
    arms = [float(np.hypot(*(view.centre_vu - fit.pivot_vu))) for view, _ in stamped]
    if max(arms, default=0.0) < 1.0:
        return None
    bound = context.max_rotation_rad
    step = _STEP_PX / max(arms)
    low, high = -bound - fit.rotation_rad, bound - fit.rotation_rad
    if fit.information[2, 2] > 0:
        reach = _SIGMAS * float(np.sqrt(np.linalg.inv(fit.information)[2, 2])) + 2.0 * step
        low, high = max(low, -reach), min(high, reach)
    thetas = np.linspace(low, high, int(np.clip((high - low) / step, 3, 20000)))
    gain = np.zeros(len(thetas))
    for view, stamp in stamped:
        gain += np.array([_gain(view, stamp, fit, float(theta), frame) for theta in thetas])
    best = int(np.argmax(gain))
    apart = np.abs(thetas - thetas[best]) * max(arms) > max(3.0, max(view.diameter_px for view, _ in stamped))
    rival = float(gain[apart].max()) if apart.any() else 0.0
    return float(thetas[best]) if gain[best] - max(rival, 0.0) > _SURE else None


def _stamp(view: BodyView, scene: BodyScene) -> FloatArray | None:
    """Odd square image of one small body about its centre, brightness one."""
    half = int(np.ceil(view.diameter_px / 2 + 4.0 * scene.sigma_px)) + 1
    middle = np.rint(view.centre_vu).astype(int)
    window = Window(int(middle[0]) - half, int(middle[1]) - half, 2 * half + 1, 2 * half + 1)
    outside = window.intersection(scene.canvas) != window
    return None if outside else scene.picture((view,), window).astype(float)


def _gain(view: BodyView, stamp: FloatArray, fit: TemplateFit, theta: float, frame: Frame) -> float:
    """Gain of log-likelihood by light of the body's shape and brightness at its place under a rotation."""
    place = fit.pivot_vu + plane_rotation(theta) @ (view.centre_vu - fit.pivot_vu)
    half = stamp.shape[0] // 2
    v, u = np.rint(place).astype(int)
    rows, cols = frame.raw.shape
    if v < half or u < half or v + half >= rows or u + half >= cols:
        return 0.0
    inside = np.s_[v - half : v + half + 1, u - half : u + half + 1]
    good = ~frame.bad[inside]
    data = frame.raw[inside].astype(float)
    border = np.ones_like(good)
    border[2:-2, 2:-2] = False
    if not (border & good).any():
        return 0.0
    sky = float(np.median(data[border & good]))
    variance = frame.noise.variance(sky + fit.scale_dn * stamp)
    weight = np.where(good, 1.0 / variance, 0.0)
    # The brightness may differ by half: bodies differ in albedo.
    power = float((weight * stamp**2).sum())
    if power <= 0:
        return 0.0
    prior = 1.0 / (0.5 * fit.scale_dn) ** 2
    scale = (float((weight * stamp * (data - sky)).sum()) + prior * fit.scale_dn) / (power + prior)
    without = float((weight * (data - sky) ** 2).sum())
    with_it = float((weight * (data - sky - scale * stamp) ** 2).sum()) + prior * (scale - fit.scale_dn) ** 2
    return float(np.clip(0.5 * (without - with_it), -50.0, 1e6))


def start_with_rotation(fit: TemplateFit, theta: float, context: NavContext) -> tuple[FloatArray, float]:
    """Pointing at the array centre after a rotation about a fit's pivot.

    Parameters
    ----------
    fit
        Of the large bodies.
    theta
        Radians.
    context
        Camera.

    Returns
    -------
    tuple
        (2,) offset and rotation.
    """
    return compose(context, fit.offset_vu, fit.rotation_rad, fit.pivot_vu, np.array([0.0, 0.0, theta]))
