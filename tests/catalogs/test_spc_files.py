"""SPC's own files: real records, byte-for-byte round trips, and damage told by row or byte."""

import numpy as np
import pytest

from catalogs.spc_files import MapFile, map_of, maplet_of, read_map, write_map
from catalogs.spc_text import (
    LandmarkFile,
    PictureFile,
    Sighting,
    SpcProblem,
    camera_of,
    read_landmark,
    read_picture,
    write_landmark,
    write_picture,
)
from pipeline.camera import project
from pipeline.geometry.maplet import Maplet, index_of, maplet_points_km
from tests.scenes.data import DATA, needs_data

# The header of a real map, as published: half size, scale, centre and axes, single precision.
REAL_SCALE = 9.9999997473787516e-06
REAL_PLACE = [-2.6262991130352020e-02, 0.26271706819534302, -3.1600955873727798e-02]
REAL_AXES = [
    [6.2937657348811626e-03, -0.13774713873863220, -0.99044746160507202],
    [-0.99829435348510742, -5.8354031294584274e-02, 1.7719966126605868e-03],
    [-5.8040685951709747e-02, 0.98874694108963013, -0.13787946105003357],
]


def real_map(half: int = 49) -> MapFile:
    rng = np.random.default_rng(3)
    side = 2 * half + 1
    steps = rng.integers(-30_000, 30_001, (side, side)).astype(np.int16)
    albedo = rng.integers(1, 200, (side, side)).astype(np.int16)
    steps[:3, :5], albedo[:3, :5] = 0, 0
    step = float(np.float32(7.25 / 30_000))
    return MapFile(
        half, REAL_SCALE, np.array(REAL_PLACE), np.array(REAL_AXES), step, steps, albedo,
        np.array([100, 200, 124], np.int16), float(np.float32(8.1e-4)), b"\x01SPC\x00\x02\x07",
    )  # fmt: skip


