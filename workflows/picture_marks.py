"""Marks of a summary picture: features that were predicted, used and refused, each kind in a shape of its own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.json_values import Json
from pipeline.records import BoolArray, FloatArray
from workflows.picture_canvas import GREY, ORANGE, PURPLE, SKY, YELLOW, Canvas, Colour

_LINES = ("limb", "terminator")
# Neighbouring pieces of one line lie closer than this many medians of their distances.
_GAP = 2.2
# Pieces of ring edges are some 24 px long; a chord over more than a few of them is no edge.
_RING_GAP_PX = 60.0
_NAMES = 24
_NAME_LETTERS = 16
_NAME_SIZE = 11
# Pieces whose robust weight is below this did not count.
_COUNTED = 0.05
# Ring edges that a piece places worse than this, in pixels, would be a cloud of dots.
_PLACED_PX = 1.0
_VECTOR_PX = 22.0
_BOX = 9.0
RingLine = tuple[str, FloatArray]
"""Name of a ring feature and (n, 2) pixels along one of its edges, NaN where it breaks off."""
# A short line in the key.
_BAR = np.array([[-8.0, 0.0], [8.0, 0.0]])


@dataclass(frozen=True)
class Key:
    """One entry of the key: how a mark looks and what it means."""

    draw: Callable[[Canvas, FloatArray], None]
    label: str


@dataclass(frozen=True)
class Features:
    """Inventory of one technique.

    Attributes
    ----------
    name, kind
        (n,) text.
    predicted_vu, measured_vu
        (n, 2), NaN where not known.
    used
        (n,) took part in the fit.
    """

    name: Sequence[str]
    kind: Sequence[str]
    predicted_vu: FloatArray
    measured_vu: FloatArray
    used: BoolArray

    @property
    def refused(self) -> BoolArray:
        """(n,) measured, but not used."""
        return np.asarray(~self.used & np.isfinite(self.measured_vu).all(axis=1))


def draw_marks(
    canvas: Canvas, document: Mapping[str, Json], shape: tuple[int, int], expected_rings: Sequence[RingLine] = ()
) -> list[Key]:
    """Draw all that is known of an image's features.

    Parameters
    ----------
    canvas
        The image, enlarged.
    document
        The image's JSON document.
    shape
        Rows and columns of the image.
    expected_rings
        Drawn where no ring edge was found.

    Returns
    -------
    list of Key
        Of the marks that are there.
    """
    lined = {str(name) for table in _tables(document, _LINES) for name in table.name}
    keys = _bodies(canvas, document, lined)
    for kind, colour in (("limb", ORANGE), ("terminator", YELLOW)):
        for table in _tables(document, (kind,))[:1]:
            keys += _line(canvas, table, kind, colour)
    keys += _rings(canvas, document, shape) or _expected_rings(canvas, expected_rings)
    for table in _tables(document, ("star",))[:1]:
        keys += _stars(canvas, table)
    return keys + _landmarks(canvas, document)


def _tables(document: Mapping[str, Json], kinds: Sequence[str]) -> list[Features]:
    """Inventories that hold a kind of feature: those that were fused first, later techniques before earlier ones."""
    answers = document["techniques"]
    listed = [t for t in reversed(answers) if isinstance(t, dict)] if isinstance(answers, list) else []
    listed.sort(key=lambda technique: not technique.get("in_ensemble"))
    found = []
    for technique in listed:
        columns = technique.get("features")
        if isinstance(columns, dict) and set(kinds) & set(map(str, columns["kind"])):  # type: ignore[arg-type]
            found.append(_features(columns))
    return found


def _features(columns: Mapping[str, Json]) -> Features:
    return Features(
        [str(name) for name in columns["name"]],  # type: ignore[union-attr]
        [str(kind) for kind in columns["kind"]],  # type: ignore[union-attr]
        _vu(columns, "predicted_{}_px"), _vu(columns, "measured_{}_px"), np.array(columns["used"], dtype=bool),
    )  # fmt: skip


def _vu(columns: Mapping[str, Json], pattern: str) -> FloatArray:
    """(n, 2) of two columns, NaN for null."""
    return np.stack([np.array(columns[pattern.format(axis)], dtype=float) for axis in "vu"], axis=1)


def _finite(vu: FloatArray) -> FloatArray:
    return np.asarray(vu[np.isfinite(vu).all(axis=1)])


def _bodies(canvas: Canvas, document: Mapping[str, Json], lined: set[str]) -> list[Key]:
    """Names at predicted centres, discs where no limb shows them, and centres that correlation or light has found."""
    listed = document["bodies"]
    drawn = False
    for body in listed if isinstance(listed, list) else []:
        if not isinstance(body, dict) or not isinstance(body["centre_vu"], list) or body["left_out"] == "outside_field":
            continue
        centre = canvas.places(np.array([body["centre_vu"]], dtype=float))
        radius = float(body["diameter_px"]) / 2 * canvas.scale  # type: ignore[arg-type]
        # OpenCV refuses circles far larger than the picture, and of those an arc would tell nothing.
        if str(body["name"]) not in lined and radius < 4000:
            canvas.circles(centre, max(radius, 3.0), SKY)
            drawn = True
        canvas.crosses(centre, 5, SKY)
        canvas.text(centre[0, 0] + 8, centre[0, 1] - 6, str(body["name"]), _NAME_SIZE, SKY, shade=True)
    keys = [Key(lambda c, p: c.circles(p, 6, SKY), "body predicted")] if drawn else []
    for table in _tables(document, ("disc", "blob"))[:1]:
        centres = _finite(table.measured_vu[table.used])
        canvas.crosses(canvas.places(centres), 9, ORANGE)
        canvas.circles(canvas.places(centres), 5, ORANGE)
        if len(centres):
            keys.append(Key(_found_centre, f"centre found ({len(centres)})"))
    return keys


def _found_centre(canvas: Canvas, place: FloatArray) -> None:
    canvas.crosses(place, 8, ORANGE)
    canvas.circles(place, 4, ORANGE)


def _runs(xy: FloatArray, widest: float = np.inf) -> list[FloatArray]:
    """Split pieces into lines of neighbours, which are never farther apart than the widest gap."""
    if len(xy) < 2:
        return []
    gaps = np.hypot(*np.diff(xy, axis=0).T)
    cuts = np.flatnonzero(gaps > min(_GAP * max(float(np.median(gaps)), 2.0), widest)) + 1
    return [run for run in np.split(xy, cuts) if len(run) > 1]


def _dots(canvas: Canvas, used: FloatArray, refused: FloatArray, colour: Colour) -> None:
    canvas.circles(refused, 2.5, PURPLE)
    canvas.circles(used, 2, colour, -1)


def _line(canvas: Canvas, table: Features, kind: str, colour: Colour) -> list[Key]:
    """Thin line where a limb or terminator was predicted, dots along it where it was found."""
    mine = np.array([each == kind for each in table.kind])
    for name in dict.fromkeys(table.name):
        pieces = mine & np.array([each == name for each in table.name])
        for run in _runs(canvas.places(_finite(table.predicted_vu[pieces]))):
            canvas.line(run, SKY)
    used, refused = table.measured_vu[mine & table.used], table.measured_vu[mine & table.refused]
    _dots(canvas, canvas.places(used), canvas.places(refused), colour)
    keys = [Key(_piece_of_line, f"{kind} predicted")]
    keys.append(Key(lambda c, p: c.circles(p, 2.5, colour, -1), f"{kind} found ({len(used)})"))
    return keys + _refused(len(refused))


def _piece_of_line(canvas: Canvas, place: FloatArray) -> None:
    canvas.line(np.concatenate([place, place]) + _BAR, SKY)


def _refused(count: int) -> list[Key]:
    return [Key(lambda c, p: c.circles(p, 3, PURPLE), f"refused ({count})")] if count else []


def _rings(canvas: Canvas, document: Mapping[str, Json], shape: tuple[int, int]) -> list[Key]:
    """Dots along each edge where it was found, a thin line where it was before the correction."""
    block = document["ring_edges"]
    if not isinstance(block, dict) or not block["feature"]:
        return []
    found, counted = _vu(block, "{}_px"), np.array(block["weight"], dtype=float) > _COUNTED
    placed = np.array(block["sigma_px"], dtype=float) <= _PLACED_PX
    names = [f"{name} {outer}" for name, outer in zip(block["feature"], block["outer"], strict=True)]  # type: ignore[arg-type]
    longitude = np.array(block["longitude_deg"], dtype=float)
    before = _uncorrected(found, document, shape)
    labelled = []
    for name in dict.fromkeys(names):
        pieces = np.flatnonzero(placed & [each == name for each in names])
        pieces = pieces[np.argsort(longitude[pieces])]
        for run in _runs(canvas.places(before[pieces]), _RING_GAP_PX * canvas.scale):
            canvas.line(run, SKY)
        labelled.append((pieces, name.rpartition(" ")[0]))
    used, refused = placed & counted, placed & ~counted
    _dots(canvas, canvas.places(found[used]), canvas.places(found[refused]), ORANGE)
    _ring_names(canvas, [(canvas.places(found[pieces]), name) for pieces, name in labelled], ORANGE)
    keys = [Key(_piece_of_line, "ring edge before correction")]
    faint = f", {int((~placed).sum())} too faint to show" if not placed.all() else ""
    keys.append(Key(lambda c, p: c.circles(p, 2.5, ORANGE, -1), f"ring edge found ({int(used.sum())}{faint})"))
    return keys + _refused(int(refused.sum()))


def _expected_rings(canvas: Canvas, lines: Sequence[RingLine]) -> list[Key]:
    """Thin lines where edges were expected."""
    for _, vu in lines:
        whole, places = np.flatnonzero(np.isfinite(vu).all(axis=1)), canvas.places(vu)
        for run in np.split(whole, np.flatnonzero(np.diff(whole) > 1) + 1):
            if len(run) > 1:
                canvas.line(places[run], SKY)
    limits = np.array(canvas.pixels.shape[:2]) / canvas.scale
    inside = [(vu[((vu >= 0) & (vu < limits)).all(axis=1)], name) for name, vu in lines]
    _ring_names(canvas, [(canvas.places(vu), name) for vu, name in inside if len(vu)], SKY)
    return [Key(_piece_of_line, f"ring edge predicted ({len(lines)})")] if lines else []


def _ring_names(canvas: Canvas, edges: list[tuple[FloatArray, str]], colour: Colour) -> None:
    """Each feature's name once, where no other name stands."""
    taken: list[tuple[float, float]] = []
    named: set[str] = set()
    for places, name in edges:
        if name in named:
            continue
        for x, y in places[:: max(len(places) // 6, 1)]:
            if all(abs(x - a) > 110 or abs(y - b) > 15 for a, b in taken):
                canvas.text(x + 6, y - 4, name, _NAME_SIZE, colour, shade=True)
                taken.append((x, y))
                named.add(name)
                break


def _uncorrected(found_vu: FloatArray, document: Mapping[str, Json], shape: tuple[int, int]) -> FloatArray:
    """Where things found would stand without the image's offset and rotation."""
    offset, observable = document["offset_px"], document["observable"]
    if isinstance(offset, list):
        shift = np.array(offset, dtype=float)
    elif isinstance(observable, dict):
        shift = np.array(observable["direction_vu"], dtype=float) * float(observable["offset_along_px"])  # type: ignore[arg-type]
    else:
        return found_vu
    rotation = document.get("rotation_deg")
    angle = float(np.radians(float(rotation))) if isinstance(rotation, float) else 0.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre = (np.array(shape) - 1) / 2
    return np.asarray(centre + (found_vu - shift - centre) @ turn)


def _stars(canvas: Canvas, table: Features) -> list[Key]:
    """Crosses where stars were predicted, boxes with names where they were found."""
    mine = np.array([kind == "star" for kind in table.kind])
    predicted = canvas.places(np.where(mine[:, None], table.predicted_vu, np.nan))
    measured = canvas.places(table.measured_vu)
    canvas.crosses(_finite(predicted), 5, SKY)
    used, refused = np.flatnonzero(mine & table.used), np.flatnonzero(mine & table.refused)
    for index in used:
        canvas.line(np.stack([predicted[index], measured[index]]), SKY)
    canvas.boxes(measured[used], _BOX, ORANGE)
    canvas.circles(measured[refused], _BOX, PURPLE)
    # Inventories start with the brightest stars.
    for index in used[:_NAMES]:
        x, y = measured[index]
        canvas.text(x + _BOX + 3, y - _BOX + 2, _short(table.name[index]), _NAME_SIZE, ORANGE, shade=True)
    keys = [Key(lambda c, p: c.crosses(p, 5, SKY), f"star predicted ({int(mine.sum())})")]
    keys.append(Key(lambda c, p: c.boxes(p, 6, ORANGE), f"star found ({len(used)})"))
    return keys + _refused(len(refused))


def _short(name: str) -> str:
    return name if len(name) <= _NAME_LETTERS else f"…{name[1 - _NAME_LETTERS:]}"


def _landmarks(canvas: Canvas, document: Mapping[str, Json]) -> list[Key]:
    """Diamonds where landmarks were found, with their offsets drawn so much longer that they can be seen."""
    block = document["landmarks"]
    if not isinstance(block, dict) or not block["landmark"]:
        return []
    predicted, observed = _vu(block, "predicted_{}_px"), _vu(block, "observed_{}_px")
    used = np.array(block["used"], dtype=bool)
    seen = np.isfinite(observed).all(axis=1)
    canvas.crosses(_finite(canvas.places(predicted[~used])), 3, GREY)
    lengths = np.hypot(*(observed - predicted)[used].T)
    typical = float(np.median(lengths)) * canvas.scale if len(lengths) else 0.0
    factor = float(np.clip(_round_number(_VECTOR_PX / max(typical, 1e-3)), 1, 100))
    for vu, vector, good in zip(predicted[seen], (observed - predicted)[seen], used[seen], strict=True):
        start = canvas.places(vu[None])[0]
        canvas.arrow(start, start + vector[::-1] * factor * canvas.scale, ORANGE if good else PURPLE)
    canvas.diamonds(canvas.places(predicted[used]), 4, ORANGE)
    canvas.diamonds(canvas.places(predicted[seen & ~used]), 4, PURPLE)
    times = f", arrows {factor:g} times as long" if factor != 1 else ""
    keys = [Key(_arrow_of_landmark, f"landmark used ({int(used.sum())}){times}")]
    if (seen & ~used).any():
        keys.append(Key(lambda c, p: c.diamonds(p, 5, PURPLE), f"landmark refused ({int((seen & ~used).sum())})"))
    keys.append(Key(lambda c, p: c.crosses(p, 4, GREY), f"landmark not found ({int((~seen).sum())})"))
    return keys


def _arrow_of_landmark(canvas: Canvas, place: FloatArray) -> None:
    canvas.diamonds(place - [5, 0], 4, ORANGE)
    canvas.arrow(place[0] - [5, 0], place[0] + [8, 0], ORANGE)


def _round_number(value: float) -> float:
    """Largest of 1, 2 and 5 times a power of ten that is not greater."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(factor * power for factor in (5, 2, 1) if factor * power <= value * (1 + 1e-9)))
