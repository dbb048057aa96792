"""From raw pixels and a State to a Frame: masks, background, noise, and the image classifier."""

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from pydantic import Field

from pipeline.errors import ImageError
from pipeline.imaging.background import Background, BackgroundOptions, estimate_background, estimate_gain
from pipeline.imaging.masks import missing_pixels, saturated_pixels, spikes
from pipeline.imaging.noise import PixelNoise, pixel_noise
from pipeline.imaging.psf import PointSpread
from pipeline.options import Options
from pipeline.records import BoolArray, CameraModel, Detector, FloatArray, Image, State
from pipeline.status import StatusReason

_EIGHT_BIT_MAX = 255
# So many pixels at exactly 2^n - 1 are a converter's end and no chance.
_FULL_PIXELS = 4
# Noise alone makes one such pixel in a thousand million.
_SPIKE_SIGMA = 8.0
# An ideal quantiser adds a twelfth of its step squared to the variance.
_QUANTISATION_SIGMA = 1.0 / np.sqrt(12.0)


class FrameOptions(Options):
    """Limits of the image classifier and the noise model's defaults."""

    background: BackgroundOptions = BackgroundOptions()
    max_missing_share: float = Field(
        0.6, gt=0, le=1, description="share of missing pixels beyond which a frame is left"
    )
    max_saturated_share: float = Field(0.5, gt=0, le=1, description="share of full pixels beyond which a frame is left")
    noisy_factor: float = Field(4.0, gt=1, description="noise over the expected noise that marks a frame as noisy")
    gradient_sigma: float = Field(
        10.0, gt=0, description="range of the background over the noise that marks a gradient"
    )
    default_psf_sigma_px: float = Field(0.8, gt=0.2, le=10, description="PSF core where neither camera nor label says")
    default_psf_misfit: float = Field(
        0.15, gt=0, le=1, description="share of a star's light off the Gaussian, where the camera does not say"
    )
    max_trail_px: float = Field(30.0, ge=0, le=200, description="longest smear that is modelled, pixels")


class ImageClass(StrEnum):
    """What kind of image this is, before anything is looked for in it."""

    NORMAL = "normal"
    NOISY = "noisy"
    GRADIENT = "gradient"


@dataclass(frozen=True, eq=False)
class Frame:
    """An image ready for measurement.

    Attributes
    ----------
    pixels
        (rows, cols) float32 DN, background subtracted; zero where bad.
    sigma
        (rows, cols) background noise, DN.
    raw
        (rows, cols) float32 DN as read, for light that fills a background's tiles; zero where not finite.
    noise
        Noise of a raw pixel by its level.
    bad
        (rows, cols) True where no measurement exists (missing, flagged or saturated).
    saturated
        (rows, cols) True where the response ended.
    gain_e_per_dn
        From the camera or estimated; None when unknown.
    spread
        Shape of a point source, with the smear that the attitude's rate predicts.
    image_class
        Kind of image.
    background_dn, noise_dn, missing_share, saturated_share
        Figures for the record.
    """

    pixels: Image
    sigma: Image
    raw: Image
    noise: PixelNoise
    bad: BoolArray
    saturated: BoolArray
    gain_e_per_dn: float | None
    spread: PointSpread
    image_class: ImageClass
    background_dn: float
    noise_dn: float
    missing_share: float
    saturated_share: float


def make_frame(pixels: Image, flagged: BoolArray | None, state: State, options: FrameOptions) -> Frame:
    """Mask, level and classify one image.

    Parameters
    ----------
    pixels
        (rows, cols) DN as read, any real type.
    flagged
        (rows, cols) True where the product itself marks a pixel as bad, or None.
    state
        Camera, detector and attitude.
    options
        Limits.

    Returns
    -------
    Frame
        Ready for measurement.

    Raises
    ------
    ImageError
        If the array does not fit the camera, or is blank, full, mostly missing or not finite.
    """
    _check_shape(pixels, state.camera_model)
    integral = pixels.dtype.kind in "iub"
    image = np.ascontiguousarray(pixels, dtype=np.float32)
    detector = state.detector
    image, not_finite = _finite(image)
    saturated = saturated_pixels(image, _saturation(detector, pixels), detector.read_noise_dn)
    floor = float(np.hypot(detector.read_noise_dn or 0.0, _QUANTISATION_SIGMA if integral else 0.0))
    level, noise = _rough_level(image, saturated if not_finite is None else saturated | not_finite)
    missing = missing_pixels(image, detector.missing_value, level, max(noise, floor))
    if not_finite is not None:
        missing |= not_finite
    _refuse_hopeless(image, missing, saturated, options)
    unusable = missing if flagged is None else missing | flagged
    bad = unusable | saturated
    background, gain = _level(image, bad, detector, floor, options)
    raw = image
    image = image - background.level
    image[unusable & ~saturated] = 0.0
    noise = float(np.median(background.tile_sigma))
    image_class = _classify(background, replace(detector, gain_e_per_dn=gain), noise, floor, options)
    return Frame(
        pixels=image, sigma=background.sigma, raw=raw,
        noise=pixel_noise(raw, bad, _read_noise(detector, integral), detector.gain_e_per_dn, detector.bias_dn),
        bad=bad, saturated=saturated, gain_e_per_dn=gain,
        spread=point_spread(state, options), image_class=image_class,
        background_dn=float(np.median(background.tile_level)), noise_dn=noise,
        missing_share=_share(missing), saturated_share=_share(saturated),
    )  # fmt: skip


