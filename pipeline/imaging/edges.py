"""Edges of an image: a direction field for searches, and the distance to the nearest edge for fits."""

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from pipeline.records import BoolArray, FloatArray, Image, Record

# Norm of the derivative-of-Gaussian filter at sigma 1: noise of a gradient's component per unit of pixel noise.
_GRADIENT_NOISE = 1.0 / np.sqrt(8.0 * np.pi)


@dataclass(frozen=True, eq=False)
class EdgeField(Record):
    """Gradient of an image, compressed to at most one.

    Attributes
    ----------
    along_v, along_u
        (rows, cols) float32; a strong edge has length near 1, noise near 0.
    strength
        (rows, cols) float32, length of the gradient over its noise.
    """

    along_v: Image
    along_u: Image
    strength: Image


def edge_field(image: Image, bad: BoolArray, sigma_dn: Image | FloatArray, scale_px: float = 1.0) -> EdgeField:
    """Smoothed gradient relative to its noise.

    Parameters
    ----------
    image
        (rows, cols) DN.
    bad
        (rows, cols) True where not measured; no edge is seen within the filter's reach of it.
    sigma_dn
        (rows, cols) noise of a pixel.
    scale_px
        Smoothing.

    Returns
    -------
    EdgeField
        For :func:`pipeline.techniques.lm.lm_subpixel_refine` and searches.
    """
    smooth = _smoothed(image, bad, scale_px)
    half = np.array([-0.5, 0.0, 0.5])
    one = np.ones(1)
    dv = cv2.sepFilter2D(smooth, cv2.CV_32F, one, half)
    du = cv2.sepFilter2D(smooth, cv2.CV_32F, half, one)
    noise = np.asarray(_GRADIENT_NOISE / scale_px**2 * sigma_dn, np.float32)
    length = np.sqrt(dv * dv + du * du)
    # Four sigmas is where an edge begins to count in full.
    denominator = length + 4.0 * noise + np.float32(1e-30)
    reach = int(np.ceil(2.0 * scale_px)) * 2 + 1
    near_bad = cv2.dilate(bad.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    dv, du, strength = dv / denominator, du / denominator, length / (noise + np.float32(1e-30))
    for plane in (dv, du, strength):
        plane[near_bad] = 0.0
    return EdgeField(dv, du, strength)


def _smoothed(image: Image, bad: BoolArray, scale_px: float) -> Image:
    """Gaussian means of what is measured: a gap must not look like a step, whose flanks reach beyond the filter."""
    if not bad.any():
        return np.asarray(cv2.GaussianBlur(image, (0, 0), scale_px), np.float32)
    total = cv2.GaussianBlur(np.where(bad, np.float32(0.0), image), (0, 0), scale_px)
    share = cv2.GaussianBlur((~bad).astype(np.float32), (0, 0), scale_px)
    return np.asarray(total / np.maximum(share, np.float32(1e-6)), np.float32)


@numba.njit(cache=True, nogil=True)
def _ridges(strength, along_v, along_u, least):  # type: ignore[no-untyped-def]
    """1 where there is no edge, 0 on pixels whose gradient is the largest along its own direction."""
    rows, cols = strength.shape
    result = np.ones((rows, cols), np.uint8)
    for i in range(1, rows - 1):
        for j in range(1, cols - 1):
            s = strength[i, j]
            if s < least:
                continue
            a, b = abs(along_v[i, j]), abs(along_u[i, j])
            if a > 2.0 * b:
                p, q = strength[i - 1, j], strength[i + 1, j]
            elif b > 2.0 * a:
                p, q = strength[i, j - 1], strength[i, j + 1]
            elif along_v[i, j] * along_u[i, j] > 0:
                p, q = strength[i - 1, j - 1], strength[i + 1, j + 1]
            else:
                p, q = strength[i - 1, j + 1], strength[i + 1, j - 1]
            if s >= p and s >= q:
                result[i, j] = 0
    return result


def distance_to_edges(field: EdgeField, least_sigma: float) -> Image:
    """Distance of every pixel to the nearest edge.

    Parameters
    ----------
    field
        Edges.
    least_sigma
        Gradient over its noise from which a pixel is an edge.

    Returns
    -------
    numpy.ndarray
        (rows, cols) float32 pixels; the image's own size everywhere where there is no edge at all.
    """
    away = _ridges(field.strength, field.along_v, field.along_u, least_sigma)
    if away.all():
        return np.full(away.shape, float(max(away.shape)), np.float32)
    return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)
