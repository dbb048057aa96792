"""Products of the flyby sample as the missions' archives keep them: VICAR with a PDS3 label beside it, and FITS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from workflows.samples.attitude import wxyz_from_matrix
from workflows.samples.camera_table import PHOTZPT_1X1, PHOTZPT_4X4
from workflows.samples.flyby_expose import Taken
from workflows.samples.flyby_plan import Shot
from workflows.samples.flyby_system import sun_state
from workflows.samples.flyby_time import (
    CASSINI_CLOCK,
    NEW_HORIZONS_CLOCK,
    Clock,
    calendar_text,
    day_of_year_text,
    et_from_utc,
)
from workflows.samples.write import LORRI_HEADER_FLAG, LORRI_HEADER_PIXELS

Words = dict[str, str | int | float]

LABEL_BYTES = 3144
PREFIX_BYTES = 24
"""Binary bytes before each line of a raw Cassini image, and one record of them before the first."""
CASSINI_MODES = {1: "FULL", 2: "SUM2", 4: "SUM4"}


def _vicar_value(value: str | int | float) -> str:
    """Return a value as VICAR labels write it."""
    return f"'{value}'" if isinstance(value, str) else repr(value)


def vicar_file(
    pixels: NDArray[np.generic], system: Words, words: Words, prefix_bytes: int = 0, header_records: int = 0
) -> tuple[bytes, int]:
    """Return a VICAR file and the number of the record, from 1, in which its image begins.

    Parameters
    ----------
    pixels
        Image in the byte order that the system words tell.
    system
        Words that describe the host, after those of the format.
    words
        Properties and history.
    prefix_bytes, header_records
        Binary prefix of each line, and binary records before the first.
    """
    lines, samples = pixels.shape
    record = prefix_bytes + samples * pixels.dtype.itemsize
    size = -(-LABEL_BYTES // record) * record
    kind = {"u1": "BYTE", "i2": "HALF"}[pixels.dtype.str[1:]]
    first: Words = {
        "LBLSIZE": size, "FORMAT": kind, "TYPE": "IMAGE", "BUFSIZ": 20480, "DIM": 3, "EOL": 0, "RECSIZE": record,
        "ORG": "BSQ", "NL": lines, "NS": samples, "NB": 1, "N1": samples, "N2": lines, "N3": 1, "N4": 0,
        "NBB": prefix_bytes, "NLB": header_records,
    }  # fmt: skip
    text = "  ".join(f"{key}={_vicar_value(value)}" for key, value in (first | system | words).items())
    if len(text) >= size:
        raise ValueError(f"a VICAR label of {len(text)} bytes where {size} are kept")
    label = text.encode("ascii").ljust(size, b" " if not header_records else b"\0")
    body = np.zeros((lines, record), dtype=np.uint8)
    body[:, prefix_bytes:] = np.ascontiguousarray(pixels).view(np.uint8).reshape(lines, -1)
    return label + bytes(header_records * record) + body.tobytes(), size // record + header_records + 1


def pds3_label(
    file_name: str, size: int, record: int, first_image_record: int, words: list[str], image: list[str]
) -> str:
    """Return a detached PDS3 label of a VICAR file."""
    head = [
        "PDS_VERSION_ID = PDS3",
        "RECORD_TYPE = FIXED_LENGTH",
        f"RECORD_BYTES = {record}",
        f"FILE_RECORDS = {size // record}",
        f'^IMAGE_HEADER = ("{file_name}",1)',
        f'^IMAGE = ("{file_name}",{first_image_record})',
    ]
    header = ["OBJECT = IMAGE_HEADER", "  HEADER_TYPE = VICAR2", "END_OBJECT = IMAGE_HEADER"]
    lines = [*head, *words, *header, "OBJECT = IMAGE", *(f"  {line}" for line in image), "END_OBJECT = IMAGE", "END"]
    return "".join(f"{line}\r\n" for line in lines)


def _count_text(clock: Clock, et: float) -> str:
    seconds, parts = clock.fields(et)
    return f"{seconds}.{parts:03d}"


def _write_pair(shot: Shot, folder: Path, data: bytes, label: str) -> list[Path]:
    paths = [folder / f"{shot.image_id}.IMG", folder / f"{shot.image_id}.LBL"]
    paths[0].write_bytes(data)
    paths[1].write_text(label, encoding="ascii", newline="")
    return paths


def write_cassini(shot: Shot, taken: Taken, folder: Path) -> list[Path]:
    """Write a raw frame of one of Cassini's cameras; bytes where they suffice, else big-endian integers."""
    pixels = taken.image.astype("u1" if taken.as_bytes else ">i2")
    stop_et = et_from_utc(shot.stop_utc)
    start, stop = (_count_text(CASSINI_CLOCK, et_from_utc(utc)) for utc in (shot.start_utc, shot.stop_utc))
    mode, letter = CASSINI_MODES[shot.camera.summation], shot.camera.letter
    times = {
        "IMAGE_MID_TIME": shot.utc,
        "IMAGE_TIME": shot.stop_utc,
        "START_TIME": shot.start_utc,
        "STOP_TIME": shot.stop_utc,
    }
    common: Words = {
        "DATA_CONVERSION_TYPE": "8LSB" if taken.as_bytes else "12BIT",
        "EXPOSURE_DURATION": round(1000.0 * shot.exposure_s, 3),
        "GAIN_MODE_ID": f"{shot.camera.optics.gain_e_per_dn:.0f} ELECTRONS PER DN",
        "IMAGE_NUMBER": int(CASSINI_CLOCK.fields(stop_et)[0]),
        "INSTRUMENT_HOST_NAME": "CASSINI ORBITER",
        "INSTRUMENT_ID": f"ISS{letter}A",
        "INSTRUMENT_MODE_ID": mode,
        "INSTRUMENT_NAME": f"IMAGING SCIENCE SUBSYSTEM {'WIDE' if letter == 'W' else 'NARROW'} ANGLE",
        "MISSING_LINES": taken.missing_lines,
        "MISSION_NAME": "CASSINI-HUYGENS",
        "PRODUCT_ID": f"1_{letter}{stop}",
        "SPACECRAFT_CLOCK_CNT_PARTITION": 1,
        "SPACECRAFT_CLOCK_START_COUNT": start,
        "SPACECRAFT_CLOCK_STOP_COUNT": stop,
        "TARGET_NAME": shot.target,
    }
    host: Words = {
        "HOST": "SUN-SOLR", "INTFMT": "HIGH", "REALFMT": "IEEE", "BHOST": "SUN-SOLR", "BINTFMT": "HIGH",
        "BREALFMT": "IEEE", "BLTYPE": "CAS-ISS3", "PROPERTY": "IMAGE",
    }  # fmt: skip
    stamps: Words = {key: day_of_year_text(utc) + "Z" for key, utc in times.items()}
    data, first = vicar_file(pixels, host, common | stamps, PREFIX_BYTES, 1)
    words = [f"{key} = {_pds_value(value)}" for key, value in common.items() if key != "EXPOSURE_DURATION"]
    words.append(f"EXPOSURE_DURATION = {1000.0 * shot.exposure_s:.6f}")
    words += ['FILTER_NAME = ("CL1","CL2")'] + [f"{key} = {day_of_year_text(utc)}" for key, utc in times.items()]
    image = _image_object(pixels, "SUN_INTEGER", PREFIX_BYTES)
    record = PREFIX_BYTES + pixels.shape[1] * pixels.dtype.itemsize
    return _write_pair(shot, folder, data, pds3_label(f"{shot.image_id}.IMG", len(data), record, first, words, image))


