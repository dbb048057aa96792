"""The flyby sample's archive: kernels read back by SPICE, products by the readers, and the truth against both."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import spiceypy
import yaml
from numpy.typing import NDArray

from catalogs.images import read_image
from catalogs.labels import Label, read_label
from tests.support import pilotage
from workflows.config import load_configuration
from workflows.samples.cameras import project, unproject
from workflows.samples.flyby import make_flyby_sample
from workflows.samples.flyby_cameras import SPACECRAFT, flyby_cameras
from workflows.samples.flyby_kernels import write_kernels
from workflows.samples.flyby_options import TRAPS, FlybyOptions
from workflows.samples.flyby_plan import Shot, plan_shot, plan_shots
from workflows.samples.flyby_system import BODIES, MOONS, PLANET, body_named, body_state, see, sun_state
from workflows.samples.flyby_time import (
    CASSINI_CLOCK,
    J2000,
    LEAP_SECONDS,
    VOYAGER_CLOCK,
    calendar_text,
    day_of_year_text,
    et_from_utc,
)

Floats = NDArray[np.float64]
OPTIONS = FlybyOptions(
    frames=8, seed=5, processes=1, cameras=("lorri_4x4", "voyager_na", "lorri_4x4", "cassini_nac_sum2"), smooth=True,
    diameter_px=(6.0, 120.0), star_share=0.5, trap_share=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sample of smooth bodies."""
    folder = tmp_path_factory.mktemp("flyby") / "archive"
    make_flyby_sample(folder, OPTIONS)
    return folder


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    return plan_shots(OPTIONS)


@pytest.fixture
def kernels(archive: Path) -> Iterator[None]:
    """The sample's kernels, loaded from their own folder as the meta-kernel wants it."""
    before = Path.cwd()
    os.chdir(archive / "kernels")
    try:
        spiceypy.kclear()
        spiceypy.furnsh("meta.tm")
        yield
    finally:
        spiceypy.kclear()
        os.chdir(before)


def _truth(archive: Path) -> dict[str, dict[str, object]]:
    frames = json.loads((archive / "truth.json").read_text())["frames"]
    assert isinstance(frames, dict)
    return frames


def _read(archive: Path, shot: Shot) -> tuple[NDArray[np.generic], Label]:
    """Pixels and label as the project's own readers see a product."""
    folder = archive / "data"
    if shot.camera.stored == "lorri":
        raw = read_image((folder / f"{shot.image_id}.fit").read_bytes(), shot.image_id)
    else:
        label = {f"{shot.image_id}.LBL": (folder / f"{shot.image_id}.LBL").read_bytes()}
        raw = read_image((folder / f"{shot.image_id}.IMG").read_bytes(), f"{shot.image_id}.IMG", label)
    return raw.pixels, read_label(raw, load_configuration().instruments)


@pytest.mark.usefixtures("kernels")
def test_times_are_spices(shots: list[Shot]) -> None:
    for shot in shots:
        assert spiceypy.str2et(calendar_text(shot.utc)) == pytest.approx(shot.et, abs=1e-6)
        assert spiceypy.str2et(day_of_year_text(shot.utc)) == pytest.approx(shot.et, abs=1e-6)
        clock = shot.camera.spacecraft.clock
        # Half a tick, which SPICE may round either way.
        assert spiceypy.sce2c(clock.spacecraft_id, shot.et) == pytest.approx(clock.ticks(shot.et), abs=1.0)
    assert spiceypy.str2et("2017-01-01T00:00:00") - spiceypy.str2et("2016-12-31T23:59:59") == pytest.approx(
        2.0, abs=1e-6
    )


def test_clocks_show_what_real_labels_tell() -> None:
    stop = J2000.replace(year=2004, month=9, day=6, hour=14, minute=12, second=43, microsecond=332_000)
    assert CASSINI_CLOCK.fields(et_from_utc(stop)) == (1_473_172_656, 118)
    assert VOYAGER_CLOCK.fields(et_from_utc(VOYAGER_CLOCK.known_utc)) == (20_693, 2, 1)
    assert len(LEAP_SECONDS) == 28


@pytest.mark.usefixtures("kernels")
def test_attitudes_are_the_truth_less_the_planted_error(shots: list[Shot]) -> None:
    for shot in shots:
        camera = shot.camera
        told = camera.camera_from_instrument @ spiceypy.pxform("J2000", camera.frame, shot.et)
        assert np.abs(told - shot.apriori).max() < 1e-12
        sky = np.array([[0.0, 0.0], [0.0, 5.0], [5.0, 0.0]]) + camera.optics.centre_vu
        angle = shot.rotation_rad
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        wanted = camera.optics.centre_vu + (sky - camera.optics.centre_vu) @ turn.T + shot.offset_vu
        # What the told attitude shows at a pixel, seen by the true one.
        found = project(camera.optics, unproject(camera.optics, sky) @ told @ shot.truth.T)
        assert np.abs(found[0] - wanted[0]).max() < 1e-6
        # Distortion bends the frame by a thousandth.
        assert np.abs(found - wanted).max() < 0.02


