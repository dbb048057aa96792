"""Star fluxes and what noise hides, for the star sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workflows.samples.cameras import FloatArray, SampleCamera

DETECTION_SNR = 5.0
"""A star counts as in the frame above this ratio of flux to its noise."""


@dataclass(frozen=True)
class Exposure:
    """One exposure: duration (s) and the turning rate of the camera about its own axes (3,), rad/s."""

    seconds: float
    rate_rad_s: FloatArray

    def trail_px(self, camera: SampleCamera) -> float:
        """Return the length of a star's trail near the axis, px."""
        return float(np.hypot(self.rate_rad_s[0], self.rate_rad_s[1]) * self.seconds / camera.rad_per_px)


def fluxes_dn(camera: SampleCamera, mags: FloatArray, seconds: float) -> FloatArray:
    """Return the total DN of stars of some magnitudes."""
    flux: FloatArray = camera.star_dn_per_s_mag0 * 10.0 ** (-0.4 * mags) * seconds
    return flux


def noise_area_px(camera: SampleCamera, exposure: Exposure) -> float:
    """Return the number of pixels whose noise a matched filter gathers.

    4 pi sigma_1 sigma_2 of a Gaussian; the pixel adds 1/12 px2 to each variance and a trail of length L adds L^2/12 to
    one.
    """
    across = camera.psf_sigma_px**2 + 1.0 / 12.0
    along = across + exposure.trail_px(camera) ** 2 / 12.0
    return float(4.0 * np.pi * np.sqrt(across * along))


def signal_to_noise(camera: SampleCamera, flux_dn: FloatArray, exposure: Exposure) -> FloatArray:
    """Return flux over its sigma with photon noise of star and background and read noise."""
    per_pixel = camera.read_noise_dn**2 + camera.background_dn / camera.gain_e_per_dn
    sigma = np.sqrt(flux_dn / camera.gain_e_per_dn + noise_area_px(camera, exposure) * per_pixel)
    ratio: FloatArray = flux_dn / sigma
    return ratio


def flux_at_limit_dn(camera: SampleCamera, exposure: Exposure) -> float:
    """Return the DN of a star whose signal to noise is `DETECTION_SNR`: the root of F^2 = s^2 (F/g + A)."""
    per_pixel = camera.read_noise_dn**2 + camera.background_dn / camera.gain_e_per_dn
    area = noise_area_px(camera, exposure) * per_pixel
    half = DETECTION_SNR**2 / (2.0 * camera.gain_e_per_dn)
    return float(half + np.sqrt(half**2 + DETECTION_SNR**2 * area))


def limit_mag(camera: SampleCamera, exposure: Exposure) -> float:
    """Return the magnitude of a star at `DETECTION_SNR`."""
    rate = flux_at_limit_dn(camera, exposure) / exposure.seconds
    return float(2.5 * np.log10(camera.star_dn_per_s_mag0 / rate))