def _pds_value(value: str | int | float) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _image_object(pixels: NDArray[np.generic], sample_type: str, prefix_bytes: int = 0) -> list[str]:
    lines = [
        f"LINES = {pixels.shape[0]}",
        f"LINE_SAMPLES = {pixels.shape[1]}",
        f"SAMPLE_BITS = {8 * pixels.dtype.itemsize}",
        f"SAMPLE_TYPE = {sample_type}",
    ]
    return lines + ([f"LINE_PREFIX_BYTES = {prefix_bytes}"] if prefix_bytes else [])


def write_voyager(shot: Shot, taken: Taken, folder: Path) -> list[Path]:
    """Write a geometrically corrected frame of Voyager's narrow camera, little-endian integers."""
    pixels = taken.image.astype("<i2")
    number = shot.image_id.removesuffix("_GEOMED").removeprefix("C")
    host: Words = {
        "HOST": "VAX-VMS", "INTFMT": "LOW", "REALFMT": "VAX", "BHOST": "VAX-VMS", "BINTFMT": "LOW", "BREALFMT": "VAX",
        "BLTYPE": "", "TASK": "GEOMA", "USER": "SAMPLE",
    }  # fmt: skip
    scet = shot.stop_utc.strftime("%y.%j %H:%M:%S")
    history: Words = {
        "LAB01": f"{'':<20}1000    1000 1000 1000 L 2".ljust(71) + "C",
        "LAB02": f"VGR-2   FDS {number[:5]}.{number[5:]}   SCET {scet}".ljust(71) + "C",
        "LAB03": f"NA CAMERA  EXP {1000.0 * shot.exposure_s:9.1f} MSEC FILT 0(CLEAR )  LO GAIN".ljust(71) + "C",
    }
    data, first = vicar_file(pixels, host, history)
    words = [
        'DATA_SET_ID = "VG2-S-ISS-2/3/4/6-PROCESSED-V1.1"',
        f'PRODUCT_ID = "{shot.image_id}.IMG"',
        'INSTRUMENT_HOST_NAME = "VOYAGER 2"',
        'INSTRUMENT_HOST_ID = "VG2"',
        'INSTRUMENT_NAME = "IMAGING SCIENCE SUBSYSTEM - NARROW ANGLE"',
        'INSTRUMENT_ID = "ISSN"',
        'MISSION_NAME = "VOYAGER"',
        f'TARGET_NAME = "{shot.target}"',
        f'IMAGE_NUMBER = "{number[:5]}.{number[5:]}"',
        f"IMAGE_TIME = {calendar_text(shot.stop_utc)}",
        f"START_TIME = {calendar_text(shot.start_utc)}",
        f"STOP_TIME = {calendar_text(shot.stop_utc)}",
        f"EXPOSURE_DURATION = {shot.exposure_s:.4f} <SECOND>",
        'FILTER_NAME = "CLEAR"',
        'GAIN_MODE_ID = "LOW"',
        'SHUTTER_MODE_ID = "NAONLY"',
    ]
    record = pixels.shape[1] * pixels.dtype.itemsize
    image = _image_object(pixels, "LSB_INTEGER")
    return _write_pair(shot, folder, data, pds3_label(f"{shot.image_id}.IMG", len(data), record, first, words, image))


