"""The spice provider against CSPICE's own routines, and the archive's kernels under attack."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from catalogs.bodies import BodyBlock, BodyModels
from catalogs.instruments import InstrumentBlock
from catalogs.kernels import Kernel, check_kernels
from catalogs.spice import Candidate, focal_length_notes, load_bodies, state_from_spice, structure_of
from pipeline.errors import GeometryError
from pipeline.geometry.ellipsoid import limb_points, sub_point
from pipeline.records import State
from pipeline.status import StatusReason
from tests.scenes.kernels import (
    FRAME,
    MOTIONS,
    PEBBLE,
    ROCK,
    SPACECRAFT,
    SPAN_S,
    START_ET,
    STRUCTURE,
    write_kernels,
    write_spk,
)

# Cassini's narrow-angle camera in round figures, its array turned by half a turn.
NAC = InstrumentBlock.model_validate({
    "mission": "CASSINI", "camera": "NAC", "search_margin_vu": [50.0, 140.0],
    "spice": {
        "spacecraft_id": SPACECRAFT, "instrument_id": -82360, "frame": FRAME,
        "camera_from_instrument": [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
    },
    "modes": {"1024": {
        "shape_vu": [1024, 1024], "focal_length_mm": 2000.0, "k_px_per_mm": [[83.33, 0.0], [0.0, 83.33]],
        "principal_point_vu": [511.5, 511.5],
    }},
})  # fmt: skip
MIDDLE_ET = START_ET + SPAN_S / 2
# Relative, of the acceptance.
PROMISE = 1e-9


@dataclass(frozen=True)
class Shot:
    """A label's word."""

    mid_utc: str | None
    exposure_s: float | None = 1.0


@dataclass(frozen=True)
class Scene:
    kernels: tuple[Kernel, ...]
    known: tuple[Candidate, ...]
    folder: Path

    def shot(self, et: float = MIDDLE_ET) -> Shot:
        return Shot(str(spiceypy.et2utc(et, "ISOC", 6)) + "Z")

    def state(self, label: Shot | None = None, block: InstrumentBlock = NAC, mode: str | None = "1024") -> State:
        models = BodyModels({"ROCK": BodyBlock(shape_sigma_km=0.5)})
        return state_from_spice(label or self.shot(), "id", (block, mode), {}, self.known, models)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archive")
    write_kernels(path / "kernels")
    return path


@pytest.fixture
def scene(folder: Path, tmp_path: Path) -> Iterator[Scene]:
    kernels = check_kernels(str(folder), "kernels/meta.tm", tmp_path)
    yield Scene(kernels, load_bodies(kernels), folder)
    spiceypy.kclear()


def test_the_kernels_know_their_bodies(scene: Scene) -> None:
    assert [body.naif_id for body in scene.known] == [601, 699, ROCK, PEBBLE]
    names = {body.naif_id: (body.name, body.frame) for body in scene.known}
    assert names[601] == ("MIMAS", "IAU_MIMAS")
    assert names[ROCK] == ("ROCK", None)


def test_the_camera_looks_where_the_kernels_say(scene: Scene) -> None:
    state = scene.state()
    assert state.et == pytest.approx(MIDDLE_ET, abs=1e-6)
    assert (state.mission, state.camera) == (NAC.mission, NAC.camera)
    assert NAC.spice is not None
    wanted = NAC.spice.rotation() @ np.array(spiceypy.pxform("J2000", FRAME, state.et))
    assert np.allclose(state.attitude.camera_from_j2000, wanted, atol=1e-14)
    assert state.attitude.sigma_rad is None
    # The camera's z points at Mimas at mid-span, whichever way its x and y lie.
    mimas = state.bodies[0]
    assert state.attitude.camera_from_j2000 @ mimas.position_km == pytest.approx(
        [0.0, 0.0, np.linalg.norm(mimas.position_km)], abs=1e-5 * float(np.linalg.norm(mimas.position_km))
    )


def test_angular_rate_is_about_the_cameras_own_axes(scene: Scene) -> None:
    state = scene.state()
    assert state.attitude.rate_rad_s is not None
    # Planted: 2e-5 rad/s about the instrument's z, which is the camera's.
    assert state.attitude.rate_rad_s == pytest.approx([0.0, 0.0, 2e-5], abs=1e-12)
    later = scene.state(scene.shot(MIDDLE_ET + 10.0))
    turned = later.attitude.camera_from_j2000 @ state.attitude.camera_from_j2000.T
    # A frame that turns by +phi about its z sees the sky turn by -phi.
    assert np.arctan2(turned[0, 1], turned[0, 0]) == pytest.approx(2e-4, abs=1e-9)


def test_c_kernels_without_rates_leave_it_open(tmp_path: Path) -> None:
    write_kernels(tmp_path / "kernels", with_rate=False)
    known = load_bodies(check_kernels(str(tmp_path), ["kernels/meta.tm"], tmp_path))
    state = Scene((), known, tmp_path).state()
    assert state.attitude.rate_rad_s is None


