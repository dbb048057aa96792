"""What the terminal shows: plans, outcomes, one image, and a run against planted truth."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from pipeline.errors import ConfigurationError
from pipeline.json_values import Json
from workflows.store import RunFolder
from workflows.tables_reader import open_tables

_PLANTED = ["offset_dv_px", "offset_du_px", "rotation_deg"]


@dataclass(frozen=True)
class Agreement:
    """A run against planted truth.

    Attributes
    ----------
    images, answered
        Images with truth, and those of them with a full answer.
    median_error_px
        Of the distance between recovered and planted offset.
    pull_rms
        Of error over sigma, both axes.
    within_two_sigma
        Share of axes whose error is at most two sigmas.
    false_successes
        Answers off by more than five sigmas and a pixel.
    """

    images: int
    answered: int
    median_error_px: float
    pull_rms: float
    within_two_sigma: float
    false_successes: tuple[str, ...]


def offsets(folder: RunFolder) -> pd.DataFrame:
    """Table ``offsets`` of a run.

    Parameters
    ----------
    folder
        The run.

    Returns
    -------
    pandas.DataFrame
        One row per image, sorted by id.

    Raises
    ------
    ConfigurationError
        If there is no such table.
    """
    table = open_tables(folder).get("offsets")
    if table is None:
        raise ConfigurationError(f"{folder.root} holds no finished run: it has no table offsets")
    return pd.DataFrame(table.to_table().sort_by("image_id").to_pandas())


def read_truth(path: Path) -> dict[str, dict[str, float]]:
    """Planted offsets by image id.

    Parameters
    ----------
    path
        A ``truth.json``: ``frames`` maps an image (id or file name) to offset_dv_px, offset_du_px, rotation_deg.

    Returns
    -------
    dict
        Keys without a ``.fits`` ending.

    Raises
    ------
    ConfigurationError
        If the file is not of that form.
    """
    try:
        frames = json.loads(path.read_text())["frames"]
        return {
            key.removesuffix(".fits"): {name: float(value[name]) for name in _PLANTED} for key, value in frames.items()
        }
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise ConfigurationError(f"{path} is no truth.json: {type(error).__name__}: {error}") from error


def compare(table: pd.DataFrame, truth: Mapping[str, Mapping[str, float]]) -> tuple[pd.DataFrame, Agreement]:
    """Recovered against planted, image by image and together.

    Parameters
    ----------
    table
        Table ``offsets``.
    truth
        Of :func:`read_truth`.

    Returns
    -------
    tuple
        Joined table with errors and pulls; figures over all images that have truth.
    """
    planted = pd.DataFrame.from_dict(dict(truth), orient="index", columns=_PLANTED)
    joined = table.merge(planted.add_prefix("planted_"), left_on="image_id", right_index=True, how="inner")
    for axis in ("dv", "du"):
        joined[f"error_{axis}_px"] = joined[f"offset_{axis}_px"] - joined[f"planted_offset_{axis}_px"]
        joined[f"pull_{axis}"] = joined[f"error_{axis}_px"] / joined[f"sigma_{axis}_px"]
    joined["error_rotation_deg"] = joined["rotation_deg"] - joined["planted_rotation_deg"]
    good = joined[joined["status"] == "success"].dropna(subset=["pull_dv", "pull_du"])
    pulls = good[["pull_dv", "pull_du"]].to_numpy()
    distance = np.hypot(good["error_dv_px"], good["error_du_px"])
    false = good["image_id"][(np.abs(pulls).max(axis=1, initial=0) > 5) & (distance > 1)]
    nothing = len(good) == 0
    agreement = Agreement(
        len(joined), len(good), math.nan if nothing else float(np.median(distance)),
        math.nan if nothing else float(np.sqrt(np.mean(pulls**2))),
        math.nan if nothing else float((np.abs(pulls) <= 2).mean()), tuple(false),
    )  # fmt: skip
    return joined, agreement


# Columns of the comparison and their widths; only the image's id gives way on a narrow terminal.
_COMPARISON = {
    "image": 6, "outcome": 9, "planted dv, du": 15, "found dv, du": 17, "error": 6, "sigma": 6, "rotation, found": 15,
}  # fmt: skip


def _comparison_row(row: Mapping[str, float | str]) -> list[str]:
    """Cells of one image."""
    number = {key: float(value) for key, value in row.items() if isinstance(value, int | float)}
    answered = not math.isnan(number.get("offset_dv_px", math.nan))
    turned = not math.isnan(number.get("rotation_deg", math.nan))
    return [
        str(row["image_id"]), str(row["status"] if row["status"] == "success" else row["status_reason"]),
        f"{number['planted_offset_dv_px']:+.2f}, {number['planted_offset_du_px']:+.2f}",
        f"{number['offset_dv_px']:+.3f}, {number['offset_du_px']:+.3f}" if answered else "",
        f"{math.hypot(number['error_dv_px'], number['error_du_px']):.3f}" if answered else "",
        f"{max(number['sigma_dv_px'], number['sigma_du_px']):.3f}" if answered else "",
        f"{number['planted_rotation_deg']:+.3f}, {number['rotation_deg']:+.3f}" if turned else "",
    ]  # fmt: skip


def print_comparison(console: Console, joined: pd.DataFrame, agreement: Agreement, limit: int) -> None:
    """Table of recovered against planted, and the figures over all.

    Parameters
    ----------
    console
        Terminal.
    joined, agreement
        Of :func:`compare`.
    limit
        Most rows shown.
    """
    table = Table(title="found against planted: pixels at the array centre, degrees", title_justify="left", box=None)
    for name, width in _COMPARISON.items():
        justify: Literal["left", "right"] = "left" if name in ("image", "outcome") else "right"
        table.add_column(name, justify=justify, no_wrap=True, min_width=width, overflow="ellipsis")
    # Ids sort by camera: rows from all over say more than the first ones.
    chosen = np.unique(np.linspace(0, max(len(joined) - 1, 0), min(limit, len(joined))).astype(int))
    for row in joined.iloc[chosen].to_dict("records"):
        table.add_row(*_comparison_row({str(key): value for key, value in row.items()}))
    console.print(table)
    if len(joined) > limit:
        console.print(f"... and {len(joined) - limit} more")
    console.print(
        f"{agreement.answered} of {agreement.images} images answered; median error {agreement.median_error_px:.3f} px; "
        f"error/sigma rms {agreement.pull_rms:.2f}; within 2 sigma {agreement.within_two_sigma:.1%}; "
        f"false successes {len(agreement.false_successes)}"
    )


def print_counts(console: Console, table: pd.DataFrame) -> None:
    """Outcome counts with their reasons.

    Parameters
    ----------
    console
        Terminal.
    table
        Table ``offsets``.
    """
    counts = table.groupby(["status", "status_reason"], observed=True).size().sort_values(ascending=False)
    grid = Table(box=None, pad_edge=False)
    for name in ("status", "reason", "images"):
        grid.add_column(name, justify="right" if name == "images" else "left")
    for row in counts.reset_index(name="images").to_dict("records"):
        grid.add_row(str(row["status"]), str(row["status_reason"]), str(row["images"]))
    console.print(grid)


def print_image(console: Console, document: Mapping[str, Json]) -> None:
    """One image's answer and what its techniques found.

    Parameters
    ----------
    console
        Terminal.
    document
        The image's JSON document.
    """
    # Texts from files may hold brackets, which rich would take for its markup.
    console.print(Text(f"{document['image_id']}", style="bold"), end="")
    console.print(Text(f"  {document['mission']} {document['camera']}  {document['time_utc']}"))
    outcome = f"{document['status']} ({document['status_reason']}), rank {document['rank']}: {document['detail']}"
    console.print(outcome, markup=False)
    if isinstance(document["offset_px"], list):
        console.print(f"offset dv, du {_plain(document['offset_px'])} px, sigma {_plain(document['sigma_px'])} px")
    if document.get("rotation_deg") is not None:
        console.print(
            f"rotation {_plain(document['rotation_deg'])} deg, sigma {_plain(document['sigma_rotation_deg'])} deg"
        )
    table = Table(box=None, pad_edge=False)
    for name in ("technique", "outcome", "offset", "sigma", "rotation", "confidence", "used"):
        table.add_column(name)
    for technique in _dicts(document["techniques"]):
        features = technique.get("features")
        used = sum(map(bool, features["used"])) if isinstance(features, dict) else ""  # type: ignore[arg-type]
        table.add_row(
            str(technique["technique"]), escape(str(technique["detail"] or technique["status_reason"])),
            *(_plain(technique.get(key)) for key in ("offset_px", "sigma_px", "rotation_deg", "confidence")), str(used),
        )  # fmt: skip
    console.print(table)


def _dicts(value: Json) -> Iterable[dict[str, Json]]:
    return (entry for entry in value if isinstance(entry, dict)) if isinstance(value, list) else ()


def _plain(value: Json) -> str:
    if isinstance(value, list):
        return ", ".join(_plain(entry) for entry in value)
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1 else f"{value:.4f}"
    return "" if value is None else str(value)
