"""The five cameras of the star sample.

Each stored array is turned or mirrored differently, so that no sign error in a reader can hide: LORRI's rows run
against +y, the Cassini array is upright, the Voyager narrow camera is turned by a quarter and the wide one is mirrored
and slightly skewed.
"""

from __future__ import annotations

from dataclasses import replace
from math import radians, tan

from workflows.samples.cameras import SampleCamera

PHOTZPT_4X4 = 18.97
"""V of a star giving one DN/s, from the level 2 headers of 4x4 frames."""
PHOTZPT_1X1 = 18.88
"""The same for unbinned frames, a tenth of a magnitude less, so that a reader must take it from the header."""

_NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _k_of_field(size_px: int, focal_length_mm: float, field_deg: float) -> float:
    """Pixels per millimetre of an array of size_px that spans field_deg behind focal_length_mm."""
    return size_px / (2.0 * focal_length_mm * tan(radians(field_deg) / 2.0))


def _lorri() -> tuple[SampleCamera, SampleCamera]:
    """Return LORRI binned 4x4 and unbinned.

    Focal length 2619.008 mm and 13 um pixels: NAIF's instrument kernel (nh_lorri). Read noise 1.1 DN and 22 e/DN: the
    level 2 headers. The bias (about 539 DN) is taken off in level 2, which lowers the 12-bit ceiling of 4095 DN. PSF: a
    core of 1.8 to 2.1 unbinned pixels at half maximum (Weaver et al. 2020, PASP 132), taken as 0.90 px; binned frames
    as 0.40 px. Star images of real 4x4 frames scatter by 0.09 px about a pinhole camera, the scale's 0.11 % included,
    which is taken four times as large unbinned, less what the finer sampling gains.
    """
    k = 1.0 / 0.052
    binned = SampleCamera(
        name="lorri_4x4",
        mission="New Horizons",
        instrument="LORRI",
        shape_vu=(256, 256),
        focal_length_mm=2619.008,
        k_px_per_mm=((k, 0.0), (0.0, -k)),
        principal_point_vu=(127.5, 127.5),
        distortion_eps=_NO_DISTORTION,
        psf_sigma_px=0.40,
        read_noise_dn=1.1,
        gain_e_per_dn=22.0,
        bias_dn=0.0,
        background_dn=0.9,
        saturation_dn=4095.0 - 539.0,
        missing_value=None,
        star_dn_per_s_mag0=10.0 ** (0.4 * PHOTZPT_4X4),
        search_margin_vu=(27.5, 55.0),
        fit_camera_rotation=False,
        exposures_s=(0.1, 0.2, 0.5),
        faint_mags=(10.0, 15.0),
        image_error_px=0.09,
        years=(2014.0, 2020.9),
        distance_au=(29.0, 47.0),
        speed_kms=(13.8, 14.8),
    )
    full = replace(
        binned,
        name="lorri_1x1",
        shape_vu=(1024, 1024),
        k_px_per_mm=((4.0 * k, 0.0), (0.0, -4.0 * k)),
        principal_point_vu=(511.5, 511.5),
        psf_sigma_px=0.90,
        image_error_px=0.30,
        background_dn=0.2,
        star_dn_per_s_mag0=10.0 ** (0.4 * PHOTZPT_1X1),
        search_margin_vu=(44.0, 110.0),
        exposures_s=(0.1, 0.15, 0.3),
        faint_mags=(10.0, 14.0),
    )
    return binned, full


def _cassini_nac() -> SampleCamera:
    """Return Cassini's narrow camera.

    f = 2003.44 mm and 12 um pixels: NAIF's cas_iss kernel. Distortion: the size and form Owen (2003, JPL IOM
    312.E-2003) found, half a pixel at the corners. PSF sigma 0.54 px: Porco et al. 2004 (FWHM 1.3 px).
    """
    k = 1.0 / 0.012
    return SampleCamera(
        name="cassini_nac",
        mission="Cassini",
        instrument="NAC",
        shape_vu=(1024, 1024),
        focal_length_mm=2003.44,
        k_px_per_mm=((k, 0.0), (0.0, k)),
        principal_point_vu=(511.5, 511.5),
        distortion_eps=(8.28e-6, 0.0, 5.45e-6, -19.67e-6, 0.0, 0.0),
        psf_sigma_px=0.54,
        read_noise_dn=0.9,
        gain_e_per_dn=29.0,
        bias_dn=20.0,
        background_dn=4.0,
        saturation_dn=4095.0,
        missing_value=None,
        star_dn_per_s_mag0=4.0e5,
        search_margin_vu=(50.0, 140.0),
        fit_camera_rotation=False,
        exposures_s=(2.0, 5.6, 12.0),
        faint_mags=(10.0, 13.5),
        image_error_px=0.0,
        years=(2004.5, 2017.6),
        distance_au=(9.0, 10.1),
        speed_kms=(5.0, 25.0),
    )


def _voyager() -> tuple[SampleCamera, SampleCamera]:
    """Return Voyager's narrow and wide cameras.

    Focal lengths 1503.49 and 200.77 mm, fields 0.424 and 3.169 deg over 800 lines: NAIF's vg2_issna and vg2_isswa
    kernels. Frames hold 8 bits. Lens distortion, PSF, noise and sensitivity are invented within what such vidicons do.
    """
    k = _k_of_field(800, 1503.49, 0.424)
    narrow = SampleCamera(
        name="voyager_na",
        mission="Voyager 2",
        instrument="NA",
        shape_vu=(800, 800),
        focal_length_mm=1503.49,
        k_px_per_mm=((0.0, -k), (k, 0.0)),
        principal_point_vu=(396.0, 405.5),
        distortion_eps=(-1.5e-5, 0.0, 0.0, 0.0, 0.0, 0.0),
        psf_sigma_px=0.85,
        read_noise_dn=1.5,
        gain_e_per_dn=60.0,
        bias_dn=4.0,
        background_dn=2.0,
        saturation_dn=255.0,
        missing_value=0,
        star_dn_per_s_mag0=3.0e5,
        search_margin_vu=(60.0, 80.0),
        fit_camera_rotation=True,
        exposures_s=(5.76, 11.52, 15.36),
        faint_mags=(10.0, 13.5),
        image_error_px=0.0,
        years=(1979.2, 1989.9),
        distance_au=(5.0, 30.5),
        speed_kms=(15.0, 27.0),
    )
    k = _k_of_field(800, 200.77, 3.169)
    wide = replace(
        narrow,
        name="voyager_wa",
        instrument="WA",
        focal_length_mm=200.77,
        k_px_per_mm=((-k, 0.004 * k), (0.0, k)),
        principal_point_vu=(399.5, 399.5),
        distortion_eps=(-2.5e-5, 1.0e-8, 0.0, 0.0, 1.0e-4, 0.0),
        psf_sigma_px=0.75,
        star_dn_per_s_mag0=1.5e5,
        search_margin_vu=(40.0, 40.0),
        exposures_s=(0.48, 0.96, 1.92),
        faint_mags=(),
    )
    return narrow, wide


def sample_cameras() -> dict[str, SampleCamera]:
    """Return every camera by its name."""
    cameras = (*_lorri(), _cassini_nac(), *_voyager())
    return {camera.name: camera for camera in cameras}
