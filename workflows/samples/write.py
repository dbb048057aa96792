"""Write one frame of the star sample: image, sidecar or header, and the rows of the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from workflows.samples.attitude import LORRI_CAMERA_FROM_INSTRUMENT, wxyz_from_matrix
from workflows.samples.camera_table import PHOTZPT_1X1, PHOTZPT_4X4
from workflows.samples.cameras import FloatArray, SampleCamera
from workflows.samples.plan import MET_OF_ET_S, FramePlan, inside
from workflows.samples.render import add_stars, expose, lose_lines, sky_background
from workflows.samples.scene import Sources, catalogue_sources, compose, is_detectable, join_sources
from workflows.samples.sky import AU_KM

Json = dict[str, "JsonValue"]
JsonValue = str | int | float | bool | None | list["JsonValue"] | Json

TruthColumns = dict[str, list[str] | list[float] | list[bool]]

CATALOGUE_KINDS = ("catalogue", "moved", "variable", "double")
LORRI_HEADER_PIXELS = 34
"""The first pixels of a LORRI frame carry its header instead of light; level 2 flags them."""
LORRI_HEADER_FLAG = 32
"""The flag value seen on them in level 2 frames."""


@dataclass(frozen=True)
class FrameTruth:
    """What is known of one frame: its entry of truth.json and the columns of its rows of truth_stars.parquet."""

    image_id: str
    entry: Json
    stars: TruthColumns


def refuse_used(directory: Path) -> None:
    """Raise FileExistsError unless a directory is empty or not there."""
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise FileExistsError(f"{directory} is not an empty directory")


def write_frame(plan: FramePlan, folder: Path) -> FrameTruth:
    """Render a planned frame and write it into a folder; returns its truth."""
    camera = plan.camera
    rng = np.random.default_rng([plan.seed, plan.index, 1])
    shining, stray, hits = compose(plan, rng)
    light = sky_background(camera, rng)
    add_stars(light, camera, shining, plan.exposure)
    image = expose(light, camera, hits, rng)
    expected = _expected_places(plan)
    missing, lost = lose_lines(camera, expected, rng)
    if camera.missing_value is not None:
        image[missing] = camera.missing_value
    if camera.is_lorri:
        _write_lorri(plan, image, folder)
    else:
        _write_raw(plan, image, folder)
    sources = join_sources([shining, stray])
    sources = sources.take(inside(camera, sources.vu))
    entry = _truth_entry(plan, len(expected) - int(lost.sum()), sources, missing)
    return FrameTruth(plan.image_id, entry, _truth_rows(plan, sources, image))


def _expected_places(plan: FramePlan) -> FloatArray:
    """Return the true pixels (n, 2) of the catalogue stars that should rise above five sigma."""
    from_catalogue = catalogue_sources(plan)
    return from_catalogue.vu[is_detectable(plan.camera, from_catalogue)]


def _numbers(array: FloatArray) -> list[JsonValue]:
    """Return an array's numbers as nested lists for JSON."""
    numbers: list[JsonValue] = array.tolist()
    return numbers


def _camera_model(camera: SampleCamera) -> Json:
    """Return the sidecar's description of a camera."""
    return {
        "shape_vu": list(camera.shape_vu),
        "focal_length_mm": camera.focal_length_mm,
        "k_px_per_mm": [list(row) for row in camera.k_px_per_mm],
        "principal_point_vu": list(camera.principal_point_vu),
        "distortion_eps": list(camera.distortion_eps),
        "psf_sigma_px": camera.psf_sigma_px,
        "read_noise_dn": camera.read_noise_dn,
        "saturation_dn": camera.saturation_dn,
        "missing_value": camera.missing_value,
        "star_dn_per_s_mag0": camera.star_dn_per_s_mag0,
    }


