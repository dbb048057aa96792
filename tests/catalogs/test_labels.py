"""What labels say, family by family: real products where they are at hand, and labels by their standards' words."""

from datetime import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catalogs.images import read_image
from catalogs.instruments import CardValue
from catalogs.label_text import parse_label, parse_pds4, parse_vicar
from catalogs.labels import Label, read_label, utc_of
from catalogs.raw_images import RawImage
from tests.catalogs.planetary import pds4_label
from tests.scenes.data import DATA, needs_data
from workflows.config import load_configuration

BLOCKS = load_configuration().instruments


def said(header: dict[str, CardValue], shape: tuple[int, int] = (1024, 1024), instrument: str | None = None) -> Label:
    return read_label(RawImage(np.zeros(shape, np.uint8), header, {}), BLOCKS, instrument)


def label_of(text: str, shape: tuple[int, int] = (1024, 1024)) -> Label:
    return said(parse_label(text).flat(), shape)


def test_values_of_pds3_labels() -> None:
    text = """PDS_VERSION_ID = PDS3 /* a comment with = and "quotes */
    /* one that is never closed
    NAME = "two
       lines"  SYMBOL = 'N/A' NUMBER = -5 REAL = 1.50E+2 HEX = 16#FF# TIME = 1999-01-02T03:04:05.6Z
    WITH_UNIT = 2600.0 <ms> PAIR = ("CL1", "CB2") SET = {1,2.5} DEEP = ((1,2),(3,4)) UNITS = (1 <K>, 2 <K>)
    ^IMAGE = ("A.IMG", 2001 <BYTES>) EMPTY = "" UNDERSCORE = 1_000 NAN = nan
    OBJECT = IMAGE  LINES = 5  OBJECT = INNER  X = 1  END_OBJECT = INNER  END_OBJECT = IMAGE
    OBJECT = IMAGE  LINES = 6  END_OBJECT
    AFTER = yes  AFTER = no
    END
    LOST = 1"""
    found = parse_label(text).flat()
    assert found == {
        "PDS_VERSION_ID": "PDS3", "NAME": "two lines", "SYMBOL": "N/A", "NUMBER": -5, "REAL": 150.0, "HEX": "16#FF#",
        "TIME": "1999-01-02T03:04:05.6Z", "WITH_UNIT": 2600.0, "WITH_UNIT.unit": "ms", "PAIR": "CL1,CB2",
        "SET": "1,2.5", "DEEP": "1,2,3,4", "UNITS": "1,2", "^IMAGE": "A.IMG,2001,<BYTES>", "EMPTY": "",
        "UNDERSCORE": "1_000", "NAN": "nan", "IMAGE.LINES": 5, "IMAGE.INNER.X": 1, "AFTER": "yes",
    }  # fmt: skip


@given(st.text(alphabet="AB=(){}\"'<>/*#,. \n19", max_size=80))
def test_any_text_is_a_label_or_a_value_error(text: str) -> None:
    try:
        parse_label(text)
    except ValueError as error:
        assert "label" in str(error)  # noqa: PT017
    parse_vicar(text)


CASSINI = """
PRODUCT_ID = "1_N1473172656.118"  INSTRUMENT_HOST_NAME = "CASSINI ORBITER"  INSTRUMENT_ID = "ISSNA"
EXPOSURE_DURATION = 2600.000000  FILTER_NAME = ("CL1","CB2")  IMAGE_MID_TIME = 2004-250T14:12:42.032
START_TIME = 2004-250T14:12:40.732  STOP_TIME = 2004-250T14:12:43.332  INSTRUMENT_MODE_ID = "SUM2"
TARGET_NAME = "SATURN"  MISSING_LINES = 17  MISSING_PACKET_FLAG = "YES"
END
"""


def test_cassini() -> None:
    assert label_of(CASSINI, (512, 512)) == Label(
        "1_N1473172656.118", "coiss_nac", "512", "2004-09-06T14:12:40.732", "2004-09-06T14:12:42.032", 2.6,
        ("CL1", "CB2"), "SATURN", 2, 17, ("missing packets",),
    )  # fmt: skip
    without = CASSINI.replace("IMAGE_MID_TIME", "OTHER").replace("MISSING_LINES = 17", 'MISSING_LINES = "N/A"')
    found = label_of(without)
    assert found.mid_utc == "2004-09-06T14:12:42.032"
    assert found.missing_lines is None


