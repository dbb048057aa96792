"""Configuration: numbered YAML files, the user's files on top, and single keys from the command line."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import yaml
from pydantic import BaseModel, Field, ValidationError

from catalogs.bodies import BodyBlock
from catalogs.instruments import InstrumentBlock
from pipeline.curate import RankOptions
from pipeline.ensemble import EnsembleOptions
from pipeline.errors import ConfigurationError
from pipeline.frame import FrameOptions
from pipeline.imaging.detect import DetectionOptions
from pipeline.navigate import NavigationOptions, TechniquesOptions
from pipeline.options import Options
from pipeline.predict.bodies import BodyPredictionOptions
from pipeline.predict.rings import RingPredictionOptions
from pipeline.predict.stars import StarPredictionOptions

Tree = dict[str, object]
Path_ = tuple[str, ...]
_COMMAND_LINE = "--set"


class OrchestratorOptions(Options):
    """From techniques' answers to the image's answer."""

    ensemble: EnsembleOptions = EnsembleOptions()
    rank: RankOptions = RankOptions()


class Configuration(Options):
    """Everything that can be set."""

    instruments: dict[str, InstrumentBlock] = Field(default_factory=dict, description="camera blocks by name")
    bodies: dict[str, BodyBlock] = Field(default_factory=dict, description="planets, moons and small bodies by name")
    frame: FrameOptions = FrameOptions()
    detection: DetectionOptions = DetectionOptions()
    stars: StarPredictionOptions = StarPredictionOptions()
    body_prediction: BodyPredictionOptions = BodyPredictionOptions()
    ring_prediction: RingPredictionOptions = RingPredictionOptions()
    techniques: TechniquesOptions = TechniquesOptions()
    orchestrator: OrchestratorOptions = OrchestratorOptions()

    def navigation(self) -> NavigationOptions:
        """The part that steers one image."""
        return NavigationOptions(
            frame=self.frame, detection=self.detection, stars=self.stars,
            body_prediction=self.body_prediction, ring_prediction=self.ring_prediction, techniques=self.techniques,
            ensemble=self.orchestrator.ensemble,
        )  # fmt: skip

    def digest(self) -> str:
        """sha256 of all values, defaults included."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def load_configuration(user_files: Sequence[Path] = (), settings: Sequence[str] = ()) -> Configuration:
    """Shipped files in the order of their numbers, then the user's, then single settings.

    Parameters
    ----------
    user_files
        YAML files, later ones win.
    settings
        ``a.b=c`` each; the value is YAML.

    Returns
    -------
    Configuration
        Checked.

    Raises
    ------
    ConfigurationError
        One line that names the file, the key and what is allowed.
    """
    return trace_configuration(user_files, settings)[0]


def trace_configuration(
    user_files: Sequence[Path] = (), settings: Sequence[str] = ()
) -> tuple[Configuration, dict[str, str]]:
    """The same with where each value comes from.

    Parameters
    ----------
    user_files, settings
        As of :func:`load_configuration`.

    Returns
    -------
    tuple
        Configuration; file or setting by dotted key, for keys that any of them names.

    Raises
    ------
    ConfigurationError
        As :func:`load_configuration`.
    """
    tree: Tree = {}
    origin: dict[Path_, str] = {}
    for name, text in _shipped():
        _merge(tree, _parse(text, name), name, origin)
    for path in user_files:
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{path} cannot be read: {error}") from error
        _merge(tree, _parse(text, str(path)), str(path), origin)
    for setting in settings:
        _merge(tree, parse_setting(setting), f"{_COMMAND_LINE} {setting}", origin)
    try:
        configuration = Configuration.model_validate(tree)
    except ValidationError as error:
        raise ConfigurationError(_explain(error, origin)) from error
    return configuration, {".".join(path): source for path, source in origin.items()}


def _shipped() -> Iterator[tuple[str, str]]:
    folder = files("catalogs") / "config"
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.startswith("config_") and entry.name.endswith(".yaml"):
            yield entry.name, entry.read_text(encoding="utf-8")


def _parse(text: str, source: str) -> Tree:
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{source} is not YAML: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigurationError(f"{source} must hold keys and values")
    return content


def parse_setting(setting: str) -> Tree:
    """Nested dictionary of one ``a.b=c``.

    Parameters
    ----------
    setting
        Text from the command line.

    Returns
    -------
    dict
        For example ``{"a": {"b": c}}``.

    Raises
    ------
    ConfigurationError
        If there is no ``=``, no key, or the value is not YAML.
    """
    key, equals, value = setting.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigurationError(f"{_COMMAND_LINE} {setting}: say KEY=VALUE, for example detection.threshold_sigma=6")
    try:
        tree: object = yaml.safe_load(value)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{_COMMAND_LINE} {setting}: the value is not YAML") from error
    for part in reversed(parts):
        tree = {part: tree}
    return tree if isinstance(tree, dict) else {}


def _merge(tree: Tree, addition: Mapping[str, object], source: str, origin: dict[Path_, str], at: Path_ = ()) -> None:
    for raw_key, value in addition.items():
        key = str(raw_key)
        here = (*at, key)
        origin[here] = source
        old = tree.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            _merge(old, value, source, origin, here)
        elif isinstance(value, dict):
            tree[key] = {}
            _merge(tree[key], value, source, origin, here)  # type: ignore[arg-type]
        else:
            tree[key] = value


def _explain(error: ValidationError, origin: Mapping[Path_, str]) -> str:
    problem = error.errors(include_url=False)[0]
    where = tuple(str(part) for part in problem["loc"])
    source = next((origin[where[:n]] for n in range(len(where), 0, -1) if where[:n] in origin), "configuration")
    key = ".".join(where)
    if problem["type"] == "extra_forbidden":
        allowed = ", ".join(_keys_at(where[:-1])) or "none"
        return f"{source}: {key} is not a key; allowed here: {allowed}"
    given = problem["input"]
    shown = f" (got {given!r})" if isinstance(given, str | int | float | bool) or given is None else ""
    return f"{source}: {key}: {problem['msg'].lower()}{shown}"


def _keys_at(where: Path_) -> list[str]:
    """Keys that the schema allows at a place."""
    model: type[BaseModel] | None = Configuration
    names = iter(where)
    for name in names:
        annotation = model.model_fields[name].annotation if model and name in model.model_fields else None
        if getattr(annotation, "__origin__", None) is dict:
            next(names, None)
            annotation = annotation.__args__[1]  # type: ignore[union-attr]
        model = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
    return list(model.model_fields) if model else []
