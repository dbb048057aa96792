"""How far unknown albedo moves the limb that a band of pixels shows, and how alike it moves pieces of it.

A piece's shift is a weighted sum over its pixels (least squares for shift, brightness and sky), so albedo moves it by a
weighted sum over the surface behind them. Toward a limb that surface is foreshortened: what lies a depth x inside the
line is sqrt(2 R x) away from it on the body, so even provinces as large as a hemisphere change within the blur's width.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.records import FloatArray
from pipeline.techniques.model_errors import ModelErrors

# Steps along the surface, across the band, of the lag between pieces, and of the lag inside one.
_SURFACE, _PIXELS_PER_PX, _LAGS, _INSIDE = 32, 4.0, 24, 5
# Variance of a place inside a pixel.
_PIXEL_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True)
class LimbEdge:
    """The band around a limb.

    Attributes
    ----------
    radius_px
        Of the body.
    sigma_px
        Core of the point spread.
    half_width_px
        Of the band.
    segment_px
        Length of a piece.
    sky_weight
        Weight of a pixel of sky relative to one of the body: its noise is less.
    """

    radius_px: float
    sigma_px: float
    half_width_px: float
    segment_px: float
    sky_weight: float


def limb_albedo(errors: ModelErrors, edge: LimbEdge) -> tuple[FloatArray, FloatArray]:
    """Covariance of the shifts of two pieces of a limb by albedo.

    Parameters
    ----------
    errors
        Albedo that the rendering does not know: exponential covariances.
    edge
        Band.

    Returns
    -------
    tuple
        (k,) distances between pieces, pixels, from zero; (k,) covariance there, px^2.
    """
    place, influence = _influence(edge)
    gap = place[:, None] - place[None, :]
    offset, share = _inside(edge.segment_px)
    pair = np.outer(influence, influence).ravel()
    fields = [
        (errors.texture, errors.texture_px), (errors.wide_texture, errors.wide_texture_px), *errors.patches
    ]  # fmt: skip
    lags = np.concatenate([[0.0], np.geomspace(0.5, 2.0 * edge.radius_px + 1.0, _LAGS)])
    # Along the limb nothing is foreshortened.
    distance = np.hypot(gap.ravel()[None, None, :], (lags[:, None] + offset[None, :])[..., None])
    total = np.zeros(len(lags))
    for rms, reach in fields:
        if rms > 0:
            total += rms**2 * (np.exp(-distance / reach) @ pair) @ share
    return lags, total


def _inside(length: float) -> tuple[FloatArray, FloatArray]:
    """Distances between two places of one piece, and how often they occur."""
    offset = np.linspace(-length, length, _INSIDE + 2)[1:-1]
    share = length - np.abs(offset)
    return offset, share / share.sum()


def _influence(edge: LimbEdge) -> tuple[FloatArray, FloatArray]:
    """Places on the surface, as distance from the limb, and the shift by a unit of albedo at each."""
    blur = float(np.sqrt(edge.sigma_px**2 + _PIXEL_VARIANCE))
    deepest = min(edge.half_width_px + 4.0 * blur, edge.radius_px)
    # Steps alike along the surface are fine in depth where it matters, at the limb.
    border = np.arccos(1.0 - deepest / edge.radius_px) * np.linspace(0.0, 1.0, _SURFACE + 1)
    middle = (border[1:] + border[:-1]) / 2
    depth = edge.radius_px * (1.0 - np.cos(middle))
    width = edge.radius_px * np.diff(-np.cos(border))
    # Of a small body the far side's blur is no part of this limb's.
    inner = float(np.clip(deepest - 2.0 * blur, 1.0, edge.half_width_px))
    pixel = np.arange(-inner, edge.half_width_px, 1.0 / _PIXELS_PER_PX)
    # Positive outward: the surface lies at minus its depth.
    gap = (pixel[:, None] + depth[None, :]) / blur
    light = np.exp(-0.5 * gap**2) / (np.sqrt(2.0 * np.pi) * blur) * width
    profile = light.sum(axis=1)
    slope = (light * gap / blur).sum(axis=1)
    design = np.stack([slope, profile, np.ones(len(pixel))], axis=1)
    weight = np.where(pixel > 2.0 * edge.sigma_px, edge.sky_weight, 1.0)
    weighted = design * weight[:, None]
    estimate = np.linalg.solve(weighted.T @ design, weighted.T)[0]
    return edge.radius_px * middle, np.asarray(estimate @ light)
