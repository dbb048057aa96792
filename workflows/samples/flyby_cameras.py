"""The three spacecraft of the flyby sample, their cameras and the frames that hold them.

Focal lengths, pixels and orientations are those of the instrument kernels that the comments name; noise, saturation
and sensitivity are typical figures of the same cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from workflows.samples.camera_table import sample_cameras
from workflows.samples.cameras import FloatArray, SampleCamera
from workflows.samples.flyby_time import CASSINI_CLOCK, NEW_HORIZONS_CLOCK, VOYAGER_CLOCK, Clock


@dataclass(frozen=True)
class Spacecraft:
    """A spacecraft and the frame that its C-kernel orients.

    Attributes
    ----------
    name, short
        As labels and kernel names write it.
    platform, platform_id
        Frame of class 3 whose attitude the C-kernel holds.
    start_utc
        When its first frame is due.
    """

    name: str
    short: str
    naif_id: int
    platform: str
    platform_id: int
    clock: Clock
    start_utc: datetime


@dataclass(frozen=True)
class FlybyCamera:
    """A camera in one read-out mode.

    Attributes
    ----------
    optics
        Array, lens and detector.
    spacecraft
        What carries it.
    frame, frame_id
        Its SPICE frame, fixed in the platform.
    instrument_from_platform, camera_from_instrument
        (3, 3) rotations; the camera frame is right-handed with z out of the lens.
    wings
        Share of the light in the broad part of the point spread function, and that part's sigma in pixels.
    stored
        ``cassini``, ``voyager`` or ``lorri``: how products are written.
    summation
        Pixels summed along each side.
    """

    optics: SampleCamera
    spacecraft: Spacecraft
    frame: str
    frame_id: int
    instrument_from_platform: FloatArray
    camera_from_instrument: FloatArray
    wings: tuple[float, float]
    stored: str
    summation: int = 1

    @property
    def name(self) -> str:
        """Name in truth and options."""
        return self.optics.name

    @property
    def letter(self) -> str:
        """First letter of the product ids of Cassini's narrow (N) or wide (W) camera."""
        return "W" if self.frame.endswith("WAC") else "N"


CASSINI = Spacecraft("CASSINI ORBITER", "cas", -82, "CASSINI_SC_COORD", -82000, CASSINI_CLOCK, datetime(2007, 2, 3, 4))
VOYAGER = Spacecraft("VOYAGER 2", "vg2", -32, "VG2_SCAN_PLATFORM", -32100, VOYAGER_CLOCK, datetime(1981, 6, 12, 9))
NEW_HORIZONS = Spacecraft(
    "NEW HORIZONS", "nh", -98, "NH_SPACECRAFT", -98000, NEW_HORIZONS_CLOCK, datetime(2015, 5, 7, 21)
)
SPACECRAFT = (CASSINI, VOYAGER, NEW_HORIZONS)


def _along(x: tuple[float, float, float], z: tuple[float, float, float]) -> FloatArray:
    """Return the rotation to axes whose z looks along one vector and whose x lies as near another as it can."""
    third = np.array(z) / np.linalg.norm(z)
    first = np.array(x) - (np.array(x) @ third) * third
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def _cassini() -> tuple[FlybyCamera, FlybyCamera]:
    """Return the narrow camera, full and summed 2x2, looking along about -Y of the spacecraft.

    Focal length, distortion and the lines' slightly finer pitch: Owen 2003 (JPL IOM 312.E-2003). Lines run along -Y and
    samples along -X of the instrument frame, as the Ring-Moon Systems Node has it.
    """
    star = sample_cameras()["cassini_nac"]
    k, k_lines = 83.33333, 83.3428
    full = FlybyCamera(
        optics=replace(
            star,
            focal_length_mm=2002.703,
            k_px_per_mm=((k, 0.0), (0.0, k_lines)),
            distortion_eps=(8.28e-6, 0.0, 5.45e-6, -1.967e-5, 0.0, 0.0),
            psf_sigma_px=0.54,
            read_noise_dn=1.0,
            gain_e_per_dn=29.0,
            bias_dn=8.0,
            background_dn=1.0,
            missing_value=0,
            exposures_s=(0.006, 0.020, 0.120, 0.460, 1.200),
        ),
        spacecraft=CASSINI,
        frame="CASSINI_ISS_NAC",
        frame_id=-82360,
        instrument_from_platform=_along((-1.0, 0.0007, 0.0004), (-0.0012, -1.0, 0.0002)),
        camera_from_instrument=np.diag([-1.0, -1.0, 1.0]),
        wings=(0.03, 5.0),
        stored="cassini",
    )
    optics = replace(
        full.optics,
        name="cassini_nac_sum2",
        shape_vu=(512, 512),
        k_px_per_mm=((k / 2.0, 0.0), (0.0, k_lines / 2.0)),
        principal_point_vu=(255.5, 255.5),
        psf_sigma_px=0.27,
        search_margin_vu=(25.0, 70.0),
    )
    return full, replace(full, optics=optics, wings=(0.03, 2.5), summation=2)


