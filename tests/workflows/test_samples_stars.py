"""The star sample against astropy, erfa and geometry written a second time from the conventions alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from workflows.samples.attitude import looking_at, matrix_from_wxyz, pointing_error, wxyz_from_matrix
from workflows.samples.camera_table import sample_cameras
from workflows.samples.cameras import SampleCamera, project, unproject
from workflows.samples.photometry import DETECTION_SNR, Exposure, flux_at_limit_dn, signal_to_noise
from workflows.samples.plan import detectable, plan_frames
from workflows.samples.render import star_stamp, trails
from workflows.samples.scene import compose
from workflows.samples.sky import MAS, Observer, RealSky, Stars, apparent_directions, read_real_sky
from workflows.samples.stars import StarSampleOptions, make_star_sample

erfa = pytest.importorskip("erfa")  # astropy brings it; it has no types of its own
Floats = NDArray[np.float64]
CAMERAS = sample_cameras()
AU_KM = 149_597_870.7


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sample of every camera, clean enough to be measured."""
    folder = tmp_path_factory.mktemp("sample") / "archive"
    make_star_sample(folder, StarSampleOptions(frames=15, seed=3, processes=1, min_stars=3, smeared_fraction=0.4))
    return folder


@pytest.fixture(scope="module")
def sky() -> RealSky:
    return read_real_sky()


def _some_stars(count: int = 50) -> Stars:
    rng = np.random.default_rng(5)
    return Stars(
        star_id=np.array([str(k) for k in range(count)], dtype=np.str_),
        ra_deg=rng.uniform(0.0, 360.0, count),
        dec_deg=np.degrees(np.arcsin(rng.uniform(-0.99, 0.99, count))),
        mag=np.full(count, 10.0),
        pm_ra_masyr=rng.normal(0.0, 500.0, count),
        pm_dec_masyr=rng.normal(0.0, 500.0, count),
        parallax_mas=rng.uniform(0.0, 400.0, count),
        epoch=np.full(count, 2016.0),
    )


def _erfa_directions(stars: pd.DataFrame, year: float, position_au: Floats, velocity_kms: Floats) -> Floats:
    """Apparent directions by IAU SOFA: motion and parallax, then aberration far from the Sun's gravity."""
    ra, dec = np.radians(stars["ra_deg"].to_numpy()), np.radians(stars["dec_deg"].to_numpy())
    # SOFA adds the light time from the observer to the epoch; taken out again, since no catalogue user does so.
    toward = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    light_years = toward @ position_au * 499.004784 / 86400.0 / 365.25
    natural = erfa.pmpx(
        ra,
        dec,
        stars["pm_ra_masyr"].to_numpy() * MAS / np.cos(dec),
        stars["pm_dec_masyr"].to_numpy() * MAS,
        stars["parallax_mas"].to_numpy() / 1000.0,
        0.0,
        year - stars["epoch"].to_numpy() - light_years,
        position_au,
    )
    beta = velocity_kms / 299_792.458
    seen: Floats = erfa.ab(natural, beta, 1e12, np.sqrt(1.0 - beta @ beta))
    return seen


def _milliarcseconds(a: Floats, b: Floats) -> Floats:
    apart: Floats = np.linalg.norm(a - b, axis=1) / MAS
    return apart


def test_apparent_places_agree_with_sofa() -> None:
    stars = _some_stars()
    observer = Observer(1986.1, np.array([-11.0, 14.0, 5.0]), np.array([14.0, -9.0, 3.0]))
    ours = apparent_directions(stars, observer)
    theirs = _erfa_directions(stars.to_frame(), observer.year, observer.position_au, observer.velocity_kms)
    # Both are the same straight line and Lorentz transformation; what is left is rounding.
    assert _milliarcseconds(ours, theirs).max() < 0.01
    at_rest = apparent_directions(stars, replace(observer, velocity_kms=np.zeros(3)))
    assert _milliarcseconds(ours, at_rest).max() > 5000.0


def test_stars_shift_toward_the_apex() -> None:
    stars = replace(_some_stars(1), ra_deg=np.array([90.0]), dec_deg=np.array([0.0]), parallax_mas=np.zeros(1))
    still = replace(stars, pm_ra_masyr=np.zeros(1), pm_dec_masyr=np.zeros(1))
    seen = apparent_directions(still, Observer(2016.0, np.zeros(3), np.array([0.0, 0.0, 299.792458])))
    assert seen[0, 2] == pytest.approx(1e-3, rel=1e-5)