def without_light_of(covered: BoolArray, frame: Frame, state: State, options: FrameOptions) -> Frame:
    """The same frame with extended bodies taken out, so that point sources beside them can be looked for.

    Parameters
    ----------
    covered
        (rows, cols) True where a body is.
    frame
        Of :func:`make_frame`.
    state
        Its geometry.
    options
        Limits.

    Returns
    -------
    Frame
        Level, noise and bad pixels renewed; the frame itself where nothing is covered.
    """
    if not covered.any():
        return frame
    # A limb's blur, and the wings of a bright one, reach beyond the body itself.
    reach = 2 * int(np.ceil(4.0 * frame.spread.sigma_px) + 3) + 1
    near = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
    bad = frame.bad | near
    if bad.all():
        return frame
    detector = state.detector
    floor = _read_noise(detector, False) or 0.0
    background, _ = _level(frame.raw, bad, replace(detector, gain_e_per_dn=frame.gain_e_per_dn), floor, options)
    pixels = frame.raw - background.level
    pixels[bad & ~frame.saturated] = 0.0
    saturated = frame.saturated & ~near
    return replace(frame, pixels=pixels, sigma=background.sigma, bad=bad, saturated=saturated)


def without_spikes(frame: Frame) -> Frame:
    """The same frame with single struck pixels bad, which for bodies are nothing but disturbance.

    Parameters
    ----------
    frame
        Of :func:`make_frame`.

    Returns
    -------
    Frame
        For techniques on bodies; stars would lose their cores.
    """
    sigma = np.sqrt(frame.noise.variance(frame.raw)).astype(np.float32)
    struck = spikes(frame.raw, frame.bad, sigma, _SPIKE_SIGMA)
    return replace(frame, bad=frame.bad | struck) if struck.any() else frame


def _read_noise(detector: Detector, integral: bool) -> float | None:
    """Declared noise without light, with the rounding to whole numbers; None where nobody declares it."""
    if detector.read_noise_dn is None:
        return None
    return float(np.hypot(detector.read_noise_dn, _QUANTISATION_SIGMA if integral else 0.0))


def _share(flags: BoolArray) -> float:
    return int(np.count_nonzero(flags)) / flags.size


def _check_shape(pixels: Image, camera: CameraModel) -> None:
    if pixels.ndim != 2 or pixels.shape != tuple(camera.shape_vu):
        got = "x".join(map(str, pixels.shape))
        want = "x".join(map(str, camera.shape_vu))
        raise ImageError(StatusReason.IMAGE_SHAPE_MISMATCH, f"the image is {got}, the camera's array {want}")


def _saturation(detector: Detector, pixels: Image) -> float | None:
    """Declared saturation, else the end of an integer range at which several pixels stand."""
    if detector.saturation_dn is not None or pixels.dtype.kind not in "iu":
        return detector.saturation_dn
    if pixels.dtype.itemsize == 1:
        return float(_EIGHT_BIT_MAX)
    top = int(pixels.max())
    full = top >= _EIGHT_BIT_MAX and (top & (top + 1)) == 0
    return float(top) if full and np.count_nonzero(pixels == top) >= _FULL_PIXELS else None


def _finite(image: Image) -> tuple[Image, BoolArray | None]:
    """Image with zeros for what is not a number, and where that was; None (and no copy) where all of it is."""
    # A sum is finite if all its terms are: one pass instead of a mask, for nearly every image.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(image.sum(dtype=np.float64)):
            return image, None
    not_finite = ~np.isfinite(image)
    if not_finite.all():
        raise ImageError(StatusReason.IMAGE_NOT_FINITE, "no pixel is a finite number")
    return np.where(not_finite, np.float32(0.0), image), not_finite