@pytest.mark.usefixtures("kernels")
def test_places_are_spices(shots: list[Shot]) -> None:
    for shot in shots:
        craft = str(shot.camera.spacecraft.naif_id)
        for sighting in shot.sightings():
            place, light_time = spiceypy.spkpos(sighting.body.name, shot.et, "J2000", "CN+S", craft)
            # SPICE turns by asin(v/c sin), special relativity by (v/c)^2 / 4 less or so: 1e-9 at 30 km/s.
            assert np.linalg.norm(place - sighting.place_km) < 4e-9 * sighting.range_km
            then = shot.et - light_time
            turned = spiceypy.pxform("J2000", f"IAU_{sighting.body.name}", then)
            assert np.abs(turned - sighting.from_j2000).max() < 1e-9
            assert np.abs(spiceypy.tipbod("J2000", sighting.body.naif_id, then) - turned).max() < 1e-12
            sun, _ = spiceypy.spkpos("SUN", then, "J2000", "LT", sighting.body.name)
            assert np.abs(sun / np.linalg.norm(sun) - sighting.sun).max() < 1e-9
            assert tuple(spiceypy.bodvcd(sighting.body.naif_id, "RADII", 3)[1]) == sighting.body.radii_km


@pytest.mark.usefixtures("kernels")
def test_orbits_are_smooth_between_the_kernels_states(shots: list[Shot]) -> None:
    start = min(shot.et for shot in shots if shot.camera.stored == "voyager")
    for et in start + np.linspace(-80_000.0, 80_000.0, 37):
        for body in BODIES:
            theirs, _ = spiceypy.spkezr(body.name, float(et), "J2000", "NONE", "SSB")
            place, velocity = body_state(body, float(et))
            assert np.linalg.norm(theirs[:3] - place) < 1e-3  # of 1e9 km
            assert np.linalg.norm(theirs[3:] - velocity) < 1e-7


def test_velocities_are_the_derivatives_of_places() -> None:
    for body in BODIES:
        ahead, behind = (body_state(body, 1.0e8 + s)[0] for s in (50.0, -50.0))
        assert np.abs((ahead - behind) / 100.0 - body_state(body, 1.0e8)[1]).max() < 1e-4
    assert np.abs(sun_state(100.0)[0] - sun_state(0.0)[0] - 100.0 * sun_state(0.0)[1]).max() < 1e-9


def test_light_time_and_aberration_move_a_body_as_they_should() -> None:
    moon = MOONS[2]
    place, velocity = body_state(moon, 0.0)
    away = place + np.array([3.0e6, 0.0, 0.0])
    seen = see(moon, 0.0, away, velocity)
    # To one who moves along with the moon both effects on its direction cancel.
    assert np.abs(seen.place_km / seen.range_km - (place - away) / 3.0e6).max() < 1e-8
    still = see(moon, 0.0, away, np.zeros(3))
    lag = 3.0e6 / 299_792.458
    assert np.linalg.norm(still.place_km - (body_state(moon, -lag)[0] - away)) < 0.1


@pytest.mark.usefixtures("kernels")
def test_truth_is_where_the_kernels_and_the_planted_error_put_the_target(archive: Path, shots: list[Shot]) -> None:
    truth = _truth(archive)
    assert list(truth) == [shot.image_id for shot in shots]
    for shot in shots:
        entry, optics = truth[shot.image_id], shot.camera.optics
        place, _ = spiceypy.spkpos(str(entry["target"]), shot.et, "J2000", "CN+S", str(shot.camera.spacecraft.naif_id))
        told = shot.camera.camera_from_instrument @ spiceypy.pxform("J2000", shot.camera.frame, shot.et)
        predicted = project(optics, (told @ place)[None])[0]
        angle = np.radians(float(str(entry["rotation_deg"])))
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        offset = np.array([entry["offset_dv_px"], entry["offset_du_px"]], dtype=float)
        actual = optics.centre_vu + turn @ (predicted - optics.centre_vu) + offset
        found = predicted + np.array([entry["target_dv_px"], entry["target_du_px"]], dtype=float)
        # A tilt is not quite a shift far from the centre.
        assert np.abs(actual - found).max() < 0.3
        assert found == pytest.approx(entry["bodies"][entry["target"]]["centre_vu"], abs=0.01)  # type: ignore[index]


