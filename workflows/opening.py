"""An archive and the configuration for it, from what a command line says."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from catalogs.archive import Archive, open_archive
from catalogs.geometry import first_problem
from pipeline.errors import ConfigurationError
from pipeline.json_values import Json
from workflows.config import Configuration, load_configuration, parse_setting
from workflows.store import RunFolder, read_json

_ARCHIVE_KEY = "archive."


def open_both(archive: str, config: Sequence[Path], settings: Sequence[str]) -> tuple[Archive, Configuration]:
    """Archive and configuration as a command line names them.

    Parameters
    ----------
    archive
        Folder or URL.
    config
        The user's files.
    settings
        ``a.b=c`` each; ``archive.KEY=VALUE`` replaces a key of ``archive.yaml``.

    Returns
    -------
    tuple
        Both, checked.

    Raises
    ------
    ConfigurationError
        In one line.
    """
    mine = [s for s in settings if not s.startswith(_ARCHIVE_KEY)]
    overrides: dict[str, object] = {}
    for setting in settings:
        if setting.startswith(_ARCHIVE_KEY):
            _merge(overrides, parse_setting(setting.removeprefix(_ARCHIVE_KEY)))
    configuration = load_configuration(config, mine)
    return open_archive(archive, overrides), configuration


def open_remembered(folder: RunFolder, hint: str) -> Archive:
    """The archive that a run was made of, as the run described it.

    Parameters
    ----------
    folder
        A run that has ended once.
    hint
        How else the archive can be named, for messages.

    Returns
    -------
    Archive
        Where the run found it.

    Raises
    ------
    ConfigurationError
        If the run does not say, or there is no archive any more.
    """
    summary = _summary(folder, hint)
    url, description = summary.get("archive_url"), summary.get("archive_description")
    if not isinstance(url, str) or not isinstance(description, dict):
        raise ConfigurationError(f"{folder.root} does not say where its archive is: add {hint}")
    return open_archive(url, description)


def remembered_configuration(folder: RunFolder, hint: str) -> Configuration:
    """The configuration of a run's latest end.

    Parameters
    ----------
    folder
        A run that has ended once.
    hint
        What else can be said, for messages.

    Returns
    -------
    Configuration
        All of it, checked.

    Raises
    ------
    ConfigurationError
        If the run does not say, or said it to another version whose keys were others.
    """
    try:
        return Configuration.model_validate(_summary(folder, hint).get("configuration"))
    except ValidationError as error:
        raise ConfigurationError(f"configuration of {folder.root}: {first_problem(error)}") from error


def _summary(folder: RunFolder, hint: str) -> dict[str, Json]:
    if not folder.plan.exists():
        raise ConfigurationError(f"{folder.root} holds no run")
    summary = read_json(folder.root / "run.json")
    if summary is None:
        raise ConfigurationError(f"{folder.root} has no run.json: the run has not ended yet; add {hint}")
    return summary


def _merge(tree: dict[str, object], addition: dict[str, object]) -> None:
    for key, value in addition.items():
        old = tree.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            _merge(old, value)
        else:
            tree[key] = value
