"""What every technique is given and what it returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.errors import ContractError
from pipeline.options import Options
from pipeline.records import BoolArray, CameraModel, FloatArray, Record, State
from pipeline.status import StatusReason

# Seed 000: finite stand-in for "infinite" in a covariance matrix. It exists at the techniques' interface only;
# everything behind it works on information, where the same statement is an exact zero.
ROTATION_UNOBSERVABLE_VARIANCE = 1.0e15
# Seed 000: share of max_rotation_deg from which a rotation counts as having run into its bound.
ROTATION_AT_EDGE_FRACTION = 0.95


class TechniqueOptions(Options):
    """Keys that every technique's block has."""

    enabled: bool = Field(True, description="run this technique")
    rotation_at_edge_fraction: float = Field(
        ROTATION_AT_EDGE_FRACTION, gt=0, le=1, description="share of max_rotation_deg that counts as its edge"
    )
    margin_at_edge_fraction: float = Field(
        0.99, gt=0, le=1, description="share of the search margin that counts as its edge"
    )


@dataclass(frozen=True, eq=False)
class NavContext(Record):
    """Image-side facts that a technique reads from here and never from the observation (seed 000).

    Attributes
    ----------
    camera_model
        Camera.
    camera_from_j2000
        (3, 3) a-priori attitude that all predictions use.
    fit_camera_rotation, max_rotation_deg
        Whether theta is a parameter, and its bound.
    search_margin_vu
        Largest offset along v and u, pixels.
    """

    camera_model: CameraModel
    camera_from_j2000: FloatArray
    fit_camera_rotation: bool
    max_rotation_deg: float
    search_margin_vu: tuple[float, float]

    def __post_init__(self) -> None:
        self._freeze(camera_from_j2000=(3, 3))

    @staticmethod
    def of(state: State) -> "NavContext":
        """Context of an image."""
        settings = state.settings
        return NavContext(
            state.camera_model, state.attitude.camera_from_j2000, settings.fit_camera_rotation,
            settings.max_rotation_deg, settings.search_margin_vu,
        )  # fmt: skip

    @property
    def max_rotation_rad(self) -> float:
        """Bound on theta, zero where no rotation is fitted."""
        return float(np.radians(self.max_rotation_deg)) if self.fit_camera_rotation else 0.0


@dataclass(frozen=True, eq=False)
class FeatureTable(Record):
    """What became of each predicted feature; one row each.

    Attributes
    ----------
    name, kind
        (n,) identity.
    predicted_vu
        (n, 2) under the a-priori attitude.
    measured_vu
        (n, 2), NaN where not found.
    residual_vu
        (n, 2) measured minus predicted under the fitted pointing, NaN where not found.
    sigma_px
        (n,) 1 sigma of the measurement per axis, NaN where not found.
    mag, snr
        (n,) NaN where they mean nothing.
    used
        (n,) True where the feature took part in the fit.
    reason
        (n,) why not, empty where used.
    """

    name: NDArray[np.str_]
    kind: NDArray[np.str_]
    predicted_vu: FloatArray
    measured_vu: FloatArray
    residual_vu: FloatArray
    sigma_px: FloatArray
    mag: FloatArray
    snr: FloatArray
    used: BoolArray
    reason: NDArray[np.str_]

    def __post_init__(self) -> None:
        n = len(self.name)
        pairs = {"predicted_vu", "measured_vu", "residual_vu"}
        self._freeze(**{key: (n, 2) if key in pairs else (n,) for key in self.__dataclass_fields__})

    def __len__(self) -> int:
        return len(self.name)


@dataclass(frozen=True, eq=False)
class TechniqueResult(Record):
    """One technique's answer, about its own pivot.

    Attributes
    ----------
    technique
        Name, as in the configuration.
    offset_vu
        (2,) offset d about ``pivot_vu``.
    rotation_rad
        Theta; zero where it is not fitted or not observable.
    information
        (2, 2) or (3, 3) inverse covariance of (dv, du[, theta]); exact zeros where nothing is known.
    pivot_vu
        (2,) pixels.
    confidence
        Probability, in the technique's own model, that the answer is not a mistake.
    measurements
        Stars in the fit; 1 for techniques whose numbers of vertices or pixels say nothing of their worth.
    at_edge, at_edge_rotation
        The search ran into its bound: any of them, and the rotation's.
    spurious
        The technique itself no longer believes the answer.
    error_sources
        Names of what the answer's errors come from; two results that share one are not independent.
    features
        Inventory.
    diagnostics
        Figures for the record.
    """

    technique: str
    offset_vu: FloatArray
    rotation_rad: float
    information: FloatArray
    pivot_vu: FloatArray
    confidence: float
    measurements: int = 1
    at_edge: bool = False
    at_edge_rotation: bool = False
    spurious: bool = False
    error_sources: tuple[str, ...] = ()
    features: FeatureTable | None = None
    diagnostics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = len(self.information)
        if size not in (2, 3):
            raise ContractError(f"information of shape {np.shape(self.information)}")
        self._freeze(offset_vu=(2,), information=(size, size), pivot_vu=(2,))

    @property
    def degrees_of_freedom(self) -> int:
        """2 or 3."""
        return len(self.information)

    @property
    def covariance(self) -> FloatArray:
        """Covariance in the seed's form, with the sentinel variance where nothing is known."""
        return covariance_of(self.information)


