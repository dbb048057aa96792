"""Schema of the camera blocks in ``catalogs/config/config_4N0_inst_*.yaml``, and whose label is whose."""

import re
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from pipeline.options import InstrumentSettings, Options
from pipeline.records import CameraModel, Detector, FloatArray

CardValue = str | int | float | bool
Header = Mapping[str, CardValue]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
# Matrices are written with a handful of digits; a wrong sign is off by more.
_ROTATION_TOLERANCE = 1e-5


def _invertible(matrix: tuple[Pair, Pair]) -> tuple[Pair, Pair]:
    (a, b), (c, d) = matrix
    if a * d == b * c:
        raise ValueError("the matrix must have an inverse")
    return matrix


def _rotation(matrix: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
    array = np.array(matrix)
    if not np.allclose(array @ array.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(array) < 0:
        raise ValueError("the matrix must be a rotation")
    return matrix


def _regular_expression(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"no regular expression: {error}") from error
    return text


Pattern = Annotated[str, Field(min_length=1), AfterValidator(_regular_expression)]
# Keywords of a label, each with a regular expression that its whole value must match, in either case; of keywords
# joined by '|' any one may.
Marks = dict[str, Pattern]


class SpiceNames(Options):
    """What SPICE calls a camera, and how its frame lies in it."""

    spacecraft_id: int = Field(ge=-999999, lt=0, description="NAIF id of the spacecraft")
    instrument_id: int = Field(lt=0, description="NAIF id of the camera, which its instrument kernel uses")
    frame: str = Field(min_length=1, max_length=32, description="frame whose orientation the kernels give")
    camera_from_instrument: Annotated[tuple[Triple, Triple, Triple], AfterValidator(_rotation)] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="rotation from that frame to the camera frame (z out of the lens)",
    )
    ck_tolerance_s: float = Field(
        0.0, ge=0, le=3600, description="how far the nearest pointing may be where C-kernels hold single ones, seconds"
    )

    def rotation(self) -> FloatArray:
        """(3, 3) camera_from_instrument, orthonormal to the last digit whatever was written."""
        u, _, vt = np.linalg.svd(np.array(self.camera_from_instrument))
        return np.asarray(u @ vt)


class CameraMode(Options):
    """One read-out mode of a camera: array, optics and detector."""

    identify: Marks = Field(
        default_factory=dict, description="label keywords that tell this mode from others of the same array"
    )
    shape_vu: tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]]
    focal_length_mm: float = Field(gt=0)
    k_px_per_mm: Annotated[tuple[Pair, Pair], AfterValidator(_invertible)] = Field(
        description="[[Kx, Kxy], [Kyx, Ky]], photo-plane mm to (u, v) pixels"
    )
    principal_point_vu: Pair
    distortion_eps: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    search_margin_vu: Pair | None = Field(None, description="replaces the block's margin in this mode, pixels")
    psf_sigma_px: float | None = Field(None, gt=0.1, le=20)
    psf_misfit: float | None = Field(None, gt=0, le=1, description="share of a star's light off the Gaussian")
    model_residual_px: float = Field(0.0, ge=0, le=10, description="1-sigma of what the camera model leaves out")
    read_noise_dn: float | None = Field(None, ge=0)
    gain_e_per_dn: float | None = Field(None, gt=0)
    bias_dn: float = 0.0
    saturation_dn: float | None = None
    missing_value: float | None = None
    star_dn_per_s_mag0: float | None = Field(None, gt=0)

    def camera_model(self) -> CameraModel:
        """Optics as a record."""
        return CameraModel(
            self.shape_vu, self.focal_length_mm, np.array(self.k_px_per_mm), np.array(self.principal_point_vu),
            np.array(self.distortion_eps),
        )  # fmt: skip

    def detector(self) -> Detector:
        """Detector as a record."""
        return Detector(
            self.psf_sigma_px, self.psf_misfit, self.model_residual_px, self.read_noise_dn, self.gain_e_per_dn,
            self.bias_dn, self.saturation_dn, self.missing_value, self.star_dn_per_s_mag0,
        )  # fmt: skip


class InstrumentBlock(InstrumentSettings):
    """One camera: who it is, how its headers are told, and its modes."""

    mission: str
    camera: str
    header: Literal["lorri"] | None = Field(None, description="reader of pointing cards in the product's own label")
    identify: Marks | list[Marks] = Field(
        default_factory=list, description="label keywords that mark this camera's products; a list holds alternatives"
    )
    image_time: Literal["start", "middle", "end"] = Field(
        "start", description="part of the exposure that IMAGE_TIME stands for in this camera's labels"
    )
    exposure_unit: Literal["s", "ms"] = Field("ms", description="of exposures in labels that name no unit")
    product_id_pattern: Pattern | None = Field(
        None, description="regular expression of a file stem that is a product id"
    )
    spice: SpiceNames | None = Field(None, description="names for the spice provider; without them it cannot be used")
    quality_extension: str | None = Field(None, description="name of the extension whose non-zero pixels are bad")
    modes: dict[str, CameraMode] = Field(min_length=1, description="read-out modes by name")


def matches(marks: Mapping[str, str], header: Header) -> bool:
    """Whether a label carries all of some marks; without marks, no.

    Parameters
    ----------
    marks
        Regular expression by keyword.
    header
        Keywords of a label.

    Returns
    -------
    bool
        True if every expression matches its keyword's whole value.
    """
    return bool(marks) and all(
        any(re.fullmatch(pattern, str(header.get(key, "")).strip(), re.IGNORECASE) for key in keys.split("|"))
        for keys, pattern in marks.items()
    )


def identify(header: Header, blocks: Mapping[str, InstrumentBlock]) -> InstrumentBlock | None:
    """Camera whose identifying keywords a label carries.

    Parameters
    ----------
    header
        Keywords of a label, or columns of an index.
    blocks
        Configured cameras.

    Returns
    -------
    InstrumentBlock or None
        None where no camera claims the label.
    """
    for block in blocks.values():
        alternatives = block.identify if isinstance(block.identify, list) else [block.identify]
        if any(matches(marks, header) for marks in alternatives):
            return block
    return None


def mode_of(block: InstrumentBlock, shape_vu: tuple[int, ...], header: Header) -> str | None:
    """Name of the read-out mode of an image.

    Parameters
    ----------
    block
        Camera.
    shape_vu
        Of the stored array.
    header
        Keywords of its label, which decide where modes share a shape.

    Returns
    -------
    str or None
        The mode whose marks the label carries, else the first of this shape; None where no mode has the shape.
    """
    names = [name for name, mode in block.modes.items() if mode.shape_vu == shape_vu]
    marked = (name for name in names if matches(block.modes[name].identify, header))
    return next(marked, names[0] if names else None)
