"""What the caller of the star sample may choose."""

from __future__ import annotations

from dataclasses import dataclass

from workflows.samples.camera_table import sample_cameras

MAX_FRAMES = 20_000
MAX_PROCESSES = 256


@dataclass(frozen=True)
class StarSampleOptions:
    """Choices of a star sample; `check` names the first absurd one.

    Attributes
    ----------
    frames
        Number of frames; cameras take turns.
    seed
        Seed of everything random.
    cameras
        Names from `camera_table.sample_cameras`.
    false_fraction
        Share of the detectable point-like things of a frame that are not catalogue stars, [0, 0.95].
    processes
        Worker processes; no byte written depends on it.
    min_stars, max_stars
        Catalogue stars above five sigma in a narrow frame.
    max_stars_wide
        The same upper bound for wide cameras, which take the real sky as it is.
    max_rotation_deg
        Largest planted rotation, deg, for cameras whose rotation is to be fitted.
    oddity_fraction
        Share of the catalogue stars that are moved, as many that are variable, and as many that are double, [0, 0.2].
    smeared_fraction
        Share of the frames in which the spacecraft turns by one to four pixels during the exposure.
    deep
        Whether synthetic stars fainter than the real catalogue fill the narrow fields.
    """

    frames: int = 60
    seed: int = 1
    cameras: tuple[str, ...] = ("lorri_4x4", "lorri_1x1", "cassini_nac", "voyager_na", "voyager_wa")
    false_fraction: float = 0.5
    processes: int = 2
    min_stars: int = 0
    max_stars: int = 40
    max_stars_wide: int = 200
    max_rotation_deg: float = 3.0
    oddity_fraction: float = 0.05
    smeared_fraction: float = 0.25
    deep: bool = True

    def check(self) -> None:
        """Raise ValueError, in one line, for a choice that makes no sense."""
        known = sample_cameras()
        unknown = [name for name in self.cameras if name not in known]
        if not self.cameras or unknown:
            raise ValueError(f"cameras must be some of {', '.join(known)}; got {', '.join(unknown) or 'none'}")
        bounds: dict[str, tuple[float, float, float]] = {
            "frames": (self.frames, 1, MAX_FRAMES),
            "seed": (self.seed, 0, 2**63 - 1),
            "processes": (self.processes, 1, MAX_PROCESSES),
            "false_fraction": (self.false_fraction, 0.0, 0.95),
            "oddity_fraction": (self.oddity_fraction, 0.0, 0.2),
            "smeared_fraction": (self.smeared_fraction, 0.0, 1.0),
            "max_rotation_deg": (self.max_rotation_deg, 0.0, 5.0),
            "min_stars": (self.min_stars, 0, 200),
            "max_stars": (self.max_stars, self.min_stars, 200),
            "max_stars_wide": (self.max_stars_wide, self.min_stars, 2000),
        }
        for name, (value, low, high) in bounds.items():
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low}, {high}]; got {value}")
