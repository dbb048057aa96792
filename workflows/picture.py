"""Summary picture of one navigated image."""

from collections.abc import Mapping
from io import BytesIO

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pipeline.curate import Json
from pipeline.records import Image

# Okabe and Ito's colours, told apart by every kind of colour vision.
_PREDICTED, _USED, _REJECTED = "#56B4E9", "#E69F00", "#CC79A7"
_SIDE_INCHES = 8.0
_DPI = 110


def draw_image(pixels: Image, document: Mapping[str, Json]) -> bytes:
    """Draw an image with what was predicted, found and rejected.

    Parameters
    ----------
    pixels
        (rows, cols) as read.
    document
        The image's JSON document.

    Returns
    -------
    bytes
        PNG.
    """
    figure = Figure(figsize=(_SIDE_INCHES, _SIDE_INCHES * pixels.shape[0] / pixels.shape[1] + 0.9), dpi=_DPI)
    axes = figure.add_axes((0.07, 0.05, 0.91, 0.84))
    low, high = np.nanpercentile(pixels[::2, ::2], (2, 99.7))
    stretched = np.arcsinh(np.clip((pixels - low) / max(high - low, 1e-6), 0, 8) * 6)
    axes.imshow(stretched, cmap="gray", interpolation="nearest", origin="upper")
    _mark_features(axes, _features(document))
    axes.set_xlim(-0.5, pixels.shape[1] - 0.5)
    axes.set_ylim(pixels.shape[0] - 0.5, -0.5)
    axes.set_xlabel("u (px)", fontsize=8, labelpad=1)
    axes.set_ylabel("v (px)", fontsize=8, labelpad=1)
    axes.tick_params(labelsize=7)
    figure.text(0.07, 0.965, _title(document), fontsize=10, va="top", weight="bold")
    figure.text(0.07, 0.935, _figures(document), fontsize=8.5, va="top")
    buffer = BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", metadata={"Software": "pilotage"})
    return buffer.getvalue()


def _mark_features(axes: object, features: Mapping[str, Json]) -> None:
    """Thin crosses where features were predicted, boxes where they were used, circles where they were refused."""
    columns = {name: np.array(values, dtype=float) for name, values in features.items() if name.endswith("_px")}
    if not columns:
        return
    used = np.array(features["used"], dtype=bool)
    refused = ~used & np.isfinite(columns["measured_v_px"])
    plot = axes.plot  # type: ignore[attr-defined]
    style = {"linestyle": "none", "markerfacecolor": "none"}
    # A line has many pieces close together: large marks would hide it.
    pieces = bool(set(map(str, features["kind"])) & {"limb", "terminator"})  # type: ignore[arg-type]
    cross, mark = (3, 3) if pieces else (6, 10)
    plot(columns["predicted_u_px"], columns["predicted_v_px"], marker="+", ms=cross, mew=0.8, color=_PREDICTED,
         label="predicted", **style)  # fmt: skip
    for mask, marker, colour, label in ((used, "s", _USED, "used"), (refused, "o", _REJECTED, "refused")):
        u, v = columns["measured_u_px"][mask], columns["measured_v_px"][mask]
        width = 0.6 if pieces else 1.2
        plot(u, v, marker=marker, ms=mark, mew=width, color=colour, label=f"{label} ({int(mask.sum())})", **style)
    joined = np.flatnonzero(used)[:: 12 if pieces else 1]
    joins_u = np.stack([columns["predicted_u_px"][joined], columns["measured_u_px"][joined]])
    joins_v = np.stack([columns["predicted_v_px"][joined], columns["measured_v_px"][joined]])
    plot(joins_u, joins_v, color=_USED, lw=0.5)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.85)  # type: ignore[attr-defined]


def _features(document: Mapping[str, Json]) -> Mapping[str, Json]:
    """Inventory of the technique that was fused, else of any that has one."""
    answers = document["techniques"]
    listed = [t for t in answers if isinstance(t, dict) and t.get("features")] if isinstance(answers, list) else []
    # Of a disc or a blob the inventory is one row: the pieces of its limb show more.
    bodies = any(t.get("in_ensemble") and str(t["technique"]).startswith("Body") for t in listed)
    lines = {"BodyLimbNav"} if bodies else set()
    listed.sort(key=lambda t: (t["technique"] not in lines, not t.get("in_ensemble")))
    features = listed[0]["features"] if listed else None
    return features if isinstance(features, dict) else {}


def _title(document: Mapping[str, Json]) -> str:
    return f"{document['image_id']}   {document['mission']} {document['camera']}   {document['time_utc'] or ''}"


def _figures(document: Mapping[str, Json]) -> str:
    offset, sigma = document["offset_px"], document["sigma_px"]
    if not isinstance(offset, list) or not isinstance(sigma, list):
        return f"{document['status']}: {document['status_reason']}. {document['detail']}"
    text = f"offset dv {offset[0]:+.3f} ± {sigma[0]:.3f} px, du {offset[1]:+.3f} ± {sigma[1]:.3f} px"
    if document.get("rotation_deg") is not None:
        text += f", rotation {document['rotation_deg']:+.4f} ± {document['sigma_rotation_deg']:.4f} deg"
    return f"{text}.  rank {document['rank']}"
