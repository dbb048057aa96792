"""Interactive figures of a run, from the rows of its tables."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import plotly.graph_objects as go

# Okabe and Ito 2008: told apart by colour-blind eyes; each camera has a shape of its own beside.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#4D4D4D")
SYMBOLS = ("circle", "square", "diamond", "cross", "triangle-up", "x", "star")
MOST_POINTS = 1000
"""Points of one figure: a page of a hundred thousand images stays light."""
_HEIGHT, _BAR_HEIGHT = 340, 30


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
        showlegend=True, paper_bgcolor="#ffffff", plot_bgcolor="#ffffff",
        font={"family": "system-ui, sans-serif", "color": "#1c2127"},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
    )  # fmt: skip
    figure.update_xaxes(gridcolor="#e3e6ea", zerolinecolor="#9aa3ad")
    figure.update_yaxes(gridcolor="#e3e6ea", zerolinecolor="#9aa3ad")
    return figure


def scatter(
    rows: pd.DataFrame, x: str, y: str, titles: tuple[str, str], by: str = "camera", log_y: bool = False
) -> go.Figure:
    """One point per image, which its hover names.

    Parameters
    ----------
    rows
        With ``image_id``.
    x, y
        Columns.
    titles
        Of the axes.
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
    shown = sample(rows.dropna(subset=[x, y]).sort_values("image_id"))
    hover = f"<b>%{{customdata}}</b><br>%{{fullData.name}}<br>{titles[1]} %{{y}}<br>{titles[0]} %{{x}}<extra></extra>"
    for k, (name, group) in enumerate(shown.groupby(by, observed=True)):
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
        text=[f"{value:.4g}" for value in values], hovertemplate="%{y}: %{x}<extra></extra>",
    )  # fmt: skip
    _layout(figure, *titles)
    figure.update_yaxes(autorange="reversed", automargin=True)
    figure.update_layout(showlegend=False, height=80 + _BAR_HEIGHT * max(len(names), 2))
    return figure


def histogram(groups: dict[str, np.ndarray], titles: tuple[str, str]) -> go.Figure:
    """Histograms of logarithms, one line each.

    Parameters
    ----------
    groups
        Positive numbers by name.
    titles
        Of the axes.

    Returns
    -------
    plotly.graph_objects.Figure
        Counts are made here, so that the page holds no single values.
    """
    figure = go.Figure()
    everything = np.concatenate([*groups.values(), np.array([1.0])])
    edges = np.geomspace(max(everything.min(), 1e-4) * 0.9, everything.max() * 1.1, 41)
    for k, (name, values) in enumerate(groups.items()):
        counts, _ = np.histogram(values, edges)
        figure.add_scatter(
            x=np.sqrt(edges[1:] * edges[:-1]).round(6).tolist(), y=counts.tolist(), mode="lines", line_shape="hvh",
            name=name, line={"color": COLOURS[k % len(COLOURS)], "dash": ("solid", "dash", "dot")[k % 3]},
        )  # fmt: skip
    _layout(figure, *titles)
    figure.update_xaxes(type="log")
    return figure
