"""BodyBlobNav: brightness moments of a small body against those of its rendering; the fallback.

The moment is taken over a window that holds the body and some sky, in both images alike, so that what the window cuts
off cancels. A rotation about its own centre does not move a moment: it is never observable.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field

from pipeline.frame import Frame
from pipeline.imaging.render import Window
from pipeline.predict.bodies import BodyScene
from pipeline.records import BoolArray, FloatArray
from pipeline.status import StatusReason
from pipeline.techniques.base import (
    FeatureTable,
    NavContext,
    TechniqueFailure,
    TechniqueOptions,
    TechniqueResult,
    edge_flags,
    embed_rotation_unobservable,
    information_of,
)
from pipeline.techniques.body_base import Cutout, about, compose, cut_out, predicted_place, rough_levels
from pipeline.techniques.model_errors import ModelErrorOptions, ModelErrors, assumed_errors, correlated_sums
from pipeline.techniques.template_fit import TemplateFit

NAME = "BodyBlobNav"
_ROUNDS = 4
_SETTLED_PX = 0.02
# Share of the template's brightest pixel from which a pixel belongs to the moment.
_LIT_SHARE = 0.05
# A blob is told from others by size alone.
_SURE = 0.99


class BodyBlobOptions(TechniqueOptions):
    """Options of the moments."""

    errors: ModelErrorOptions = ModelErrorOptions()
    max_diameter_px: float = Field(150.0, gt=3, le=2000, description="larger bodies are no blobs")
    threshold_sigma: float = Field(5.0, ge=3, le=100, description="smoothed light over its noise that makes a blob")
    threshold_share: float = Field(0.1, gt=0, lt=1, description="light relative to the brightest that makes a blob")
    rival_share: float = Field(0.5, gt=0, le=1, description="light of a second blob, relative, that makes it ambiguous")
    min_likeness: float = Field(0.7, gt=0, le=1, description="correlation with the rendering, over what noise allows")
    flux_factor: float = Field(3.0, gt=1, le=100, description="size of a blob may differ from the rendering's by this")


def body_blob_nav(
    scene: BodyScene, frame: Frame, fix: TemplateFit | None, context: NavContext, options: BodyBlobOptions
) -> TechniqueResult | TechniqueFailure:
    """Brightest blob within the margin, then its moment against the rendering's.

    Parameters
    ----------
    scene
        Bodies; the largest is the one meant, and it must be small and alone.
    frame
        Image.
    fix
        A fit of the rendered body, from which its albedo and relief are taken where it agrees; never the place.
    context
        Camera, bounds.
    options
        Limits.

    Returns
    -------
    TechniqueResult or TechniqueFailure
        With an unobservable rotation.
    """
    views = [view for view in scene.views if view.diameter_px <= options.max_diameter_px]
    if len(scene.views) != 1 or not views:
        reason = StatusReason.NO_FEATURES_PREDICTED
        return TechniqueFailure(NAME, reason, "blobs are for one small body")
    start = _brightest(scene, frame, context, options)
    if isinstance(start, TechniqueFailure):
        return start
    offset, confidence = start
    for _ in range(_ROUNDS):
        cutout = cut_out(scene, frame, offset, 0.0)
        if cutout is None or not _whole(cutout, frame):
            return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "the blob is cut by the frame or by gaps")
        moment = _moment(cutout)
        if moment is None:
            return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "the blob has no light")
        before = offset
        offset, _ = compose(context, cutout.offset_vu, 0.0, cutout.primary.centre_vu, np.append(moment.shift, 0.0))
        if float(np.hypot(*moment.shift)) > max(2.0, 0.25 * cutout.primary.diameter_px):
            return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "the blob is not of the body's shape")
        if float(np.hypot(*(offset - before))) < _SETTLED_PX:
            break
    assert cutout is not None
    assert moment is not None
    if _likeness(cutout) < options.min_likeness * _expected_likeness(cutout, frame, moment):
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "the blob does not look like the body")
    covariance = _covariance(cutout, frame, moment, _errors(cutout, fix, options))
    place = moment.middle + moment.shift
    return _result(offset, covariance, place, scene, context, confidence, options)


def _brightest(
    scene: BodyScene, frame: Frame, context: NavContext, options: BodyBlobOptions
) -> tuple[FloatArray, float] | TechniqueFailure:
    """Offset that puts the rendering's moment onto the brightest blob, and how sure that is."""
    view = scene.views[0]
    rows, cols = frame.raw.shape
    reach = int(np.ceil(context.max_rotation_rad * np.abs(view.centre_vu - context.camera_model.centre_vu).max()))
    margin = [int(np.ceil(m)) + reach for m in context.search_margin_vu]
    region = view.box.grown(margin[0] + 3, margin[1] + 3).intersection(Window(0, 0, rows, cols))
    if min(region.rows, region.cols) < 5:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, "the body cannot be inside the frame")
    inside = region.slices_in(Window(0, 0, rows, cols))
    light, bad = frame.raw[inside], frame.bad[inside]
    sky = float(np.median(light[~bad])) if (~bad).any() else 0.0
    excess = np.where(bad, np.float32(0.0), light - np.float32(sky))
    smooth = cv2.GaussianBlur(excess, (0, 0), 1.0)
    noise = np.sqrt(frame.noise.variance(np.array(sky))) / (2.0 * np.sqrt(np.pi))
    # Light of a night side, and the wings of a bright one, are no part of what the rendering shows.
    threshold = max(options.threshold_sigma * float(noise), options.threshold_share * float(smooth.max()))
    count, labels, stats, _ = cv2.connectedComponentsWithStats((smooth > threshold).astype(np.uint8))
    if count < 2:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "no light above the noise within the margin")
    flux = np.bincount(labels.ravel(), excess.ravel().astype(float), count)
    # A blob is as large as the rendering is bright, within a factor: stars and cosmic rays are not.
    expected = np.pi / 4.0 * view.diameter_px * max(view.lit_px, 1.0)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    fits = (area > expected / options.flux_factor - 2.0) & (area < expected * options.flux_factor + 30.0)
    flux = np.where(fits, flux, 0.0)
    flux[0] = 0.0
    order = np.argsort(flux)[::-1]
    best = int(order[0])
    if flux[best] <= 0:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_DETECTED, "no blob of the body's size")
    rival = float(flux[order[1]]) if count > 2 else 0.0
    if rival > options.rival_share * flux[best]:
        return TechniqueFailure(NAME, StatusReason.AMBIGUOUS_MATCH, "two blobs of the body's size")
    chosen = labels == best
    v, u = np.nonzero(chosen)
    weight = np.clip(excess[chosen].astype(float), 0.0, None)
    centre = np.array([weight @ v, weight @ u]) / weight.sum() + [region.v0, region.u0]
    window = view.box.grown(4, 4)
    if window.intersection(scene.canvas) != window:
        return TechniqueFailure(NAME, StatusReason.NO_FEATURES_PREDICTED, "the body is predicted too far outside")
    image = scene.picture(scene.views, window).astype(float)
    tv, tu = np.indices(image.shape)
    predicted = np.array([(image * tv).sum(), (image * tu).sum()]) / max(float(image.sum()), 1e-30)
    gap = centre - predicted - [window.v0, window.u0]
    return gap, _SURE


