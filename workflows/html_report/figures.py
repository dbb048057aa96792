"""Interactive figures of a run, from the rows of its tables."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import plotly.graph_objects as go

# Okabe and Ito 2008: told apart by colour-blind eyes; each camera has a shape of its own beside.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#808080")
SYMBOLS = ("circle", "square", "diamond", "cross", "triangle-up", "x", "star")
MOST_POINTS = 1000
"""Points of one figure: a page of a hundred thousand images stays light."""
_HEIGHT, _BAR_HEIGHT = 340, 30
# The page shows through, in its light and in its dark colours.
_CLEAR = "rgba(0,0,0,0)"
RANKS = ("high", "medium", "low", "conflicted", "failed")


def looks(names: Iterable[object]) -> dict[str, int]:
    """Number the names by which they get a colour and a shape.

    Parameters
    ----------
    names
        Repeated or not.

    Returns
    -------
    dict
        Numbers from 0 by name, in the order of the alphabet.
    """
    return {name: k for k, name in enumerate(sorted(set(map(str, names))))}


def sample(rows: pd.DataFrame, most: int = MOST_POINTS) -> pd.DataFrame:
    """Evenly spaced rows, always the same ones.

    Parameters
    ----------
    rows
        In their order.
    most
        How many at most.

    Returns
    -------
    pandas.DataFrame
        All of them where they are few.
    """
    if len(rows) <= most:
        return rows
    return rows.iloc[np.unique(np.linspace(0, len(rows) - 1, most).astype(int))]


def _layout(figure: go.Figure, x: str, y: str) -> go.Figure:
    figure.update_layout(
        height=_HEIGHT, margin={"l": 62, "r": 12, "t": 12, "b": 52}, xaxis_title=x, yaxis_title=y, hovermode="closest",
        showlegend=True, paper_bgcolor=_CLEAR, plot_bgcolor=_CLEAR,
        font={"family": "system-ui, sans-serif", "color": "#1c2127"},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
    )  # fmt: skip
    figure.update_xaxes(gridcolor="#e3e6ea", zerolinecolor="#9aa3ad")
    figure.update_yaxes(gridcolor="#e3e6ea", zerolinecolor="#9aa3ad")
    return figure


def scatter(
    rows: pd.DataFrame, x: str, y: str, titles: tuple[str, str], look: Mapping[str, int], by: str = "camera",
    log_y: bool = False,
) -> go.Figure:  # fmt: skip
    """One point per image, which its hover names.

    Parameters
    ----------
    rows
        With ``image_id``.
    x, y
        Columns.
    titles
        Of the axes.
    look
        Of :func:`looks`, of all values of that column.
    by
        Column whose values get a colour and a shape each.
    log_y
        Logarithmic ordinate.

    Returns
    -------
    plotly.graph_objects.Figure
        Sampled.
    """
    figure = go.Figure()
    if x == "rank":
        figure.update_xaxes(categoryorder="array", categoryarray=RANKS)
    shown = sample(rows.dropna(subset=[x, y]).sort_values("image_id"))
    hover = f"<b>%{{customdata}}</b><br>%{{fullData.name}}<br>{titles[1]} %{{y}}<br>{titles[0]} %{{x}}<extra></extra>"
    for name, group in shown.groupby(by, observed=True):
        k = look[str(name)]
        figure.add_scatter(
            x=group[x].to_list(), y=group[y].to_list(), mode="markers", name=str(name),
            customdata=group["image_id"].to_list(),
            hovertemplate=hover,
            marker={"color": COLOURS[k % len(COLOURS)], "symbol": SYMBOLS[k % len(SYMBOLS)], "size": 6, "opacity": 0.8},
        )  # fmt: skip
    if log_y:
        figure.update_yaxes(type="log")
    return _layout(figure, *titles)


def bars(names: Sequence[str], values: Sequence[float], titles: tuple[str, str]) -> go.Figure:
    """Horizontal bars with their numbers.

    Parameters
    ----------
    names
        One each.
    values
        Lengths.
    titles
        Of the values' and the names' axis.

    Returns
    -------
    plotly.graph_objects.Figure
        The first name on top.
    """
    figure = go.Figure()
    figure.add_bar(
        x=list(values), y=list(names), orientation="h", marker_color=COLOURS[0],
        text=[f"{value:.4g}" for value in values], textposition="outside", cliponaxis=False,
        hovertemplate="%{y}: %{x}<extra></extra>",
    )  # fmt: skip
    _layout(figure, *titles)
    figure.update_yaxes(autorange="reversed", automargin=True)
    figure.update_layout(showlegend=False, height=80 + _BAR_HEIGHT * max(len(names), 2))
    return figure


def histogram(groups: dict[str, np.ndarray], titles: tuple[str, str], look: Mapping[str, int]) -> go.Figure:
    """Histograms of logarithms, one line each.

    Parameters
    ----------
    groups
        Positive numbers by name.
    titles
        Of the axes.
    look
        Of :func:`looks`, of all names.

    Returns
    -------
    plotly.graph_objects.Figure
        Counts are made here, so that the page holds no single values.
    """
    figure = go.Figure()
    everything = np.concatenate([*groups.values(), np.array([1.0])])
    # A few images in many bins are a fence of single ones.
    count = int(np.clip(2.0 * np.sqrt(max(map(len, groups.values()), default=1)), 6, 40))
    edges = np.geomspace(max(everything.min(), 1e-4) * 0.9, everything.max() * 1.1, count + 1)
    for name, values in groups.items():
        k = look[name]
        counts, _ = np.histogram(values, edges)
        figure.add_scatter(
            x=np.sqrt(edges[1:] * edges[:-1]).round(6).tolist(), y=counts.tolist(), mode="lines", line_shape="hvh",
            name=name, line={"color": COLOURS[k % len(COLOURS)], "dash": ("solid", "dash", "dot")[k % 3]},
        )  # fmt: skip
    _layout(figure, *titles)
    figure.update_xaxes(type="log")
    return figure


def trend(
    bins: pd.DataFrame, y: str, titles: tuple[str, str], look: Mapping[str, int], log_y: bool = False
) -> go.Figure:
    """One line per camera over its spells of time.

    Parameters
    ----------
    bins
        Of :func:`workflows.html_report.trend.spells`.
    y
        Column.
    titles
        Of the axes.
    look
        Of :func:`looks`, of all cameras.
    log_y
        Logarithmic ordinate.

    Returns
    -------
    plotly.graph_objects.Figure
        A point stands at the middle image of its spell.
    """
    figure = go.Figure()
    for camera, group in bins.groupby("camera", observed=True):
        k = look[str(camera)]
        figure.add_scatter(
            x=group["middle"].to_list(), y=group[y].to_list(), mode="lines+markers", name=str(camera),
            customdata=group[["images", "start", "stop"]].to_numpy().tolist(),
            hovertemplate="%{fullData.name}<br>%{y:.4g}<br>%{customdata[0]} images from %{customdata[1]} to "
            "%{customdata[2]}<extra></extra>",
            line={"color": COLOURS[k % len(COLOURS)], "dash": ("solid", "dash", "dot")[k % 3]},
            marker={"symbol": SYMBOLS[k % len(SYMBOLS)], "size": 7},
        )  # fmt: skip
    figure.update_yaxes(type="log") if log_y else figure.update_yaxes(rangemode="tozero")
    return _layout(figure, *titles)


def arrows(
    field: pd.DataFrame, cells: int, titles: tuple[str, str], look: Mapping[str, int]
) -> tuple[go.Figure, float]:
    """Mean residuals as arrows over the array, rows downward.

    Parameters
    ----------
    field
        ``camera, row_cell, column_cell, dv_px, du_px, sigma_px, features`` per cell.
    cells
        Along each side.
    titles
        Of the axes.
    look
        Of :func:`looks`, of all cameras.

    Returns
    -------
    tuple
        The figure; the length in pixels of an arrow that is one cell long.
    """
    figure = go.Figure()
    lengths = np.hypot(field["dv_px"], field["du_px"])
    # Most arrows stay inside their cell; a few cells of one feature may be far longer than all others.
    unit = float(max(np.quantile(lengths, 0.9), 1e-6)) if len(field) else 1.0
    for camera, group in field.groupby("camera", observed=True):
        k = look[str(camera)]
        v, u = (group["row_cell"] + 0.5) / cells, (group["column_cell"] + 0.5) / cells
        tip_v, tip_u = v + group["dv_px"] / unit / cells, u + group["du_px"] / unit / cells
        nothing = [None] * len(group)
        colour = COLOURS[k % len(COLOURS)]
        figure.add_scatter(
            x=[x for point in zip(u, tip_u, nothing, strict=True) for x in point],
            y=[x for point in zip(v, tip_v, nothing, strict=True) for x in point], mode="lines", hoverinfo="skip",
            legendgroup=str(camera), showlegend=False, line={"color": colour, "width": 1.5},
        )  # fmt: skip
        figure.add_scatter(
            x=tip_u.to_list(), y=tip_v.to_list(), mode="markers", name=str(camera), legendgroup=str(camera),
            text=[
                f"dv {row.dv_px:+.4f}, du {row.du_px:+.4f} px ± {row.sigma_px:.4f}, {row.features} features"
                for row in group.itertuples()
            ],
            hovertemplate="%{fullData.name}<br>%{text}<extra></extra>",
            marker={"color": colour, "symbol": SYMBOLS[k % len(SYMBOLS)], "size": 5},
        )  # fmt: skip
    _layout(figure, *titles)
    # A square, so that arrows keep their directions.
    figure.update_layout(height=2 * _HEIGHT)
    figure.update_xaxes(range=[0, 1], constrain="domain")
    figure.update_yaxes(range=[1, 0], constrain="domain", scaleanchor="x")
    return figure, unit
