"""Whether a run, or a spell of it, went worse than usual."""

import math

import numpy as np
import pandas as pd

_LEAST_IMAGES, _MOST_SPELLS = 20, 30
WORSE_SIGMAS = 5.0
"""By so many sigmas of chance more images of a spell must be without an answer than elsewhere."""
WIDER = 2.0
"""From so many times the camera's median sigma a spell's answers count as less sharp."""
_SPELL = ["camera", "spell"]


def spells(answers: pd.DataFrame) -> pd.DataFrame:
    """Images of each camera in spells of equal number, in the order of their times.

    Parameters
    ----------
    answers
        One row per image: ``camera, time_utc, status, sigma_px``.

    Returns
    -------
    pandas.DataFrame
        ``camera, spell, images, unsolved, solved_percent, sigma_px`` (median), ``start, middle, stop``, and how the
        spell compares with the camera's other images: ``excess`` in sigmas of chance, ``wider`` as a ratio of sigmas.
    """
    columns = ["camera", "time_utc", "status", "sigma_px"]
    timed = answers[columns].dropna(subset=["time_utc"]).sort_values("time_utc", kind="stable")
    place = timed.groupby("camera", observed=True).cumcount()
    count = timed.groupby("camera", observed=True)["status"].transform("size")
    parts = np.clip(count // _LEAST_IMAGES, 1, _MOST_SPELLS)
    timed = timed.assign(spell=place * parts // count, unsolved=timed["status"] != "success")
    found = timed.groupby(_SPELL, observed=True, as_index=False).agg(
        images=("status", "size"), unsolved=("unsolved", "sum"), sigma_px=("sigma_px", "median"),
        start=("time_utc", "first"), middle=("time_utc", _middle), stop=("time_utc", "last"),
    )  # fmt: skip
    found["solved_percent"] = 100.0 * (1.0 - found["unsolved"] / found["images"])
    for column in ("images", "unsolved"):
        found[f"other_{column}"] = found.groupby("camera", observed=True)[column].transform("sum") - found[column]
    found["excess"] = [
        _excess(*row) for row in found[["unsolved", "images", "other_unsolved", "other_images"]].to_numpy(float)
    ]
    usual = found.groupby("camera", observed=True)["sigma_px"].transform("median")
    found["wider"] = found["sigma_px"] / usual
    return found


def _middle(times: pd.Series) -> str:
    return str(times.iloc[len(times) // 2])


def _excess(unsolved: float, images: float, other_unsolved: float, other_images: float) -> float:
    """Images without an answer beyond what the others let expect, in sigmas of both binomials."""
    if not other_images:
        return 0.0
    # One success and one failure more keep a share of zero from having no scatter.
    share = (unsolved + other_unsolved + 1.0) / (images + other_images + 2.0)
    scatter = math.sqrt(share * (1.0 - share) * (1.0 / images + 1.0 / other_images))
    return (unsolved / images - other_unsolved / other_images) / scatter


def worse_than_usual(found: pd.DataFrame, most: int = 3) -> list[str]:
    """What stands out, in words, the worst first.

    Parameters
    ----------
    found
        Of :func:`spells`.
    most
        Sentences of each kind.

    Returns
    -------
    list of str
        Empty where no spell is worse than its camera's others.
    """
    failing = found[found["excess"] > WORSE_SIGMAS].nlargest(most, "excess", keep="first")
    said = [
        f"worse than usual: {row.unsolved} of {row.images} {row.camera} images from {_day(row.start)} to "
        f"{_day(row.stop)} without an answer; of its other {row.other_images}, {row.other_unsolved}"
        for row in failing.itertuples()
    ]
    blurred = found[found["wider"] > WIDER].nlargest(most, "wider", keep="first")
    return said + [
        f"less sharp than usual: {row.camera} from {_day(row.start)} to {_day(row.stop)}, median sigma "
        f"{row.sigma_px:.3f} px, {row.wider:.1f} times that of its other spells"
        for row in blurred.itertuples()
    ]


def _day(time: object) -> str:
    return str(time)[:16].replace("T", " ")
