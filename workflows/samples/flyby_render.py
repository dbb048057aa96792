"""Light of one frame of the flyby sample: samples of every pixel, spread by the optics and gathered by the pixels.

The core of the point spread function is Gaussian and acts before the pixels integrate, so a sample at some place inside
a pixel lights the neighbours by the integral of that Gaussian over each of them. Where nothing ends inside a pixel its
light counts as even. The frame's derivatives with respect to a shift of everything come the same way, from the smooth
grey twins of the bodies: texture and relief that nobody has mapped tell nobody where a body is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from scipy.fft import irfft2, rfft2
from scipy.special import ndtr

from workflows.samples.cameras import FloatArray, SampleCamera, unproject
from workflows.samples.flyby_rays import HAZE_HEIGHTS, SUB, Spheres, approach, sight

BORDER_PX = 24
"""Light from this far outside the array is followed."""
EDGE_PX = 2.0
"""Pixels this near to a limb get all samples."""
PERIOD = 1152
"""Size to which full frames are padded for the wings' convolution, which wraps around; a product of small primes."""


@dataclass(frozen=True)
class Light:
    """Noise-free light (rows, columns) of bodies, for a brightness factor of one.

    Attributes
    ----------
    total
        What the detector gathers.
    shift_v, shift_u
        Its derivatives with respect to a shift of the scene by one pixel, from smooth grey bodies.
    target
        Light of the target alone before the optics.
    """

    total: FloatArray
    shift_v: FloatArray
    shift_u: FloatArray
    target: FloatArray


