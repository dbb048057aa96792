"""What is in one frame of the star sample: catalogue stars, a few of them odd, and things no catalogue knows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from workflows.samples.cameras import FloatArray, SampleCamera, project
from workflows.samples.photometry import DETECTION_SNR, flux_at_limit_dn, fluxes_dn, signal_to_noise
from workflows.samples.plan import FramePlan, inside

OUTSIDE_PX = 12.0
"""Stars this far beyond the array still shed light into it."""
ODD_CAP = 4
"""At most one detectable star in this many is odd, so that a small field never consists of exceptions."""
FALSE_KINDS = ("confuser", "cosmic", "hot")
FALSE_SHARES = (0.5, 0.35, 0.15)


@dataclass(frozen=True)
class Sources:
    """Things in a frame: identity, kind, true (v, u) (n, 2) px, total DN and signal to noise by the catalogue."""

    star_id: NDArray[np.str_]
    kind: NDArray[np.str_]
    vu: FloatArray
    flux_dn: FloatArray
    snr: FloatArray

    def take(self, rows: NDArray[np.bool_]) -> Sources:
        """Return the rows of a mask."""
        return Sources(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True)
class Hits:
    """Pixels (n, 2), rows and columns, that gain DN (n,) without any optics: cosmic rays and hot pixels."""

    pixels: NDArray[np.intp]
    dn: FloatArray


def join_sources(parts: list[Sources]) -> Sources:
    """Return the rows of several tables in order."""
    names = Sources.__dataclass_fields__
    return Sources(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _sources(ids: list[str], kind: str, vu: FloatArray, flux_dn: FloatArray, snr: FloatArray) -> Sources:
    """Make a table of one kind."""
    return Sources(np.array(ids, dtype=np.str_), np.full(len(ids), kind, dtype="<U9"), vu.reshape(-1, 2), flux_dn, snr)


def catalogue_sources(plan: FramePlan) -> Sources:
    """Return the catalogue stars that light the array, at their true pixels and as bright as the catalogue says."""
    vu = project(plan.camera, plan.directions @ plan.truth.T)
    near = inside(plan.camera, vu, margin=OUTSIDE_PX)
    flux = fluxes_dn(plan.camera, plan.stars.mag[near], plan.exposure.seconds)
    snr = signal_to_noise(plan.camera, flux, plan.exposure)
    return _sources(plan.stars.star_id[near].tolist(), "catalogue", vu[near], flux, snr)


def is_detectable(camera: SampleCamera, sources: Sources) -> NDArray[np.bool_]:
    """Tell which catalogue stars lie on the array and should rise above five sigma."""
    seen: NDArray[np.bool_] = inside(camera, sources.vu) & (sources.snr >= DETECTION_SNR)
    return seen


def _step(rng: np.random.Generator, shortest: float, longest: float) -> FloatArray:
    """Draw a displacement (2,) of some length in any direction."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    step: FloatArray = rng.uniform(shortest, longest) * np.array([np.sin(angle), np.cos(angle)])
    return step