@dataclass(frozen=True, eq=False)
class Prior(Record):
    """What a refiner starts from: the first ensemble's answer at the array centre.

    Attributes
    ----------
    offset_vu, rotation_rad
        Pointing.
    covariance
        (2, 2) or (3, 3), px^2 and rad^2.
    confidence
        A refiner cannot be surer of the identification than its seed.
    """

    offset_vu: FloatArray
    rotation_rad: float
    covariance: FloatArray
    confidence: float

    def __post_init__(self) -> None:
        self._freeze(offset_vu=(2,), covariance=(len(self.covariance), len(self.covariance)))


@dataclass(frozen=True)
class TechniqueFailure:
    """A technique that ran and has no answer."""

    technique: str
    reason: StatusReason
    detail: str


def embed_rotation_unobservable(covariance: FloatArray) -> FloatArray:
    """Promote a translation covariance to three parameters with an unobservable rotation (seed 000).

    Parameters
    ----------
    covariance
        (2, 2) px^2.

    Returns
    -------
    numpy.ndarray
        (3, 3) with :data:`ROTATION_UNOBSERVABLE_VARIANCE` on the rotation's diagonal.
    """
    result = np.zeros((3, 3))
    result[:2, :2] = covariance
    result[2, 2] = ROTATION_UNOBSERVABLE_VARIANCE
    return result


def information_of(covariance: FloatArray) -> FloatArray:
    """Information matrix of a covariance, its sentinel turned into exact zeros.

    Parameters
    ----------
    covariance
        (2, 2) or (3, 3); a parameter whose variance is at the sentinel must be uncorrelated with the others.

    Returns
    -------
    numpy.ndarray
        Same shape.

    Raises
    ------
    ContractError
        If the covariance of the observable parameters is not positive definite.
    """
    known = np.diag(covariance) < ROTATION_UNOBSERVABLE_VARIANCE / 10
    block = covariance[np.ix_(known, known)]
    if not np.isfinite(covariance).all() or (np.linalg.eigvalsh(block) <= 0).any():
        raise ContractError(f"covariance is not positive definite: {covariance.tolist()}")
    result = np.zeros_like(covariance)
    result[np.ix_(known, known)] = np.linalg.inv(block)
    return result


def covariance_of(information: FloatArray) -> FloatArray:
    """Covariance of an information matrix, with the sentinel along its null directions.

    Parameters
    ----------
    information
        (2, 2) or (3, 3), possibly singular.

    Returns
    -------
    numpy.ndarray
        Same shape. Only for people and for the seed's interface: never fuse with it.
    """
    scale = np.sqrt(np.where(np.diag(information) > 0, np.diag(information), 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    known = values > 1e-12
    variance = np.where(known, 1.0 / np.where(known, values, 1.0), ROTATION_UNOBSERVABLE_VARIANCE)
    directions = vectors / scale[:, None]
    # A null direction keeps its sense in the parameters' own units; only its length is arbitrary.
    directions[:, ~known] /= np.linalg.norm(directions[:, ~known], axis=0)
    return np.asarray((directions * variance) @ directions.T)


def edge_flags(
    offset_vu: FloatArray, rotation_rad: float, context: NavContext, options: TechniqueOptions
) -> tuple[bool, bool]:
    """Whether an answer has run into the search's bounds.

    Parameters
    ----------
    offset_vu
        (2,) offset **at the array centre**, where the margin is defined.
    rotation_rad
        Theta.
    context
        Bounds.
    options
        Fractions of them that count as the edge.

    Returns
    -------
    tuple
        Any bound reached; the rotation's reached.
    """
    margin = np.asarray(context.search_margin_vu) * options.margin_at_edge_fraction
    limit = context.max_rotation_rad * options.rotation_at_edge_fraction
    turned = context.fit_camera_rotation and abs(rotation_rad) >= limit
    return bool((np.abs(offset_vu) >= margin).any() or turned), bool(turned)
