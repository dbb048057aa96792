"""Rings by the spice provider against CSPICE's own routines."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from catalogs.bodies import BodyModels
from catalogs.kernels import check_kernels
from catalogs.ring_catalog import built_in_rings, parse_rings
from catalogs.spice import load_bodies, state_from_spice
from pipeline.geometry.rings import plane_points
from pipeline.records import State
from tests.catalogs.test_spice import MIDDLE_ET, NAC, Shot
from tests.scenes.kernels import SPACECRAFT, write_kernels

_OWN = """
planet: Saturn
epoch_utc: "2004-01-01T12:00:00"
features:
  - {name: A, kind: edge_outer, a_km: 150000.0, ae_km: 300.0, long_peri_rate_deg_day: 3.0}
"""


@pytest.fixture
def state(tmp_path: Path) -> Iterator[State]:
    write_kernels(tmp_path / "kernels")
    kernels = check_kernels(str(tmp_path), "kernels/meta.tm", tmp_path)
    known = load_bodies(kernels)
    shot = Shot(str(spiceypy.et2utc(MIDDLE_ET, "ISOC", 6)) + "Z")
    rings = (*built_in_rings(), parse_rings(_OWN, "rings.yaml"))
    yield state_from_spice(shot, "id", (NAC, "1024"), {}, known, BodyModels(), rings)
    spiceypy.kclear()


def test_ring_points_are_seen_where_spice_sees_them(state: State) -> None:
    rings = state.rings
    assert rings is not None
    assert rings.planet == "SATURN"
    place = np.array(spiceypy.spkezr("699", state.et, "J2000", "NONE", str(SPACECRAFT))[0][:3])
    left = state.et - float(np.linalg.norm(place)) / spiceypy.clight()
    pole = np.array(spiceypy.pxform("J2000", "IAU_SATURN", left))[2]
    node = np.cross([0.0, 0.0, 1.0], pole)
    plane = np.stack([node / np.linalg.norm(node), np.cross(pole, node / np.linalg.norm(node)), pole])
    boresight = state.attitude.camera_from_j2000[2]
    middle, _ = plane_points(rings.observer_km, (rings.plane_from_j2000 @ boresight)[None])
    assert np.isfinite(middle).all()
    steps = 4000.0 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points = middle + steps
    seen = rings.position_km + points @ rings.plane_from_j2000
    for k in range(len(points)):
        wanted = np.array(spiceypy.spkcpt(
            plane.T @ points[k], "SATURN", "J2000", state.et, "J2000", "OBSERVER", "CN+S", str(SPACECRAFT)
        )[0][:3])  # fmt: skip
        gap = np.linalg.norm(seen[k] / np.linalg.norm(seen[k]) - wanted / np.linalg.norm(wanted))
        # Squares of velocities over light's are 1e-9; a pixel of this camera is 6e-6.
        assert gap < 1e-8
    # One apparent place of the planet's centre would be a hundred times worse there.
    centre = np.array(spiceypy.spkezp(699, state.et, "J2000", "CN+S", SPACECRAFT)[0])
    plain, ours = centre + points @ plane, seen
    plain, ours = (x / np.linalg.norm(x, axis=1)[:, None] for x in (plain, ours))
    assert np.linalg.norm(plain - ours, axis=1).max() > 5e-7


def test_sun_and_time_are_those_of_the_planet(state: State) -> None:
    rings = state.rings
    assert rings is not None
    assert rings.sun_direction_j2000 is not None
    toward = float(rings.plane_from_j2000[2] @ rings.sun_direction_j2000)
    assert np.sin(rings.opening_sun_rad) == pytest.approx(toward, abs=1e-4)
    distance = float(np.linalg.norm(rings.position_km))
    days = (state.et - distance / spiceypy.clight() - float(spiceypy.str2et("2004-01-01T12:00:00"))) / 86400.0
    assert np.degrees(rings.features[0].long_peri_rad) == pytest.approx((3.0 * days) % 360.0, abs=1e-3)
    # The planet hides and shades its rings even where its own disc is not in the field.
    assert "SATURN" in {body.name for body in state.bodies}