def test_frames_show_the_target_where_the_truth_says(archive: Path, shots: list[Shot]) -> None:
    truth = _truth(archive)
    for shot in shots:
        entry = truth[shot.image_id]
        if float(str(entry["snr"])) < 5.0 or float(str(entry["target_inside_share"])) < 0.99:
            continue
        pixels, _ = _read(archive, shot)
        v, u = np.indices(pixels.shape)
        centre = np.array(entry["bodies"][entry["target"]]["centre_vu"])  # type: ignore[index]
        apart = np.hypot(v - centre[0], u - centre[1])
        radius = float(str(entry["diameter_px"])) / 2.0
        known = pixels != 0 if shot.camera.stored != "lorri" else np.ones(pixels.shape, dtype=bool)
        inside = pixels[(apart < radius) & known].astype(float)
        beyond = pixels[(apart > 1.3 * radius + 4.0) & (apart < 1.6 * radius + 8.0) & known].astype(float)
        assert inside.mean() > np.median(beyond) + 3.0 * beyond.std() / np.sqrt(len(inside)), shot.image_id


def test_labels_tell_time_exposure_and_target(archive: Path, shots: list[Shot]) -> None:
    blocks = {"cassini": "coiss_nac", "voyager": "vgiss_2_na", "lorri": "nhlorri"}
    modes = {"cassini_nac_sum2": "512", "voyager_na": "GEOMED", "lorri_4x4": "4X4"}
    for shot in shots:
        pixels, label = _read(archive, shot)
        assert pixels.shape == shot.camera.optics.shape_vu
        assert (label.block, label.mode) == (blocks[shot.camera.stored], modes[shot.camera.name])
        assert label.target == shot.target
        assert label.exposure_s == pytest.approx(shot.exposure_s)
        assert label.mid_utc is not None
        assert abs(pd.Timestamp(label.mid_utc) - pd.Timestamp(shot.utc)) < pd.Timedelta(seconds=1e-3)


def test_cameras_are_the_configured_ones(shots: list[Shot]) -> None:
    """The sample's own table agrees with the shipped blocks, or the planted truth would be another camera's."""
    instruments = load_configuration().instruments
    names = {
        "cassini_nac": ("coiss_nac", "1024"), "cassini_nac_sum2": ("coiss_nac", "512"),
        "cassini_wac": ("coiss_wac", "1024"), "cassini_wac_sum2": ("coiss_wac", "512"),
        "voyager_na": ("vgiss_2_na", "GEOMED"), "lorri_1x1": ("nhlorri", "1X1"), "lorri_4x4": ("nhlorri", "4X4"),
    }  # fmt: skip
    assert set(names) == set(flyby_cameras())
    for name, camera in flyby_cameras().items():
        block = instruments[names[name][0]]
        mode, optics = block.modes[names[name][1]], camera.optics
        assert mode.shape_vu == optics.shape_vu
        assert mode.focal_length_mm == pytest.approx(optics.focal_length_mm, rel=1e-7)
        assert np.allclose(mode.k_px_per_mm, optics.k_px_per_mm, rtol=1e-7)
        assert mode.principal_point_vu == optics.principal_point_vu
        assert np.allclose(mode.distortion_eps, optics.distortion_eps, rtol=1e-6, atol=0.0)
        assert mode.psf_sigma_px == optics.psf_sigma_px
        assert block.fit_camera_rotation == optics.fit_camera_rotation
        margin = mode.search_margin_vu or block.search_margin_vu
        assert np.all(np.array(optics.search_margin_vu) <= margin)
        assert mode.read_noise_dn in (None, optics.read_noise_dn)
        assert mode.gain_e_per_dn in (None, optics.gain_e_per_dn)
        assert block.spice is not None
        assert block.spice.frame == camera.frame
        assert block.spice.spacecraft_id == camera.spacecraft.naif_id
        assert np.allclose(block.spice.camera_from_instrument, camera.camera_from_instrument)


def test_the_archive_tells_its_bodies_and_nothing_of_the_truth(archive: Path) -> None:
    described = yaml.safe_load((archive / "archive.yaml").read_text())
    assert described["geometry"] == "spice"
    assert set(described["bodies"]) == {body.name for body in BODIES}
    assert described["bodies"]["CORVETH"]["photometry"] == "lunar_lambert"
    assert described["bodies"]["CORVETH"]["photometry_parameter"] == body_named("CORVETH").surface.parameter
    assert all((archive / "kernels" / name).stat().st_size for name in ("meta.tm", "bodies.bsp", "nh_apriori.bc"))


