"""What the caller of the asteroid sample may choose, and the invented body."""

from __future__ import annotations

from dataclasses import dataclass

from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.flyby_system import SampleBody, Surface, System
from workflows.samples.options import MAX_FRAMES, MAX_PROCESSES

ASTEROID_ID = 2_987_001
"""Of the numbered asteroids' range, beyond what is numbered."""
POLE_DEG = (88.0, -63.0)
SYSTEM = System(ASTEROID_ID, 2.1e-6, 2.2, 0.4, POLE_DEG)
BODY = SampleBody(
    "TESSARY", ASTEROID_ID, (2.7, 2.2, 1.9), Surface(0.0, 2, 2.0, 0.09, "lunar_lambert"), POLE_DEG, 71.0, 1234.5,
    system=SYSTEM,
)  # fmt: skip


@dataclass(frozen=True)
class AsteroidOptions:
    """Choices of an asteroid sample; `check` names the first absurd one.

    Attributes
    ----------
    frames
        Number of images: from the approach and from orbit in turn.
    seed
        Seed of everything random.
    processes
        Worker processes; no byte written depends on it.
    camera
        Name from `flyby_cameras.flyby_cameras`.
    cells, coarse_cells
        Cells along a side of each of the six faces of the fine and of the coarse shape.
    scales_km, half
        Widths of the maplets' cells, and cells on each side of the middle one.
    coverage
        How often maplets of each scale cover the surface.
    pixel_km
        Sizes of a pixel at the body: the smallest and largest from orbit, the largest from the approach.
    phase_deg
        Range of the phase angle.
    snr
        Range of the light of the lit surface over the noise of a pixel.
    pointing_sigma_px, twist_sigma_deg
        1 sigma of the a-priori attitude, across and about the line of sight.
    position_sigma_share
        1 sigma of the a-priori position per axis, share of the distance.
    landmark_sigma_cells
        Range of the 1 sigma per axis of landmarks' places, which the catalogue tells of each.
    height_error_cells, albedo_error
        Rms of the errors of maplets that nothing tells.
    """

    frames: int = 12
    seed: int = 1
    processes: int = 2
    camera: str = "cassini_wac_sum2"
    cells: int = 1024
    coarse_cells: int = 64
    scales_km: tuple[float, ...] = (0.010, 0.005)
    half: int = 24
    coverage: float = 2.0
    pixel_km: tuple[float, float, float] = (0.0038, 0.0095, 0.0140)
    phase_deg: tuple[float, float] = (15.0, 75.0)
    snr: tuple[float, float] = (40.0, 150.0)
    pointing_sigma_px: float = 20.0
    twist_sigma_deg: float = 0.5 / 3.0
    position_sigma_share: float = 0.01 / 3.0
    landmark_sigma_cells: tuple[float, float] = (0.15, 0.5)
    height_error_cells: float = 0.04
    albedo_error: float = 0.015

    def check(self) -> None:
        """Raise ValueError, in one line, for a choice that makes no sense."""
        known = flyby_cameras()
        if self.camera not in known or known[self.camera].stored != "cassini":
            names = ", ".join(name for name, camera in known.items() if camera.stored == "cassini")
            raise ValueError(f"camera must be one of {names}; got {self.camera}")
        single: dict[str, tuple[float, float, float]] = {
            "frames": (self.frames, 1, MAX_FRAMES),
            "seed": (self.seed, 0, 2**63 - 1),
            "processes": (self.processes, 1, MAX_PROCESSES),
            "cells": (self.cells, 16, 4096),
            "coarse_cells": (self.coarse_cells, 4, 512),
            "half": (self.half, 4, 100),
            "coverage": (self.coverage, 0.01, 20.0),
            "pointing_sigma_px": (self.pointing_sigma_px, 0.0, 100.0),
            "twist_sigma_deg": (self.twist_sigma_deg, 0.0, 1.5),
            "position_sigma_share": (self.position_sigma_share, 0.0, 0.05),
            "height_error_cells": (self.height_error_cells, 0.0, 2.0),
            "albedo_error": (self.albedo_error, 0.0, 0.3),
        }
        for name, (value, low, high) in single.items():
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low}, {high}]; got {value}")
        rising: dict[str, tuple[tuple[float, ...], float, float]] = {
            "pixel_km": (self.pixel_km, 1e-4, 1.0),
            "phase_deg": (self.phase_deg, 0.0, 120.0),
            "snr": (self.snr, 1.0, 1000.0),
            "landmark_sigma_cells": (self.landmark_sigma_cells, 0.0, 10.0),
        }
        for name, (values, low, high) in rising.items():
            if list(values) != sorted(values) or not low <= values[0] <= values[-1] <= high:
                raise ValueError(f"{name} must rise within [{low}, {high}]; got {', '.join(map(str, values))}")
        if not self.scales_km or min(self.scales_km) <= 0.0:
            raise ValueError("scales_km must hold widths above zero")
