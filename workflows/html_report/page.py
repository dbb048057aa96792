"""The page itself: figures, tables and words of one run in a file that needs no network."""

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from pipeline.json_values import Json
from workflows.html_report.figures import arrows, bars, histogram, looks, scatter, trend
from workflows.html_report.rows import FEWEST_IN_CELL, FIELD_CELLS, MOST_PULL, Change, RunRows, strangest
from workflows.html_report.style import SCRIPT, STYLE
from workflows.html_report.trend import spells, worse_than_usual

_THUMBNAIL_PX = 720
_MOST_LISTED, _MOST_EMBEDDED, _MOST_THUMBNAILS = 40, 36, 6
MOST_STRANGENESS = 10.0
"""Sigmas from which an answer is said to be unlike its camera's others."""


@dataclass(frozen=True)
class Pictures:
    """Summary pictures that a run has.

    Attributes
    ----------
    folder
        PNG files named by image id; need not exist.
    address
        The same, as the page's links reach it.
    """

    folder: Path
    address: str = "pictures"

    def embedded(self, image_ids: Sequence[str]) -> dict[str, str]:
        """Data URIs of those that exist, shrunk."""
        found = {}
        for image_id in dict.fromkeys(image_ids):
            path = self.folder / f"{image_id}.png"
            picture = cv2.imread(str(path)) if path.is_file() else None
            if picture is None:
                continue
            factor = min(1.0, _THUMBNAIL_PX / max(picture.shape))
            small = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
            found[image_id] = "data:image/jpeg;base64," + base64.b64encode(data).decode()
        return found


def render(
    title: str, rows: RunRows, provenance: dict[str, Json], pictures: Pictures, change: Change | None = None
) -> str:
    """Write the report.

    Parameters
    ----------
    title
        Name of the run.
    rows
        Its tables.
    provenance
        Of ``run.json``: versions, configuration digest, kernels, catalogues.
    pictures
        Its summary pictures.
    change
        Against another run.

    Returns
    -------
    str
        HTML; the same tables give the same text.
    """
    strange = strangest(rows.answers)
    lately = spells(rows.answers)
    worse = [*([] if change is None else _against(change)), *worse_than_usual(lately)]
    first_failures = [image_id for ids in rows.failed["first_ids"] for image_id in ids[:3]]
    worst = [*rows.conflicts["image_id"], *rows.worst_pairs["image_id"]]
    wanted = [*strange["image_id"], *first_failures, *worst, *rows.slowest["image_id"]]
    embedded = pictures.embedded(wanted[:_MOST_EMBEDDED])
    # A camera looks the same in every figure.
    look = looks(rows.answers["camera"])
    parts = [_headline(title, rows, strange, worse)]
    if change is not None:
        parts.append(_changes(change))
    parts += [_outcomes(rows), _trend(lately, look), _offsets(rows, look), _field(rows, look)]
    parts += [_agreement(rows), _speed(rows), _strange(strange, rows, embedded)]
    parts += [_failures(rows), _provenance(provenance)]
    shown = {"pictures": embedded, "address": pictures.address}
    parts.insert(1, _contents(parts[1:]))
    # A closing tag inside a script would end it.
    data = json.dumps(shown, sort_keys=True).replace("</", "<\\/")
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)} - Pilotage</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>\n'
        f"<script>{get_plotlyjs()}</script></head>\n<body><main>\n{body}\n</main>\n"
        '<dialog id="picture" aria-labelledby="picture-title"><h2 id="picture-title"></h2><div id="picture-body"></div>'
        '<form method="dialog"><button>Close</button></form></dialog>\n'
        f'<script id="data" type="application/json">{data}</script><script>{SCRIPT}</script></body></html>\n'
    )


def _section(name: str, *content: str) -> str:
    anchor = name.lower().replace(" ", "-")
    return f'<section aria-labelledby="{anchor}"><h2 id="{anchor}">{html.escape(name)}</h2>\n' + "\n".join(content) + (
        "\n</section>"
    )


def _contents(sections: Sequence[str]) -> str:
    """Links to the sections: figures' own buttons are many steps for who goes by keyboard."""
    names = [re.search(r'<h2 id="([^"]*)">(.*?)</h2>', section) for section in sections]
    links = " ".join(f'<a href="#{name[1]}">{name[2]}</a>' for name in names if name)
    return f'<nav aria-label="Sections">{links}</nav>'


def _figure(figure: go.Figure, name: str, said: str) -> str:
    """One figure with its caption, which is its text alternative too."""
    # A closing tag inside a script would end it.
    content = (figure.to_json() or "").replace("</", "<\\/")
    return (
        f'<figure role="group" aria-label="{html.escape(said, quote=True)}"><div class="plot" id="plot-{name}"'
        f' style="height:{figure.layout.height}px"></div><script type="application/json">{content}</script>'
        f"<figcaption>{html.escape(said)}</figcaption></figure>"
    )


