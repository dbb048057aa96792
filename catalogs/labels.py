"""What a product's label says of an image: when, how long, through which filter, at what, and what went wrong.

Labels of different families are first put into the words of PDS3, then read by one set of rules.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from catalogs.instruments import CardValue, Header, InstrumentBlock, identify, mode_of
from catalogs.raw_images import RawImage

if TYPE_CHECKING:
    from pipeline.curate import Json

Words = dict[str, CardValue]

# Outside these a figure is damage, and sums of them overflow.
_YEARS = (1900, 2200)
_LONGEST_EXPOSURE_S = 1e6
# What labels write where they do not know (PDS3 Standards Reference 17.2).
_UNKNOWN = ("", "N/A", "UNK", "UNKNOWN", "NULL", "NONE", "---")
_TIME = re.compile(
    r"(\d{4})(?:-(\d{2})-(\d{2})|-(\d{3}))(?:[T ](\d{2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?)?\s*Z?\s*", re.ASCII
)
# Voyager's label of 72-character lines, as VICAR's LAB02, LAB03 and LAB05 keep it.
_VGR_FRAME = re.compile(r"VGR-(\d)\s+FDS\s+(\d+)\.(\d+)")
_VGR_TIME = re.compile(r"SCET\s+(\d\d)\.(\d{3})\s+(\d\d:\d\d:\d\d)")
_VGR_SHUTTER = re.compile(r"(?:NA|WA) CAMERA\s+EXP\s+([\d.]+)\s*MSEC\s+FILT\s+\d\s*\(([^)]*)\)")
_VGR_TARGET = re.compile(r"OUT/\S+\s+(\S.*?)\s+DSS")
# Positions of SSI's filter wheel: Belton et al. 1992, Space Sci. Rev. 60, 413, table V.
_SSI_FILTERS = ("CLEAR", "GREEN", "RED", "VIOLET", "IR-7560", "IR-9680", "IR-7270", "IR-8890")
_SUMMED = {"FULL": 1, "SUM2": 2, "SUM4": 4, "1X1": 1, "4X4": 4, "HIS": 2, "AI8": 2}
_ANOMALY_KEYS = ("DATA_ANOMALY", "DATA_ANOMALY_FLAG", "DATA_ANOMALIES", "DATA_ANOMALY_DESC")


@dataclass(frozen=True)
class Label:
    """What the label says; None, or an empty tuple, where it does not.

    Attributes
    ----------
    product_id
        As the label writes it.
    block, mode
        Names of the camera's block and of its read-out mode.
    start_utc, mid_utc
        ISO-8601 UTC of the exposure's start and middle.
    exposure_s
        Seconds.
    filters
        Names, in the order of their wheels.
    target
        Name.
    summation
        Detector pixels per stored pixel, along either axis.
    missing_lines
        Lines that were never received.
    anomalies
        What the label or its archive calls wrong with the data.
    """

    product_id: str | None = None
    block: str | None = None
    mode: str | None = None
    start_utc: str | None = None
    mid_utc: str | None = None
    exposure_s: float | None = None
    filters: tuple[str, ...] = ()
    target: str | None = None
    summation: int | None = None
    missing_lines: int | None = None
    anomalies: tuple[str, ...] = ()

    def document(self) -> "dict[str, Json]":
        """As JSON values."""
        return {
            "product_id": self.product_id, "block": self.block, "mode": self.mode, "start_utc": self.start_utc,
            "mid_utc": self.mid_utc, "exposure_s": self.exposure_s, "filters": [*self.filters],
            "target": self.target, "summation": self.summation, "missing_lines": self.missing_lines,
            "anomalies": [*self.anomalies],
        }  # fmt: skip


def read_label(raw: RawImage, blocks: Mapping[str, InstrumentBlock], instrument: str | None = None) -> Label:
    """What an image's label says.

    Parameters
    ----------
    raw
        Image with its keywords.
    blocks
        Camera blocks by name.
    instrument
        Name of the block where the archive says it; by default the label is recognised.

    Returns
    -------
    Label
        Never refused: what cannot be understood is None.
    """
    block = blocks[instrument] if instrument is not None else identify(raw.header, blocks)
    name = next((name for name, candidate in blocks.items() if candidate is block), None)
    words = in_pds3_words(raw.header)
    exposure = _exposure(words, block)
    start, middle = _times(words, block, exposure)
    return Label(
        product_id=_text(words, "PRODUCT_ID"), block=name,
        mode=None if block is None else mode_of(block, raw.pixels.shape, raw.header),
        start_utc=None if start is None else _iso(start), mid_utc=None if middle is None else _iso(middle),
        exposure_s=exposure, filters=_filters(words), target=_text(words, "TARGET_NAME"),
        summation=_summation(words), missing_lines=_count(words, "MISSING_LINES"), anomalies=_anomalies(words),
    )  # fmt: skip


def in_pds3_words(header: Header) -> Words:
    """Keywords of a label with those of PDS3 that follow from another family's.

    Parameters
    ----------
    header
        Keywords of any label.

    Returns
    -------
    dict
        Only keywords that this module reads; what the label itself calls so wins.
    """
    words: Words = {}
    for key in _READ:
        value = header.get(key)
        if value is not None and str(value).strip().upper() not in _UNKNOWN:
            words[key] = value
    said = set(words)
    for translate in (_voyager, _galileo, _lorri, _near, _isis, _pds4):
        for key, value in translate(header).items():
            # A unit belongs to its figure: it comes with it or not at all.
            if key.removesuffix(".unit") not in said:
                words.setdefault(key, value)
    return words


_READ = (
    "PRODUCT_ID", "START_TIME", "STOP_TIME", "IMAGE_MID_TIME", "IMAGE_TIME", "EXPOSURE_DURATION",
    "EXPOSURE_DURATION.unit", "FILTER_NAME", "TARGET_NAME", "MISSING_LINES", "MISSING_PACKET_FLAG",
    "INSTRUMENT_MODE_ID", "TELEMETRY_FORMAT_ID", *_ANOMALY_KEYS,
)  # fmt: skip


def _voyager(header: Header) -> Words:
    lines = [str(header.get(f"LAB0{n}", "")) for n in (2, 3, 5)]
    frame, time = _VGR_FRAME.search(lines[0]), _VGR_TIME.search(lines[0])
    shutter, target = _VGR_SHUTTER.search(lines[1]), _VGR_TARGET.search(lines[2])
    words: Words = {}
    if frame:
        words["PRODUCT_ID"] = f"C{frame[2]}{frame[3]}"
    if time:
        words["IMAGE_TIME"] = f"19{time[1]}-{time[2]}T{time[3]}"
    if shutter:
        words |= {"EXPOSURE_DURATION": float(shutter[1]), "EXPOSURE_DURATION.unit": "ms"}
        words["FILTER_NAME"] = shutter[2].strip()
    if target:
        words["TARGET_NAME"] = target[1].replace("_", " ")
    return words


def _galileo(header: Header) -> Words:
    if str(header.get("SENSOR", "")).strip() != "SSI":
        image = header.get("IMAGE_ID")
        return {} if image is None else {"PRODUCT_ID": image}
    words: Words = {}
    year, day, hour, minute, second, milli = (
        header.get(f"SCET{part}") for part in ("YEAR", "DAY", "HOUR", "MIN", "SEC", "MSEC")
    )
    if all(isinstance(part, int) for part in (year, day, hour, minute, second, milli)):
        words["IMAGE_TIME"] = f"{year:04d}-{day:03d}T{hour:02d}:{minute:02d}:{second:02d}.{milli:03d}"
    wheel = header.get("FILTER")
    if isinstance(wheel, int) and 0 <= wheel < len(_SSI_FILTERS):
        words["FILTER_NAME"] = _SSI_FILTERS[wheel]
    pairs = {
        "PICNO": "PRODUCT_ID",
        "TARGET": "TARGET_NAME",
        "EXP": "EXPOSURE_DURATION",
        "TLMFMT": "TELEMETRY_FORMAT_ID",
    }
    words |= {theirs: header[own] for own, theirs in pairs.items() if own in header}
    return words | ({"EXPOSURE_DURATION.unit": "ms"} if "EXP" in header else {})


def _lorri(header: Header) -> Words:
    if str(header.get("INSTRU", "")).strip().lower() != "lor":
        return {}
    # SPCUTCAL is the middle of the exposure: STARTMET and half of EXPTIME (SOC-to-instrument ICD).
    pairs = {
        "SPCUTCAL": "IMAGE_MID_TIME", "EXPTIME": "EXPOSURE_DURATION", "TARGET": "TARGET_NAME",
        "SFORMAT": "INSTRUMENT_MODE_ID", "FILENAME": "PRODUCT_ID",
    }  # fmt: skip
    words = {theirs: value for own, theirs in pairs.items() if (value := header.get(own)) is not None}
    return words | ({"EXPOSURE_DURATION.unit": "s"} if "EXPOSURE_DURATION" in words else {})


def _near(header: Header) -> Words:
    if not str(header.get("NEAR-005", "")).startswith("MSI") and header.get("INSTRUMENT_ID") != "MSI":
        return {}
    pairs = {"NEAR-003": "PRODUCT_ID", "NEAR-010": "EXPOSURE_DURATION", "NEAR-047": "TARGET_NAME"}
    words = {theirs: value for own, theirs in pairs.items() if (value := header.get(own)) is not None}
    wheel = header.get("FILTER_NUMBER", header.get("NEAR-009"))
    words |= {} if wheel is None else {"FILTER_NAME": str(wheel).strip()}
    return words | ({"EXPOSURE_DURATION.unit": "ms"} if "EXPOSURE_DURATION" in words else {})


def _isis(header: Header) -> Words:
    pairs = {
        "Archive.ProductId": "PRODUCT_ID", "Instrument.StartTime": "START_TIME", "Instrument.StopTime": "STOP_TIME",
        "Instrument.ExposureDuration": "EXPOSURE_DURATION", "BandBin.FilterName": "FILTER_NAME",
        "Instrument.ExposureDuration.unit": "EXPOSURE_DURATION.unit", "Instrument.TargetName": "TARGET_NAME",
        "Instrument.ImageMidTime": "IMAGE_MID_TIME", "Instrument.MissingLines": "MISSING_LINES",
        "Instrument.InstrumentModeId": "INSTRUMENT_MODE_ID", "Instrument.TelemetryFormat": "TELEMETRY_FORMAT_ID",
    }  # fmt: skip
    words = {theirs: header.get(f"IsisCube.{own}") for own, theirs in pairs.items()}
    # ISIS joins two wheels by '/'.
    return {key: str(v).replace("/", ",") if key == "FILTER_NAME" else v for key, v in words.items() if v is not None}


def _pds4(header: Header) -> Words:
    if "Identification_Area.logical_identifier" not in header:
        return {}
    leaves = {
        "start_date_time": "START_TIME", "stop_date_time": "STOP_TIME", "exposure_duration": "EXPOSURE_DURATION",
        "exposure_duration.unit": "EXPOSURE_DURATION.unit", "filter_name": "FILTER_NAME",
        "image_mid_time": "IMAGE_MID_TIME", "missing_lines": "MISSING_LINES",
        "instrument_mode_id": "INSTRUMENT_MODE_ID",
    }  # fmt: skip
    words: Words = {"PRODUCT_ID": str(header["Identification_Area.logical_identifier"]).rpartition(":")[2]}
    for path, value in header.items():
        parts = path.split(".")
        leaf = ".".join(parts[-2:]) if parts[-1] == "unit" else parts[-1]
        if leaf in leaves:
            words.setdefault(leaves[leaf], value)
    target = header.get("Observation_Area.Target_Identification.name")
    return words | ({} if target is None else {"TARGET_NAME": str(target).split(",")[0]})


def _text(words: Words, key: str) -> str | None:
    value = words.get(key)
    text = "" if value is None else str(value).strip()
    return None if text.upper() in _UNKNOWN else text


def _exposure(words: Words, block: InstrumentBlock | None) -> float | None:
    value = words.get("EXPOSURE_DURATION")
    unit = str(words.get("EXPOSURE_DURATION.unit", "" if block is None else block.exposure_unit)).lower()
    if not isinstance(value, int | float) or isinstance(value, bool) or not unit:
        return None
    seconds = value / 1000.0 if unit.startswith(("ms", "milli")) else float(value)
    return seconds if 0 <= seconds < _LONGEST_EXPOSURE_S else None


def _times(
    words: Words, block: InstrumentBlock | None, exposure: float | None
) -> tuple[datetime | None, datetime | None]:
    """Start and middle of the exposure.

    Voyager's IMAGE_TIME and STOP_TIME are taken for the shutter's closing, as the Ring-Moon Systems Node's software
    does; ISIS takes the same figure for the read-out and closes the shutter two seconds before it.
    Galileo's IMAGE_TIME is the middle of the exposure (ISIS, SsiCamera).
    """
    start, stop, middle, single = (
        utc_of(str(words.get(key, ""))) for key in ("START_TIME", "STOP_TIME", "IMAGE_MID_TIME", "IMAGE_TIME")
    )
    half = None if exposure is None else timedelta(seconds=exposure / 2)
    convention = "start" if block is None else block.image_time
    if middle is None and convention == "middle":
        middle = single
    elif middle is None and convention == "end" and half is not None:
        closed = stop or single
        middle = None if closed is None else closed - half
    if middle is None and half is not None and (opened := start or single) is not None:
        middle = opened + half
    if middle is None and start is not None and stop is not None:
        middle = start + (stop - start) / 2
    if start is None and middle is not None and half is not None:
        start = middle - half
    return start, middle


def utc_of(text: str) -> datetime | None:
    """Time of a label.

    Parameters
    ----------
    text
        ISO-8601, by month and day or by day of the year.

    Returns
    -------
    datetime or None
        UTC without a zone; None where the text is no time.
    """
    match = _TIME.fullmatch(text.strip())
    if match is None:
        return None
    year, month, day, of_year, hour, minute, second = match.groups()
    if not _YEARS[0] <= int(year) <= _YEARS[1]:
        return None
    try:
        date = datetime(int(year), int(month or 1), int(day or 1)) + timedelta(days=int(of_year or 1) - 1)
        # By hand: the sixtieth second of a leap becomes the next minute, which costs a second once in years.
        return date + timedelta(hours=int(hour or 0), minutes=int(minute or 0), seconds=float(second or 0.0))
    except (ValueError, OverflowError):
        return None


def _iso(time: datetime) -> str:
    return time.isoformat(timespec="milliseconds" if time.microsecond % 1000 == 0 else "microseconds")


def _filters(words: Words) -> tuple[str, ...]:
    names = (name.strip() for name in str(words.get("FILTER_NAME", "")).split(","))
    return tuple(name for name in names if name.upper() not in _UNKNOWN)


def _summation(words: Words) -> int | None:
    modes = (str(words.get(key, "")).strip().upper() for key in ("INSTRUMENT_MODE_ID", "TELEMETRY_FORMAT_ID"))
    return next((_SUMMED[mode] for mode in modes if mode in _SUMMED), None)


def _count(words: Words, key: str) -> int | None:
    value = words.get(key)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None


def _anomalies(words: Words) -> tuple[str, ...]:
    found = [text for key in _ANOMALY_KEYS if (text := _text(words, key)) is not None and text.upper() != "NO"]
    if str(words.get("MISSING_PACKET_FLAG", "")).strip().upper() == "YES":
        found.append("missing packets")
    return tuple(dict.fromkeys(found))