# By the words of the Ring-Moon Systems Node's Voyager volumes.
VOYAGER = """
PRODUCT_ID = "C3450702_GEOMED.IMG"  INSTRUMENT_HOST_NAME = {"VOYAGER 1", VG1}  INSTRUMENT_ID = "ISSN"
IMAGE_TIME = 1980-10-29T09:58:10.00  START_TIME = 1980-10-29T09:58:08.08  STOP_TIME = 1980-10-29T09:58:10.00
EXPOSURE_DURATION = 1.920 <SECOND>  FILTER_NAME = VIOLET  TARGET_NAME = "S RINGS"  DATA_ANOMALY_FLAG = "STREAK"
END
"""


def test_voyager_closes_the_shutter_at_the_labels_time() -> None:
    found = label_of(VOYAGER, (1000, 1000))
    assert found == Label(
        "C3450702_GEOMED.IMG", "vgiss_1_na", "GEOMED", "1980-10-29T09:58:08.080", "1980-10-29T09:58:09.040", 1.92,
        ("VIOLET",), "S RINGS", None, None, ("STREAK",),
    )  # fmt: skip
    single = "\n".join(line for line in VOYAGER.splitlines() if "IMAGE_TIME" not in line)
    single = single.replace("END", "IMAGE_TIME = 1980-10-29T09:58:10.00\nEND").replace(" <SECOND>", "")
    assert label_of(single, (1000, 1000)).mid_utc == "1980-10-29T09:58:09.040"


GALILEO = """
SPACECRAFT_NAME = "GALILEO ORBITER"  INSTRUMENT_NAME = "SOLID STATE IMAGING SYSTEM"
IMAGE_TIME = 1999-10-11T04:51:12.894Z  IMAGE_ID = "24I0068"  TARGET_NAME = "IO"  FILTER_NAME = "CLEAR"
EXPOSURE_DURATION = 6.25  TELEMETRY_FORMAT_ID = "AI8"
END
"""


def test_galileos_time_is_the_middle() -> None:
    assert label_of(GALILEO, (400, 400)) == Label(
        "24I0068", "gossi", "400", "1999-10-11T04:51:12.890875", "1999-10-11T04:51:12.894", 0.00625, ("CLEAR",), "IO",
        2, None, (),
    )  # fmt: skip


def test_isis_cubes() -> None:
    text = """Object = IsisCube
      Group = Instrument
        SpacecraftName = Cassini-Huygens  InstrumentId = ISSWA  TargetName = Titan
        StartTime = 2005-004T10:00:00.5  ExposureDuration = 1000.0 <milliseconds>  InstrumentModeId = FULL
      End_Group
      Group = BandBin  FilterName = CL1/RED  End_Group
      Group = Archive  ProductId = 1_W123  End_Group
    End_Object
    End"""
    found = label_of(text)
    assert (found.block, found.mode, found.product_id, found.filters) == ("coiss_wac", "1024", "1_W123", ("CL1", "RED"))
    assert (found.mid_utc, found.exposure_s, found.target) == ("2005-01-04T10:00:01.000", 1.0, "Titan")


def test_pds4_labels() -> None:
    more = """<Time_Coordinates><start_date_time>2004-09-06T14:12:40.732Z</start_date_time>
      <stop_date_time>2004-09-06T14:12:43.332Z</stop_date_time></Time_Coordinates>
      <Observing_System><Observing_System_Component><name>Cassini Orbiter</name></Observing_System_Component>
      <Observing_System_Component><name>Cassini Imaging Science Subsystem - Narrow Angle Camera</name>
      </Observing_System_Component></Observing_System>
      <Target_Identification><name>Saturn</name></Target_Identification>
      <Mission_Area><x><exposure_duration unit="ms">2600</exposure_duration><filter_name>CL1</filter_name>
      <filter_name>CB2</filter_name></x></Mission_Area>"""
    header = parse_pds4(pds4_label("n.img", "UnsignedByte", (1024, 1024), product="n1473172656_1", more=more))
    found = said(header)
    assert found == Label(
        "n1473172656_1", "coiss_nac", "1024", "2004-09-06T14:12:40.732", "2004-09-06T14:12:42.032", 2.6, ("CL1", "CB2"),
        "Saturn", None, None, (),
    )  # fmt: skip


