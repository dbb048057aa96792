"""Serial runs of an archive inside a test."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from catalogs.archive import open_archive
from workflows.config import load_configuration
from workflows.execute import ClusterOptions
from workflows.plan import make_plan
from workflows.report import offsets
from workflows.run import RunListener, execute
from workflows.store import RunFolder

QUIET = RunListener(lambda text: None, lambda outcome: None)


def run_archive(
    archive: Path, folder: Path, overrides: dict[str, object] | None = None, settings: Sequence[str] = ()
) -> pd.DataFrame:
    """Navigate an archive in this process and return its table of offsets, by image id."""
    run_folder = RunFolder(folder)
    plan = make_plan(open_archive(str(archive), overrides or {}), load_configuration((), settings), run_folder)
    execute(plan, ClusterOptions(workers=0), QUIET)
    return offsets(run_folder).set_index("image_id")
