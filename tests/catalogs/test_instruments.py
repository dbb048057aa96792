"""Camera blocks: whose label is whose, which mode an image is of, and where its pixels look."""

import json

import numpy as np
import pytest
import spiceypy
from pydantic import ValidationError

from catalogs.instruments import InstrumentBlock, SpiceNames, identify, matches, mode_of
from pipeline.camera import distort, unproject
from pipeline.geometry.rotations import matrix_from_quaternion
from tests.scenes.data import DATA, needs_data
from workflows.config import load_configuration

BLOCKS = load_configuration().instruments

LABELS = [
    ("coiss_nac", {"INSTRUMENT_HOST_NAME": "CASSINI ORBITER", "INSTRUMENT_ID": "ISSNA"}),
    ("coiss_wac", {"INSTRUMENT_HOST_NAME": "Cassini Orbiter", "INSTRUMENT_ID": "ISSWA"}),
    ("coiss_nac", {"IsisCube.Instrument.SpacecraftName": "Cassini-Huygens",
                   "IsisCube.Instrument.InstrumentId": "ISSNA"}),
    ("vgiss_1_na", {"SPACECRAFT_NAME": "VOYAGER 1", "INSTRUMENT_ID": "ISSN"}),
    ("vgiss_1_wa", {"SPACECRAFT_NAME": "VOYAGER_1", "INSTRUMENT_NAME": "WIDE_ANGLE_CAMERA"}),
    ("vgiss_2_na", {"INSTRUMENT_HOST_NAME": "VOYAGER 2,VG2",
                    "INSTRUMENT_NAME": "IMAGING SCIENCE SUBSYSTEM - NARROW ANGLE CAMERA"}),
    ("vgiss_2_wa", {"LAB02": "VGR-2   FDS 20693.02   PICNO 0215J2+001", "LAB03": "WA CAMERA  EXP   15360.0 MSEC"}),
    ("gossi", {"SENSOR": "SSI", "MISSION": "GALILEO"}),
    ("gossi", {"SPACECRAFT_NAME": "GALILEO ORBITER", "INSTRUMENT_NAME": "SOLID_STATE_IMAGING SYSTEM"}),
    ("nhlorri", {"INSTRU": "LOR "}),
    ("nearmsi", {"NEAR-005": "MSI.004"}),
    ("nearmsi", {"INSTRUMENT_HOST_NAME": "NEAR EARTH ASTEROID RENDEZVOUS", "INSTRUMENT_ID": "MSI"}),
    (None, {"INSTRUMENT_HOST_NAME": "CASSINI ORBITER", "INSTRUMENT_ID": "VIMS"}),
    (None, {"SPACECRAFT_NAME": "VOYAGER 3", "INSTRUMENT_ID": "ISSN"}),
    (None, {"SPACECRAFT_NAME": "VOYAGER 10", "INSTRUMENT_ID": "ISSN"}),
    (None, {"INSTRUMENT_ID": "SSI"}),
    (None, {}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "header"), LABELS)
def test_labels_are_told_apart(name: str | None, header: dict[str, str]) -> None:
    found = identify(header, BLOCKS)
    assert found is (None if name is None else BLOCKS[name])


def test_no_marks_match_nothing() -> None:
    assert not matches({}, {"A": "b"})
    assert matches({"A|B": "c"}, {"B": "C"})
    assert not matches({"A|B": "c"}, {"B": "cc"})


MODES: list[tuple[str, tuple[int, ...], dict[str, str], str | None]] = [
    ("coiss_nac", (1024, 1024), {"FORMAT": "BYTE"}, "1024"), ("coiss_nac", (512, 512), {"FORMAT": "HALF"}, "512"),
    ("coiss_wac", (256, 256), {}, "256"), ("coiss_wac", (1024, 1024), {"FORMAT": "REAL"}, "1024_CALIB"),
    ("vgiss_2_na", (1000, 1000), {}, "GEOMED"), ("vgiss_2_na", (800, 800), {}, "RAW"),
    ("vgiss_2_na", (800, 800), {"PRODUCT_ID": "C2069302_CLEANED.IMG"}, "CLEANED"),
    ("vgiss_2_wa", (800, 800), {"PRODUCT_ID": "C2069302_CALIB.IMG"}, "CALIB"),
    ("vgiss_2_wa", (800, 800), {"PRODUCT_ID": "C2069302_RAW.IMG"}, "RAW"), ("gossi", (400, 400), {}, "400"),
    ("nearmsi", (244, 537), {"NEAR-013": "2"}, "CALIB"), ("nearmsi", (244, 537), {"NEAR-013": "0"}, "RAW"),
    ("nhlorri", (256, 256), {}, "4X4"), ("coiss_nac", (100, 100), {}, None), ("gossi", (3, 800, 800), {}, None),
]  # fmt: skip


@pytest.mark.parametrize(("name", "shape", "header", "mode"), MODES)
def test_modes(name: str, shape: tuple[int, ...], header: dict[str, str], mode: str | None) -> None:
    assert mode_of(BLOCKS[name], shape, header) == mode


