"""The sample archive of an invented planet and its moons, seen by three spacecraft, with planted truth.

Nothing here is shared with the navigator: places, rays, noise and kernels are made by code of their own.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import yaml

from workflows.samples.flyby_expose import compose, take
from workflows.samples.flyby_kernels import META_KERNEL, bodies_of, write_kernels
from workflows.samples.flyby_options import FlybyOptions
from workflows.samples.flyby_plan import Shot, plan_shots
from workflows.samples.flyby_products import write_product
from workflows.samples.flyby_ring_plan import plan_ring_shots
from workflows.samples.flyby_ring_system import ring_catalogue
from workflows.samples.flyby_ring_truth import CONVENTION as RING_CONVENTION
from workflows.samples.flyby_ring_truth import ring_truth_entry, told_features
from workflows.samples.flyby_system import PLANET_ID, SampleBody
from workflows.samples.flyby_terrain import terrain_of
from workflows.samples.flyby_truth import CONVENTION, truth_entry
from workflows.samples.write import Json, refuse_used

CHUNK = 4
"""Frames a worker takes at a time."""
RINGS = "rings.yaml"
"""The ring catalogue, beside the description."""


def write_shot(shot: Shot, folder: Path) -> Json:
    """Render a planned frame and write it into a folder; returns its entry of the truth."""
    rng = np.random.default_rng([shot.seed, shot.index, 8])
    scene = compose(shot, rng)
    taken = take(shot, scene, rng)
    write_product(shot, taken, folder)
    if shot.stars:
        scene.stars.to_parquet(folder / f"{shot.image_id}.stars.parquet", index=False)
    return truth_entry(shot, scene, taken) if scene.disc is None else ring_truth_entry(shot, scene, scene.disc, taken)


def told_bodies(options: FlybyOptions, bodies: list[SampleBody]) -> Json:
    """Return what the archive tells of each body: its heights' rms (km) and correlation, scattering law and haze."""
    told: Json = {}
    for body in bodies:
        terrain = None if options.smooth else terrain_of(body, options.seed)
        block: Json = {
            "photometry": body.surface.law,
            "shape_sigma_km": 0.0 if terrain is None else round(terrain.rms * body.mean_radius_km, 6),
            "shape_correlation_deg": 5.0 if terrain is None else terrain.correlation_deg,
            "haze_km": options.haze_km if body.naif_id == PLANET_ID else 0.0,
        }
        if body.surface.law == "lunar_lambert":
            block["photometry_parameter"] = body.surface.parameter
        told[body.name] = block
    return told


def make_flyby_sample(directory: Path, options: FlybyOptions) -> Path:
    """Write a sample archive of bodies and return the path of its archive.yaml.

    The same options but the number of processes give the same bytes: every frame has random generators of its own.

    Parameters
    ----------
    directory
        Where to write; made if it is not there.
    options
        What to write.

    Raises
    ------
    ValueError
        If an option makes no sense, or a frame cannot be had as wanted.
    FileExistsError
        If the directory holds anything, or is not a directory.
    """
    options.check()
    refuse_used(directory)
    shots = plan_shots(options) + plan_ring_shots(options)
    for name in ("data", "kernels"):
        (directory / name).mkdir(parents=True)
    write_kernels(directory / "kernels", shots)
    entries = _write_shots(shots, directory / "data", options.processes)
    truth: Json = {"convention": CONVENTION, "frames": {s.image_id: e for s, e in zip(shots, entries, strict=True)}}
    if options.ring_frames:
        truth |= {"ring_convention": RING_CONVENTION, "rings": told_features(options.seed)}
        text = yaml.safe_dump(ring_catalogue(), sort_keys=False)
        (directory / RINGS).write_text(text, encoding="utf-8")
    (directory / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    # The description comes last: an archive without it was interrupted.
    globs = sorted({"data/*.fit" if shot.camera.stored == "lorri" else "data/*.IMG" for shot in shots})
    description: Json = {
        "name": f"flyby-{options.seed}",
        "images": list(globs),
        "geometry": "spice",
        "kernels": f"kernels/{META_KERNEL}",
        "stars": "per-image" if any(shot.stars for shot in shots) else [],
        "bodies": told_bodies(options, bodies_of(shots)),
    }
    if options.ring_frames:
        description["rings"] = RINGS
    path = directory / "archive.yaml"
    path.write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
    return path


def _write_shots(shots: list[Shot], folder: Path, processes: int) -> list[Json]:
    """Write all frames and return their truth in order."""
    work = partial(write_shot, folder=folder)
    if processes == 1 or len(shots) == 1:
        return [work(shot) for shot in shots]
    # Forking a program that may run threads is not safe.
    with ProcessPoolExecutor(min(processes, len(shots)), mp_context=get_context("spawn")) as pool:
        return list(pool.map(work, shots, chunksize=CHUNK))