def relative(found: object, wanted: object) -> float:
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


def test_positions_are_those_of_spkezr_and_spkcpt(scene: Scene) -> None:
    state = scene.state()
    # Mimas before Saturn; the others stand outside the narrow field.
    assert [body.name for body in state.bodies] == ["MIMAS", "SATURN"]
    # A camera that sees all of the sky keeps every body.
    wide = NAC.model_copy(update={"search_margin_vu": (2000.0, 2000.0)})
    mode = wide.modes["1024"].model_copy(update={"focal_length_mm": 2.0, "search_margin_vu": None})
    state = scene.state(block=wide.model_copy(update={"modes": {"1024": mode}}))
    assert {body.name for body in state.bodies} <= {"MIMAS", "SATURN", "ROCK", "PEBBLE"}
    assert len(state.bodies) >= 2
    distances = [float(np.linalg.norm(body.position_km)) for body in state.bodies]
    assert distances == sorted(distances)
    for body in state.bodies:
        code, observer = str(body.naif_id), str(SPACECRAFT)
        wanted, light = spiceypy.spkezr(code, state.et, "J2000", "CN+S", observer)
        assert relative(body.position_km, wanted[:3]) < PROMISE
        frame = "IAU_SATURN"
        point, _ = spiceypy.spkcpt([0.0, 0.0, 0.0], code, frame, state.et, "J2000", "TARGET", "CN+S", observer)
        assert relative(body.position_km, point[:3]) < PROMISE
        sun, _ = spiceypy.spkezr("SUN", state.et - light, "J2000", "CN+S", code)
        assert relative(body.sun_direction_j2000, sun[:3] / np.linalg.norm(sun[:3])) < PROMISE
        assert body.radii_km.tolist() == list(spiceypy.bodvcd(int(code), "RADII", 3)[1])


def test_light_time_by_hand(scene: Scene) -> None:
    """Mimas from its planted motion: seen where it was when the light left, and displaced by the camera's motion."""
    mimas = scene.state().bodies[0]

    def from_ssb(code: int, et: float) -> np.ndarray:
        place = np.zeros(6)
        while code != 0:
            code, motion = MOTIONS[code]
            place = place + motion(et - START_ET)
        return place

    observer, c = from_ssb(SPACECRAFT, MIDDLE_ET), 299_792.458
    light = 0.0
    for _ in range(10):
        seen = from_ssb(601, MIDDLE_ET - light)[:3] - observer[:3]
        light = float(np.linalg.norm(seen)) / c
    # Classical aberration: light of velocity -c n arrives at a camera of velocity v from c n + v.
    direction = c * seen / np.linalg.norm(seen) + observer[3:]
    direction *= np.linalg.norm(seen) / np.linalg.norm(direction)
    # SPICE turns by asin(v sin / c), which differs in second order, (v / c)^2.
    assert relative(mimas.position_km, direction) < 2e-9
    without = relative(seen, direction)
    assert without > 1e-5


def test_orientation_sub_observer_point_and_limb(scene: Scene) -> None:
    state = scene.state()
    mimas = state.bodies[0]
    code, observer = "MIMAS", str(SPACECRAFT)
    # The camera in the body's frame when the light left.
    camera_km = -mimas.body_from_j2000 @ mimas.position_km
    wanted, _, seen = spiceypy.subpnt("INTERCEPT/ELLIPSOID", code, state.et, "IAU_MIMAS", "CN+S", observer)
    # SPICE takes the light time of that point, by 0.7 ms shorter than the centre's: the body turns by 5e-8 meanwhile.
    wanted, eye = np.array(wanted), np.array(wanted) - np.array(seen)
    assert relative(sub_point(mimas.radii_km, eye), wanted) < PROMISE
    assert relative(sub_point(mimas.radii_km, camera_km), wanted) < 1e-7
    still, _, _ = spiceypy.subpnt("INTERCEPT/ELLIPSOID", code, state.et, "IAU_MIMAS", "NONE", observer)
    place, _ = spiceypy.spkezr(observer, state.et, "IAU_MIMAS", "NONE", code)
    assert relative(sub_point(mimas.radii_km, np.array(place[:3])), still) < PROMISE
    _, points, _, tangents = spiceypy.limbpt(
        "TANGENT/ELLIPSOID", code, state.et, "IAU_MIMAS", "CN+S", "CENTER", observer, [0.0, 0.0, 1.0], 0.3, 20, 0.0,
        0.0, 20,
    )  # fmt: skip
    points = np.asarray(points)[:20]
    dense = limb_points(mimas.radii_km, camera_km, np.linspace(0.0, 2 * np.pi, 721))
    for point, tangent in zip(points, tangents, strict=False):
        scaled, eye = point / mimas.radii_km, camera_km / mimas.radii_km
        # On the surface, and in the plane of the closed-form limb.
        assert np.linalg.norm(scaled) == pytest.approx(1.0, abs=PROMISE)
        assert scaled @ eye == pytest.approx(1.0, abs=PROMISE * float(np.linalg.norm(eye)))
        assert relative(camera_km + tangent, point) < PROMISE
        assert np.linalg.norm(dense - point, axis=1).min() < 1.0