def _lorri_cards(shot: Shot) -> list[tuple[str, str | int | float]]:
    """Return a LORRI header's cards; the attitude there is the C-kernel's, the Sun is as seen from the spacecraft."""
    optics, binned = shot.camera.optics, shot.camera.summation == 4
    w, x, y, z = (float(q) for q in wxyz_from_matrix(shot.apriori.T @ shot.camera.camera_from_instrument))
    sun, motion = sun_state(shot.et)
    sun, motion = sun - shot.position_km, motion - shot.velocity_kms
    axis = shot.apriori[2]
    return [
        ("MISSION", "New Horizons"), ("HOSTNAME", "NEW HORIZONS"), ("INSTRU", "lor"),
        ("APID", "0x633" if binned else "0x631"), ("MET", round(shot.et - NEW_HORIZONS_CLOCK.zero_et)),
        ("EXPTIME", shot.exposure_s), ("TARGET", shot.target), ("SPCQUAL", "PREDICT"), ("SPCSCID", -98),
        ("SPCINSID", -98300), ("SPCSCET", shot.et), ("SPCUTCAL", calendar_text(shot.utc)),
        ("SPCBRRA", float(np.degrees(np.arctan2(axis[1], axis[0])) % 360.0)),
        ("SPCBRDEC", float(np.degrees(np.arcsin(axis[2])))),
        ("SPCQA", w), ("SPCQX", x), ("SPCQY", y), ("SPCQZ", z),
        ("SPCSSCX", float(sun[0])), ("SPCSSCY", float(sun[1])), ("SPCSSCZ", float(sun[2])),
        ("SPCSSCVX", float(motion[0])), ("SPCSSCVY", float(motion[1])), ("SPCSSCVZ", float(motion[2])),
        ("SFORMAT", "4X4" if binned else "1X1"), ("BIASLEVL", 539.0), ("RDNOISE", optics.read_noise_dn),
        ("CCDGAIN", optics.gain_e_per_dn), ("PHOTZPT", PHOTZPT_4X4 if binned else PHOTZPT_1X1),
    ]  # fmt: skip


def write_lorri(shot: Shot, taken: Taken, folder: Path) -> list[Path]:
    """Write a LORRI level 2 frame: image, error and quality flags."""
    optics = shot.camera.optics
    primary = fits.PrimaryHDU(taken.image.astype(np.float32))
    for card in _lorri_cards(shot):
        primary.header.append(card)
    sigma = np.sqrt(optics.read_noise_dn**2 + np.maximum(taken.image, 0.0) / optics.gain_e_per_dn)
    flags = np.zeros(taken.image.shape, dtype=np.uint16)
    flags[0, :LORRI_HEADER_PIXELS] = LORRI_HEADER_FLAG
    extensions = [
        fits.ImageHDU(sigma.astype(np.float32), name="LORRI Error image"),
        fits.ImageHDU(flags, name="LORRI Quality flag image"),
    ]
    path = folder / f"{shot.image_id}.fit"
    fits.HDUList([primary, *extensions]).writeto(path)
    return [path]


def write_product(shot: Shot, taken: Taken, folder: Path) -> list[Path]:
    """Write a frame in its mission's form; returns the files."""
    writers = {"cassini": write_cassini, "voyager": write_voyager, "lorri": write_lorri}
    return writers[shot.camera.stored](shot, taken, folder)
