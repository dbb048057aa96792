"""The sample archive of an invented asteroid, mapped by maplets and seen by a spacecraft that half knows where it is.

Nothing here is shared with the navigator: surface, rays, maplets, noise and kernels are made by code of their own.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import yaml

from workflows.samples.asteroid_maplets import SampleMaplet, make_maplet, wanted, write_maplet
from workflows.samples.asteroid_options import BODY, AsteroidOptions
from workflows.samples.asteroid_plan import AsteroidShot, plan_frame
from workflows.samples.asteroid_rays import Ground, ground_of
from workflows.samples.asteroid_render import expose
from workflows.samples.asteroid_surface import Asteroid, directions_of_face, make_asteroid, values_at
from workflows.samples.asteroid_truth import CONVENTION, truth_entry
from workflows.samples.cameras import FloatArray
from workflows.samples.flyby_cameras import flyby_cameras
from workflows.samples.flyby_kernels import META_KERNEL, write_kernels
from workflows.samples.flyby_products import write_product
from workflows.samples.write import Json, refuse_used

SHAPE = "shape_coarse.txt"
SPC = "spc"
MAPLETS = "tessary.maplets"
TRUTH_LANDMARKS = "truth_landmarks.parquet"
SHAPE_PROBES = 4000
SHAPE_CORRELATION_DEG = 1.5
"""About a facet and a half of the coarse shape: what it lacks are boulders and small craters."""
MARGIN_SIGMA = 3.0
CHUNK = 16


@lru_cache(maxsize=1)
def _ground(store: Path) -> Ground:
    """Return the fine body that was made once and kept in a folder."""
    asteroid = Asteroid(np.load(store / "radius.npy"), np.load(store / "albedo.npy"), *np.load(store / "bounds.npy"))
    return ground_of(asteroid)


def _keep(asteroid: Asteroid, store: Path) -> None:
    np.save(store / "radius.npy", asteroid.radius_km)
    np.save(store / "albedo.npy", asteroid.albedo)
    np.save(store / "bounds.npy", [asteroid.highest_km, asteroid.steepness])


def write_shot(item: AsteroidShot, store: Path, folder: Path) -> Json:
    """Render a frame and write it into a folder; returns its entry of the truth."""
    ground = _ground(store)
    taken, snr = expose(item, ground)
    write_product(item.shot, taken, folder)
    return truth_entry(item, ground, snr)


def _write_cut(task: tuple[int, int, FloatArray], options: AsteroidOptions, store: Path, folder: Path) -> SampleMaplet:
    maplet = make_maplet(_ground(store), options, *task)
    write_maplet(maplet, folder)
    return maplet


def _coarse(options: AsteroidOptions) -> Asteroid:
    return make_asteroid(BODY.radii_km, options.coarse_cells, options.seed, fine=False)


def write_coarse_shape(path: Path, coarse: Asteroid) -> None:
    """Write the coarse shape in Gaskell's format: the number of cells, then the vertices of six faces, km."""
    cells = coarse.radius_km.shape[1] - 1
    rows = [f"{cells:12d}"]
    for face in range(len(coarse.radius_km)):
        places = directions_of_face(face, cells) * coarse.radius_km[face][..., None].astype(np.float64)
        rows += [f"{x:13.5f}{y:13.5f}{z:13.5f}" for x, y, z in places.reshape(-1, 3)]
    path.write_text("\n".join(rows) + "\n", encoding="ascii")


def _shape_sigma_km(coarse: Asteroid, ground: Ground) -> float:
    """Return the rms height of the fine surface over the coarse one."""
    ways = np.random.default_rng(5).standard_normal((SHAPE_PROBES, 3))
    gaps = values_at(ground.radius_km, ways) - values_at(coarse.radius_km, ways)
    return float(np.sqrt(np.mean(gaps**2)))


def _margin_px(options: AsteroidOptions) -> float:
    """Return how far attitude and position errors together move the body over the array, three sigma."""
    aside = options.position_sigma_share / flyby_cameras()[options.camera].optics.rad_per_px
    return float(np.ceil(MARGIN_SIGMA * np.hypot(options.pointing_sigma_px, aside)))