def _cassini_wide(narrow: FlybyCamera) -> tuple[FlybyCamera, FlybyCamera]:
    """Return the wide camera, full and summed 2x2; sources as for the narrow one, orientation nearly the same."""
    k, k_lines = 83.33333, 83.34114
    optics = replace(
        narrow.optics,
        name="cassini_wac",
        focal_length_mm=200.7761,
        k_px_per_mm=((k, 0.0), (0.0, k_lines)),
        distortion_eps=(6.089e-5, 0.0, 4.93e-6, -7.228e-5, 0.0, 0.0),
        psf_sigma_px=0.77,
        search_margin_vu=(10.0, 20.0),
    )
    full = replace(
        narrow,
        optics=optics,
        frame="CASSINI_ISS_WAC",
        frame_id=-82361,
        instrument_from_platform=_along((-1.0, 0.0004, 0.0002), (-0.0003, -1.0, -0.0006)),
        wings=(0.03, 3.0),
    )
    summed = replace(
        optics,
        name="cassini_wac_sum2",
        shape_vu=(512, 512),
        k_px_per_mm=((k / 2.0, 0.0), (0.0, k_lines / 2.0)),
        principal_point_vu=(255.5, 255.5),
        psf_sigma_px=0.385,
        search_margin_vu=(5.0, 10.0),
    )
    return full, replace(full, optics=summed, wings=(0.03, 1.5), summation=2)


def _voyager() -> FlybyCamera:
    """Return Voyager 2's narrow camera as geometrically corrected products show it: 84.821429 px/mm, no distortion."""
    k = 84.821429
    optics = replace(
        sample_cameras()["voyager_na"],
        shape_vu=(1000, 1000),
        focal_length_mm=1503.49,
        k_px_per_mm=((k, 0.0), (0.0, k)),
        principal_point_vu=(499.5, 499.5),
        distortion_eps=(0.0,) * 6,
        psf_sigma_px=0.85,
        read_noise_dn=1.5,
        gain_e_per_dn=60.0,
        bias_dn=0.0,
        background_dn=6.0,
        saturation_dn=255.0,
        missing_value=0,
        search_margin_vu=(60.0, 60.0),
        exposures_s=(0.012, 0.048, 0.24, 0.96),
    )
    return FlybyCamera(
        optics, VOYAGER, "VG2_ISSNA", -32101, _along((1.0, 0.0, 0.0), (0.0002, -0.0004, 1.0)), np.eye(3), (0.04, 6.0),
        "voyager",
    )  # fmt: skip


def _lorri() -> tuple[FlybyCamera, FlybyCamera]:
    """Return LORRI binned and unbinned; the instrument looks along its own -Z, about +X of the spacecraft."""
    cameras = sample_cameras()
    times = (0.010, 0.050, 0.100, 0.150)
    binned = FlybyCamera(
        optics=replace(cameras["lorri_4x4"], image_error_px=0.0, exposures_s=times),
        spacecraft=NEW_HORIZONS,
        frame="NH_LORRI",
        frame_id=-98301,
        instrument_from_platform=_along((0.0, 1.0, 0.001), (-1.0, 0.0, 0.0005)),
        camera_from_instrument=np.diag([1.0, -1.0, -1.0]),
        wings=(0.04, 1.5),
        stored="lorri",
        summation=4,
    )
    optics = replace(cameras["lorri_1x1"], image_error_px=0.0, search_margin_vu=(44.0, 110.0), exposures_s=times)
    return binned, replace(binned, optics=optics, wings=(0.04, 6.0), summation=1)


def flyby_cameras() -> dict[str, FlybyCamera]:
    """Return every camera by its name."""
    narrow, summed = _cassini()
    cameras = (narrow, summed, *_cassini_wide(narrow), _voyager(), *_lorri())
    return {camera.name: camera for camera in cameras}
