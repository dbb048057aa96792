"""Whether a machine can run: versions, caches, room, a scheduler, and what an archive needs."""

import os
import platform
import shutil
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from urllib.parse import urlsplit

import numba
import psutil

from catalogs.archive import open_archive
from catalogs.stars import cache_folder
from pipeline.errors import ConfigurationError
from workflows.config import Configuration
from workflows.plan import make_plan
from workflows.store import RunFolder

_LIBRARIES = (
    "pilotage", "numpy", "scipy", "numba", "opencv-python-headless", "astropy", "rasterio", "spiceypy", "dask",
    "distributed", "pyarrow", "duckdb",
)  # fmt: skip
_GIB = 2**30
# An idle worker with its catalogues and compiled code takes a third of half a GiB; images come on top.
_LEAST_MEMORY = _GIB
_LEAST_DISK = _GIB
_PATIENCE_S = 5.0
_DIGITS_SHOWN = 12


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    subject
        What.
    said
        What was found.
    good
        Whether a run can live with it.
    """

    subject: str
    said: str
    good: bool = True


def examine_machine(output: Path) -> Iterator[Finding]:
    """Versions, caches and room.

    Parameters
    ----------
    output
        Where a run is to be written; need not exist.

    Yields
    ------
    Finding
        One per subject; nothing is left behind.
    """
    yield Finding("python", platform.python_version())
    for name in _LIBRARIES:
        yield Finding(name, version(name))
    yield _writable("star cache", cache_folder())
    yield _writable("numba cache", Path(numba.config.CACHE_DIR or Path(__file__).parents[1] / "pipeline"))
    yield _writable("output", output)
    free = shutil.disk_usage(_existing(output)).free
    yield Finding("disk", f"{free / _GIB:.1f} GiB free at {output}", free >= _LEAST_DISK)
    memory = psutil.virtual_memory().available
    yield Finding("memory", f"{memory / _GIB:.1f} GiB available", memory >= _LEAST_MEMORY)


def _existing(path: Path) -> Path:
    return next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.is_dir())


def _writable(subject: str, folder: Path) -> Finding:
    good = os.access(_existing(folder), os.W_OK | os.X_OK)
    return Finding(subject, f"{folder} is {'' if good else 'not '}writable", good)


def examine_scheduler(address: str) -> Finding:
    """Whether something listens where a scheduler should.

    Parameters
    ----------
    address
        As ``--scheduler`` takes it, such as ``tcp://host:8786``.

    Returns
    -------
    Finding
        Good if a connection is made within some seconds.
    """
    try:
        place = urlsplit(address if "://" in address else f"tcp://{address}")
        host, port = place.hostname, place.port
        if host is None or port is None:
            return Finding("scheduler", f"{address} names no host and port", good=False)
        with socket.create_connection((host, port), timeout=_PATIENCE_S):
            return Finding("scheduler", f"{address} answers")
    except (OSError, ValueError) as error:
        return Finding("scheduler", f"{address}: {error}", good=False)


def examine_archive(archive: str, configuration: Configuration, output: Path) -> Iterator[Finding]:
    """Images, kernels and catalogues of an archive, with their digests.

    Parameters
    ----------
    archive
        Folder, URL, or path of an archive.yaml.
    configuration
        All options.
    output
        Where a run is to be written.

    Yields
    ------
    Finding
        One that is not good where the archive cannot be planned.
    """
    try:
        work = make_plan(open_archive(archive, {}), configuration, RunFolder(output))
    except ConfigurationError as error:
        yield Finding("archive", " ".join(str(error).split()), good=False)
        return
    missing = sum(not ref.exists for ref in work.every)
    yield Finding("archive", f"{len(work.every)} images, {missing} of them not there", missing == 0)
    for kernel in work.setup.kernels:
        yield Finding("kernel", f"{kernel.name} sha256 {kernel.sha256[:_DIGITS_SHOWN]}")
    paths = work.setup.star_indexes
    for (name, sha256), path in zip(work.setup.star_digests, paths, strict=True):
        size = path.stat().st_size / 2**20
        yield Finding("star catalogue", f"{name} {size:.1f} MiB sha256 {sha256[:_DIGITS_SHOWN]}")
