"""What the unknowns of a ring fit do to the pieces of edges."""

import numpy as np

from pipeline.navigate import NavigationOptions
from pipeline.predict.rings import RingScene, predict_rings
from pipeline.techniques.base import NavContext
from pipeline.techniques.ring_units import RingUnits, make_units
from pipeline.techniques.ring_unknowns import Layout, Levers, first_radii, layout_of, levers_of, shifts_of, with_drifts
from tests.scenes.ring_scene import Band, RingView, ring_scene

_OFFSET = np.array([3.0, -2.0])


def _setting() -> tuple[RingScene, RingUnits, Layout, Levers]:
    """A round ringlet and one whose radius waves by ten pixels."""
    bands = (Band(185.0, 6.0, 1.0), Band(220.0, 6.0, 1.0, mode=(1, 10.0, 0.3)))
    drawn = ring_scene(np.random.default_rng(3), bands, RingView(0.9, 0.4, (200.0, 1.8)), (3.0, -2.0))
    scene = predict_rings(drawn.state, 0.8, NavigationOptions().ring_prediction)
    units = make_units(scene, scene.pose(_OFFSET, 0.0), 8.0)
    assert units is not None
    layout = layout_of(scene, NavContext.of(drawn.state))
    return scene, units, layout, levers_of(scene, units, units.places_vu[:, 0].mean(axis=0), 0.85)


def test_edges_drift_where_their_radius_changes_along_them() -> None:
    scene, _, _, levers = _setting()
    waves = np.ptp(scene.curves, axis=1) > 1.0
    assert waves.sum() == 2
    assert not levers.drift[~waves].any()
    assert (levers.drift[waves] > 0.5).all()


def test_a_drift_moves_both_ends_apart() -> None:
    _, units, layout, levers = _setting()
    edge = int(np.argmax(levers.drift))
    values = np.zeros(layout.count)
    values[layout.radii][layout.drifts][edge] = 0.4
    shifts = shifts_of(levers, layout, values)
    row, slot = np.nonzero(units.present)
    mine = units.edges[row, 0] + slot == edge
    moved = shifts[row, slot]
    assert not moved[~mine].any()
    np.testing.assert_allclose([moved[mine].min(), moved[mine].max()], [-0.4, 0.4], atol=1e-9)
    # Evenly along the longitude.
    line = np.polynomial.polynomial.polyfit(units.longitude_rad[row[mine]], moved[mine], 1)
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(units.longitude_rad[row[mine]], line), moved[mine])


def test_drifts_are_believed_as_the_edges_shifts_are() -> None:
    scene, _, layout, levers = _setting()
    radii = with_drifts(first_radii(scene, layout), layout, levers.drift)
    drifts, shifts = radii.sigma[layout.drifts], radii.sigma[layout.shifts]
    waves = levers.drift > 0
    np.testing.assert_allclose(drifts[waves], levers.drift[waves] * shifts[waves])
    assert (drifts[~waves] < 1e-3).all()


def test_a_shift_of_the_pointing_moves_pieces_along_their_normals() -> None:
    _, units, layout, levers = _setting()
    values = np.zeros(layout.count)
    values[:2] = (0.3, -0.2)
    row, slot = np.nonzero(units.present)
    expected = units.normal_vu[row, slot] @ values[:2]
    np.testing.assert_allclose(shifts_of(levers, layout, values)[row, slot], expected)