def test_star_tables_are_places_as_seen(archive: Path, shots: list[Shot]) -> None:
    starry = [shot for shot in shots if shot.stars]
    assert starry
    for shot in starry:
        table = pd.read_parquet(archive / "data" / f"{shot.image_id}.stars.parquet")
        ra, dec = np.radians(table["ra_deg"].to_numpy()), np.radians(table["dec_deg"].to_numpy())
        sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        at = project(shot.camera.optics, sky @ shot.truth.T)
        on = np.all((at > 3.0) & (at < np.array(shot.camera.optics.shape_vu) - 4.0), axis=1)
        pixels, _ = _read(archive, shot)
        flux = 10.0 ** (-0.4 * table["mag"].to_numpy()) * shot.camera.optics.star_dn_per_s_mag0 * shot.exposure_s
        bright = at[on & (flux > 150.0)]
        lit = [pixels[tuple(np.rint(vu).astype(int))] > np.median(pixels.astype(float)) for vu in bright]
        # Some stand behind a body or in lost lines.
        assert np.mean(lit or [True]) > 0.6
    assert not list((archive / "data").glob("*.geometry.json"))


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_same_seed_gives_the_same_bytes(archive: Path, tmp_path: Path) -> None:
    make_flyby_sample(tmp_path / "again", replace(OPTIONS, processes=2))
    assert _bytes(tmp_path / "again") == _bytes(archive)
    other = plan_shot(0, replace(OPTIONS, seed=6))
    assert other.image_id != plan_shot(0, OPTIONS).image_id


def test_a_folder_in_use_and_absurd_options_are_refused(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match="not an empty directory"):
        make_flyby_sample(archive, OPTIONS)
    for change in ({"frames": 0}, {"cameras": ("kodak",)}, {"snr": (5.0, 1.0)}, {"trap_share": 2.0}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(change))):
            make_flyby_sample(tmp_path / "never", replace(OPTIONS, **change))
    assert not (tmp_path / "never").exists()
    assert pilotage("sample", "flyby", archive).refusal().endswith("is not an empty directory")


def test_planned_frames_cover_sizes_phases_and_kinds() -> None:
    options = FlybyOptions(frames=120, seed=2, trap_share=0.1)
    planned = plan_shots(options)
    assert len({shot.image_id for shot in planned}) == 120
    kinds = {shot.kind for shot in planned}
    assert {"single", "companion", "edge"} <= kinds
    assert kinds & set(TRAPS)
    for shot in planned:
        target = next(s for s in shot.sightings() if s.body.name == shot.target)
        phase = np.degrees(target.phase_rad)
        assert 4.0 < phase < 151.0
        assert 2.9 < shot.snr < 200.1
        margin = np.array(shot.camera.optics.search_margin_vu)
        assert np.all(np.abs(shot.offset_vu) <= 0.9 * margin)
        assert abs(np.degrees(shot.rotation_rad)) <= (3.0 if shot.camera.optics.fit_camera_rotation else 0.0)
    sizes = [_diameter(shot) for shot in planned]
    assert min(sizes) < 12.0
    assert max(sizes) > 1500.0
    only = plan_shots(FlybyOptions(frames=20, trap_share=1.0))
    assert {shot.kind for shot in only} == set(TRAPS)
    assert all(shot.target in ("CORVETH", "HALVREN") for shot in only if shot.kind == "twins")


def test_a_trap_that_cannot_be_laid_gives_way_to_another() -> None:
    # At this hour the twins are in the planet's shadow.
    assert plan_shot(1083, FlybyOptions(seed=4, frames=1084)).kind in TRAPS


def _diameter(shot: Shot) -> float:
    target = next(s for s in shot.sightings() if s.body.name == shot.target)
    return 2.0 * target.radius_rad / shot.camera.optics.rad_per_px


def test_kernels_of_one_spacecraft_alone_load(tmp_path: Path) -> None:
    planned = plan_shots(replace(OPTIONS, frames=2, cameras=("cassini_nac",)))
    write_kernels(tmp_path, planned)
    text = (tmp_path / "meta.tm").read_text()
    assert "cas_apriori.bc" in text
    assert "vg2_apriori.bc" not in text
    assert all(max(map(len, (tmp_path / name).read_text().splitlines())) <= 132 for name in ("sample.tf", "sample.ti"))
    assert PLANET.naif_id not in {moon.naif_id for moon in MOONS}
    assert len({craft.naif_id for craft in SPACECRAFT}) == 3
