"""Reading of image files: every kind of pixel, every kind of damage."""

import io

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from catalogs.images import read_image
from pipeline.errors import ImageError
from pipeline.status import StatusReason

PIXELS = np.arange(64 * 80).reshape(64, 80)


def written(*hdus: fits.PrimaryHDU) -> bytes:
    out = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(out)
    return out.getvalue()


def reason_of(data: bytes) -> StatusReason:
    with pytest.raises(ImageError) as failure:
        read_image(data, "x.fits")
    assert "\n" not in failure.value.detail
    assert failure.value.detail.startswith("x.fits")
    return failure.value.reason


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "u4", "i8", "f4", "f8"])
def test_pixel_types_come_back_in_native_order(dtype: str) -> None:
    pixels = (PIXELS % 251).astype(dtype)
    raw = read_image(written(fits.PrimaryHDU(pixels)), "x.fits")
    assert raw.pixels.dtype == np.dtype("f4" if dtype == "f8" else dtype)
    assert raw.pixels.dtype.isnative
    assert np.array_equal(raw.pixels, pixels)


def test_scaled_pixels_are_real_values() -> None:
    hdu = fits.PrimaryHDU((PIXELS % 100).astype("f4") * 0.5 - 7.0)
    hdu.scale("int16", bscale=0.5, bzero=-7.0)
    assert np.array_equal(read_image(written(hdu), "x.fits").pixels, (PIXELS % 100) * 0.5 - 7.0)


@pytest.mark.parametrize(
    ("shape", "seen"), [((1, 64, 80), (64, 80)), ((3, 64, 80), (3, 64, 80)), ((1, 1, 64, 80), (64, 80))]
)
def test_axes_of_length_one_are_dropped(shape: tuple[int, ...], seen: tuple[int, ...]) -> None:
    assert read_image(written(fits.PrimaryHDU(np.zeros(shape))), "x.fits").pixels.shape == seen


def test_image_may_stand_in_an_extension() -> None:
    data = written(fits.PrimaryHDU(), fits.ImageHDU(PIXELS), fits.ImageHDU(PIXELS + 1, name="quality flag"))
    raw = read_image(data, "x.fits")
    assert np.array_equal(raw.pixels, PIXELS)
    assert np.array_equal(raw.extensions["QUALITY FLAG"](), PIXELS + 1)


@pytest.mark.parametrize("kind", ["RICE_1", "GZIP_1"])
def test_compressed_images_are_read(kind: str) -> None:
    data = written(fits.PrimaryHDU(), fits.CompImageHDU(PIXELS.astype("i2"), compression_type=kind))
    assert np.array_equal(read_image(data, "x.fits").pixels, PIXELS)
    assert reason_of(data[: len(data) - 2880]) is StatusReason.IMAGE_TRUNCATED


def test_missing_padding_is_no_damage() -> None:
    data = written(fits.PrimaryHDU(PIXELS.astype("i2")))
    assert np.array_equal(read_image(data[: 2880 + 64 * 80 * 2], "x.fits").pixels, PIXELS)
    assert reason_of(data[: 2880 + 64 * 80 * 2 - 1]) is StatusReason.IMAGE_TRUNCATED


def test_truncation_anywhere_is_called_so() -> None:
    data = written(fits.PrimaryHDU(PIXELS.astype("i2")), fits.ImageHDU(PIXELS.astype("i2"), name="quality"))
    assert len(data) == 2 * (2880 + 11520)
    for length in (30, 1000, 2879, 2880, 5000, 14400 + 30, 14400 + 1000, 14400 + 2880, 14400 + 5000):
        assert reason_of(data[:length]) is StatusReason.IMAGE_TRUNCATED, length


def test_other_files() -> None:
    assert reason_of(b"") is StatusReason.IMAGE_EMPTY
    assert reason_of(b"a text\nthat is no image\n") is StatusReason.IMAGE_FORMAT_UNKNOWN
    assert reason_of(b"[/b] brackets") is StatusReason.IMAGE_FORMAT_UNKNOWN
    assert reason_of(written(fits.PrimaryHDU())) in (StatusReason.IMAGE_UNREADABLE, StatusReason.IMAGE_TRUNCATED)
    assert reason_of(b"SIMPLE  = and then something else" * 300) in set(StatusReason)


def _with_card(data: bytes, key: str, value: str) -> bytes:
    start = data.index(f"{key:8}=".encode())
    return data[:start] + f"{key:8}= {value:>20}".ljust(80).encode() + data[start + 80 :]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("BITPIX", "17"), ("BITPIX", "'x'"), ("NAXIS", "2.5"), ("NAXIS", "1000"), ("NAXIS1", "-5"), ("NAXIS1", "'x'"),
        ("NAXIS1", "0"), ("NAXIS1", "99999999999"), ("NAXIS1", "9" * 19), ("NAXIS2", "T"), ("NAXIS2", "@#!"),
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused(key: str, value: str) -> None:
    data = _with_card(written(fits.PrimaryHDU(PIXELS.astype("i2"))), key, value)
    try:
        raw = read_image(data, "x.fits")
    except ImageError as failure:
        assert "\n" not in failure.detail  # noqa: PT017 - either outcome is right, another error is not
    else:
        assert raw.pixels.shape != (64, 80)


@pytest.mark.parametrize("value", ["'x'", "@#!", "T"])
@pytest.mark.parametrize("key", ["BSCALE", "BZERO"])
def test_absurd_scales_are_no_bug(key: str, value: str) -> None:
    hdu = fits.ImageHDU(PIXELS.astype("i2"), name="quality")
    hdu.header[key] = 2.0
    data = _with_card(written(fits.PrimaryHDU(PIXELS.astype("i2")), hdu), key, value)
    try:
        read_image(data, "x.fits").extensions["QUALITY"]()
    except ImageError as failure:
        assert failure.reason is StatusReason.IMAGE_UNREADABLE  # noqa: PT017


def test_cards_that_cannot_be_parsed_count_as_missing() -> None:
    hdu = fits.PrimaryHDU(PIXELS.astype("i2"))
    hdu.header["SPCQA"], hdu.header["EMPTY"], hdu.header["GOOD"] = 1.0, None, 4
    data = _with_card(written(hdu), "SPCQA", "0.1 0.2 ] garbage")
    header = read_image(data, "x.fits").header
    assert header.get("SPCQA") is None
    assert header.get("EMPTY") is None
    assert header.get("NEVER") is None
    assert header["GOOD"] == 4
    assert "GOOD" in set(header)
    assert len(header) > 5


def test_random_damage_never_raises_anything_else() -> None:
    rng = np.random.default_rng(3)
    quality = fits.CompImageHDU((PIXELS % 7).astype("i2"), name="quality")
    whole: NDArray[np.uint8] = np.frombuffer(written(fits.PrimaryHDU(PIXELS.astype("i2")), quality), np.uint8)
    for _ in range(150):
        spoiled = whole.copy()
        # Mostly headers: damaged pixels are pixels.
        where = rng.integers(10, 2880, 6) if rng.random() < 0.5 else rng.integers(10, len(whole), 40)
        spoiled[where] = rng.integers(0, 256, len(where))
        try:
            raw = read_image(spoiled.tobytes(), "x.fits")
            raw.header.get("BITPIX")
            for read in raw.extensions.values():
                read()
        except ImageError as failure:
            assert "\n" not in failure.detail  # noqa: PT017
