"""An archive and the configuration for it, from what a command line says."""

from collections.abc import Sequence
from pathlib import Path

from catalogs.archive import Archive, open_archive
from workflows.config import Configuration, load_configuration, parse_setting

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


def _merge(tree: dict[str, object], addition: dict[str, object]) -> None:
    for key, value in addition.items():
        old = tree.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            _merge(old, value)
        else:
            tree[key] = value