def test_real_sky_takes_motion_from_hipparcos_and_not_from_the_colours(sky: RealSky) -> None:
    stars = sky.stars
    barnard = int(np.argmax(stars.pm_dec_masyr))
    assert stars.pm_dec_masyr[barnard] == pytest.approx(10370.0, abs=60.0)
    assert stars.parallax_mas[barnard] == pytest.approx(548.0, abs=3.0)
    listed = stars.parallax_mas > 0.0
    assert 95_000 < listed.sum() < 118_000
    # The others move unlisted, by twenty milliarcseconds a year and axis.
    assert np.std(stars.pm_ra_masyr[~listed]) == pytest.approx(20.0, abs=3.0)
    alpha_centauri = stars.take(stars.star_id == "-71683")
    assert alpha_centauri.epoch[0] == 1991.25
    assert alpha_centauri.pm_ra_masyr[0] == pytest.approx(-3679.25)


@pytest.mark.parametrize("name", CAMERAS)
def test_unproject_inverts_project(name: str) -> None:
    camera = CAMERAS[name]
    pixels = np.random.default_rng(1).uniform(-50.0, np.array(camera.shape_vu) + 50.0, (200, 2))
    assert np.abs(project(camera, unproject(camera, pixels)) - pixels).max() < 1e-8


@pytest.mark.parametrize("name", CAMERAS)
def test_quaternions_invert(name: str) -> None:
    axis = unproject(CAMERAS[name], np.array([[3.0, 5.0]]))[0]
    for roll in np.linspace(0.0, 2.0 * np.pi, 9):
        attitude = looking_at(axis, float(roll))
        quaternion = wxyz_from_matrix(attitude)
        assert np.allclose(matrix_from_wxyz(quaternion), attitude, atol=1e-14)
        assert np.allclose(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), attitude, atol=1e-14)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("degrees", [0.0, 2.5, -2.5])
def test_pointing_error_is_the_convention(name: str, degrees: float) -> None:
    camera, angle = CAMERAS[name], np.radians(degrees)
    offset = np.array([17.0, -23.0])
    around = camera.centre_vu + np.array([[0.0, 0.0], [0.0, 4.0], [4.0, 0.0], [-3.0, 3.0]])
    moved = project(camera, unproject(camera, around) @ pointing_error(camera, offset, angle).T)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    expected = camera.centre_vu + (around - camera.centre_vu) @ turn.T + offset
    assert np.abs(moved[0] - expected[0]).max() < 1e-7
    # Away from the centre a tilt and the lens differ from a shift by second-order terms.
    assert np.abs(moved - expected).max() < 0.01


def _camera_model(path: Path) -> tuple[dict[str, object], SampleCamera]:
    """The geometry a reader finds with a frame: of LORRI the published mode, of others the sidecar's numbers."""
    beside = path.with_name(path.stem + ".geometry.json")
    if not beside.exists():
        header = fits.getheader(path)
        camera = CAMERAS["lorri_4x4" if header["SFORMAT"].strip() == "4X4" else "lorri_1x1"]
        instrument = Rotation.from_quat([header[f"SPCQ{axis}"] for axis in "XYZA"]).as_matrix()
        return {
            "attitude": np.diag([1.0, -1.0, -1.0]) @ instrument.T,
            "position": -np.array([header[f"SPCSSC{axis}"] for axis in "XYZ"]) / AU_KM,
            "velocity": -np.array([header[f"SPCSSCV{axis}"] for axis in "XYZ"]),
            "year": 2000.0 + header["SPCSCET"] / 86400.0 / 365.25,
        }, camera
    record = json.loads(beside.read_text())
    model = record["camera_model"]
    (kuu, kuv), (kvu, kvv) = model["k_px_per_mm"]
    camera = replace(
        CAMERAS["cassini_nac"],
        shape_vu=tuple(model["shape_vu"]),
        focal_length_mm=model["focal_length_mm"],
        k_px_per_mm=((kuu, kuv), (kvu, kvv)),
        principal_point_vu=tuple(model["principal_point_vu"]),
        distortion_eps=tuple(model["distortion_eps"]),
    )
    wxyz = record["attitude"]["camera_from_j2000_wxyz"]
    return {
        "attitude": Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix(),
        "position": np.array(record["spacecraft"]["position_km_ssb"]) / AU_KM,
        "velocity": np.array(record["spacecraft"]["velocity_kms_ssb"]),
        "year": 2000.0 + (pd.Timestamp(record["mid_time_utc"]) - pd.Timestamp("2000-01-01T12:00:00")).days / 365.25,
    }, camera