@pytest.mark.parametrize("half", [1, 2, 11, 49, 50])
def test_a_map_written_read_and_written_again_is_identical(half: int) -> None:
    first = write_map(real_map(half))
    assert len(first) == 72 * (1 + -(-((2 * half + 1) ** 2) // 24))
    again = read_map(first, "m")
    assert write_map(again) == first
    assert np.array_equal(again.steps, real_map(half).steps)
    assert again.landmark_km.tolist() == REAL_PLACE
    assert again.axes.tolist() == REAL_AXES


def test_bytes_stand_where_the_format_says() -> None:
    data = write_map(real_map())
    assert np.frombuffer(data[6:10], ">f4")[0] == np.float32(1e-5)
    assert int.from_bytes(data[10:12], "little") == 49
    assert data[12:15] == bytes([100, 200, 124])
    assert np.frombuffer(data[51:63], ">f4").tolist() == np.array(REAL_AXES[2], np.float32).tolist()
    cell = 72 + 3 * (99 * 10 + 4)
    assert int.from_bytes(data[cell : cell + 2], "big", signed=True) == real_map().steps[10, 4]
    assert data[cell + 2] == real_map().albedo_steps[10, 4]


def test_filling_bytes_survive() -> None:
    data = bytearray(write_map(real_map(2)))
    data[-1] = 99
    assert write_map(read_map(bytes(data), "m")) == bytes(data)


def test_a_maplet_goes_out_and_comes_back_bit_for_bit() -> None:
    file = real_map()
    maplet = maplet_of(file, "EE0425")
    assert np.isnan(maplet.heights[:3, :5]).all()
    back = map_of(maplet, file.height_step)
    assert np.array_equal(back.steps, file.steps)
    assert np.array_equal(back.albedo_steps, file.albedo_steps)
    # P = V + scale (i Ux + j Uy + h Uz), i slow.
    i, j = 60, 7
    height = file.steps[i, j] * file.height_step
    expected = np.array(REAL_PLACE) + REAL_SCALE * (np.array([i - 49, j - 49, height]) @ np.array(REAL_AXES))
    assert maplet_points_km(maplet)[i, j] == pytest.approx(expected, abs=1e-15)
    assert index_of([maplet]).radius_km[0] == pytest.approx(
        np.nanmax(np.linalg.norm(maplet_points_km(maplet) - maplet.landmark_km, axis=2)), rel=1e-5
    )


def test_heights_of_a_new_map_use_the_whole_range() -> None:
    maplet = maplet_of(real_map(3), "A")
    tall = Maplet(
        "A", maplet.landmark_km, maplet.maplet_from_body, 0.1, maplet.heights * 3, maplet.albedo, np.eye(3) * 1e-4
    )
    file = map_of(tall)
    assert np.abs(file.steps).max() == 30_000
    assert file.steps * file.height_step == pytest.approx(np.nan_to_num(tall.heights), abs=file.height_step)
    assert maplet_of(file, "A").covariance_km2 == pytest.approx(np.eye(3) * 1e-4, rel=0.01, abs=1e-12)


def damaged_maps() -> dict[str, tuple[bytes, str]]:
    good = write_map(real_map())
    return {
        "empty": (b"", "byte 1:"),
        "header cut": (good[:40], "byte 41:"),
        "cells cut": (good[:-100], f"byte {len(good) - 99}:"),
        "too long": (good + b"x", f"byte {len(good) + 1}:"),
        "scale": (good[:6] + b"\x7f\xc0\x00\x00" + good[10:], "byte 7:"),
        "size": (good[:10] + b"\x00\x00" + good[12:], "byte 11:"),
        "axes": (good[:27] + bytes(12) + good[39:], "byte 28:"),
        "height": (good[:63] + bytes(4) + good[67:], "byte 64:"),
    }


@pytest.mark.parametrize("case", damaged_maps().values(), ids=damaged_maps().keys())
def test_damaged_maps_are_refused_with_the_byte(case: tuple[bytes, str]) -> None:
    with pytest.raises(SpcProblem, match=f"^EE0425.MAP: {case[1]}"):
        read_map(case[0], "EE0425.MAP")


def landmark() -> LandmarkFile:
    return LandmarkFile(
        "ENDFIL", "T", "", 49, 1e-5, (-1, -1, -1, -1), 5e-6, 1.458559361, np.array(REAL_PLACE).round(11),
        np.array(REAL_AXES), np.array([4e-4, 5e-4, 4.5e-4]),
        (Sighting("P3LIMB2H0201", (466.27, 128.14)), Sighting("P3END", (1.5, 2.25), True)),
        (Sighting("EE0397", (66.076, 0.078, -0.25)),), (),
    )  # fmt: skip


def picture() -> PictureFile:
    turn = np.array(REAL_AXES)
    u, _, w = np.linalg.svd(turn)
    return PictureFile(
        "W1", "2014 NOV 12 17:20:03.128", (1024, 1020), (500, 65535), 135.68, np.array([511.7, 510.6]),
        np.array([-143.0589240, -38.93115914, 84.58863431]), u @ w, np.array([0.6, 0.0, 0.8]),
        np.array([[37.0371, 0.124, 0.0], [-0.124, 37.0371, 0.0]]), np.zeros(4), np.full(3, 1e-3), np.full(3, 1e-4),
        (Sighting("LIMBFI", (533.53, 475.22), True),), (),
    )  # fmt: skip


def test_text_survives_a_round_trip() -> None:
    first = write_landmark(landmark())
    again = read_landmark(first, "l")
    assert write_landmark(again) == first
    assert again.pictures[1] == Sighting("P3END", (1.5, 2.25), True)
    assert again.name == "ENDFIL"
    second = write_picture(picture())
    assert write_picture(read_picture(second, "p")) == second
    assert read_picture(second, "p").shape_vu == (1024, 1020)


def test_line_scanners_and_unknown_distortion_are_refused() -> None:
    text = write_picture(picture()).decode()
    with pytest.raises(SpcProblem, match="row 1: pictures of line scanners"):
        read_picture(text.replace("W1", "N0123456789ABL", 1).encode(), "p")
    bent = text.replace("0.00000D+00", "0.10000D-03", 1)
    with pytest.raises(SpcProblem, match="DISTORTION"):
        camera_of(read_picture(bent.encode(), "p"))


def test_truncated_and_malformed_text_is_refused_with_the_row() -> None:
    text = write_landmark(landmark()).decode()
    lines = text.splitlines()
    for count in range(len(lines)):
        with pytest.raises(SpcProblem, match=r"^l: row \d+: "):
            read_landmark("\n".join(lines[:count]).encode(), "l")
    with pytest.raises(SpcProblem, match="row 5: 2 numbers"):
        read_landmark(text.replace(lines[4], lines[4][:40]).encode(), "l")
    with pytest.raises(SpcProblem, match=r"row 8: .* no rotation"):
        read_landmark(text.replace(lines[5], lines[6]).encode(), "l")
    with pytest.raises(SpcProblem, match="row 11: 'P3LIMB2H0201"):
        read_landmark(text.replace("466.27", "466.2x").encode(), "l")
    with pytest.raises(SpcProblem, match="byte 4 is no text"):
        read_landmark(b"ABC\xff", "l")


@needs_data
def test_real_records_parse_and_a_real_landmark_is_written_as_it_was() -> None:
    data = (DATA / "spc" / "EE0425.LMK").read_bytes()
    file = read_landmark(data, "EE0425.LMK")
    assert len(file.pictures) == 16
    assert write_landmark(file) == data
    big = read_landmark((DATA / "spc" / "T11RFU_bigmap.LMK").read_bytes(), "T11RFU")
    assert big.extra.split() == ["0.2500", "0.0500"]
    assert write_landmark(big) == (DATA / "spc" / "T11RFU_bigmap.LMK").read_bytes()
    for name, count in (("D7175061219G_excerpt", 2), ("W46908480918", 7)):
        sums = read_picture((DATA / "spc" / f"{name}.SUM").read_bytes(), name)
        assert len(sums.landmarks) == count
        assert np.allclose(sums.camera_from_body @ sums.camera_from_body.T, np.eye(3), atol=1e-9)
        assert write_picture(read_picture(write_picture(sums), name)) == write_picture(sums)


def test_the_published_pair_reprojects_where_it_was_said_to() -> None:
    """Rosetta picture W48230079013 and landmark FA0115; the missing entries follow from orthonormality."""
    cxx, cxz, czx, czz, cyy = 0.5399383659, 0.8126088065, -0.8387783408, 0.4977460006, 0.9503508287
    cxy, czy = (-np.sqrt(1 - a**2 - b**2) for a, b in ((cxx, cxz), (czx, czz)))
    x, z = np.array([cxx, cxy, cxz]), np.array([czx, czy, czz])
    y = np.cross(z, x)
    assert y[1] == pytest.approx(cyy, abs=1e-6)
    u, _, w = np.linalg.svd(np.stack([x, y, z]))
    sums = PictureFile(
        "W48230079013", "2015 APR 14 16:26:27.974", (1024, 1024), (0, 65535), 135.68, np.array([511.7, 510.6]),
        np.array([-143.0589240, -38.93115914, 84.58863431]), u @ w, np.array([1.0, 0, 0]),
        np.array([[37.0371, 0.124, 0.0], [-0.124, 37.0371, 0.0]]), np.zeros(4), np.ones(3), np.ones(3), (), (),
    )  # fmt: skip
    landmark_km = np.array([2.182154009, 0.4798117875, -0.4244737920])
    pixel, ahead = project(camera_of(sums), (sums.camera_from_body @ (landmark_km + sums.object_km))[None])
    assert ahead.all()
    # 1-based (pixel, line) in the file, 0-based (v, u) here.
    assert pixel[0, ::-1] + 1.0 == pytest.approx([534.357, 476.332], abs=0.01)