def _button(image_id: str) -> str:
    escaped = html.escape(image_id, quote=True)
    return f'<button class="image" data-image="{escaped}">{escaped}</button>'


def _table(rows: pd.DataFrame, caption: str) -> str:
    """Rows as a table; image ids become buttons."""
    head = "".join(f'<th scope="col">{html.escape(str(name).replace("_", " "))}</th>' for name in rows.columns)
    lines = []
    for record in rows.itertuples(index=False):
        cells = [
            f"<td>{_button(str(value))}</td>" if name == "image_id" else f"<td>{_cell(value)}</td>"
            for name, value in zip(rows.columns, record, strict=True)
        ]
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{html.escape(caption, quote=True)}"><table><caption>'
        f"{html.escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _cell(value: object) -> str:
    if isinstance(value, (list, np.ndarray)):
        return " ".join(_button(str(item)) for item in value)
    if value is None or value != value:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))


def _headline(title: str, rows: RunRows, strange: pd.DataFrame, worse: list[str]) -> str:
    answers = rows.answers
    count, solved = len(answers), int((answers["status"] == "success").sum())
    tiles = "".join(
        f'<div class="tile {status}"><strong>{number}</strong> {status}</div>'
        for status in ("success", "failed", "conflicted", "error")
        for number in [int((answers["status"] == status).sum())]
    )
    look = worse + [f"{n} ended as {reason.replace('_', ' ')}" for reason, n in
            zip(rows.failed["reason"], rows.failed["images"], strict=True)][:3]  # fmt: skip
    odd = int((strange["strangeness"] > MOST_STRANGENESS).sum())
    if odd:
        more = " or more" if odd == len(strange) else ""
        look.append(f"{odd}{more} lie more than {MOST_STRANGENESS:g} sigmas from their camera's others")
    doubt = int(rows.by_pair["apart"].sum())
    if doubt:
        look.append(f"{doubt} pairs of techniques differ by more than {MOST_PULL:g} sigmas")
    share = 100.0 * solved / count if count else 0.0
    text = f"<p class='lead'>{solved} of {count} images navigated ({share:.1f} %).</p>"
    listed = "".join(f"<li>{html.escape(item)}</li>" for item in look) or "<li>Nothing stands out.</li>"
    head = f"<h1>{html.escape(title)}</h1>{text}<div class='tiles'>{tiles}</div>"
    return f"<header>{head}<h2>Look at</h2><ul>{listed}</ul></header>"


def _outcomes(rows: RunRows) -> str:
    counts = rows.answers.groupby(["status", "status_reason"], observed=True).size().sort_values(ascending=False)
    names = [f"{status}: {reason.replace('_', ' ')}" for status, reason in counts.index]
    figure = bars(names, counts.to_list(), ("images", ""))
    return _section("Outcomes", _figure(figure, "outcomes", "Images by outcome and its reason."))


def _offsets(rows: RunRows, look: Mapping[str, int]) -> str:
    solved = rows.answers.dropna(subset=["offset_dv_px"])
    sigmas = {
        str(camera): group["sigma_px"].to_numpy(float)[group["sigma_px"].to_numpy(float) > 0]
        for camera, group in solved.groupby("camera", observed=True)
    }
    parts = [
        _figure(scatter(solved, "time_utc", "offset_dv_px", ("time (UTC)", "dv, px"), look), "dv-time",
                "Offset along rows against time."),
        _figure(scatter(solved, "time_utc", "offset_du_px", ("time (UTC)", "du, px"), look), "du-time",
                "Offset along columns against time."),
        _figure(scatter(solved, "offset_du_px", "offset_dv_px", ("du, px", "dv, px"), look), "field",
                "Offsets of both axes: a camera's boresight error is a common shift."),
        _figure(histogram(sigmas, ("sigma, px", "images"), look), "sigmas", "One sigma of the offset, by camera."),
        _figure(scatter(solved, "rank", "sigma_px", ("rank", "sigma, px"), look, log_y=True), "rank",
                "Sigma against rank."),
    ]  # fmt: skip
    turned = solved.dropna(subset=["rotation_deg"])
    if len(turned):
        parts.append(
            _figure(scatter(turned, "time_utc", "rotation_deg", ("time (UTC)", "rotation, deg"), look), "rotation",
                    "Rotation against time, where it was fitted and seen.")
        )  # fmt: skip
    return _section("Offsets", '<div class="grid">', *parts, "</div>")


def _trend(lately: pd.DataFrame, look: Mapping[str, int]) -> str:
    if not len(lately):
        return _section("Trend", "<p>No image says when it was taken.</p>")
    return _section(
        "Trend", '<div class="grid">',
        _figure(trend(lately, "solved_percent", ("time (UTC)", "navigated, %"), look), "solved-time",
                "Share of images navigated, by camera, in spells of equal number."),
        _figure(trend(lately, "sigma_px", ("time (UTC)", "median sigma, px"), look, log_y=True), "sigma-time",
                "Median sigma of the answers of each spell."), "</div>",
    )  # fmt: skip


