"""``pilotage config``: the configuration, what a key means, and what differs."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer
import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pipeline.errors import ConfigurationError
from workflows.config import Configuration, load_configuration, trace_configuration
from workflows.store import read_json

app = typer.Typer(help="Configuration: show it, explain a key, compare two.")
ConfigOption = Annotated[
    list[Path], typer.Option("--config", help="YAML file on top of the shipped ones (repeatable).")
]
SetOption = Annotated[list[str], typer.Option("--set", help="One key, a.b=c (repeatable).")]
_DEFAULTS = "defaults"


@app.callback(invoke_without_command=True)
def everything(
    context: typer.Context,
    config: ConfigOption = [],  # noqa: B006
    settings: SetOption = [],  # noqa: B006
) -> None:
    """Print the configuration that a run would use, as YAML."""
    if context.invoked_subcommand is None:
        _print(load_configuration(config, settings).model_dump(mode="json"))


@app.command()
def show(
    key: Annotated[str | None, typer.Argument(help="Part of it, a.b; all by default.")] = None,
    config: ConfigOption = [],  # noqa: B006
    settings: SetOption = [],  # noqa: B006
) -> None:
    """Print the configuration or a part of it, as YAML."""
    tree: object = load_configuration(config, settings).model_dump(mode="json")
    for part in key.split(".") if key else ():
        if not isinstance(tree, dict) or part not in tree:
            raise ConfigurationError(f"{key} is not a key; {_known(tree)}")
        tree = tree[part]
    _print(tree)


def _print(tree: object) -> None:
    typer.echo(yaml.safe_dump(tree, sort_keys=False).removesuffix("...\n").rstrip("\n"))


def _known(tree: object) -> str:
    return f"allowed here: {', '.join(map(str, tree))}" if isinstance(tree, Mapping) else "its parent is a value"


@app.command()
def explain(
    key: Annotated[str, typer.Argument(help="For example detection.threshold_sigma; a part lists its keys.")],
    config: ConfigOption = [],  # noqa: B006
    settings: SetOption = [],  # noqa: B006
) -> None:
    """Say what a key means, what it may be, what it is and where that was said."""
    configuration, origin = trace_configuration(config, settings)
    value: object = configuration
    field: FieldInfo | None = None
    for part in key.split("."):
        if isinstance(value, BaseModel) and part in type(value).model_fields:
            field, value = type(value).model_fields[part], getattr(value, part)
        elif isinstance(value, Mapping) and part in value:
            field, value = None, value[part]
        else:
            fields = type(value).model_fields if isinstance(value, BaseModel) else value
            raise ConfigurationError(f"{key} is not a key; {_known(fields)}")
    if isinstance(value, BaseModel):
        for name, inner in type(value).model_fields.items():
            typer.echo(f"{key}.{name}: {inner.description or 'keys of its own'}")
        return
    for line in _lines(key, field, value, origin):
        typer.echo(line)


def _lines(key: str, field: FieldInfo | None, value: object, origin: Mapping[str, str]) -> Iterator[str]:
    yield f"{key}: {field.description if field and field.description else 'one of the names that files may add'}"
    if field is not None:
        bounds = ", ".join(str(bound) for bound in field.metadata)
        named = getattr(field.annotation, "__name__", None) if isinstance(field.annotation, type) else None
        yield f"  type     {named or field.annotation}{f', {bounds}' if bounds else ''}"
        if not field.is_required():
            yield f"  default  {field.get_default(call_default_factory=True)!r}"
    source = next((origin[at] for at in _ancestors(key) if at in origin), _DEFAULTS)
    yield f"  now      {value!r}, by {source}"


def _ancestors(key: str) -> Iterator[str]:
    parts = key.split(".")
    return (".".join(parts[:n]) for n in range(len(parts), 0, -1))


@app.command()
def diff(
    first: Annotated[str, typer.Argument(help="A run's folder, a YAML file, or 'defaults'.")],
    second: Annotated[str, typer.Argument(help="The same.")] = _DEFAULTS,
) -> None:
    """Print the keys in which two configurations differ."""
    one, other = (_flat(_tree_of(place)) for place in (first, second))
    for key in sorted(one.keys() | other.keys()):
        if one.get(key) != other.get(key):
            typer.echo(f"{key}: {one.get(key)!r} | {other.get(key)!r}")


def _tree_of(place: str) -> object:
    """Configuration of a run, of a file on top of the shipped ones, or of these alone."""
    if place == _DEFAULTS:
        return load_configuration().model_dump(mode="json")
    path = Path(place)
    if not path.is_dir():
        return load_configuration([path]).model_dump(mode="json")
    summary = read_json(path / "run.json")
    if summary is None or not isinstance(summary.get("configuration"), dict):
        raise ConfigurationError(f"{place} has no run.json with a configuration")
    return summary["configuration"]


def _flat(tree: object, at: str = "") -> dict[str, object]:
    if not isinstance(tree, dict) or not tree:
        return {at: tree}
    found: dict[str, object] = {}
    for key, value in tree.items():
        found |= _flat(value, f"{at}.{key}" if at else str(key))
    return found


def all_keys(model: type[BaseModel] = Configuration, at: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every key that has a value of its own.

    Parameters
    ----------
    model
        Where to begin.
    at
        Its dotted name.

    Yields
    ------
    tuple
        Dotted key and its field.
    """
    for name, field in model.model_fields.items():
        here = f"{at}.{name}" if at else name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from all_keys(field.annotation, here)
        else:
            yield here, field
