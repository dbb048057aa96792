"""Help on the configuration."""

import json
from pathlib import Path

import pytest

from pipeline.errors import ConfigurationError
from workflows.cli import app
from workflows.config import load_configuration
from workflows.config_cli import all_keys


def say(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    app(["config", *words], standalone_mode=False)
    return capsys.readouterr().out


def test_every_key_says_what_it_means() -> None:
    keys = list(all_keys())
    assert len(keys) > 100
    assert [key for key, field in keys if not field.description] == []


def test_every_key_can_be_explained(capsys: pytest.CaptureFixture[str]) -> None:
    for key, field in all_keys():
        assert say(capsys, "explain", key).startswith(f"{key}: {field.description}")


def test_an_explanation_tells_default_bounds_value_and_source(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("detection: {threshold_sigma: 6.5}\n")
    said = say(capsys, "explain", "detection.threshold_sigma", "--config", str(mine))
    default = load_configuration().detection.threshold_sigma
    assert f"default  {default!r}" in said
    assert f"now      6.5, by {mine}" in said
    assert "Gt(gt=0)" in said or "Ge(ge=" in said


def test_a_part_is_shown_and_a_wrong_key_names_the_right_ones(capsys: pytest.CaptureFixture[str]) -> None:
    default = load_configuration().detection.threshold_sigma
    assert say(capsys, "show", "detection.threshold_sigma").strip() == str(default)
    for command in ("show", "explain"):
        with pytest.raises(ConfigurationError, match="threshold_sigma"):
            say(capsys, command, "detection.threshold")


def test_differences_of_a_run_and_a_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("detection: {threshold_sigma: 6.5}\n")
    default = load_configuration().detection.threshold_sigma
    assert say(capsys, "diff", str(mine)) == f"detection.threshold_sigma: 6.5 | {default!r}\n"
    configuration = load_configuration([mine]).model_dump(mode="json")
    (tmp_path / "run.json").write_text(json.dumps({"configuration": configuration}))
    assert say(capsys, "diff", str(tmp_path), str(mine)) == ""
