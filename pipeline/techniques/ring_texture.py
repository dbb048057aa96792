"""How far texture shifts ring edges: one error per edge, and what changes along it, as likely as an image shows.

Rings are uneven: undulations, waves and wakes beside an edge, which no catalogue has, shift its blurred step by a share
of the blur. What depends on the radius alone shifts an edge all along, and no number of pixels averages it away; what
changes along the edge has the spectral power at long waves that independent errors of its pieces would need to have.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.imaging.ring_light import MOST_EDGES
from pipeline.records import FloatArray
from pipeline.techniques.ring_solve import Equations, System, inverse_of, own_shifts, prior_of, told_size
from pipeline.techniques.ring_units import RingUnits
from pipeline.techniques.ring_unknowns import USUAL_TEXTURE, Layout, Radii

# Width (natural logarithm) of the prior of the rings' unevenness, and its grid.
_TEXTURE_WIDTH = 0.7
_TEXTURES = np.geomspace(1e-3, 0.4, 45)
# Share of an edge's own sigma by which neighbouring stretches of so many pieces differ, and stretches that say as much.
_ALONG_SHARE, _STRETCH, _ALONG_PRIOR = 0.2, 8, 8.0
_LEAST_ALONG, _MOST_ALONG = 0.1, 100.0
# Stretches' worth of belief in what is usual; an edge counts with so much at most for what is usual.
_OWN_PRIOR, _TAMEST = 3.0, 6.0
# Degrees of freedom of Student's distribution of the edges' errors; beyond four sigmas it is another edge.
_TAIL, _WILDEST = 4.0, 16.0
# Sigma of differences within one step.
_APART_PX = 1.0


def edge_scatter(system: System, layout: Layout, radii: Radii) -> tuple[Radii, float]:
    """Sigma of single edges: the most likely one, all other parameters being free (restricted maximum likelihood).

    With the edges' own errors w of sigma s, information A and pull b on them, the likelihood is
    ``det(I + s^2 A)^(-1/2) exp(b (A + I / s^2)^-1 b / 2)`` (Patterson and Thompson 1971, Biometrika 58, 545); all edges
    share one unevenness, whose prior has the tails of Student's distribution.

    Parameters
    ----------
    system
        Without priors.
    layout, radii
        Parameters and their priors.

    Returns
    -------
    tuple
        Radii with the edges' sigma renewed; the unevenness.
    """
    edges = np.arange(layout.count)[layout.radii][layout.shifts]
    others = np.setdiff1d(np.arange(layout.count), edges)
    prior = prior_of(layout, radii, False)
    prior[: layout.size] = 1.0 / layout.bounds**2
    # About errors of zero, not about the present ones, whose prior is left out.
    prior[edges] = 0.0
    own = system.values.copy()
    own[others] = 0.0
    target = prior * system.values
    target[: layout.size] = 0.0
    pull = system.pull - target + system.gram @ own
    gram = system.gram + np.diag(prior + 1e-12 * np.diag(system.gram) + 1e-300)
    inner = inverse_of(gram[np.ix_(others, others)])
    cross = gram[np.ix_(edges, others)]
    scale = layout.texture_px * np.sqrt(radii.wild)
    block = (gram[np.ix_(edges, edges)] - cross @ inner @ cross.T) * np.outer(scale, scale)
    told = (pull[edges] - cross @ (inner @ pull[others])) * scale
    strength, vectors = np.linalg.eigh((block + block.T) / 2)
    strength, along = np.maximum(strength, 0.0), vectors.T @ told
    grid = _TEXTURES[:, None]
    likely = (-0.5 * np.log1p(grid**2 * strength) + 0.5 * along**2 / (strength + 1.0 / grid**2)).sum(axis=1)
    likely -= 2.5 * np.log1p((np.log(_TEXTURES / USUAL_TEXTURE) / _TEXTURE_WIDTH) ** 2 / 4.0)
    texture = float(_TEXTURES[int(np.argmax(likely))])
    # Errors in units of their sigma after the fit: their squares' expectations tell which edges are beyond the usual.
    posterior = 1.0 / (strength + 1.0 / texture**2)
    error = vectors @ (posterior * along)
    power = (error**2 + (vectors**2) @ posterior) * radii.wild / texture**2
    wild = np.clip((_TAIL + power) / (_TAIL + 1.0), 1.0, _WILDEST)
    sigma = radii.sigma.copy()
    sigma[layout.shifts] = np.minimum(texture * layout.texture_px * np.sqrt(wild), np.sqrt(layout.blur2))
    return replace(radii, sigma=sigma, wild=wild), texture


def blended(equations: Equations, units: RingUnits, step: NDArray[np.int64]) -> Equations:
    """Equations of units that know edges of one step by their common shift only.

    How far such edges lie apart is told by the blur's variance, which is known too badly for that.

    Parameters
    ----------
    equations, units
        Of single edges.
    step
        (n, 10) step of each edge.

    Returns
    -------
    Equations
        Of the same units.
    """
    shared = units.present[:, 1:] & (step[:, 1:] == step[:, :-1])
    if not shared.any():
        return equations
    same = (step[:, :, None] == step[:, None, :]) & units.present[:, :, None] & units.present[:, None, :]
    among = np.maximum(same.sum(axis=2), 1)
    variance = np.zeros(equations.gram.shape)
    variance[:, :MOST_EDGES, :MOST_EDGES] = _APART_PX**2 * (np.eye(MOST_EDGES) * same - same / among[:, :, None])
    return _with_errors(equations, variance)


def loosened(equations: Equations, units: RingUnits, layout: Layout, radii: Radii) -> Equations:
    """Equations of units whose edges' shifts err one by one.

    Parameters
    ----------
    equations, units
        Without such errors.
    layout, radii
        Sigma of the edges, of which these errors are a share.

    Returns
    -------
    Equations
        Of the same units.
    """
    if not radii.along.any():
        return equations
    edge = np.minimum(units.edges[:, :1] + np.arange(MOST_EDGES), len(layout.column) - 1)
    variance = np.zeros(equations.gram.shape)
    own = np.arange(MOST_EDGES)
    variance[:, own, own] = radii.along[edge] * units.present
    return _with_errors(equations, variance)


def _with_errors(equations: Equations, variance: FloatArray) -> Equations:
    """G becomes (1 + G S)^-1 G where the shifts have errors of covariance S, (n, 11, 11)."""
    size = told_size(equations.gram)
    gram, pull = np.zeros(equations.gram.shape), np.zeros(equations.pull.shape)
    before = equations.gram[:, :size, :size]
    matrix = np.eye(size) + before @ variance[:, :size, :size]
    both = np.concatenate([before, equations.pull[:, :size, None]], axis=2)
    solved = np.linalg.solve(matrix, both)
    gram[:, :size, :size] = (solved[:, :, :-1] + solved[:, :, :-1].transpose(0, 2, 1)) / 2.0
    pull[:, :size] = solved[:, :, -1]
    return replace(equations, gram=gram, pull=pull)


def change_along(equations: Equations, units: RingUnits, layout: Layout, radii: Radii) -> Radii:
    """How much edges' shifts change along them, by the scatter of stretches of pieces about their edge's mean.

    Spokes and wakes make single edges drift by much more than others, so each has a variance of its own, beside the one
    that is usual in the image.

    Parameters
    ----------
    equations, units
        Without errors of pieces, at the end of a round.
    layout, radii
        Sigma of the edges.

    Returns
    -------
    Radii
        With ``along`` renewed.
    """
    shift, sigma = own_shifts(equations, units)
    row, column = np.nonzero(np.isfinite(shift) & (equations.freedom > 0)[:, None])
    edge = units.edges[row, 0] + column
    order = np.lexsort((units.longitude_rad[row], edge))
    row, column, edge = row[order], column[order], edge[order]
    count = len(layout.column)
    usual = (_ALONG_SHARE * radii.sigma[layout.shifts]) ** 2 / radii.wild
    excess, weights = np.zeros(count), np.zeros(count)
    for k in np.unique(edge):
        mine = edge == k
        if int(mine.sum()) >= 2 * _STRETCH and usual[k] > 0.0:
            excess[k], weights[k] = _scatter(shift[row[mine], column[mine]], sigma[row[mine], column[mine]], usual[k])
    tame = np.minimum(excess, _TAMEST * weights)
    common = (_ALONG_PRIOR + float(tame.sum())) / (_ALONG_PRIOR + float(weights.sum()))
    common = float(np.clip(common, _LEAST_ALONG, _MOST_ALONG))
    factor = np.maximum((_OWN_PRIOR * common + excess) / (_OWN_PRIOR + weights), 0.5 * common)
    return replace(radii, along=factor * usual * _STRETCH)


def _scatter(shift: FloatArray, sigma: FloatArray, usual: float) -> tuple[float, float]:
    """Variance of an edge's stretches beyond their noise, over the usual one, times a weight; that weight."""
    count = len(shift)
    stretch = np.minimum(np.arange(count) // _STRETCH, count // _STRETCH - 1)
    w = 1.0 / sigma**2
    precision = np.bincount(stretch, weights=w)
    noise = 1.0 / precision
    trust = (usual / (noise + usual)) ** 2
    gap = np.bincount(stretch, weights=w * shift) / precision - float((w * shift).sum() / w.sum())
    freed = np.maximum(1.0 - precision / precision.sum(), 1e-3)
    return float((trust * (gap**2 / freed - noise)).sum() / usual), float(trust.sum())