@needs_data
@pytest.mark.parametrize(
    ("name", "companion", "expected"),
    [
        ("images/C0532836239R.IMG", None, Label(
            "26E0001", "gossi", "800", "2000-01-03T18:02:23.549750", "2000-01-03T18:02:23.556", 0.0125003, ("CLEAR",),
            "EUROPA")),
        ("images/C2069302_RAW.IMG", None, Label(
            "C2069302", "vgiss_2_wa", "RAW", "1979-07-11T01:19:42.640", "1979-07-11T01:19:50.320", 15.36, ("CLEAR",),
            "J RINGS")),
        ("images/N1473172656_1.IMG", None, Label(
            "1_N1473172656.118", "coiss_nac", "1024", "2004-09-06T14:12:40.732", "2004-09-06T14:12:42.032", 2.6,
            ("CL1", "CB2"), "SATURN", 1, 0)),
        ("images/N1473172656_1.IMG", "images/N1473172656_1.LBL", Label(
            "1_N1473172656.118", "coiss_nac", "1024", "2004-09-06T14:12:40.732", "2004-09-06T14:12:42.032", 2.6,
            ("CL1", "CB2"), "SATURN", 1, 0)),
        ("eros_near/m0126865998f4_2p_iof.fit", "eros_near/m0126865998f4_2p_iof.lbl", Label(
            "M0126865998F4_2P_IOF.FIT", "nearmsi", "CALIB", "2000-02-25T05:16:12.656", "2000-02-25T05:16:12.700500",
            0.089, ("4",), "EROS")),
        ("eros_near/m0126865998f4_2p_iof.fit", None, Label(
            "M0126865998F4_2P_IOF.FIT", "nearmsi", "CALIB", None, None, 0.089, ("4",), "EROS")),
    ],
)  # fmt: skip
def test_real_labels(name: str, companion: str | None, expected: Label) -> None:
    beside = {} if companion is None else {companion.split("/")[-1]: (DATA / companion).read_bytes()}
    found = read_label(read_image((DATA / name).read_bytes(), name, beside), BLOCKS)
    assert found.exposure_s == pytest.approx(expected.exposure_s)
    assert {**found.document(), "exposure_s": 0} == {**expected.document(), "exposure_s": 0}


@needs_data
def test_lorri_cards() -> None:
    frame = sorted((DATA / "lorri").rglob("*.fit*"))[0]
    found = read_label(read_image(frame.read_bytes(), frame.name), BLOCKS)
    assert (found.block, found.mode, found.summation) == ("nhlorri", "4X4", 4)
    assert found.target
    assert found.mid_utc is not None
    assert found.exposure_s == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2004-250T14:12:42.032Z", datetime(2004, 9, 6, 14, 12, 42, 32000)), ("1979-001", datetime(1979, 1, 1)),
        ("1999-12-31T23:59:60", datetime(2000, 1, 1)), ("2000-02-25T05:16", datetime(2000, 2, 25, 5, 16)),
        ("UNK", None), ("", None), ("2004-13-01", None), ("1004-01-01", None), ("9999-366T24:00:00", None),
    ],
)  # fmt: skip
def test_times(text: str, expected: datetime | None) -> None:
    assert utc_of(text) == expected


@pytest.mark.parametrize("value", ["N/A", "UNK", -1.0, 1e300, True, float("inf"), float("nan")])
def test_unknown_exposures_are_none(value: CardValue) -> None:
    header: dict[str, CardValue] = {"INSTRUMENT_ID": "ISSNA", "EXPOSURE_DURATION": value,
                                    "START_TIME": "2004-09-06T14:12:40"}  # fmt: skip
    found = said(header)
    assert (found.exposure_s, found.mid_utc, found.start_utc) == (None, None, "2004-09-06T14:12:40.000")


def test_nothing_known_is_nothing_said() -> None:
    assert said({}) == Label()
    assert said({}, instrument="coiss_nac") == Label(block="coiss_nac", mode="1024")
    assert said({"EXPOSURE_DURATION": 5.0}).exposure_s is None