def _rough_level(image: Image, unusable: BoolArray) -> tuple[float, float]:
    """Median and half the central 68 % of a sample, without regard to where in the image."""
    # A step that shares no factor with usual row lengths samples all columns.
    step = max(1, image.size // 20000) | 1
    sample = image.ravel()[::step][~unusable.ravel()[::step]]
    if not sample.size:
        return 0.0, 0.0
    low, middle, high = np.quantile(sample, (0.158655, 0.5, 0.841345))
    return float(middle), float(high - low) / 2


def _refuse_hopeless(image: Image, missing: BoolArray, saturated: BoolArray, options: FrameOptions) -> None:
    missing_share, full_share = _share(missing), _share(saturated)
    if full_share > options.max_saturated_share:
        raise ImageError(StatusReason.IMAGE_OVEREXPOSED, f"{full_share:.0%} of the pixels are saturated")
    received = image[~missing] if 0.0 < missing_share < 1.0 else image
    if received.min() == received.max():
        raise ImageError(StatusReason.IMAGE_BLANK, f"every pixel is {received.flat[0]:g} DN")
    if missing_share > options.max_missing_share:
        raise ImageError(StatusReason.IMAGE_MOSTLY_MISSING, f"{missing_share:.0%} of the pixels are missing")


def _level(
    image: Image, bad: BoolArray, detector: Detector, floor: float, options: FrameOptions
) -> tuple[Background, float | None]:
    """Background with the camera's gain, or with the one that the image itself shows."""
    biased = image if detector.bias_dn == 0.0 else image - np.float32(detector.bias_dn)
    background = estimate_background(biased, bad, floor, detector.gain_e_per_dn, options.background)
    gain = detector.gain_e_per_dn
    if gain is None and detector.read_noise_dn is not None:
        gain = estimate_gain(background, detector.read_noise_dn)
    if detector.bias_dn:
        bias = np.float32(detector.bias_dn)
        background = replace(background, level=background.level + bias, tile_level=background.tile_level + bias)
    return background, gain


def _classify(
    background: Background, detector: Detector, noise: float, floor: float, options: FrameOptions
) -> ImageClass:
    expected = floor
    if detector.gain_e_per_dn:
        above_bias = float(np.median(background.tile_level)) - detector.bias_dn
        expected = float(np.hypot(floor, np.sqrt(max(above_bias, 0.0) / detector.gain_e_per_dn)))
    if expected > 0 and noise > options.noisy_factor * expected:
        return ImageClass.NOISY
    if np.ptp(background.tile_level) > options.gradient_sigma * max(noise, 1e-6):
        return ImageClass.GRADIENT
    return ImageClass.NORMAL


def point_spread(state: State, options: FrameOptions) -> PointSpread:
    """Point source of this camera during this exposure.

    Parameters
    ----------
    state
        Detector's PSF and the attitude's rate.
    options
        Default PSF and longest trail.

    Returns
    -------
    PointSpread
        With the trail that a star leaves at the array centre.
    """
    sigma = state.detector.psf_sigma_px or options.default_psf_sigma_px
    trail = smear_trail(state)
    length = float(np.hypot(*trail))
    if length > options.max_trail_px:
        trail = trail * (options.max_trail_px / length)
    # A hundredth of the core's width cannot be told from none, and none is faster.
    if length < 0.1 * sigma:
        trail = np.zeros(2)
    return PointSpread(
        sigma, (float(trail[0]), float(trail[1])), state.detector.psf_misfit or options.default_psf_misfit
    )


def smear_trail(state: State) -> FloatArray:
    """Vector along which a star moves over the array during the exposure.

    A camera that turns at rate w (its own axes) sees a fixed direction s move as -w x s.

    Parameters
    ----------
    state
        Rate and exposure; unknown ones count as zero.

    Returns
    -------
    numpy.ndarray
        (2,) pixels along (v, u), at the boresight.
    """
    rate = state.attitude.rate_rad_s
    if rate is None or not state.exposure_s:
        return np.zeros(2)
    camera = state.camera_model
    motion_xy = -np.cross(rate, [0.0, 0.0, 1.0])[:2] * state.exposure_s
    uv = camera.k_px_per_mm @ (camera.focal_length_mm * motion_xy)
    return np.asarray(uv[::-1])