def _tangent_plane_pixels(camera: SampleCamera, attitude: Floats, directions: Floats) -> Floats:
    """Pixels by astropy's WCS: the sky on its tangent plane, then Owen's terms and K one star at a time."""
    axis, east = attitude[2], np.cross([0.0, 0.0, 1.0], attitude[2])
    east /= np.linalg.norm(east)
    north = np.cross(axis, east)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [np.degrees(np.arctan2(axis[1], axis[0])), np.degrees(np.arcsin(axis[2]))]
    wcs.wcs.crpix = [1.0, 1.0]
    wcs.wcs.cdelt = [np.degrees(1.0 / camera.focal_length_mm)] * 2
    ra, dec = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])), np.degrees(np.arcsin(directions[:, 2]))
    sky_mm = wcs.all_world2pix(np.stack([ra, dec], axis=1), 0)
    (e1, e2, e3, e4, e5, e6), (kuu, kuv), (kvu, kvv) = camera.distortion_eps, *camera.k_px_per_mm
    pixels = []
    for along_east, along_north in sky_mm:
        x = along_east * (attitude[0] @ east) + along_north * (attitude[0] @ north)
        y = along_east * (attitude[1] @ east) + along_north * (attitude[1] @ north)
        r = (x * x + y * y) ** 0.5
        grow, turn = 1.0 + e1 * r**2 + e2 * r**4 + e3 * y + e4 * x, e5 * r + e6 * r**3
        x, y = x * grow - y * turn, y * grow + x * turn
        v0, u0 = camera.principal_point_vu
        pixels.append([v0 + kvu * x + kvv * y, u0 + kuu * x + kuv * y])
    return np.array(pixels)


def _catalogue(archive: Path, sky: RealSky) -> pd.DataFrame:
    faint = pd.read_parquet(archive / "faint.parquet")
    return pd.concat([sky.stars.to_frame(), faint]).set_index("star_id")


def test_truth_against_files_read_anew(archive: Path, sky: RealSky) -> None:
    truth = json.loads((archive / "truth.json").read_text())["frames"]
    rows = pd.read_parquet(archive / "truth_stars.parquet")
    catalogue = _catalogue(archive, sky)
    assert len(truth) == 15
    for image_id, entry in truth.items():
        mine = rows[(rows["image_id"] == image_id) & (rows["kind"] == "catalogue")]
        geometry, camera = _camera_model(archive / "frames" / f"{image_id}.fits")
        attitude = np.asarray(geometry["attitude"])
        directions = _erfa_directions(
            catalogue.loc[mine["star_id"]],
            float(str(geometry["year"])),
            np.asarray(geometry["position"]),
            np.asarray(geometry["velocity"]),
        )
        wxyz = entry["true_camera_from_j2000_wxyz"]
        true = Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix()
        pixels = mine[["v_px", "u_px"]].to_numpy()
        # The day of the sidecar's time is cut off here: 0.003 years of 0.7 arcsec a year is 0.002 px.
        slack = 5.0 * camera.image_error_px
        assert np.abs(_tangent_plane_pixels(camera, true, directions) - pixels).max() < 0.01 + slack
        predicted = _tangent_plane_pixels(camera, attitude, directions)
        angle = np.radians(entry["rotation_deg"])
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        offset = np.array([entry["offset_dv_px"], entry["offset_du_px"]])
        actual = camera.centre_vu + (predicted - camera.centre_vu) @ turn.T + offset
        # A tilt is not quite a shift far from the centre: up to half a pixel in the wide camera or a bent one.
        assert np.abs(actual - pixels).max() < 0.7 + slack


def test_offsets_stay_inside_the_margin(archive: Path) -> None:
    for image_id, entry in json.loads((archive / "truth.json").read_text())["frames"].items():
        camera = CAMERAS[entry["camera"]]
        assert abs(entry["offset_dv_px"]) <= 0.9 * camera.search_margin_vu[0]
        assert abs(entry["offset_du_px"]) <= 0.9 * camera.search_margin_vu[1]
        assert abs(entry["rotation_deg"]) <= (3.0 if camera.fit_camera_rotation else 0.0)
        assert (archive / "frames" / f"{image_id}.geometry.json").exists() != camera.is_lorri


def test_star_counts_and_false_share(archive: Path) -> None:
    rows = pd.read_parquet(archive / "truth_stars.parquet")
    for image_id, entry in json.loads((archive / "truth.json").read_text())["frames"].items():
        assert entry["n_stars"] >= 2  # one in five may fall on lost lines
        mine = rows[rows["image_id"] == image_id]
        false = mine["kind"].isin(["confuser", "cosmic", "hot"])
        assert entry["n_false"] == false.sum()
        seen = (mine["snr"] >= DETECTION_SNR).sum()
        assert abs(int(false.sum()) - int(seen)) <= 2
        assert (mine["kind"].isin(["moved", "variable"])).sum() <= max(1, seen) / 4 + 1


