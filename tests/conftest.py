"""What tests share within a session: a star cache of their own, and small sample archives."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from workflows.samples.stars import StarSampleOptions, make_star_sample


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that all processes of a test session share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def star_cache(shared_folder: Path) -> Path:
    """Cache of star indexes that is not the user's."""
    cache = shared_folder / "cache"
    os.environ["PILOTAGE_CACHE"] = str(cache)
    return cache


def _made_once(folder: Path, make: Callable[[Path], object]) -> Path:
    """Folder that the first process to come has filled."""
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder.with_suffix(".done")
        if not done.exists():
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def lorri_archive(shared_folder: Path) -> Path:
    """Thirty-two LORRI-like 4x4 frames with their pointing in the header; not to be written to."""
    options = StarSampleOptions(frames=32, seed=5, cameras=("lorri_4x4",), min_stars=4, max_stars=20, processes=1)
    return _made_once(shared_folder / "lorri", lambda folder: make_star_sample(folder, options))