def _description(options: AsteroidOptions, shape_sigma_km: float) -> Json:
    margin = _margin_px(options)
    return {
        "name": f"asteroid-{options.seed}",
        "images": ["data/*.IMG"],
        "geometry": "spice",
        "kernels": f"kernels/{META_KERNEL}",
        "stars": [],
        "settings": {
            "fit_camera_rotation": True,
            "max_rotation_deg": max(0.5, round(MARGIN_SIGMA * options.twist_sigma_deg, 3)),
            "search_margin_vu": [margin, margin],
        },
        "maplets": {BODY.name: MAPLETS},
        "bodies": {
            BODY.name: {
                "shape": SHAPE,
                "photometry": "mcewen",
                "shape_sigma_km": round(shape_sigma_km, 6),
                "shape_correlation_deg": SHAPE_CORRELATION_DEG,
            }
        },
    }


def make_asteroid_sample(directory: Path, options: AsteroidOptions) -> Path:
    """Write a sample archive of an asteroid and return the path of its archive.yaml.

    Its maplets are in SPC's own files in the folder ``spc``; whoever calls turns them into the catalogue that the
    description names. The same options but the number of processes give the same bytes.

    Parameters
    ----------
    directory
        Where to write; made if it is not there.
    options
        What to write.

    Raises
    ------
    ValueError
        If an option makes no sense.
    FileExistsError
        If the directory holds anything, or is not a directory.
    """
    options.check()
    refuse_used(directory)
    fine = make_asteroid(BODY.radii_km, options.cells, options.seed)
    ground, coarse = ground_of(fine), _coarse(options)
    shots = [plan_frame(index, options, ground) for index in range(options.frames)]
    for name in ("data", "kernels", f"{SPC}/MAPFILES", f"{SPC}/LMKFILES", f"{SPC}/SUMFILES"):
        (directory / name).mkdir(parents=True)
    write_kernels(directory / "kernels", [item.told for item in shots])
    write_coarse_shape(directory / SHAPE, coarse)
    cuts = [(s, *cut) for s in range(len(options.scales_km)) for cut in wanted(ground, shots, options, s)]
    with TemporaryDirectory() as store:
        _keep(fine, Path(store))
        entries, maplets = _write_all(shots, cuts, (directory, Path(store)), options)
    landmark_table(maplets).to_parquet(directory / TRUTH_LANDMARKS, index=False)
    frames: Json = {item.shot.image_id: entry for item, entry in zip(shots, entries, strict=True)}
    truth: Json = {"convention": CONVENTION, "frames": frames}
    (directory / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    # The description comes last: an archive without it was interrupted.
    path = directory / "archive.yaml"
    description = _description(options, _shape_sigma_km(coarse, ground))
    path.write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
    return path


def _write_all(
    shots: list[AsteroidShot],
    cuts: list[tuple[int, int, FloatArray]],
    folders: tuple[Path, Path],
    options: AsteroidOptions,
) -> tuple[list[Json], list[SampleMaplet]]:
    """Write all frames and maplets; returns their truth in order."""
    directory, store = folders
    draw = partial(write_shot, store=store, folder=directory / "data")
    cut = partial(_write_cut, options=options, store=store, folder=directory / SPC)
    if options.processes == 1:
        return [draw(item) for item in shots], [cut(task) for task in cuts]
    # Forking a program that may run threads is not safe.
    with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(draw, shots)), list(pool.map(cut, cuts, chunksize=CHUNK))


def landmark_table(maplets: list[SampleMaplet]) -> pd.DataFrame:
    """Return the truth of the landmarks: true and told place, and the told sigma, km, body-fixed."""
    columns: dict[str, object] = {"landmark": [maplet.name for maplet in maplets]}
    columns["scale_km"] = [maplet.scale_km for maplet in maplets]
    for what in ("true", "told", "sigma"):
        values = np.array([getattr(maplet, f"{what}_km") for maplet in maplets]).reshape(-1, 3)
        columns |= {f"{what}_{axis}_km": values[:, k] for k, axis in enumerate("xyz")}
    return pd.DataFrame(columns)