def test_stamp_is_the_integral_over_pixels() -> None:
    for sigma in (0.54, 0.62, 0.9):
        row, column, stamp = star_stamp(sigma, np.array([20.3, 31.8]), np.zeros(2), 1000.0)
        edges_v = np.arange(stamp.shape[0] + 1) + row - 0.5
        edges_u = np.arange(stamp.shape[1] + 1) + column - 0.5
        exact = np.outer(np.diff(ndtr((edges_v - 20.3) / sigma)), np.diff(ndtr((edges_u - 31.8) / sigma)))
        # Nine samples per pixel are the midpoint rule, off by (step/sigma)^2/24 of the curvature.
        assert np.abs(stamp - 1000.0 * exact).max() < 1.0
        assert stamp.sum() == pytest.approx(1000.0, rel=1e-4)


def test_trail_keeps_light_and_middle() -> None:
    trail = np.array([2.5, -1.5])
    row, column, stamp = star_stamp(0.7, np.array([10.2, 12.6]), trail, 500.0)
    v, u = np.mgrid[row : row + stamp.shape[0], column : column + stamp.shape[1]]
    assert stamp.sum() == pytest.approx(500.0, rel=1e-4)
    assert (stamp * v).sum() / stamp.sum() == pytest.approx(10.2, abs=1e-3)
    assert (stamp * u).sum() / stamp.sum() == pytest.approx(12.6, abs=1e-3)
    # Variance of a trail is its length squared over 12; its slope is the correlation of rows and columns.
    covariance = (stamp * (v - 10.2) * (u - 12.6)).sum() / stamp.sum()
    assert covariance == pytest.approx(trail[0] * trail[1] / 12.0, rel=0.02)


@pytest.mark.parametrize("name", CAMERAS)
def test_trails_follow_the_turning_camera(name: str) -> None:
    camera, rate, seconds = CAMERAS[name], np.array([2.0e-6, -3.0e-6, 1.0e-5]), 2.0
    pixels = np.array([[100.0, 30.0], [20.0, 200.0]])
    rays = unproject(camera, pixels)
    # A camera turned by w t has the inverse rotation applied to what it sees.
    begin = project(camera, Rotation.from_rotvec(rate * seconds / 2.0).apply(rays))
    end = project(camera, Rotation.from_rotvec(-rate * seconds / 2.0).apply(rays))
    assert np.abs(trails(camera, pixels, Exposure(seconds, rate)) - (end - begin)).max() < 1e-6


@pytest.mark.parametrize("name", CAMERAS)
def test_flux_at_limit_is_five_sigma(name: str) -> None:
    camera = CAMERAS[name]
    exposure = Exposure(1.0, np.array([camera.rad_per_px, 0.0, 0.0]))
    flux = np.array([flux_at_limit_dn(camera, exposure)])
    assert signal_to_noise(camera, flux, exposure)[0] == pytest.approx(DETECTION_SNR)


def test_light_in_the_frames_adds_up(archive: Path) -> None:
    """Aperture sums of lone stars scatter about the true flux as their noise says."""
    rows = pd.read_parquet(archive / "truth_stars.parquet")
    truth = json.loads((archive / "truth.json").read_text())["frames"]
    pulls: list[float] = []
    for image_id, mine in rows.groupby("image_id"):
        camera = CAMERAS[truth[str(image_id)]["camera"]]
        image = fits.getdata(archive / "frames" / f"{image_id}.fits").astype(np.float64)
        good = image[image > 0] if camera.missing_value is not None else image
        background = float(np.median(good)) if camera.is_lorri else float(good[good < np.percentile(good, 99)].mean())
        noise = np.hypot(camera.read_noise_dn, np.sqrt(camera.background_dn / camera.gain_e_per_dn))
        bright = mine[~mine["kind"].isin(["cosmic", "hot"]) & (mine["snr"] > 30.0) & ~mine["saturated"]]
        places = mine[["v_px", "u_px"]].to_numpy(dtype=np.float64)
        for place, flux in zip(
            bright[["v_px", "u_px"]].to_numpy(dtype=np.float64),
            bright["flux_dn"].to_numpy(dtype=np.float64),
            strict=True,
        ):
            v, u = (round(float(x)) for x in place)
            box = image[max(v - 7, 0) : v + 8, max(u - 7, 0) : u + 8]
            lone = (np.hypot(*(places - place).T) < 16.0).sum() == 1
            if not lone or box.shape != (15, 15) or (box == 0).sum() > 2:
                continue
            sigma = np.sqrt(225.0 * noise**2 + flux / camera.gain_e_per_dn + (225.0 * 0.15 * noise) ** 2)
            pulls.append((box.sum() - 225.0 * background - flux) / sigma)
    assert len(pulls) > 20
    # The common background is known to about 0.15 of the noise, gradient included; hence the wide limits.
    assert abs(np.median(pulls)) < 1.0
    assert np.mean(np.abs(pulls) < 3.0) > 0.9