def sidecar(plan: FramePlan) -> Json:
    """Return the geometry/1 record of a frame: everything the navigator may know, nothing of the truth."""
    camera, observer = plan.camera, plan.observer
    attitude: Json = {"camera_from_j2000_wxyz": _numbers(wxyz_from_matrix(plan.apriori))}
    if plan.exposure.trail_px(camera) > 0.0:
        attitude["rate_rad_s"] = _numbers(plan.exposure.rate_rad_s)
    return {
        "schema": "geometry/1",
        "image_id": plan.image_id,
        "mission": camera.mission,
        "camera": camera.instrument,
        "mid_time_utc": plan.utc,
        "exposure_s": plan.exposure.seconds,
        "camera_model": _camera_model(camera),
        "gain_e_per_dn": camera.gain_e_per_dn,
        "bias_dn": camera.bias_dn,
        "fit_camera_rotation": camera.fit_camera_rotation,
        "max_rotation_deg": 5.0 if camera.fit_camera_rotation else 0.0,
        "search_margin_vu": list(camera.search_margin_vu),
        "attitude": attitude,
        "spacecraft": {
            "position_km_ssb": _numbers(observer.position_au * AU_KM),
            "velocity_kms_ssb": _numbers(observer.velocity_kms),
        },
        "bodies": [],
        "rings": None,
    }


def _write_raw(plan: FramePlan, image: FloatArray, folder: Path) -> None:
    """Write an integer frame and its sidecar."""
    hdu = fits.PrimaryHDU(image.astype(np.int16))
    hdu.writeto(folder / f"{plan.image_id}.fits")
    text = json.dumps(sidecar(plan), indent=1)
    (folder / f"{plan.image_id}.geometry.json").write_text(text + "\n", encoding="utf-8")


def lorri_cards(plan: FramePlan) -> list[tuple[str, str | int | float, str]]:
    """Return the header cards of level 2 LORRI frames that tell the geometry and the calibration.

    The quaternion turns instrument vectors into J2000 ones; the Sun is given as seen from the spacecraft, so signs are
    reversed. Sun and barycentre are taken for one point: they are 0.01 au and 0.02 km/s apart, which moves no star by a
    hundredth of a pixel.
    """
    camera, exposure = plan.camera, plan.exposure
    w, x, y, z = wxyz_from_matrix(plan.apriori.T @ LORRI_CAMERA_FROM_INSTRUMENT)
    sun = -plan.observer.position_au * AU_KM
    motion = -plan.observer.velocity_kms
    rate = LORRI_CAMERA_FROM_INSTRUMENT.T @ exposure.rate_rad_s * 1.0e6
    axis = plan.apriori[2]
    return [
        ("MISSION", "New Horizons", "Mission name"),
        ("HOSTNAME", "NEW HORIZONS", "Host name (PDS terminology)"),
        ("INSTRU", "lor", "Instrument"),
        ("APID", "0x633" if camera.name.endswith("4x4") else "0x631", "Application ID of science data"),
        ("MET", round(plan.et - MET_OF_ET_S), "First packet MET"),
        ("EXPTIME", exposure.seconds, "Exposure time"),
        ("TARGET", plan.field, "Intended target"),
        ("SPCQUAL", "PREDICT", "QUALITY: PREDICT (poor); RECONSTRUCTED"),
        ("SPCSCID", -98, "[SPICE ID] Spacecraft"),
        ("SPCINSID", -98300, "[SPICE ID] Instrument"),
        ("SPCSCET", plan.et, "[s past J2000] Spacecraft mid-obs time, TDB"),
        ("SPCUTCAL", plan.utc, "[Cal d] Spacecraft mid-obs time, UTC"),
        ("SPCBRRA", float(np.degrees(np.arctan2(axis[1], axis[0])) % 360.0), "[degrees] Boresight RA, EME J2000"),
        ("SPCBRDEC", float(np.degrees(np.arcsin(axis[2]))), "[degrees] Boresight DEC, EME J2000"),
        ("SPCQA", float(w), "cos(theta/2)     - Quaternion to transform"),
        ("SPCQX", float(x), "sin(theta/2) * X -   instrument vectors"),
        ("SPCQY", float(y), "sin(theta/2) * Y -   to EME J2000 vectors"),
        ("SPCQZ", float(z), "sin(theta/2) * Z -   ***N.B. SPICE FORMAT"),
        ("RATEX", float(rate[0]), "[urad/s] Angular rate about inst frame +X axis"),
        ("RATEY", float(rate[1]), "[urad/s] Angular rate about inst frame +Y axis"),
        ("RATEZ", float(rate[2]), "[urad/s] Angular rate about inst frame +Z axis"),
        ("SPCSSCX", float(sun[0]), "[km] Sun vec wrt S/C observer, X, EMEJ2000"),
        ("SPCSSCY", float(sun[1]), "[km] Sun vec wrt S/C obs, Y"),
        ("SPCSSCZ", float(sun[2]), "[km] Sun vec wrt S/C obs, Z"),
        ("SPCSSCVX", float(motion[0]), "[km/s] Sun vel vec wrt S/C obs, X"),
        ("SPCSSCVY", float(motion[1]), "[km/s] Sun vel vec wrt S/C obs, Y"),
        ("SPCSSCVZ", float(motion[2]), "[km/s] Sun vel vec wrt S/C obs, Z"),
        ("SFORMAT", "4X4" if camera.name.endswith("4x4") else "1X1", "Image format"),
        ("BIASLEVL", 539.0, "median bias level of dark columns, units=DN"),
        ("RDNOISE", camera.read_noise_dn, "Read noise, units=DN"),
        ("CCDGAIN", camera.gain_e_per_dn, "CCD gain, units=e/DN"),
        ("PHOTZPT", PHOTZPT_4X4 if camera.name.endswith("4x4") else PHOTZPT_1X1, "Zero point for visual magnitude, V"),
    ]


