"""Predicted stars: apparent place, pixel, expected brightness, and how sure all of that is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.camera import field_of_view, pixel_scale_rad, project
from pipeline.frame import Frame
from pipeline.geometry.astrometry import RAD_PER_MAS, apparent_directions, julian_year
from pipeline.options import Options
from pipeline.records import BoolArray, CameraModel, FloatArray, Record, StarTable, State

# Rounding at the corners of the field must not cost a star.
_FIELD_SLACK_RAD = 1e-6


class StarPredictionOptions(Options):
    """Which catalogue stars are worth looking for."""

    min_snr: float = Field(3.0, gt=0, description="expected signal to noise below which a star is not predicted")
    max_stars: int = Field(150, ge=1, le=2000, description="brightest stars kept")
    unknown_motion_masyr: float = Field(
        20.0,
        ge=0,
        description="1-sigma proper motion per axis of a star whose catalogue gives none, mas/yr: what the Hipparcos "
        "stars fainter than G = 9 show (robust sigma)",
    )
    place_sigma_mas: float = Field(2.0, ge=0, description="floor of a catalogue place's 1-sigma per axis, mas")
    centroid_floor_px: float = Field(
        0.003, ge=0, le=1, description="1-sigma per axis of a centroid because no PSF is a Gaussian, pixels"
    )


@dataclass(frozen=True, eq=False)
class PredictedStars(Record):
    """Stars expected in or near the frame, brightest first.

    Attributes
    ----------
    star_id
        (n,) text.
    mag
        (n,) catalogue magnitude.
    direction
        (n, 3) unit vectors in J2000 as the spacecraft sees them.
    position_vu
        (n, 2) predicted pixels under the a-priori attitude.
    place_sigma_px
        (n,) 1 sigma per axis of the prediction: catalogue place at the image's epoch, and what the camera model
        leaves out.
    flux_dn
        (n,) expected flux, NaN where the camera's zero point is unknown.
    snr
        (n,) expected signal to noise, NaN where unknown.
    """

    star_id: NDArray[np.str_]
    mag: FloatArray
    direction: FloatArray
    position_vu: FloatArray
    place_sigma_px: FloatArray
    flux_dn: FloatArray
    snr: FloatArray

    def __post_init__(self) -> None:
        n = len(self.star_id)
        self._freeze(
            star_id=(n,), mag=(n,), direction=(n, 3), position_vu=(n, 2), place_sigma_px=(n,), flux_dn=(n,), snr=(n,)
        )

    def __len__(self) -> int:
        return len(self.star_id)

    def take(self, index: NDArray[np.generic]) -> "PredictedStars":
        """Rows of an index or mask."""
        return PredictedStars(*(column[index] for column in self.columns().values()))


def predict_stars(stars: StarTable, state: State, frame: Frame, options: StarPredictionOptions) -> PredictedStars:
    """Place catalogue stars on the array, widened by the search margin.

    Parameters
    ----------
    stars
        Catalogue rows around the field.
    state
        Attitude, camera, detector, spacecraft.
    frame
        Noise and PSF of the image.
    options
        Cuts.

    Returns
    -------
    PredictedStars
        Brightest first; those outside the widened array or too faint are left out.
    """
    if not len(stars):
        return PredictedStars(stars.star_id, *(np.zeros(s) for s in (0, (0, 3), (0, 2), 0, 0, 0)))
    directions = apparent_directions(stars, state.et, state.spacecraft)
    position, ahead = project(state.camera_model, directions @ state.attitude.camera_from_j2000.T)
    flux = expected_flux(stars.mag, state)
    snr = flux / flux_sigma(flux, frame)
    keep = ahead & near_array(position, state.camera_model, reach_px(state)) & ~(snr < options.min_snr)
    # Far outside its field a distortion may fold back onto the array what no camera sees.
    axis, half_angle = field_of_view(state.camera_model, reach_px(state))
    keep &= directions @ (state.attitude.camera_from_j2000.T @ axis) >= np.cos(half_angle + _FIELD_SLACK_RAD)
    order = np.flatnonzero(keep)
    order = order[np.lexsort((stars.star_id[order], stars.mag[order]))][: options.max_stars]
    scale = np.sqrt(np.prod(pixel_scale_rad(state.camera_model)))
    unmodelled = np.hypot(state.detector.model_residual_px, options.centroid_floor_px)
    sigma = np.hypot(place_sigma_rad(stars.take(order), state.et, options) / scale, unmodelled)
    return PredictedStars(
        stars.star_id[order], stars.mag[order], directions[order], position[order], sigma, flux[order],
        snr[order],
    )  # fmt: skip


def expected_flux(mag: FloatArray, state: State) -> FloatArray:
    """Flux in DN of stars of a magnitude.

    Parameters
    ----------
    mag
        (n,) magnitudes.
    state
        Zero point and exposure.

    Returns
    -------
    numpy.ndarray
        (n,) DN, NaN where zero point or exposure is unknown.
    """
    zero = state.detector.star_dn_per_s_mag0
    if zero is None or not state.exposure_s:
        return np.full(len(mag), np.nan)
    return np.asarray(zero * state.exposure_s * 10.0 ** (-0.4 * mag))


def flux_sigma(flux_dn: FloatArray, frame: Frame) -> FloatArray:
    """1-sigma of an optimally measured flux: background over the PSF's effective area, and shot noise.

    Parameters
    ----------
    flux_dn
        (n,) DN.
    frame
        Noise, gain and PSF.

    Returns
    -------
    numpy.ndarray
        (n,) DN.
    """
    width = np.sqrt(frame.spread.sigma_px**2 + 1.0 / 12.0)
    effective_px = 4 * np.pi * width**2 + 2 * np.sqrt(np.pi) * width * frame.spread.trail_px
    shot = np.nan_to_num(flux_dn) / frame.gain_e_per_dn if frame.gain_e_per_dn else 0.0
    return np.asarray(np.sqrt(frame.noise_dn**2 * effective_px + shot))


def place_sigma_rad(stars: StarTable, et: float, options: StarPredictionOptions) -> FloatArray:
    """1-sigma per axis of where a catalogue puts its stars at an epoch.

    Parameters
    ----------
    stars
        Catalogue rows.
    et
        TDB seconds past J2000.
    options
        Floor, and the motion assumed where none is known.

    Returns
    -------
    numpy.ndarray
        (n,) radians; stars seen at their apparent place only have the floor.
    """
    unknown = np.isnan(stars.pm_ra_masyr) & ~stars.apparent
    drift = np.where(unknown, options.unknown_motion_masyr * np.nan_to_num(np.abs(julian_year(et) - stars.epoch)), 0.0)
    return np.asarray(np.hypot(drift, options.place_sigma_mas) * RAD_PER_MAS)


def reach_px(state: State) -> tuple[float, float]:
    """How far from its predicted pixel any star of the array may really be, along v and u.

    Parameters
    ----------
    state
        Search margin, and the largest rotation where one is fitted.

    Returns
    -------
    tuple
        Pixels along v and u.
    """
    settings = state.settings
    turn = np.radians(settings.max_rotation_deg) if settings.fit_camera_rotation else 0.0
    half_v, half_u = state.camera_model.centre_vu
    return settings.search_margin_vu[0] + turn * half_u, settings.search_margin_vu[1] + turn * half_v


def near_array(position_vu: FloatArray, camera: CameraModel, margin_vu: tuple[float, float]) -> BoolArray:
    """True inside the array widened by a margin.

    Parameters
    ----------
    position_vu
        (n, 2) pixels, NaN allowed.
    camera
        The array.
    margin_vu
        Widening, pixels.

    Returns
    -------
    numpy.ndarray
        (n,) flags.
    """
    low = np.array([-0.5, -0.5]) - margin_vu
    high = np.array(camera.shape_vu) - 0.5 + margin_vu
    with np.errstate(invalid="ignore"):
        return np.asarray(((position_vu >= low) & (position_vu <= high)).all(axis=1))