def test_frames_are_stored_as_their_missions_do(archive: Path) -> None:
    truth = json.loads((archive / "truth.json").read_text())["frames"]
    for path in sorted((archive / "frames").glob("*.fits")):
        camera = CAMERAS[truth[path.stem]["camera"]]
        with fits.open(path) as units:
            image = units[0].data
            assert image.shape == camera.shape_vu
            assert image.max() <= camera.saturation_dn
            assert len(units) == (3 if camera.is_lorri else 1)
            assert image.dtype.kind == ("f" if camera.is_lorri else "i")
            spread = 1.4826 * np.median(np.abs(image - np.median(image)))
            # Whole DN quantise the spread itself.
            assert spread == pytest.approx(camera.read_noise_dn, abs=0.2 if camera.is_lorri else 0.75)


def test_archive_description(archive: Path) -> None:
    description = yaml.safe_load((archive / "archive.yaml").read_text())
    assert description["stars"] == ["gaia", {"path": "faint.parquet", "place": "mean"}]
    assert description["images"] == "frames/*.fits"
    assert not {"geometry", "instrument"} & set(description)


def test_bytes_do_not_depend_on_processes(tmp_path: Path) -> None:
    options = StarSampleOptions(frames=6, seed=9, processes=1)
    make_star_sample(tmp_path / "one", options)
    make_star_sample(tmp_path / "two", replace(options, processes=2))
    one, two = (
        {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (tmp_path / "one", tmp_path / "two")
    )
    assert len(one) > 10
    assert one == two


@pytest.mark.parametrize(("low", "high"), [(1, 2), (10, 40)])
def test_wanted_star_counts(sky: RealSky, low: int, high: int) -> None:
    cameras = ("lorri_4x4", "cassini_nac")
    options = StarSampleOptions(
        frames=30, cameras=cameras, min_stars=low, max_stars=high, false_fraction=0.0, oddity_fraction=0.0
    )
    plans, faint = plan_frames(options, sky)
    assert faint is not None
    for plan in plans:
        assert low <= detectable(plan).sum() <= high
        shining, stray, hits = compose(plan, np.random.default_rng(0))
        assert set(shining.kind) == {"catalogue"}
        assert len(stray.kind) == len(hits.dn) == 0


def test_frames_do_not_overlap(sky: RealSky) -> None:
    plans, _ = plan_frames(StarSampleOptions(frames=60), sky)
    axes = np.array([plan.apriori[2] for plan in plans])
    apart = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    assert apart[~np.eye(60, dtype=bool)].min() > 0.5


def test_without_synthetic_stars(tmp_path: Path) -> None:
    options = StarSampleOptions(frames=1, processes=1, cameras=("voyager_wa",), deep=False)
    path = make_star_sample(tmp_path, options)
    assert yaml.safe_load(path.read_text())["stars"] == ["gaia"]
    assert not (tmp_path / "faint.parquet").exists()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (StarSampleOptions(frames=0), "frames"),
        (StarSampleOptions(processes=0), "processes"),
        (StarSampleOptions(cameras=()), "cameras"),
        (StarSampleOptions(cameras=("hubble",)), "hubble"),
        (StarSampleOptions(false_fraction=1.0), "false_fraction"),
        (StarSampleOptions(false_fraction=float("nan")), "false_fraction"),
        (StarSampleOptions(min_stars=5, max_stars=4), "max_stars"),
        (StarSampleOptions(max_rotation_deg=-1.0), "max_rotation_deg"),
        (StarSampleOptions(seed=-1), "seed"),
    ],
)
def test_absurd_options_are_refused(tmp_path: Path, wrong: StarSampleOptions, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make_star_sample(tmp_path / "never", wrong)
    assert not (tmp_path / "never").exists()


def test_a_used_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "something").write_text("here first")
    with pytest.raises(FileExistsError, match="not an empty directory"):
        make_star_sample(tmp_path, StarSampleOptions(frames=1))
    with pytest.raises(FileExistsError, match="not an empty directory"):
        make_star_sample(tmp_path / "something", StarSampleOptions(frames=1))
