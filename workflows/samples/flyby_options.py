"""What the caller of the flyby sample may choose."""

from __future__ import annotations

from dataclasses import dataclass

from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.options import MAX_FRAMES, MAX_PROCESSES

TRAPS = ("lumpy", "haze", "ghost", "twins")
"""Scenes in which what is told of the bodies, or of the light, is wrong."""


@dataclass(frozen=True)
class FlybyOptions:
    """Choices of a flyby sample; `check` names the first absurd one.

    Attributes
    ----------
    frames, ring_frames
        Number of frames of bodies and, after them, of rings; cameras take turns.
    seed
        Seed of everything random.
    cameras
        Names from `flyby_cameras.flyby_cameras`, each as often as it is named.
    processes
        Worker processes; no byte written depends on it.
    diameter_px
        Range of the target's apparent diameter, log-uniform.
    phase_deg
        Range of the phase angle, uniform.
    snr
        Range of the mean light of the lit disc over the noise of a pixel, log-uniform; cameras cut it off where they
        saturate.
    max_rotation_deg
        Largest planted rotation, for cameras whose rotation is to be fitted.
    haze_km
        Scale height of the planet's atmosphere, which the archive tells; zero for none.
    star_share
        Share of frames with stars, which have tables of their own.
    trap_share
        Share of frames in which something told is wrong: a lumpy body, haze, a ghost, twins, the radius of a ring.
    smooth
        Whether bodies are smooth grey ellipsoids, without relief and texture.
    scale_error
        By how much the pixels per millimetre of LORRI really exceed what its camera says: 0.0011 in flight.
    """

    frames: int = 24
    ring_frames: int = 0
    seed: int = 1
    cameras: tuple[str, ...] = (
        "cassini_nac", "voyager_na", "lorri_4x4", "cassini_nac_sum2", "voyager_na", "lorri_1x1", "cassini_nac",
    )  # fmt: skip
    processes: int = 2
    diameter_px: tuple[float, float] = (6.0, 3000.0)
    phase_deg: tuple[float, float] = (5.0, 150.0)
    snr: tuple[float, float] = (3.0, 200.0)
    max_rotation_deg: float = 3.0
    haze_km: float = 0.0
    star_share: float = 0.2
    trap_share: float = 0.04
    smooth: bool = False
    scale_error: float = 0.0

    def check(self) -> None:
        """Raise ValueError, in one line, for a choice that makes no sense."""
        known = flyby_cameras()
        unknown = [name for name in self.cameras if name not in known]
        if not self.cameras or unknown:
            raise ValueError(f"cameras must be some of {', '.join(known)}; got {', '.join(unknown) or 'none'}")
        single: dict[str, tuple[float, float, float]] = {
            "frames": (self.frames, 0 if self.ring_frames else 1, MAX_FRAMES),
            "ring_frames": (self.ring_frames, 0, MAX_FRAMES),
            "seed": (self.seed, 0, 2**63 - 1),
            "processes": (self.processes, 1, MAX_PROCESSES),
            "max_rotation_deg": (self.max_rotation_deg, 0.0, 5.0),
            "haze_km": (self.haze_km, 0.0, 500.0),
            "star_share": (self.star_share, 0.0, 1.0),
            "scale_error": (self.scale_error, -0.01, 0.01),
            "trap_share": (self.trap_share, 0.0, 1.0),
        }
        for name, (value, low, high) in single.items():
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low}, {high}]; got {value}")
        ranges: dict[str, tuple[tuple[float, float], float, float]] = {
            "diameter_px": (self.diameter_px, 2.0, 10_000.0),
            "phase_deg": (self.phase_deg, 0.0, 175.0),
            "snr": (self.snr, 0.1, 1000.0),
        }
        for name, ((first, last), low, high) in ranges.items():
            if not low <= first <= last <= high:
                raise ValueError(f"{name} must rise within [{low}, {high}]; got {first} to {last}")