def make_odd(sources: Sources, seen: NDArray[np.bool_], fraction: float, rng: np.random.Generator) -> Sources:
    """Move some detectable stars by 1 to 10 px, change the light of others by 1 to 2 mag, give others a companion.

    Each of the three befalls a star with the probability `fraction`; at most one star in `ODD_CAP` is touched.
    """
    candidates = np.flatnonzero(seen)
    draws = rng.random(len(candidates))
    odd = candidates[draws < 3.0 * fraction][: len(candidates) // ODD_CAP]
    kind, vu, flux = sources.kind.copy(), sources.vu.copy(), sources.flux_dn.copy()
    companions: list[Sources] = []
    for row in odd:
        kind[row] = str(rng.choice(["moved", "variable", "double"]))
        if kind[row] == "moved":
            vu[row] += _step(rng, 1.0, 10.0)
        elif kind[row] == "variable":
            flux[row] *= 10.0 ** (0.4 * rng.uniform(1.0, 2.0) * rng.choice([-1.0, 1.0]))
        else:
            light = flux[row] * 10.0 ** (-0.4 * rng.uniform(0.0, 1.5))
            place = vu[row] + _step(rng, 0.7, 3.0)
            # A companion is in no catalogue, so its expected signal is none.
            companions.append(_sources([f"{sources.star_id[row]}b"], "double", place, np.array([light]), np.zeros(1)))
    return join_sources([Sources(sources.star_id, kind, vu, flux, sources.snr), *companions])


def count_false(n_stars: int, fraction: float, rng: np.random.Generator) -> dict[str, int]:
    """Return how many things of each false kind join n_stars so that they are a given fraction of everything."""
    total = round(fraction / (1.0 - fraction) * max(n_stars, 2))
    return dict(zip(FALSE_KINDS, rng.multinomial(total, FALSE_SHARES).tolist(), strict=True))


def confusers(plan: FramePlan, like_dn: FloatArray, count: int, rng: np.random.Generator) -> Sources:
    """Return stars that no catalogue holds, as bright as those of like_dn (n,) give or take half a magnitude or so."""
    faintest = flux_at_limit_dn(plan.camera, plan.exposure)
    models = like_dn if len(like_dn) else faintest * (1.0 + rng.exponential(3.0, 8))
    flux = np.maximum(rng.choice(models, count) * 10.0 ** (0.4 * rng.normal(0.0, 0.6, count)), faintest)
    vu = rng.uniform(0.0, np.array(plan.camera.shape_vu) - 1.0, (count, 2))
    return _sources([f"confuser-{k:03d}" for k in range(count)], "confuser", vu, flux, np.zeros(count))


def _track(shape_vu: tuple[int, int], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the pixels (n, 2), with repeats, that a cosmic ray crosses: one, or a straight line of two to eight."""
    start = rng.uniform(-0.5, np.array(shape_vu) - 0.5)
    length = 0.0 if rng.random() < 0.6 else rng.uniform(1.5, 8.0)
    ahead = _step(rng, 1.0, 1.0)
    points = start + np.linspace(0.0, length, max(1, int(4 * length)))[:, None] * ahead
    pixels = np.rint(points).astype(np.intp)
    on = np.all((pixels >= 0) & (pixels < np.array(shape_vu)), axis=1)
    return pixels[on]


def cosmic_rays(plan: FramePlan, count: int, rng: np.random.Generator) -> tuple[Sources, Hits]:
    """Return cosmic rays as sources, placed at the middle of their light, and the pixels they fill."""
    noise = plan.camera.read_noise_dn
    tracks = [_track(plan.camera.shape_vu, rng) for _ in range(count)]
    peaks = noise * 10.0 ** rng.uniform(1.0, 2.3, count)
    shares = [np.full(len(track), 2.0 * peak / (len(track) + 1.0)) for track, peak in zip(tracks, peaks, strict=True)]
    middle = np.array([track.mean(axis=0) for track in tracks]).reshape(-1, 2)
    light = np.array([share.sum() for share in shares])
    rows = _sources([f"cosmic-{k:03d}" for k in range(count)], "cosmic", middle, light, np.zeros(count))
    pixels = np.concatenate([*tracks, np.zeros((0, 2), dtype=np.intp)])
    return rows, Hits(pixels, np.concatenate([*shares, np.zeros(0)]))


def hot_pixels(plan: FramePlan, count: int) -> tuple[Sources, Hits]:
    """Return the camera's first hot pixels: the same places in all its frames, more charge in longer exposures."""
    camera = plan.camera
    rng = np.random.default_rng([plan.seed, crc32(camera.name.encode())])
    places = rng.integers(0, np.array(camera.shape_vu), (4096, 2))[:count].astype(np.intp)
    dark = camera.read_noise_dn * 10.0 ** rng.uniform(0.9, 2.0, 4096)[:count]
    dn = dark * plan.exposure.seconds / float(np.median(camera.exposures_s))
    ids = [f"hot-{v:04d}-{u:04d}" for v, u in places]
    return _sources(ids, "hot", places.astype(np.float64), dn, np.zeros(len(ids))), Hits(places, dn)


def compose(plan: FramePlan, rng: np.random.Generator) -> tuple[Sources, Sources, Hits]:
    """Return what shines through the optics, what does not, and the pixels of the latter.

    Only detectable catalogue stars count against the false things.
    """
    stars = catalogue_sources(plan)
    seen = is_detectable(plan.camera, stars)
    stars = replace(stars, vu=stars.vu + plan.camera.image_error_px * rng.standard_normal(stars.vu.shape))
    counts = count_false(int(seen.sum()), plan.false_fraction, rng)
    odd = make_odd(stars, seen, plan.oddity_fraction, rng)
    shining = join_sources([odd, confusers(plan, stars.flux_dn[seen], counts["confuser"], rng)])
    rays, ray_hits = cosmic_rays(plan, counts["cosmic"], rng)
    hot, hot_hits = hot_pixels(plan, counts["hot"])
    hits = Hits(np.concatenate([ray_hits.pixels, hot_hits.pixels]), np.concatenate([ray_hits.dn, hot_hits.dn]))
    return shining, join_sources([rays, hot]), hits