def core_kernels(sigma_px: float, per_axis: int) -> tuple[FloatArray, FloatArray]:
    """Return what samples of a pixel give its neighbours along one axis.

    Parameters
    ----------
    sigma_px
        Sigma of the Gaussian core.
    per_axis
        Samples across the pixel, each an even strip; one of `SUB`'s divisors.

    Returns
    -------
    shares (per_axis, taps) that fall into the pixels around, and their derivatives with respect to the sample's place.
    """
    reach = int(np.ceil(4.2 * sigma_px + 1.0))
    strips = SUB * 4
    place = (np.arange(strips) + 0.5) / strips - 0.5
    pixel = np.arange(-reach, reach + 1)
    upper = (pixel[None, :] + 0.5 - place[:, None]) / sigma_px
    lower = (pixel[None, :] - 0.5 - place[:, None]) / sigma_px
    share = ndtr(upper) - ndtr(lower)
    share /= share.sum(axis=1, keepdims=True)
    slope = -(np.exp(-0.5 * upper**2) - np.exp(-0.5 * lower**2)) / (np.sqrt(2.0 * np.pi) * sigma_px)
    groups = (per_axis, strips // per_axis, len(pixel))
    return share.reshape(groups).mean(axis=1), slope.reshape(groups).mean(axis=1)


@numba.njit(cache=True)
def _samples_wanted(s, v, u, x, y, z):  # type: ignore[no-untyped-def]
    """Samples per axis of a pixel: none, one where light is even, all where something ends inside it."""
    wanted = 0
    for k in range(len(s.law)):
        if (v - s.centre_vu[k, 0]) ** 2 + (u - s.centre_vu[k, 1]) ** 2 > s.reach_px[k] ** 2:
            continue
        _, _, _, angle, edge = approach(s, k, x, y, z)
        outside = (angle / edge - 1.0) * s.radius_px[k]
        if abs(outside) < EDGE_PX or s.radius_px[k] < 30.0:
            return SUB
        if outside < 0.0:
            inside = 1 if s.radius_px[k] > 250.0 else 2 if s.radius_px[k] > 100.0 else 4
            return max(wanted, inside)
        if s.haze[k, 1] > 0.0 and outside < HAZE_HEIGHTS * s.haze[k, 0] * s.radius_px[k]:
            wanted = max(wanted, 4)
    return wanted


@numba.njit(cache=True)
def _spread(image, v, u, samples, first, second):  # type: ignore[no-untyped-def]
    """Add a pixel's samples (n, n) to an image through kernels (n, taps) along v and u."""
    n, taps = first.shape
    reach = taps // 2
    for i in range(n):
        for b in range(taps):
            line = 0.0
            for j in range(n):
                line += samples[i, j] * second[j, b]
            line /= n * n
            if line != 0.0 and 0 <= u + b - reach < image.shape[1]:
                for a in range(taps):
                    if 0 <= v + a - reach < image.shape[0]:
                        image[v + a - reach, u + b - reach] += first[i, a] * line


@numba.njit(cache=True)
def _gather(s, shape_vu, across, kernels, slopes, images):  # type: ignore[no-untyped-def]
    """Sample every pixel; spread the finely sampled ones at once and keep the even ones.

    across holds the directions (x/z, y/z) of the canvas's pixels and of one ring around it, (rows + 2, columns + 2, 2);
    images are total, shift_v, shift_u, even light and even smooth light, all on the bordered canvas, and the target.
    """
    total, shift_v, shift_u, even, even_smooth, own = images
    fine, smooth = np.empty((SUB, SUB)), np.empty((SUB, SUB))
    for row in range(total.shape[0]):
        for column in range(total.shape[1]):
            v, u = row - BORDER_PX, column - BORDER_PX
            here = across[row + 1, column + 1]
            n = _samples_wanted(s, v, u, here[0], here[1], 1.0)
            if n == 0:
                continue
            down = 0.5 * (across[row + 2, column + 1] - across[row, column + 1])
            right = 0.5 * (across[row + 1, column + 2] - across[row + 1, column])
            mine = 0.0
            for i in range(n):
                for j in range(n):
                    pv, pu = (i + 0.5) / n - 0.5, (j + 0.5) / n - 0.5
                    x = here[0] + pv * down[0] + pu * right[0]
                    y = here[1] + pv * down[1] + pu * right[1]
                    fine[i, j], smooth[i, j], target = sight(s, x, y, 1.0)
                    mine += target / (n * n)
            if 0 <= v < shape_vu[0] and 0 <= u < shape_vu[1]:
                own[v, u] = mine
            if n == 1:
                even[row, column], even_smooth[row, column] = fine[0, 0], smooth[0, 0]
                continue
            level = 0 if n == 2 else 1 if n == 4 else 2
            _spread(total, row, column, fine[:n, :n], kernels[level], kernels[level])
            _spread(shift_v, row, column, smooth[:n, :n], slopes[level], kernels[level])
            _spread(shift_u, row, column, smooth[:n, :n], kernels[level], slopes[level])


@numba.njit(cache=True)
def _smear(image, along_v, along_u):  # type: ignore[no-untyped-def]
    """Spread an image of even pixels through kernels (taps,) along v and u; zero outside."""
    rows, columns = image.shape
    reach = len(along_v) // 2
    half, out = np.zeros_like(image), np.zeros_like(image)
    for i in range(rows):
        for b in range(len(along_u)):
            step = b - reach
            for j in range(max(0, step), min(columns, columns + step)):
                half[i, j] += along_u[b] * image[i, j - step]
    for a in range(len(along_v)):
        step = a - reach
        for i in range(max(0, step), min(rows, rows + step)):
            for j in range(columns):
                out[i, j] += along_v[a] * half[i - step, j]
    return out


def with_wings(image: FloatArray, wings: tuple[float, float]) -> FloatArray:
    """Return an image in which a share of all light is spread by a broad Gaussian."""
    share, sigma = wings
    rows, columns = (size + 128 if size > PERIOD - 128 else PERIOD // (1 if size > 512 else 2) for size in image.shape)
    nu_v, nu_u = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :]
    transfer = np.exp(-2.0 * (np.pi * sigma) ** 2 * nu_v**2) * np.exp(-2.0 * (np.pi * sigma) ** 2 * nu_u**2)
    spectrum = rfft2(image.astype(np.float32), (rows, columns))
    broad = irfft2(spectrum * transfer.astype(np.float32), (rows, columns))[: image.shape[0], : image.shape[1]]
    mixed: FloatArray = (1.0 - share) * image + share * broad
    return mixed


@lru_cache(maxsize=8)
def directions(camera: SampleCamera) -> FloatArray:
    """Return (x/z, y/z) of the canvas's pixels and of one ring around it, (rows + 2, columns + 2, 2)."""
    sides = [np.arange(-BORDER_PX - 1.0, size + BORDER_PX + 1.0) for size in camera.shape_vu]
    pixels = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    rays = unproject(camera, pixels.reshape(-1, 2))
    across: FloatArray = (rays[:, :2] / rays[:, 2:]).reshape(pixels.shape)
    return across


def gather_light(camera: SampleCamera, wings: tuple[float, float], spheres: Spheres) -> Light:
    """Return the light that a camera gathers from bodies.

    Parameters
    ----------
    wings
        Share and sigma (px) of the broad part of the point spread function.
    spheres
        The bodies as the camera sees them.
    """
    kernels, slopes = zip(*(core_kernels(camera.psf_sigma_px, n) for n in (2, 4, 8)), strict=True)
    canvas = tuple(size + 2 * BORDER_PX for size in camera.shape_vu)
    total, shift_v, shift_u, even, even_smooth = (np.zeros(canvas) for _ in range(5))
    own = np.zeros(camera.shape_vu)
    images = (total, shift_v, shift_u, even, even_smooth, own)
    _gather(spheres, camera.shape_vu, directions(camera), kernels, slopes, images)
    if even.any():
        (share,), (slope,) = core_kernels(camera.psf_sigma_px, 1)
        total += _smear(even, share, share)
        shift_v += _smear(even_smooth, slope, share)
        shift_u += _smear(even_smooth, share, slope)
    frame = tuple(slice(BORDER_PX, BORDER_PX + size) for size in camera.shape_vu)
    core = 1.0 - wings[0]
    return Light(with_wings(total, wings)[frame], core * shift_v[frame], core * shift_u[frame], own)