def _write_lorri(plan: FramePlan, image: FloatArray, folder: Path) -> None:
    """Write a LORRI level 2 frame: image, error and quality flags, geometry in the header."""
    camera = plan.camera
    primary = fits.PrimaryHDU(image.astype(np.float32))
    for card in lorri_cards(plan):
        primary.header.append(card)
    sigma = np.sqrt(camera.read_noise_dn**2 + np.maximum(image, 0.0) / camera.gain_e_per_dn)
    flags = np.zeros(image.shape, dtype=np.uint16)
    flags[0, :LORRI_HEADER_PIXELS] = LORRI_HEADER_FLAG
    extensions = [
        fits.ImageHDU(sigma.astype(np.float32), name="LORRI Error image"),
        fits.ImageHDU(flags, name="LORRI Quality flag image"),
    ]
    fits.HDUList([primary, *extensions]).writeto(folder / f"{plan.image_id}.fits")


def _truth_rows(plan: FramePlan, sources: Sources, image: FloatArray) -> TruthColumns:
    """Return the rows of everything point-like on the array."""
    at = tuple(np.rint(sources.vu).astype(int).T)
    return {
        "image_id": [plan.image_id] * len(sources.snr),
        "star_id": sources.star_id.tolist(),
        "v_px": sources.vu[:, 0].tolist(),
        "u_px": sources.vu[:, 1].tolist(),
        "flux_dn": sources.flux_dn.tolist(),
        "kind": sources.kind.tolist(),
        "snr": sources.snr.tolist(),
        "saturated": (image[at] >= plan.camera.saturation_dn).tolist(),
    }


def _truth_entry(plan: FramePlan, n_stars: int, sources: Sources, missing: NDArray[np.bool_]) -> Json:
    """Return a frame's entry of truth.json."""
    kind = "empty" if n_stars == 0 else "few" if n_stars <= 2 else "field" if n_stars <= 40 else "rich"
    return {
        "offset_dv_px": float(plan.offset_vu[0]),
        "offset_du_px": float(plan.offset_vu[1]),
        "rotation_deg": float(np.degrees(plan.rotation_rad)),
        "n_stars": n_stars,
        "n_false": int((~np.isin(sources.kind, CATALOGUE_KINDS)).sum()),
        "n_odd": int(np.isin(sources.kind, CATALOGUE_KINDS[1:]).sum()),
        "camera": plan.camera.name,
        "kind": kind,
        "field": plan.field,
        "exposure_s": plan.exposure.seconds,
        "smear_px": plan.exposure.trail_px(plan.camera),
        "missing_px": int(missing.sum()),
        "true_camera_from_j2000_wxyz": _numbers(wxyz_from_matrix(plan.truth)),
    }
