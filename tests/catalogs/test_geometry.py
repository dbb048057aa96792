"""States from sidecars and LORRI headers: what is taken, and what is refused with which reason."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catalogs.geometry import et_of_utc
from catalogs.header import state_from_header
from catalogs.images import RawImage, read_image
from catalogs.instruments import InstrumentBlock, identify
from catalogs.sidecar import sidecar_image_id, state_from_sidecar
from pipeline.errors import GeometryError, ImageFailure
from pipeline.records import State
from pipeline.status import StatusReason
from tests.support import Document, sidecar_of, state_of_frame
from workflows.config import load_configuration

BLOCKS = load_configuration().instruments
LORRI = BLOCKS["nhlorri"]


@pytest.fixture(scope="module")
def frame(lorri_archive: Path) -> Path:
    return sorted((lorri_archive / "frames").glob("*.fits"))[0]


@pytest.fixture(scope="module")
def good(frame: Path) -> Document:
    return sidecar_of(frame)


def state_of(content: object, block: InstrumentBlock | None = None, **overrides: object) -> State:
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    return state_from_sidecar(data, "id", block, overrides, (256, 256))


def reason_of(content: object, block: InstrumentBlock | None = None, **overrides: object) -> StatusReason:
    with pytest.raises(GeometryError) as failure:
        state_of(content, block, **overrides)
    assert "\n" not in failure.value.detail
    return failure.value.reason


def changed(content: Document, key: str, value: object) -> Document:
    """Copy with the value at a dotted key replaced."""
    copy: Document = json.loads(json.dumps(content))
    *path, last = key.split(".")
    inside = copy
    for part in path:
        inside = inside[part]  # type: ignore[assignment]
    inside[last] = value
    return copy


def test_sidecar_says_what_the_header_says(frame: Path, good: Document) -> None:
    header, sidecar = state_of_frame(frame), state_of(good)
    assert np.allclose(sidecar.attitude.camera_from_j2000, header.attitude.camera_from_j2000, atol=1e-12)
    assert np.array_equal(sidecar.camera_model.k_px_per_mm, header.camera_model.k_px_per_mm)
    # A millisecond: the header's text has no more digits.
    assert sidecar.et == pytest.approx(header.et, abs=2e-3)
    assert sidecar.settings.search_margin_vu == header.settings.search_margin_vu
    assert sidecar.detector.read_noise_dn == header.detector.read_noise_dn


def test_unknown_keys_are_another_tools_business(good: Document) -> None:
    assert state_of({**good, "bodies": [], "rings": None, "other": {"x": 1}}).image_id == "id"


def test_archive_settings_win(good: Document) -> None:
    state = state_of({**good, "max_rotation_deg": 3.0}, None, fit_camera_rotation=True, search_margin_vu=[5.0, 6.0])
    assert state.settings.fit_camera_rotation
    assert state.settings.max_rotation_deg == 3.0
    assert state.settings.search_margin_vu == (5.0, 6.0)


def test_camera_of_the_block_is_the_mode_of_the_images_shape(good: Document) -> None:
    assert state_of({**good, "camera_model": None}, LORRI).camera_model.shape_vu == (256, 256)
    assert reason_of({**good, "camera_model": None}) is StatusReason.CAMERA_UNKNOWN


HALF = [0.5, 0.5, 0.5, 0.5]
INVALID = [
    ("schema", "geometry/2"), ("schema", None), ("mid_time_utc", "yesterday"), ("mid_time_utc", "9999-01-01T00:00:00"),
    ("mid_time_utc", "-4000-01-01T00:00:00"), ("mid_time_utc", ""), ("mid_time_utc", 5), ("mid_time_utc", "2015-02-31"),
    ("exposure_s", -1.0), ("exposure_s", float("inf")), ("exposure_s", float("nan")), ("exposure_s", "long"),
    ("camera_model.shape_vu", [0, 0]), ("camera_model.shape_vu", [256]), ("camera_model.shape_vu", [256.5, 1]),
    ("camera_model.focal_length_mm", 0.0), ("camera_model.focal_length_mm", float("inf")),
    ("camera_model.focal_length_mm", -2619.0), ("camera_model.k_px_per_mm", [[1.0, 1.0], [1.0, 1.0]]),
    ("camera_model.k_px_per_mm", [[0.0, 0.0], [0.0, 0.0]]), ("camera_model.k_px_per_mm", [[float("nan"), 0], [0, 1]]),
    ("camera_model.k_px_per_mm", [[1e-320, 0.0], [0.0, 1e-320]]), ("camera_model.psf_sigma_px", 0.0),
    ("camera_model.distortion_eps", [1e300] * 6), ("camera_model.distortion_eps", [1.0] * 5),
    ("camera_model.saturation_dn", float("nan")),
    ("camera_model.principal_point_vu", [float("inf"), 0.0]), ("camera_model.star_dn_per_s_mag0", 0.0),
    ("attitude.camera_from_j2000_wxyz", [float("nan"), 0, 0, 0]), ("attitude.camera_from_j2000_wxyz", [1, 0, 0]),
    ("attitude.camera_from_j2000_wxyz", [0.0, 0.0, 0.0, 0.0]), ("attitude.camera_from_j2000_wxyz", [2, 0, 0, 0]),
    ("attitude", None), ("attitude.rate_rad_s", [1e300, 0.0, 0.0]), ("attitude.sigma_rad", [float("inf"), 0, 0]),
    ("spacecraft.velocity_kms_ssb", [3e5, 0.0, 0.0]), ("spacecraft.position_km_ssb", [1e300, 0.0, 0.0]),
    ("search_margin_vu", [0.0, 0.0]), ("search_margin_vu", [1e9, 1e9]), ("search_margin_vu", [float("nan"), 5]),
    ("max_rotation_deg", 90.0), ("gain_e_per_dn", 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), INVALID)
def test_impossible_figures_are_geometry_invalid(good: Document, key: str, value: object) -> None:
    assert reason_of(changed(good, key, value)) is StatusReason.GEOMETRY_INVALID


def test_rotation_without_room_is_geometry_invalid(good: Document) -> None:
    content = {**good, "fit_camera_rotation": True, "max_rotation_deg": 0.0}
    assert reason_of(content) is StatusReason.GEOMETRY_INVALID


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b"null", b"5", b"\xff\xfe", b"[" * 50_000, b'{"a": ' * 50_000, b"{}"]
)
def test_other_texts_are_geometry_invalid(data: bytes) -> None:
    assert reason_of(data) is StatusReason.GEOMETRY_INVALID
    assert sidecar_image_id(data) is None


@pytest.mark.parametrize("claim", [None, 5, "", [], {}])
def test_claims_that_are_no_id_are_no_claim(claim: object) -> None:
    assert sidecar_image_id(json.dumps({"image_id": claim}).encode()) is None
    assert sidecar_image_id(json.dumps({"image_id": "x"}).encode()) == "x"


# TT - UTC at J2000 is 64.184 s: 32 leap seconds and 32.184 s (NAIF's required reading on time).
def test_et_counts_leap_seconds() -> None:
    # TDB and TT differ by less than 2 ms.
    assert et_of_utc("2000-01-01T12:00:00") == pytest.approx(64.184, abs=2e-3)
    assert et_of_utc("2000-01-01T12:00:00Z") == et_of_utc("2000-01-01T12:00:00")
    leap = et_of_utc("2017-01-01T00:00:00") - et_of_utc("2016-12-31T23:59:59")
    assert leap == pytest.approx(2.0, abs=1e-6)


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=25))
def test_any_text_is_a_time_or_a_reason(text: str) -> None:
    try:
        assert np.isfinite(et_of_utc(text))
    except GeometryError as failure:
        assert failure.reason is StatusReason.GEOMETRY_INVALID  # noqa: PT017


def raw_with(frame: Path, **cards: object) -> RawImage:
    raw = read_image(frame.read_bytes(), frame.name)
    header = {key: raw.header[key] for key in set(raw.header) if raw.header.get(key) is not None}
    for key, value in cards.items():
        header.pop(key, None)
        if value is not None:
            header[key] = value  # type: ignore[assignment]
    return RawImage(raw.pixels, header, {})


HEADER = [
    ({"SPCQA": None}, StatusReason.GEOMETRY_MISSING), ({"SPCQX": "text"}, StatusReason.GEOMETRY_MISSING),
    ({"SPCQA": -1.0e32}, StatusReason.GEOMETRY_MISSING), ({"SPCQA": 5.0}, StatusReason.GEOMETRY_MISSING),
    ({"SPCQA": True}, StatusReason.GEOMETRY_MISSING), ({"SPCSCET": None}, StatusReason.GEOMETRY_MISSING),
    ({"SPCSCET": 1e300}, StatusReason.GEOMETRY_INVALID), ({"SPCSCET": 1e11}, StatusReason.GEOMETRY_INVALID),
    ({"SFORMAT": None}, StatusReason.CAMERA_UNKNOWN), ({"SFORMAT": "2X2"}, StatusReason.CAMERA_UNKNOWN),
    ({"RATEX": 1e300}, StatusReason.GEOMETRY_INVALID), ({"SPCSSCX": 1e300}, StatusReason.GEOMETRY_INVALID),
    ({"SPCSSCVX": 299_792.458}, StatusReason.GEOMETRY_INVALID),
]  # fmt: skip


@pytest.mark.parametrize(("cards", "reason"), HEADER)
def test_headers_without_pointing(frame: Path, cards: dict[str, object], reason: StatusReason) -> None:
    with pytest.raises(ImageFailure) as failure:
        state_from_header(raw_with(frame, **cards), "id", LORRI, {})
    assert failure.value.reason is reason


def test_unknown_extras_are_left_out(frame: Path) -> None:
    state = state_from_header(
        raw_with(frame, RATEX=-2e31, SPCSSCX=None, SPCSSCVX="x", EXPTIME=None, RDNOISE=-1.0, PHOTZPT=None),
        "id",
        LORRI,
        {},
    )
    assert state.attitude.rate_rad_s is None
    assert state.spacecraft.position_km is None
    assert state.spacecraft.velocity_km_s is None
    assert state.exposure_s is None
    assert state.detector.read_noise_dn == LORRI.modes["4X4"].read_noise_dn


def test_settings_that_contradict_the_camera(frame: Path) -> None:
    fitted = LORRI.model_copy(update={"fit_camera_rotation": True})
    with pytest.raises(GeometryError) as failure:
        state_from_header(raw_with(frame), "id", fitted, {"max_rotation_deg": 0.0})
    assert failure.value.reason is StatusReason.GEOMETRY_INVALID


def test_identification_goes_by_cards(frame: Path) -> None:
    assert identify(raw_with(frame).header, BLOCKS) is LORRI
    assert identify(raw_with(frame, INSTRU="mvic").header, BLOCKS) is None
    assert identify({}, BLOCKS) is None


def test_camera_without_header_reader(frame: Path) -> None:
    with pytest.raises(GeometryError) as failure:
        state_from_header(raw_with(frame), "id", BLOCKS["coiss_nac"], {})
    assert failure.value.reason is StatusReason.GEOMETRY_MISSING
