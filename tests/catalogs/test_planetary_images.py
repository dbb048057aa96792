"""VICAR, PDS3, PDS4 and ISIS images: pixels against numpy's and GDAL's own, and every kind of damage."""

import logging
import warnings

import numpy as np
import pytest
import rasterio
from rasterio.io import MemoryFile

from catalogs.images import labelled_file, read_image
from pipeline.errors import ImageError
from pipeline.status import StatusReason
from tests.catalogs.planetary import RECORD, Array, attached, pds3_label, pds4_label, prefixed, vicar
from tests.scenes.data import DATA, needs_data

SHAPE = (40, 50)
VALUES = np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE)


def pixels_of(dtype: str) -> Array:
    """Values that a wrong sign, order or length would change."""
    kind = np.dtype(dtype)
    if kind.kind == "f":
        return np.asarray((VALUES * 0.37 - 50.0).astype(dtype))
    span = 2 ** (8 * kind.itemsize) - 3
    lowest = 0 if kind.kind == "u" else -(span // 2)
    return np.asarray(((VALUES * (span // int(VALUES.max()) or 1)) % span + lowest).astype(dtype))


def reason_of(data: bytes, name: str = "x.img", companions: dict[str, bytes] | None = None) -> StatusReason:
    with pytest.raises(ImageError) as failure:
        read_image(data, name, companions)
    assert "\n" not in failure.value.detail
    return failure.value.reason


PDS3_TYPES = [
    ("UNSIGNED_INTEGER", "u1"), ("SUN_INTEGER", "u1"), ("MSB_INTEGER", ">i2"), ("MSB_UNSIGNED_INTEGER", ">u2"),
    ("LSB_INTEGER", "<i2"), ("LSB_UNSIGNED_INTEGER", "<u2"), ("SUN_INTEGER", ">i2"), ("PC_UNSIGNED_INTEGER", "<u2"),
    ("VAX_INTEGER", "<i2"), ("MSB_INTEGER", ">i4"), ("LSB_UNSIGNED_INTEGER", "<u4"), ("IEEE_REAL", ">f4"),
    ("PC_REAL", "<f4"), ("IEEE_REAL", ">f8"),
]  # fmt: skip


@pytest.mark.parametrize(("sample", "dtype"), PDS3_TYPES)
@pytest.mark.parametrize(("before", "after"), [(0, 0), (24, 0), (8, 16)])
def test_pds3_pixels(sample: str, dtype: str, before: int, after: int) -> None:
    pixels = pixels_of(dtype)
    data = prefixed(pixels, before, after)
    more = f"LINE_PREFIX_BYTES = {before}\r\nLINE_SUFFIX_BYTES = {after}"
    bits = pixels.dtype.itemsize * 8
    whole = attached(pds3_label("5", sample, bits, SHAPE, more=more), data)
    label = pds3_label('("A.IMG",3)', sample, bits, SHAPE, more=more)
    in_bytes = pds3_label('("A.IMG",101 <BYTES>)', sample, bits, SHAPE, more=more)
    expected = pixels.astype("f4") if dtype == ">f8" else pixels
    for raw in (
        read_image(whole, "a.img"),
        read_image(bytes(2 * RECORD) + data, "A.IMG", {"A.LBL": label}),
        read_image(label, "A.LBL", {"a.img": bytes(2 * RECORD) + data}),
        read_image(bytes(100) + data, "A.IMG", {"A.LBL": in_bytes}),
    ):
        assert raw.pixels.dtype.isnative
        assert np.array_equal(raw.pixels, expected)
        assert raw.header["IMAGE.LINES"] == SHAPE[0]


# What GDAL misreads is why numpy does it.
MISREAD = ("PC_UNSIGNED_INTEGER", "LSB_UNSIGNED_INTEGER<u4", "MSB_INTEGER>i4")


@pytest.mark.parametrize(
    ("sample", "dtype"), [(s, d) for s, d in PDS3_TYPES if s not in MISREAD and s + d not in MISREAD]
)
def test_pds3_agrees_with_gdal(sample: str, dtype: str) -> None:
    pixels = pixels_of(dtype)
    whole = attached(pds3_label("5", sample, pixels.dtype.itemsize * 8, SHAPE), prefixed(pixels))
    with warnings.catch_warnings(), MemoryFile(whole) as file:
        warnings.simplefilter("ignore")
        with file.open(driver="PDS") as dataset:
            theirs = dataset.read(1)
    assert np.array_equal(read_image(whole, "x").pixels, theirs.astype("f4") if dtype == ">f8" else theirs)


def test_pds3_with_an_sfdu_line_and_open_comments() -> None:
    label = b"CCSD3ZF0000100000001NJPL3IF0PDS200000001 = SFDU_LABEL\r\n/* this is never closed\r\n"
    label += pds3_label("5", "UNSIGNED_INTEGER", 8, SHAPE, extra="/* this is */ NOTE = 'it''s' /* x */")
    assert np.array_equal(read_image(attached(label, prefixed(pixels_of("u1"))), "x").pixels, pixels_of("u1"))


def test_missing_and_scaled_pixels() -> None:
    pixels = pixels_of(">i2")
    missing = pixels[7, 9] = -32768
    more = f"MISSING_CONSTANT = {missing}\r\nSCALING_FACTOR = 0.5\r\nOFFSET = 3"
    raw = read_image(attached(pds3_label("5", "MSB_INTEGER", 16, SHAPE, more=more), prefixed(pixels)), "x")
    assert np.isnan(raw.pixels[7, 9])
    expected = np.where(pixels == missing, np.nan, pixels.astype(float) * 0.5 + 3)
    assert np.array_equal(raw.pixels, expected.astype("f4"), equal_nan=True)
    unused = pds3_label("5", "MSB_INTEGER", 16, SHAPE, more="MISSING_CONSTANT = -32768\r\nSCALING_FACTOR = 'N/A'")
    whole = read_image(attached(unused, prefixed(pixels_of(">i2"))), "x").pixels
    assert whole.dtype == np.int16


@pytest.mark.parametrize("dtype", ["u1", ">i2", "<i2", ">i4", "<i4", ">f4", "<f4", ">f8"])
@pytest.mark.parametrize(("prefix", "records"), [(0, 0), (24, 1), (200, 6)])
def test_vicar_pixels(dtype: str, prefix: int, records: int) -> None:
    pixels = pixels_of(dtype)
    whole = vicar(pixels, "PROPERTY='A'  X=(1,2)  TASK='COPY'  USER='u'", prefix, records, eol="LATE='yes'  X=5")
    raw = read_image(whole, "x.img")
    assert np.array_equal(raw.pixels, pixels.astype("f4") if dtype == ">f8" else pixels)
    assert {key: raw.header[key] for key in ("X", "TASK", "PROPERTY", "USER", "LATE", "NL")} == {
        "X": "1,2", "TASK": "COPY", "PROPERTY": "A", "USER": "u", "LATE": "yes", "NL": 40,
    }  # fmt: skip


def test_vicar_with_a_pds3_label_beside_or_before() -> None:
    pixels = pixels_of("u1")
    inner = vicar(pixels, "SHUTTER='OPEN'  TARGET_NAME='INNER'", prefix=24, header_records=1)
    label = pds3_label('("A.IMG",2)', "UNSIGNED_INTEGER", 8, SHAPE, extra='TARGET_NAME = "SATURN"')
    raw = read_image(inner, "A.IMG", {"A.LBL": label})
    assert np.array_equal(raw.pixels, pixels)
    assert (raw.header["TARGET_NAME"], raw.header["SHUTTER"]) == ("SATURN", "OPEN")
    start = inner.index(prefixed(pixels, before=24)) + 4 * RECORD + 1
    front = pds3_label(
        f"{start} <BYTES>", "UNSIGNED_INTEGER", 8, SHAPE, extra="^IMAGE_HEADER = 5", more="LINE_PREFIX_BYTES = 24"
    )
    raw = read_image(attached(front, inner), "A.IMG")
    assert np.array_equal(raw.pixels, pixels)
    assert raw.header["SHUTTER"] == "OPEN"


PDS4_TYPES = [
    ("UnsignedByte", "u1"), ("SignedMSB2", ">i2"), ("UnsignedLSB2", "<u2"), ("SignedLSB4", "<i4"),
    ("IEEE754LSBSingle", "<f4"), ("IEEE754MSBDouble", ">f8"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "dtype"), PDS4_TYPES)
@pytest.mark.parametrize("direction", ["Top to Bottom", "Bottom to Top"])
def test_pds4_pixels_are_as_stored(kind: str, dtype: str, direction: str) -> None:
    pixels = pixels_of(dtype)
    label = pds4_label("a.img", kind, SHAPE, 64, direction)
    data = bytes(64) + pixels.tobytes()
    for raw in (read_image(data, "a.img", {"a.xml": label}), read_image(label, "a.xml", {"a.img": data})):
        assert np.array_equal(raw.pixels, pixels.astype("f4") if dtype == ">f8" else pixels)
        assert raw.header["Identification_Area.logical_identifier"] == "urn:nasa:pds:bundle:data:p1"


def test_pds4_scales() -> None:
    label = pds4_label(
        "a.img", "SignedMSB2", SHAPE, element="<scaling_factor>0.25</scaling_factor><value_offset>-2</value_offset>"
    )
    raw = read_image(pixels_of(">i2").tobytes(), "a.img", {"a.xml": label})
    assert np.array_equal(raw.pixels, (pixels_of(">i2").astype(float) * 0.25 - 2).astype("f4"))


def isis(pixels: Array, **options: object) -> bytes:
    """ISIS cube as GDAL writes one."""
    with warnings.catch_warnings(), MemoryFile(filename="x.cub") as file:
        warnings.simplefilter("ignore")
        rows, columns = pixels.shape
        with file.open(driver="ISIS3", width=columns, height=rows, count=1, dtype=pixels.dtype, **options) as dataset:
            dataset.write(pixels, 1)
        return bytes(file.read())


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "f4"])
@pytest.mark.parametrize("tiled", ["NO", "YES"])
def test_isis_pixels(dtype: str, tiled: str) -> None:
    pixels = np.tile((VALUES % 200 + 20).astype(dtype), (4, 5))
    whole = isis(pixels, tiled=tiled, blockxsize=128, blockysize=128)
    raw = read_image(whole, "x.cub")
    assert np.array_equal(raw.pixels, pixels)
    assert raw.header["IsisCube.Core.Dimensions.Samples"] == 250
    assert reason_of(whole[: len(whole) - 200 * 250 // 2]) is StatusReason.IMAGE_TRUNCATED


def test_isis_marks_are_not_a_number() -> None:
    pixels = (VALUES % 200).astype("f4")
    pixels[3, 4] = -3.4028226550889045e38
    raw = read_image(isis(pixels), "x.cub")
    assert np.isnan(raw.pixels[3, 4])
    assert np.isfinite(raw.pixels).sum() == pixels.size - 1


def good_files() -> dict[str, tuple[bytes, dict[str, bytes]]]:
    pixels = pixels_of(">i2")
    label = pds3_label('("A.IMG",1)', "MSB_INTEGER", 16, SHAPE)
    return {
        "attached": (attached(pds3_label("5", "MSB_INTEGER", 16, SHAPE), prefixed(pixels)), {}),
        "detached": (prefixed(pixels), {"A.LBL": label}),
        "vicar": (vicar(pixels, prefix=24, header_records=1), {}),
        "pds4": (pixels.tobytes(), {"A.xml": pds4_label("A.IMG", "SignedMSB2", SHAPE)}),
        # GDAL puts a history behind the pixels.
        "isis": (isis(pixels_of("i2"))[: 65536 + pixels.nbytes], {}),
    }


@pytest.mark.parametrize("kind", list(good_files()))
def test_truncation_is_called_so(kind: str) -> None:
    data, companions = good_files()[kind]
    assert read_image(data, "A.IMG", companions).pixels.shape == SHAPE
    for length in (len(data) - 1, len(data) - 100, len(data) - 3000):
        assert reason_of(data[:length], "A.IMG", companions) is StatusReason.IMAGE_TRUNCATED, length
    assert reason_of(b"", "A.IMG", companions) is StatusReason.IMAGE_EMPTY


@pytest.mark.parametrize("kind", list(good_files()))
def test_random_damage_never_raises_anything_else(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(8)
    data, companions = good_files()[kind]
    for _ in range(60):
        spoiled = {name: _spoiled(text, rng) for name, text in {"A.IMG": data, **companions}.items()}
        try:
            read_image(spoiled.pop("A.IMG"), "A.IMG", spoiled)
        except ImageError as failure:
            assert "\n" not in failure.detail  # noqa: PT017 - either outcome is right, another error is not
    assert capfd.readouterr() == ("", "")


def _spoiled(data: bytes, rng: np.random.Generator) -> bytes:
    array = np.frombuffer(data, np.uint8).copy()
    where = rng.integers(9, min(len(array), 900), 12)
    array[where] = rng.integers(32, 127, len(where))
    return array.tobytes()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LINES = 40", "LINES = -4"), ("LINES = 40", "LINES = many"), ("SAMPLE_BITS = 16", "SAMPLE_BITS = 12"),
        ("MSB_INTEGER", "VAX_COMPLEX"), ("LINE_SAMPLES = 50", ""), ("^IMAGE", "^TABLE"),
        ("SAMPLE_BITS = 16", "SAMPLE_BITS = 16\r\nENCODING_TYPE = HUFFMAN"), ("END_OBJECT = IMAGE", ""),
        ("LINES = 40", "LINES = 40\r\nBANDS = 3\r\nBAND_STORAGE_TYPE = LINE_INTERLEAVED"),
        ("LINES = 40", "LINES = (40"),
    ],
)  # fmt: skip
def test_labels_that_cannot_be_meant(old: str, new: str) -> None:
    label = pds3_label("5", "MSB_INTEGER", 16, SHAPE).decode().replace(old, new, 1).encode()
    assert reason_of(attached(label, prefixed(pixels_of(">i2")))) is StatusReason.IMAGE_UNREADABLE


def test_labels_without_their_pixels() -> None:
    label, xml = pds3_label('"A.IMG"', "MSB_INTEGER", 16, SHAPE), pds4_label("a.img", "SignedMSB2", SHAPE)
    assert reason_of(label, "A.LBL") is StatusReason.IMAGE_NOT_FOUND
    assert reason_of(xml, "a.xml") is StatusReason.IMAGE_NOT_FOUND
    assert reason_of(b"\1\2\3" * 900, "A.IMG") is StatusReason.IMAGE_FORMAT_UNKNOWN
    assert (labelled_file(label), labelled_file(xml)) == ("A.IMG", "a.img")
    assert labelled_file(b"SIMPLE  = T") is None
    assert labelled_file(b"<?xml version='1.0'?><broken") is None
    assert labelled_file(attached(pds3_label("5", "MSB_INTEGER", 16, SHAPE), b"")) is None


def test_xml_bombs_do_not_go_off() -> None:
    laughs = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10 if n else "ha"}">' for n in range(20))
    xml = f'<?xml version="1.0"?><!DOCTYPE x [{laughs}]><Product_Observational>&l19;</Product_Observational>'
    assert reason_of(b"\1" * 4000, "a.img", {"a.xml": xml.encode()}) is StatusReason.IMAGE_UNREADABLE


def test_gdal_says_nothing(caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> None:
    with caplog.at_level(logging.DEBUG):
        damaged = vicar(pixels_of("u1")).replace(b"ORG='BSQ'", b"ORG='XXX'", 1)
        assert reason_of(damaged) is StatusReason.IMAGE_UNREADABLE
    assert capfd.readouterr().err == ""
    assert rasterio.__gdal_version__


@needs_data
@pytest.mark.parametrize(
    ("name", "companion", "shape", "mean"),
    [
        ("C0532836239R.IMG", None, (800, 800), 61.158), ("C2069302_RAW.IMG", None, (800, 800), 7.469),
        ("N1473172656_1.IMG", None, (1024, 1024), 92.452),
        ("N1473172656_1.IMG", "N1473172656_1.LBL", (1024, 1024), 92.452),
        ("N1473172656_1.LBL", "N1473172656_1.IMG", (1024, 1024), 92.452),
    ],
)  # fmt: skip
def test_real_products(name: str, companion: str | None, shape: tuple[int, int], mean: float) -> None:
    folder = DATA / "images"
    companions = {companion: (folder / companion).read_bytes()} if companion else {}
    raw = read_image((folder / name).read_bytes(), name, companions)
    assert raw.pixels.shape == shape
    # The data's README gives three decimals.
    assert round(float(raw.pixels.mean()), 3) == mean
    if name.startswith("N"):
        assert (raw.pixels.min(), raw.pixels.max()) == (7, 255)
        assert raw.header["FILTER_NAME"] == "CL1,CB2"


@needs_data
def test_pds3_label_alone_reads_a_real_product_alike() -> None:
    """The same bytes by the PDS3 label (with its line prefixes) and by the VICAR label inside."""
    data = (DATA / "images" / "N1473172656_1.IMG").read_bytes()
    label = (DATA / "images" / "N1473172656_1.LBL").read_bytes()
    by_vicar = read_image(data, "N.IMG").pixels
    unnamed = b"\0" + data[1:]
    assert np.array_equal(read_image(unnamed, "N1473172656_1.IMG", {"N1473172656_1.LBL": label}).pixels, by_vicar)