def _whole(cutout: Cutout, frame: Frame) -> bool:
    """Whether all of the body is inside the frame and hardly a pixel is missing."""
    box = cutout.views[0].box
    rows, cols = frame.raw.shape
    inside = box.v0 >= 0 and box.u0 >= 0 and box.v0 + box.rows <= rows and box.u0 + box.cols <= cols
    return inside and float(cutout.good.mean()) > 0.98


@dataclass(frozen=True, eq=False)
class _Moment:
    """First moments over the lit part of the template, in image and template.

    Attributes
    ----------
    shift
        (2,) that moves the template's moment onto the image's.
    middle
        (2,) pixel of the template's moment.
    lever
        (n, 2) weight of each pixel's light in ``shift``, pixels per DN.
    support
        (rows, cols) pixels that count.
    scale, sky
        Brightness and sky, DN.
    """

    shift: FloatArray
    middle: FloatArray
    lever: FloatArray
    support: BoolArray
    scale: float
    sky: float


def _moment(cutout: Cutout) -> _Moment | None:
    """Moments over the lit part and what the blur adds to it; night sides and the sky are taken away first."""
    template = cutout.template.image.astype(float)
    border = _border(cutout.good)
    lit = template > _LIT_SHARE * float(template.max())
    support = cv2.dilate(lit.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if not border.any() or not lit.any():
        return None
    sky = float(np.median(cutout.data[border]))
    dark = cutout.good & (cutout.template.night > 0.95)
    night = float(np.median(cutout.data[dark])) - sky if np.count_nonzero(dark) > 4 else 0.0
    data = cutout.data - sky - night * cutout.template.night
    data = np.where(cutout.good, data, rough_levels(cutout).scale * template)[support]
    expected = template[support]
    scale = float(data.sum() / expected.sum())
    if not scale > 0:
        return None
    v, u = (index.astype(float) for index in np.nonzero(support))
    middle = np.array([expected @ v, expected @ u]) / expected.sum()
    arm = np.stack([v - middle[0], u - middle[1]], axis=1)
    # How the moment answers to a shift: one, but for the light that the support's border cuts off.
    slopes = np.stack([cutout.template.along_v[support], cutout.template.along_u[support]], axis=1).astype(float)
    answer = -(arm.T @ slopes)
    lever = arm @ np.linalg.inv(answer).T / scale
    place = middle + np.array([cutout.window.v0, cutout.window.u0], float)
    return _Moment(lever.T @ data, place, lever, support, scale, sky)


def _likeness(cutout: Cutout) -> float:
    """Correlation of image and rendering over the cutout."""
    pair = np.stack([cutout.data[cutout.good], cutout.template.image[cutout.good]]).astype(float)
    pair -= pair.mean(axis=1, keepdims=True)
    power = float(np.sqrt((pair[0] ** 2).sum() * (pair[1] ** 2).sum()))
    return float((pair[0] * pair[1]).sum()) / power if power > 0 else 0.0


def _expected_likeness(cutout: Cutout, frame: Frame, moment: _Moment) -> float:
    """What that correlation would be if pixels' noise were all that differs."""
    light = moment.scale * cutout.template.image[cutout.good].astype(float)
    noise = float(frame.noise.variance(moment.sky + light).sum())
    signal = float(((light - light.mean()) ** 2).sum())
    return float(np.sqrt(signal / max(signal + noise, 1e-30)))


def _border(good: BoolArray) -> BoolArray:
    edge = np.ones_like(good)
    edge[3:-3, 3:-3] = False
    return np.asarray(edge & good)


def _errors(cutout: Cutout, fix: TemplateFit | None, options: BodyBlobOptions) -> ModelErrors:
    """What the fit of the rendering at about the same place shows of the surface, else what is assumed of it."""
    assumed = assumed_errors(cutout.primary, options.errors)
    if fix is None:
        return assumed
    gap = float(np.hypot(*(fix.cutout.primary.centre_vu - cutout.primary.centre_vu)))
    return fix.errors if gap < max(2.0, 0.25 * cutout.primary.diameter_px) else assumed


def _covariance(cutout: Cutout, frame: Frame, moment: _Moment, errors: ModelErrors) -> FloatArray:
    """Covariance of the shift: noise of pixels and sky, and unknown albedo, slopes and relief."""
    template, support, lever = cutout.template, moment.support, moment.lever
    light = moment.scale * template.image[support].astype(float)
    photon = frame.noise.variance(moment.sky + light)
    covariance = (lever * photon[:, None]).T @ lever
    border = int(np.count_nonzero(_border(cutout.good)))
    # The median of the border has half as much variance again as its mean.
    sky_variance = float(frame.noise.variance(np.array(moment.sky))) * np.pi / 2.0 / max(border, 1)
    pull = lever.sum(axis=0)
    covariance += sky_variance * np.outer(pull, pull)
    v, u = (index.astype(float) for index in np.nonzero(support))
    slope = moment.scale * np.hypot(template.along_v, template.along_u)[support].astype(float)
    covariance += correlated_sums(lever, errors.texture * light, (v, u), errors.texture_px)
    covariance += correlated_sums(lever, errors.wide_texture * light, (v, u), errors.wide_texture_px)
    for rms, reach in errors.patches:
        covariance += correlated_sums(lever, rms * light, (v, u), reach)
    lit = np.where(light > 0, errors.shading * moment.scale, 0.0)
    covariance += correlated_sums(lever, lit, (v, u), errors.texture_px)
    covariance += correlated_sums(lever, errors.relief_px * slope, (v, u), errors.relief_reach_px)
    return np.asarray(covariance)


def _result(
    offset: FloatArray,
    covariance: FloatArray,
    place_vu: FloatArray,
    scene: BodyScene,
    context: NavContext,
    confidence: float,
    options: BodyBlobOptions,
) -> TechniqueResult:
    full = embed_rotation_unobservable(covariance) if context.fit_camera_rotation else covariance
    # About its own moment a rotation does nothing to a moment.
    pivot = predicted_place(context, offset, 0.0, place_vu)
    at_edge, turned = edge_flags(offset, 0.0, context, options)
    sigma = float(np.sqrt(np.trace(covariance) / 2.0))
    one = np.ones(1)
    return TechniqueResult(
        technique=NAME, offset_vu=about(context, offset, 0.0, pivot), rotation_rad=0.0,
        information=information_of(full), pivot_vu=pivot, confidence=confidence, at_edge=at_edge,
        at_edge_rotation=turned, error_sources=tuple(f"body:{name}" for name in scene.names),
        features=FeatureTable(
            name=np.array([scene.views[0].body.name]), kind=np.array(["blob"]), predicted_vu=pivot[None],
            measured_vu=place_vu[None], residual_vu=np.zeros((1, 2)), sigma_px=sigma * one,
            mag=np.nan * one, snr=np.nan * one, used=np.ones(1, bool), reason=np.array([""]),
        ),
        diagnostics={"extra_sigma_px": sigma},
    )  # fmt: skip
