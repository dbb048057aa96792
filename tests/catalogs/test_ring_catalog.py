import numpy as np
import pytest

from catalogs.geometry import et_of_utc
from catalogs.ring_catalog import built_in_rings, parse_rings, rings_of
from pipeline.errors import ConfigurationError
from pipeline.geometry.rings import edge_radius
from pipeline.records import RingKind

_OWN = """
planet: Pella
epoch_utc: "2000-01-01T00:00:00"
features:
  - {name: A, kind: ringlet, a_km: 1000.0, ae_km: 5.0, long_peri_deg: 10.0, long_peri_rate_deg_day: 2.0, width_km: 30.0,
     tau: 0.5, sigma_a_km: 0.2,
     modes: [{m: 2, amplitude_km: 1.5, longitude_deg: 20.0, pattern_speed_deg_day: 100.0},
             {m: 0, amplitude_km: 0.5, longitude_deg: 30.0, pattern_speed_deg_day: 7.0}]}
  - {name: B, kind: edge_outer, a_km: 2000.0}
"""


def test_elements_move_with_time() -> None:
    catalog = parse_rings(_OWN, "rings.yaml")
    days = 12.25
    feature, edge = catalog.at(et_of_utc("2000-01-01T00:00:00") + 86400.0 * days)
    longitude = np.linspace(0.0, 6.0, 17)
    angle = np.degrees(longitude)
    conic = 1000.0 * (1 - 0.005**2) / (1 + 0.005 * np.cos(np.radians(angle - 10.0 - 2.0 * days)))
    wave = 1.5 * np.cos(np.radians(2 * (angle - 20.0 - 100.0 * days)))
    breath = 0.5 * np.cos(np.radians(30.0 + 7.0 * days))
    np.testing.assert_allclose(edge_radius(feature, False, longitude), conic - wave - breath, atol=1e-8)
    assert edge.kind is RingKind.EDGE_OUTER
    assert edge.tau is None


def test_the_last_catalogue_of_a_planet_wins() -> None:
    own = parse_rings(_OWN.replace("Pella", "Saturn"), "rings.yaml")
    assert rings_of((*built_in_rings(), own), "SATURN") is own
    assert rings_of((own,), "URANUS") is None


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("planet: P", "epoch_utc"),
        (_OWN.replace("name: B", "name: A"), "named twice"),
        (_OWN.replace("kind: edge_outer", "kind: spoke"), "kind"),
        (_OWN.replace("a_km: 2000.0", "a_km: -1"), "a_km"),
        (_OWN.replace("width_km: 30.0,", ""), "width_km"),
        (_OWN + "  - {name: C, kind: gap, a_km: 1.0, width_km: 1.0, colour: 3}", "colour"),
        ("[", "not YAML"),
        (_OWN.replace("2000-01-01T00:00:00", "yesterday"), "ISO-8601"),
    ],
)
def test_bad_catalogues_name_the_key(text: str, complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint):
        parse_rings(text, "rings.yaml")


def test_shipped_catalogues_hold_what_is_published() -> None:
    by_planet = {catalog.planet: catalog for catalog in built_in_rings()}
    assert set(by_planet) == {"JUPITER", "SATURN", "URANUS", "NEPTUNE"}
    assert all(catalog.source for catalog in by_planet.values())
    saturn = {feature.name: feature for feature in by_planet["SATURN"].features}
    # The edge of the B ring is in the 2:1 resonance with Mimas; its gap is some 360 km wide.
    edge = saturn["B ring outer"]
    assert edge.kind is RingKind.EDGE_OUTER
    assert max(edge.modes, key=lambda mode: mode.amplitude_km).m == 2
    assert 300.0 < saturn["Huygens gap outer"].a_km - edge.a_km < 400.0
    # Encke's gap is 325 km wide (Nicholson et al. 1990).
    assert saturn["Encke gap outer"].a_km - saturn["Encke gap inner"].a_km == pytest.approx(322.0, abs=5.0)
    uranus = {feature.name: feature for feature in by_planet["URANUS"].features}
    low, high = (
        edge_radius(uranus[f"epsilon {side}"].feature(0.0), False, np.radians([214.97, 34.97]))
        for side in ("inner", "outer")
    )
    # Its width goes from 20 km at pericentre to 96 km at apocentre (French et al. 1991).
    np.testing.assert_allclose(high - low, [20.0, 96.0], atol=1.0)
