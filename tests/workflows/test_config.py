"""Configuration: layers, and what each of them may not say."""

from pathlib import Path

import pytest
import yaml

from pipeline.errors import ConfigurationError
from workflows import config
from workflows.config import Configuration, load_configuration, parse_setting
from workflows.plan import PER_IMAGE

# What is said, the key that the complaint must name, and what it must say is allowed.
SPOILED = [
    ("detections: {threshold_sigma: 5}", "detections", "detection"),
    ("detection: {threshold: 5}", "detection.threshold", "threshold_sigma"),
    ("frame: {background: {tile: 5}}", "frame.background.tile", "allowed here"),
    ("techniques: {StarFieldNav: {}}", "techniques.StarFieldNav", "StarFieldFromCatalogNav"),
    ("techniques: {StarRefineNav: {min_snrr: 1}}", "techniques.StarRefineNav.min_snrr", "min_snr"),
    ("instruments: {nhlorri: {modes: {1X1: {colour: 1}}}}", "instruments.nhlorri.modes.1X1.colour", "focal_length_mm"),
    ("orchestrator: {rank: {high: {min_sigma: 1}}}", "orchestrator.rank.high.min_sigma", "min_confidence"),
    ("detection: {threshold_sigma: many}", "detection.threshold_sigma", "number"),
    ("detection: {threshold_sigma: [5]}", "detection.threshold_sigma", "number"),
    ("detection: {threshold_sigma: null}", "detection.threshold_sigma", "number"),
    ("detection: {threshold_sigma: .nan}", "detection.threshold_sigma", ""),
    ("detection: {threshold_sigma: .inf}", "detection.threshold_sigma", "finite"),
    ("detection: {threshold_sigma: -1}", "detection.threshold_sigma", "greater than"),
    ("detection: 5", "detection", "dictionary"),
    ("detection:", "detection", "dictionary"),
    ("frame: {max_missing_share: 1.5}", "frame.max_missing_share", "less than or equal to 1"),
    ("instruments: {x: {mission: A}}", "instruments.x", "required"),
    ("instruments: {x: {mission: A, camera: B, modes: {}}}", "instruments.x.modes", "at least 1"),
    ("instruments: {nhlorri: {max_rotation_deg: 50}}", "instruments.nhlorri.max_rotation_deg", "45"),
    ("instruments: {nhlorri: {fit_camera_rotation: maybe}}", "instruments.nhlorri.fit_camera_rotation", "boolean"),
    ("instruments: {nhlorri: {search_margin_vu: [1]}}", "instruments.nhlorri.search_margin_vu", "required"),
    ("instruments: {nhlorri: {header: vicar}}", "instruments.nhlorri.header", "lorri"),
    ("instruments: {nhlorri: {product_id_pattern: '('}}", "product_id_pattern", "regular expression"),
    ("instruments: {nhlorri: {modes: {1X1: {k_px_per_mm: [[1, 1], [1, 1]]}}}}", "k_px_per_mm", "inverse"),
    ("instruments: {nhlorri: {modes: {1X1: {focal_length_mm: 0}}}}", "focal_length_mm", "greater than 0"),
    ("instruments: {nhlorri: {fit_camera_rotation: true, max_rotation_deg: 0}}", "instruments.nhlorri", "above 0"),
]  # fmt: skip


def refusal(**layers: object) -> str:
    with pytest.raises(ConfigurationError) as error:
        load_configuration(**layers)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(("text", "key", "allowed"), SPOILED)
def test_user_files(tmp_path: Path, text: str, key: str, allowed: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    said = refusal(user_files=[path])
    assert str(path) in said
    assert key in said
    assert allowed.lower() in said.lower()


@pytest.mark.parametrize(("text", "key", "allowed"), SPOILED)
def test_shipped_files(monkeypatch: pytest.MonkeyPatch, text: str, key: str, allowed: str) -> None:
    shipped = [*config._shipped(), ("config_999_spoiled.yaml", text)]
    monkeypatch.setattr(config, "_shipped", lambda: iter(shipped))
    said = refusal()
    assert "config_999_spoiled.yaml" in said
    assert key in said
    assert allowed.lower() in said.lower()


def _settings_of(tree: object, at: tuple[str, ...] = ()) -> list[str]:
    if isinstance(tree, dict) and tree:
        return [line for key, value in tree.items() for line in _settings_of(value, (*at, str(key)))]
    return [f"{'.'.join(at)}={yaml.safe_dump(tree, default_flow_style=True).splitlines()[0]}"]


@pytest.mark.parametrize(("text", "key", "allowed"), SPOILED)
def test_settings(text: str, key: str, allowed: str) -> None:
    said = refusal(settings=_settings_of(yaml.safe_load(text)))
    assert "--set" in said
    assert key in said
    assert allowed.lower() in said.lower()


@pytest.mark.parametrize("setting", ["a", "", "=5", "a.=5", ".a=5", "a..b=5", "a=[", "a={", "a=2001-99-99"])
def test_malformed_settings(setting: str) -> None:
    assert "--set" in refusal(settings=[setting])


@pytest.mark.parametrize(
    "data",
    [
        b"- a",
        b"text",
        b"a: [",
        b"\xff\xfe\x00",
        b"[" * 3000,
        b"a: b: c",
        b"a: 2001-99-99",
        b"!!python/object:os.x {}",
    ],
)
def test_files_that_are_no_settings(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(data)
    assert str(path) in refusal(user_files=[path])


def test_files_that_are_not_there(tmp_path: Path) -> None:
    assert str(tmp_path / "none.yaml") in refusal(user_files=[tmp_path / "none.yaml"])
    assert str(tmp_path) in refusal(user_files=[tmp_path])


def test_later_layers_win_key_by_key(tmp_path: Path) -> None:
    one, two = tmp_path / "1.yaml", tmp_path / "2.yaml"
    one.write_text("detection: {threshold_sigma: 6}\ninstruments: {nhlorri: {modes: {4X4: {psf_sigma_px: 0.5}}}}")
    two.write_text("detection: {threshold_sigma: 7}")
    loaded = load_configuration([one, two])
    assert loaded.detection.threshold_sigma == 7
    assert loaded.instruments["nhlorri"].modes["4X4"].psf_sigma_px == 0.5
    assert loaded.instruments["nhlorri"].modes["4X4"].focal_length_mm == 2619.008
    assert load_configuration([one, two], ["detection.threshold_sigma=8"]).detection.threshold_sigma == 8


def test_empty_and_commented_files_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("# nothing\n")
    assert load_configuration([tmp_path / "mine.yaml"]) == load_configuration()


def test_digest_tells_configurations_apart() -> None:
    assert load_configuration().digest() == load_configuration().digest()
    assert load_configuration(settings=["detection.threshold_sigma=6.5"]).digest() != load_configuration().digest()


def test_printed_configuration_loads_again(tmp_path: Path) -> None:
    path = tmp_path / "printed.yaml"
    path.write_text(yaml.safe_dump(load_configuration().model_dump(mode="json")))
    assert load_configuration([path]).digest() == load_configuration().digest()


def test_shipped_techniques_are_all_named() -> None:
    shipped = yaml.safe_load(dict(config._shipped())["config_510_techniques.yaml"])
    assert set(shipped["techniques"]) == set(Configuration().techniques.model_dump())


def test_values_of_settings_are_yaml() -> None:
    assert parse_setting("a.b=[1, x]") == {"a": {"b": [1, "x"]}}
    assert parse_setting("a=") == {"a": None}
    assert parse_setting("a=b=c") == {"a": "b=c"}
    assert parse_setting(f"stars={PER_IMAGE}")["stars"] == PER_IMAGE