def _field(rows: RunRows, look: Mapping[str, int]) -> str:
    if not len(rows.field):
        return _section("Residuals over the array", f"<p>No cell holds {FEWEST_IN_CELL} measured features.</p>")
    figure, unit = arrows(rows.field, FIELD_CELLS, ("u, share of the columns", "v, share of the rows"), look)
    said = (
        f"Measured minus fitted places of used features, mean of {FIELD_CELLS} by {FIELD_CELLS} cells that hold "
        f"{FEWEST_IN_CELL} or more: an arrow from the cell's middle to its mark, a cell long for {unit:.3g} px. "
        "A pattern is what the camera model lacks."
    )
    return _section("Residuals over the array", _figure(figure, "residuals", said))


def _agreement(rows: RunRows) -> str:
    if not len(rows.by_pair):
        return _section("Agreement of techniques", "<p>No image has two techniques' answers that can be compared.</p>")
    titles = ("pair of answers", "joint sigmas")
    figure = scatter(rows.shown_pairs, "number", "pull", titles, looks(rows.shown_pairs["pair"]), "pair", True)
    # Two dozen pairs would fill a narrow page with their key; hover names them.
    figure.update_layout(showlegend=False)
    return _section(
        "Agreement of techniques", _figure(figure, "pulls", "Distance of two techniques' answers over its sigma."),
        _table(rows.by_pair.rename(columns={"apart": f"beyond {MOST_PULL:g}"}),
               "Joint sigmas between techniques, worse axis"),
        _table(rows.worst_pairs, "Largest disagreements"),
    )  # fmt: skip


def _speed(rows: RunRows) -> str:
    stages = rows.stages[rows.stages["stage"] != "total"]
    figure = bars(stages["stage"].to_list(), stages["total_s"].to_list(), ("seconds in all", ""))
    return _section(
        "Seconds", _figure(figure, "stages", "Seconds of each stage, all images together."),
        _table(rows.stages, "Seconds per image and stage"), _table(rows.slowest, "Slowest images"),
    )  # fmt: skip


def _strange(strange: pd.DataFrame, rows: RunRows, embedded: Mapping[str, str]) -> str:
    columns = ["image_id", "camera", "offset_dv_px", "offset_du_px", "sigma_px", "rank", "strangeness"]
    parts = [_table(
        strange[columns], "Farthest from the median of their camera, in sigmas of its scatter and their own"
    )]  # fmt: skip
    if len(rows.conflicts):
        said = "Conflicted: techniques contradict each other, by the largest distance in joint sigmas"
        parts.append(_table(rows.conflicts, said))
    first = [image_id for image_id in strange["image_id"] if image_id in embedded][:_MOST_THUMBNAILS]
    strip = "".join(
        f'<button class="image thumbnail" data-image="{name}"><img alt="Summary picture of {name}"><span>{name}</span>'
        "</button>"
        for name in (html.escape(image_id, quote=True) for image_id in first)
    )
    return _section("Strangest answers", f'<div class="strip">{strip}</div>' if strip else "", *parts)


def _failures(rows: RunRows) -> str:
    if not len(rows.failed):
        return _section("Without an answer", "<p>None.</p>")
    question = "select image_id, detail from offsets where status_reason = '…'"
    ask = f'<p>All of one reason: <code>pilotage query RUN "{question}"</code></p>'
    return _section("Without an answer", _table(rows.failed, "By reason, with the first images of each"), ask)


def _against(change: Change) -> list[str]:
    """The other run in one line each way, where it differs."""
    lost, solved, moved = len(change.failed), len(change.solved), len(change.moved)
    if not lost + solved + moved:
        return []
    verdict = "worse than" if lost > solved else "better than" if solved > lost else "other than"
    return [f"{verdict} the run compared with: {lost} newly without an answer, {solved} newly solved, {moved} moved"]


def _changes(change: Change) -> str:
    text = (
        f"<p>Of {change.common} images in both runs, {len(change.failed)} are newly without an answer, "
        f"{len(change.solved)} newly solved, {len(change.moved)} moved by more than three joint sigmas.</p>"
    )
    parts = [text]
    for name, ids in (("Newly without an answer", change.failed), ("Newly solved", change.solved)):
        if ids:
            parts.append(f"<h3>{name}</h3><p>{' '.join(_button(i) for i in ids[:_MOST_LISTED])}</p>")
    if len(change.moved):
        columns = ["image_id", "sigmas", "offset_dv_px_before", "offset_du_px_before", "offset_dv_px_after",
                   "offset_du_px_after"]  # fmt: skip
        parts.append(_table(change.moved[columns].head(_MOST_LISTED), "Moved"))
    return _section("Changes", *parts)


def _provenance(provenance: dict[str, Json]) -> str:
    shown = {key: value for key, value in provenance.items() if key != "configuration"}
    return _section(
        "Provenance", f'<pre tabindex="0">{html.escape(json.dumps(shown, indent=1, sort_keys=True)[:60000])}</pre>'
    )