# Fields of view along samples, degrees, as instrument kernels and papers state them.
FIELDS = {
    ("coiss_nac", "1024"): 0.35, ("coiss_nac", "512"): 0.35, ("coiss_nac", "256"): 0.35, ("coiss_wac", "1024"): 3.5,
    ("coiss_wac", "256"): 3.5, ("gossi", "800"): 0.46, ("gossi", "400"): 0.46, ("nhlorri", "1X1"): 0.29,
    ("nhlorri", "4X4"): 0.29, ("vgiss_1_na", "RAW"): 0.424, ("vgiss_2_wa", "RAW"): 3.169,
    ("vgiss_2_na", "GEOMED"): 0.4493, ("nearmsi", "RAW"): 2.95,
}  # fmt: skip


@pytest.mark.parametrize(("name", "mode"), list(FIELDS))
def test_fields_of_view(name: str, mode: str) -> None:
    camera = BLOCKS[name].modes[mode].camera_model()
    rows, columns = camera.shape_vu
    middle = (rows - 1) / 2
    rays, good = unproject(camera, np.array([[middle, -0.5], [middle, columns - 0.5]]))
    assert good.all()
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    field = np.degrees(np.arccos(rays[0] @ rays[1]))
    # Those figures have two or three digits.
    assert field == pytest.approx(FIELDS[name, mode], rel=0.02)


@pytest.mark.parametrize("name", list(BLOCKS))
def test_every_mode_inverts_over_its_array(name: str) -> None:
    for mode in BLOCKS[name].modes.values():
        camera = mode.camera_model()
        rows, columns = mode.shape_vu
        corners = np.array([[0, 0], [0, columns - 1], [rows - 1, 0], [rows - 1, columns - 1]], dtype=float)
        assert unproject(camera, corners)[1].all()
        assert mode.search_margin_vu is None or max(mode.search_margin_vu) < min(rows, columns)


def test_summed_modes_see_what_the_full_array_sees() -> None:
    for name, full, summed, factor in (("coiss_nac", "1024", "512", 2), ("coiss_wac", "1024", "256", 4),
                                       ("gossi", "800", "400", 2), ("nhlorri", "1X1", "4X4", 4)):  # fmt: skip
        one, other = (BLOCKS[name].modes[mode].camera_model() for mode in (full, summed))
        summed_vu = np.array([[10.0, 20.0], [100.0, 7.0]])
        # The centre of a summed pixel lies between those that it is made of.
        full_vu = factor * summed_vu + (factor - 1) / 2
        assert np.allclose(unproject(one, full_vu)[0], unproject(other, summed_vu)[0], rtol=1e-6, atol=1e-9)


def test_distortions_are_those_of_the_inverse_formula() -> None:
    """ISIS gives Galileo's and NEAR's from the distorted to the undistorted point."""
    for name, k1, radius_mm in (("gossi", -2.4976983626e-05, 8.6), ("nearmsi", -7e-5, 5.4)):
        mode = next(iter(BLOCKS[name].modes.values()))
        distorted = distort(mode.camera_model(), np.array([[radius_mm, 0.0], [0.6 * radius_mm, -0.8 * radius_mm]]))
        back = distorted * (1 + k1 * (distorted**2).sum(axis=1, keepdims=True))
        # One term stands for the inverse of one: they part by the square of the distortion.
        assert np.allclose(back, [[radius_mm, 0.0], [0.6 * radius_mm, -0.8 * radius_mm]], atol=4e-5)


def test_spice_names_must_hold_a_rotation() -> None:
    rough = ((0.9999995, 0.001, 0.0), (-0.001, 0.9999995, 0.0), (0.0, 0.0, 1.0))
    turned = SpiceNames(spacecraft_id=-98, instrument_id=-98301, frame="F", camera_from_instrument=rough)
    rotation = turned.rotation()
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    with pytest.raises(ValidationError, match="rotation"):
        SpiceNames(spacecraft_id=-98, instrument_id=-98301, frame="F",
                   camera_from_instrument=((-1, 0, 0), (0, 1, 0), (0, 0, 1)))  # fmt: skip
    with pytest.raises(ValidationError, match="less than 0"):
        SpiceNames(spacecraft_id=98, instrument_id=-1, frame="F")


def test_marks_must_be_regular_expressions() -> None:
    content = BLOCKS["gossi"].model_dump() | {"identify": [{"A": "("}]}
    with pytest.raises(ValidationError, match="regular expression"):
        InstrumentBlock.model_validate(content)


@needs_data
def test_msi_looks_where_the_eros_sidecar_says() -> None:
    """Spacecraft quaternion of the product's header against the sidecar's camera attitude."""
    folder = DATA / "eros_near"
    sidecar = json.loads(next(folder.glob("*.geometry.json")).read_text())
    bus_from_j2000 = matrix_from_quaternion(
        np.array([0.6152713528318168, 0.2411572819729510, -0.2663500172469832, -0.7016708601961865])
    )
    names = BLOCKS["nearmsi"].spice
    assert names is not None
    camera = names.rotation() @ bus_from_j2000
    expected = matrix_from_quaternion(np.array(sidecar["attitude"]["camera_from_j2000_wxyz"]))
    assert np.allclose(camera, expected, atol=1e-8)
    kernel = str(folder / "kernels" / "msi15.ti")
    spiceypy.furnsh(kernel)
    try:
        # The kernel beside the image is the one that ISIS changed: its NEAR_MSI is the camera frame itself.
        assert np.allclose(names.rotation(), spiceypy.pxform("NEAR_SC_BUS_PRIME", "NEAR_MSI", 0.0), atol=1e-8)
    finally:
        spiceypy.unload(kernel)
