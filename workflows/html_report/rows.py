"""What a report tells, as rows: all from SQL over the run's tables."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa

from workflows.query import ask_many
from workflows.store import RunFolder

MOVED_SIGMAS = 3.0
"""Joint sigmas beyond which two runs' answers differ."""
MOST_PULL = 4.0
"""Joint sigmas beyond which two techniques are said to disagree."""
FIELD_CELLS = 12
"""Cells of the residual map along each side of the array."""
FEWEST_IN_CELL = 5
"""Features of a cell whose mean is shown: the map is of what images share."""
_SHOWN_PAIRS = 1000

# Two techniques on one image: the second one's offset d about its pivot p, moved to the first one's pivot c, is
# d + (I - R)(p - c). Where a rotation was fitted, what its error does over the distance of the pivots is not in these
# tables: such pairs count only where the pivots are within a pixel.
# Images and kinds of techniques go by number: names of a million pairs would be most of the memory.
_STEPS = {
    "images": "select row_number() over (order by image_id)::integer as image, image_id from offsets",
    "kinds": """
        select row_number() over (order by technique)::utinyint as kind, technique
        from (select distinct technique from techniques)
    """,
    "answered": """
        select image, kind, offset_dv_px as dv, offset_du_px as du, sigma_dv_px as sv, sigma_du_px as su,
               rotation_deg as turn, pivot_v_px as pv, pivot_u_px as pu
        from techniques join images using (image_id) join kinds using (technique)
        where sigma_dv_px is not null and not coalesce(at_edge, false)
    """,
    "pairs": """
        with couples as (
            select a.image, a.kind as first, b.kind as second, a.dv, a.du, a.sv, a.su, b.sv as sv_b,
                   b.su as su_b, radians(coalesce(b.turn, 0)) as theta, coalesce(b.pv - a.pv, 0) as v,
                   coalesce(b.pu - a.pu, 0) as u, b.dv as dv_b, b.du as du_b
            from answered a join answered b on a.image = b.image and a.kind < b.kind
            where (a.turn is null and b.turn is null) or (a.pv - b.pv) ** 2 + (a.pu - b.pu) ** 2 <= 1
        )
        select image, first, second, greatest(
            abs(dv - dv_b - v + cos(theta) * v + sin(theta) * u) / sqrt(sv ** 2 + sv_b ** 2),
            abs(du - du_b - u - sin(theta) * v + cos(theta) * u) / sqrt(su ** 2 + su_b ** 2)) as pull
        from couples where sv + sv_b > 0 and su + su_b > 0
    """,
}
_PAIR = "a.technique || ' and ' || b.technique as pair"
_NAMED = "join kinds a on a.kind = first join kinds b on b.kind = second"
_QUESTIONS = {
    "answers": """
        select image_id, mission || ' ' || camera as camera, time_utc, status, status_reason, rank, offset_dv_px,
               offset_du_px, sigma_dv_px, sigma_du_px, rotation_deg,
               sqrt((sigma_dv_px ** 2 + sigma_du_px ** 2) / 2) as sigma_px
        from offsets order by image_id
    """,
    "stages": """
        select stage, median(seconds) as median_s, quantile_cont(seconds, 0.95) as p95_s, sum(seconds) as total_s
        from timings group by stage order by total_s desc, stage
    """,
    "slowest": """
        select image_id, max(seconds) as seconds from timings where stage = 'total'
        group by image_id order by seconds desc, image_id limit 12
    """,
    "failed": """
        select status, status_reason as reason, count(*) as images, min_by(image_id, image_id, 20) as first_ids
        from offsets where status != 'success' group by all order by images desc, reason
    """,
    "by_pair": f"""
        select {_PAIR}, count(*) as images, median(pull) as median, max(pull) as largest,
               count_if(pull > {MOST_PULL}) as apart
        from pairs {_NAMED} group by all order by pair
    """,
    "worst_pairs": f"""
        select image_id, {_PAIR}, pull from pairs {_NAMED} join images using (image)
        order by pull desc, image_id, pair limit 10
    """,
    "shown_pairs": f"""
        select image_id, {_PAIR}, pull, number from (
            select *, row_number() over (order by image, first, second) - 1 as number, count(*) over () as total
            from pairs
        ) {_NAMED} join images using (image)
        where number % ceil(total / {_SHOWN_PAIRS})::bigint = 0 order by number
    """,
    "conflicts": """
        select image_id, max(pull) as strangeness from pairs join images using (image) semi join
            (select image_id from offsets where status = 'conflicted') using (image_id)
        group by image_id order by strangeness desc, image_id limit 12
    """,
    "field": f"""
        with cells as (
            select mission || ' ' || camera as seen_by, image_id, rows, columns from offsets where rows is not null
        )
        select seen_by as camera, floor({FIELD_CELLS} * (measured_v_px + 0.5) / rows) as row_cell,
               floor({FIELD_CELLS} * (measured_u_px + 0.5) / columns) as column_cell, count(*) as features,
               sum(residual_v_px / sigma_px ** 2) / sum(1 / sigma_px ** 2) as dv_px,
               sum(residual_u_px / sigma_px ** 2) / sum(1 / sigma_px ** 2) as du_px,
               1 / sqrt(sum(1 / sigma_px ** 2)) as sigma_px
        from features join cells using (image_id)
        where used and sigma_px > 0 and residual_v_px is not null and residual_u_px is not null
            and measured_v_px between -0.5 and rows - 0.5 and measured_u_px between -0.5 and columns - 0.5
        group by all having count(*) >= {FEWEST_IN_CELL} order by all
    """,
}


