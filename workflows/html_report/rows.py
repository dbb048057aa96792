"""What a report tells, as rows: all from SQL over the run's tables."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from pipeline.geometry.pointing import move_pivot
from workflows.query import ask
from workflows.store import RunFolder

MOVED_SIGMAS = 3.0
"""Joint sigmas beyond which two runs' answers differ."""
_ANSWERS = "select * exclude (detail, config_digest, techniques) from offsets order by image_id"
_STAGES = """
    select stage, median(seconds) as median_s, quantile_cont(seconds, 0.95) as p95_s, sum(seconds) as total_s
    from timings group by stage order by total_s desc, stage
"""
_SLOWEST = """
    select image_id, max(seconds) as seconds from timings where stage = 'total'
    group by image_id order by seconds desc, image_id limit 12
"""
_FAILED = """
    select status, status_reason as reason, count(*) as images, list(image_id order by image_id)[1:20] as first_ids
    from offsets where status != 'success' group by all order by images desc, reason
"""
_PAIRS = """
    select a.image_id, a.technique as first, b.technique as second,
           a.offset_dv_px as dv_a, a.offset_du_px as du_a, b.offset_dv_px as dv_b, b.offset_du_px as du_b,
           a.sigma_dv_px as sv_a, a.sigma_du_px as su_a, b.sigma_dv_px as sv_b, b.sigma_du_px as su_b,
           a.rotation_deg as turn_a, b.rotation_deg as turn_b, a.pivot_v_px as pv_a, a.pivot_u_px as pu_a,
           b.pivot_v_px as pv_b, b.pivot_u_px as pu_b
    from techniques a join techniques b on a.image_id = b.image_id and a.technique < b.technique
    where a.sigma_dv_px is not null and b.sigma_dv_px is not null and not coalesce(a.at_edge or b.at_edge, false)
    order by a.image_id, first, second
"""


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
    pairs
        Two techniques on one image: ``pull``, their distance over the joint sigma of the worse axis.
    """

    answers: pd.DataFrame
    stages: pd.DataFrame
    slowest: pd.DataFrame
    failed: pd.DataFrame
    pairs: pd.DataFrame


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
    answers, stages, slowest, failed, pairs = (
        ask(folder, question).to_pandas() for question in (_ANSWERS, _STAGES, _SLOWEST, _FAILED, _PAIRS)
    )
    answers["sigma_px"] = np.sqrt((answers["sigma_dv_px"] ** 2 + answers["sigma_du_px"] ** 2) / 2.0)
    answers["camera"] = answers["mission"].astype(str) + " " + answers["camera"].astype(str)
    return RunRows(answers, stages, slowest, failed, _pulls(pairs))


def _pulls(pairs: pd.DataFrame) -> pd.DataFrame:
    """Disagreement of each pair about the first one's pivot.

    Where a rotation was fitted, what its error does over the distance of the pivots is not in these tables: such pairs
    count only where the pivots are within a pixel.
    """
    turn = np.radians(pairs["turn_b"].fillna(0.0).to_numpy(float))
    places = pairs[["pv_b", "pu_b", "pv_a", "pu_a"]].to_numpy(float)
    moved = np.array(
        [
            move_pivot(np.array([dv, du]), theta, place[:2], place[2:])[0]
            for dv, du, theta, place in zip(pairs["dv_b"], pairs["du_b"], turn, places, strict=True)
        ]
    ).reshape(-1, 2)
    difference = pairs[["dv_a", "du_a"]].to_numpy(float) - moved
    joint = np.hypot(pairs[["sv_a", "su_a"]].to_numpy(float), pairs[["sv_b", "su_b"]].to_numpy(float))
    pulls = pairs.assign(pull=np.abs(difference / joint).max(axis=1) if len(pairs) else [])
    fixed = pairs["turn_a"].isna() & pairs["turn_b"].isna()
    near = np.hypot(places[:, 0] - places[:, 2], places[:, 1] - places[:, 3]) <= 1.0
    kept = pulls[(fixed | near) & np.isfinite(pulls["pull"])]
    named: pd.DataFrame = kept.assign(pair=kept["first"] + " and " + kept["second"])
    return named


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
        middle = solved.groupby("camera")[column].transform("median")
        spread = 1.4826 * (solved[column] - middle).abs().groupby(solved["camera"]).transform("median")
        own = np.hypot(spread, solved["sigma_px"])
        worst = np.maximum(worst, ((solved[column] - middle).abs() / np.maximum(own, 1e-6)).to_numpy(float))
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