def test_bodies_without_a_frame_turn_by_their_constants(scene: Scene) -> None:
    label = scene.shot()
    wide = NAC.modes["1024"].model_copy(update={"focal_length_mm": 2.0})
    state = scene.state(label, NAC.model_copy(update={"modes": {"1024": wide}}))
    rocks = [body for body in state.bodies if body.naif_id == ROCK]
    for rock in rocks:
        light = float(spiceypy.spkezr(str(ROCK), state.et, "J2000", "CN+S", str(SPACECRAFT))[1])
        wanted = np.array(spiceypy.tipbod("J2000", ROCK, state.et - light))
        assert np.allclose(rock.body_from_j2000, wanted, atol=1e-13)
        assert rock.shape_sigma_km == 0.5
    pebbles = [body for body in state.bodies if body.naif_id == PEBBLE]
    assert all(np.array_equal(body.body_from_j2000, np.eye(3)) for body in pebbles)
    assert rocks
    assert pebbles


def reason_of(scene: Scene, label: Shot, block: InstrumentBlock = NAC, mode: str | None = "1024") -> StatusReason:
    with pytest.raises(GeometryError) as failure:
        scene.state(label, block, mode)
    assert "\n" not in failure.value.detail
    assert str(scene.folder) not in failure.value.detail
    return failure.value.reason


def test_what_kernels_do_not_cover(scene: Scene) -> None:
    assert reason_of(scene, scene.shot(START_ET - 1e6)) is StatusReason.KERNELS_UNAVAILABLE
    assert reason_of(scene, scene.shot(START_ET + SPAN_S + 100.0)) is StatusReason.KERNELS_UNAVAILABLE
    assert reason_of(scene, Shot("next week")) is StatusReason.GEOMETRY_INVALID
    assert reason_of(scene, Shot(None)) is StatusReason.GEOMETRY_MISSING
    assert reason_of(scene, scene.shot(), NAC, None) is StatusReason.CAMERA_UNKNOWN
    assert reason_of(scene, scene.shot(), NAC.model_copy(update={"spice": None})) is StatusReason.CAMERA_UNKNOWN
    assert NAC.spice is not None
    strange = NAC.model_copy(update={"spice": NAC.spice.model_copy(update={"frame": "NOWHERE"})})
    assert reason_of(scene, scene.shot(), strange) is StatusReason.KERNELS_UNAVAILABLE
    # What went wrong before does not stick in CSPICE.
    assert scene.state().bodies


def test_a_moon_without_ephemeris_is_left_out(tmp_path: Path) -> None:
    write_kernels(tmp_path / "kernels")
    (tmp_path / "kernels" / "orbits.bsp").unlink()
    left = {code: motion for code, motion in MOTIONS.items() if code != 601}
    write_spk(tmp_path / "kernels" / "orbits.bsp", left)
    known = load_bodies(check_kernels(str(tmp_path), "kernels/meta.tm", tmp_path))
    assert Scene((), known, tmp_path).state().bodies[0].name == "SATURN"


def test_single_pointings_are_taken_within_the_tolerance(scene: Scene) -> None:
    assert NAC.spice is not None
    late = scene.shot(START_ET + SPAN_S + 25.0)
    tolerant = NAC.model_copy(update={"spice": NAC.spice.model_copy(update={"ck_tolerance_s": 60.0})})
    code, fixed = structure_of(FRAME, MIDDLE_ET)
    assert code == STRUCTURE
    assert np.allclose(fixed, np.array(spiceypy.pxform("CASSINI_SC_COORD", FRAME, MIDDLE_ET)), atol=1e-15)
    # Past the end of the pointings, 25 s on; the ephemeris of the spacecraft ends there too.
    assert reason_of(scene, late, tolerant) is StatusReason.KERNELS_UNAVAILABLE
    from catalogs.spice import instrument_attitude

    assert tolerant.spice is not None
    last = np.array(spiceypy.pxform("J2000", FRAME, START_ET + SPAN_S))
    found = instrument_attitude(tolerant.spice, START_ET + SPAN_S + 25.0)
    assert np.allclose(found, last, atol=1e-12)


def test_the_cameras_block_wins_over_the_instrument_kernel(scene: Scene) -> None:
    blocks = {"coiss_nac": NAC, "no spice": NAC.model_copy(update={"spice": None})}
    assert focal_length_notes(blocks) == []
    focal = NAC.modes["1024"].focal_length_mm
    spiceypy.pdpool("INS-82360_FOCAL_LENGTH", [focal * 1.005])
    assert focal_length_notes(blocks) == []
    spiceypy.pdpool("INS-82360_FOCAL_LENGTH", [focal / 1000.0])
    (note,) = focal_length_notes(blocks)
    assert note.startswith("coiss_nac: focal length")