@dataclass(frozen=True)
class RunRows:
    """Tables of a report.

    Attributes
    ----------
    answers
        One row per image.
    stages, slowest
        Seconds.
    failed
        Reasons with the first image ids of each.
    by_pair
        Figures of ``pull``, the distance of two techniques on one image over the joint sigma of the worse axis, by pair
        of techniques.
    worst_pairs, shown_pairs
        Pairs with the largest pulls; evenly sampled ones.
    conflicts
        Images whose techniques contradict each other, with their largest pull.
    field
        Residuals of used features by camera and cell of the array, weighted.
    """

    answers: pd.DataFrame
    stages: pd.DataFrame
    slowest: pd.DataFrame
    failed: pd.DataFrame
    by_pair: pd.DataFrame
    worst_pairs: pd.DataFrame
    shown_pairs: pd.DataFrame
    conflicts: pd.DataFrame
    field: pd.DataFrame


def collect(folder: RunFolder) -> RunRows:
    """Read all that a report shows.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    RunRows
        Tables.

    Raises
    ------
    ConfigurationError
        If the run has no tables.
    """
    answers = ask_many(folder, _STEPS, _QUESTIONS)
    return RunRows(**{name: _frame(answers.pop(name)) for name in _QUESTIONS})


def _frame(answer: pa.Table) -> pd.DataFrame:
    """Rows for pandas; texts that repeat are kept once, and nothing is held twice."""
    repeated = ("camera", "status", "status_reason", "rank")
    return pd.DataFrame(
        answer.to_pandas(categories=[name for name in repeated if name in answer.column_names], self_destruct=True)
    )


def collect_answers(folder: RunFolder) -> pd.DataFrame:
    """One row per image of another run, to compare with.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    pandas.DataFrame
        As ``answers`` of :class:`RunRows`.

    Raises
    ------
    ConfigurationError
        If the run has no tables.
    """
    return _frame(ask_many(folder, {}, {"answers": _QUESTIONS["answers"]})["answers"])


def strangest(answers: pd.DataFrame, most: int = 12) -> pd.DataFrame:
    """Answers farthest from what their camera's others say, in robust sigmas of their scatter.

    Parameters
    ----------
    answers
        Of :func:`collect`.
    most
        How many.

    Returns
    -------
    pandas.DataFrame
        With ``strangeness``, largest first.
    """
    solved = answers.dropna(subset=["offset_dv_px", "offset_du_px"]).copy()
    worst = np.zeros(len(solved))
    for column in ("offset_dv_px", "offset_du_px"):
        middle = solved.groupby("camera", observed=True)[column].transform("median")
        off = (solved[column] - middle).abs()
        spread = 1.4826 * off.groupby(solved["camera"], observed=True).transform("median")
        own = np.hypot(spread, solved["sigma_px"])
        worst = np.maximum(worst, (off / np.maximum(own, 1e-6)).to_numpy(float))
    found: pd.DataFrame = solved.assign(strangeness=worst).nlargest(most, "strangeness", keep="first")
    return found


@dataclass(frozen=True)
class Change:
    """Ids of images that two runs tell apart.

    Attributes
    ----------
    failed, solved
        Newly without and newly with an answer.
    moved
        With both answers and their distance in joint sigmas, largest first.
    common
        Number of images in both.
    """

    failed: list[str]
    solved: list[str]
    moved: pd.DataFrame
    common: int


def changes(before: pd.DataFrame, after: pd.DataFrame) -> Change:
    """Compare two runs.

    Parameters
    ----------
    before, after
        ``answers`` of each.

    Returns
    -------
    Change
        Of the images that both have.
    """
    both = before.merge(after, on="image_id", suffixes=("_before", "_after"))
    was, is_now = both["status_before"] == "success", both["status_after"] == "success"
    distance = np.zeros(len(both))
    for axis in ("dv", "du"):
        gap = (both[f"offset_{axis}_px_after"] - both[f"offset_{axis}_px_before"]).abs()
        joint = np.hypot(both[f"sigma_{axis}_px_after"], both[f"sigma_{axis}_px_before"])
        distance = np.fmax(distance, (gap / joint).to_numpy(float))
    moved = both.assign(sigmas=distance)
    moved = moved[was & is_now & (moved["sigmas"] > MOVED_SIGMAS)].sort_values(
        ["sigmas", "image_id"], ascending=[False, True]
    )
    return Change(list(both["image_id"][was & ~is_now]), list(both["image_id"][~was & is_now]), moved, len(both))
