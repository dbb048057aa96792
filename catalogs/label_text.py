"""Texts of labels: PDS3 and ISIS (keyword = value), VICAR, and PDS4, all into one flat mapping of keywords.

Nested objects are named by dotted keywords (``IMAGE.LINES``), lists become text with ',' between their items, and the
unit of a figure stands beside it as ``KEYWORD.unit``. Where a keyword comes twice the first one counts.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, field

from catalogs.instruments import CardValue

Keywords = dict[str, CardValue]

# Longest label that is looked for in front of pixels: the longest of real products is Galileo's, with 30 kB.
_LONGEST_LABEL = 1 << 18
_END = re.compile(rb"(?:^|[\r\n])[ \t]*END[ \t]*(?=[\r\n\x00]|$)", re.IGNORECASE)
# Comments end on their line (PDS Standards Reference 12.3.1), also those of old disks that are never closed.
_TOKEN = re.compile(
    r"""\s+ | /\*[^\n]*?(?:\*/|$) | \#[^\n]*
    | "(?P<text>[^"]*)" | '(?P<symbol>[^'\n]*)' | <(?P<unit>[^>\n]*)> | (?P<mark>[=(){},;])
    | (?P<word>[^\s=(){},;"'<]+) | (?P<bad>.)""",
    re.VERBOSE | re.MULTILINE,
)
_OPENING = ("OBJECT", "GROUP", "BEGIN_OBJECT", "BEGIN_GROUP")
_CLOSING = ("END_OBJECT", "END_GROUP")
_VICAR_ITEM = re.compile(r"([A-Za-z0-9_]+)\s*=\s*('(?:[^']|'')*'|\((?:'(?:[^']|'')*'|[^')])*\)|[^\s]+)")


@dataclass(frozen=True)
class LabelObject:
    """One object or group of a label.

    Attributes
    ----------
    name
        As in ``OBJECT = name``; empty for the label itself.
    keywords
        Its own.
    objects
        Those inside it, in their order.
    """

    name: str = ""
    keywords: Keywords = field(default_factory=dict)
    objects: "list[LabelObject]" = field(default_factory=list)

    def flat(self, prefix: str = "") -> Keywords:
        """All keywords by their dotted names."""
        found = {prefix + key: value for key, value in self.keywords.items()}
        for inner in self.objects:
            for key, value in inner.flat(f"{prefix}{inner.name}.").items():
                found.setdefault(key, value)
        return found

    def all_named(self, name: str) -> "Iterator[LabelObject]":
        """Objects of a name, at any depth."""
        for inner in self.objects:
            if inner.name.upper() == name:
                yield inner
            yield from inner.all_named(name)


def attached_label(data: bytes) -> str | None:
    """Text of the PDS3 or ISIS label in front of a file.

    Parameters
    ----------
    data
        The file.

    Returns
    -------
    str or None
        Up to its END; None where there is none.
    """
    end = _END.search(data, 0, _LONGEST_LABEL)
    return None if end is None else data[: end.end()].decode("latin-1")


def parse_label(text: str) -> LabelObject:
    """Objects and keywords of a PDS3 or ISIS label.

    Parameters
    ----------
    text
        The label; whatever is no ``keyword = value`` is passed over.

    Returns
    -------
    LabelObject
        The label as one object.

    Raises
    ------
    ValueError
        If brackets or objects are not closed.
    """
    tokens = [(kind, match[kind]) for match in _TOKEN.finditer(text) if (kind := match.lastgroup)]
    tokens += [("stop", ""), ("stop", "")]
    root = LabelObject()
    stack = [root]
    position = 0
    while tokens[position][0] != "stop":
        kind, key = tokens[position]
        name = key.upper()
        if kind == "word" and name == "END" and tokens[position + 1] != ("mark", "="):
            break
        if kind == "word" and tokens[position + 1] == ("mark", "="):
            value, unit, position = _value(tokens, position + 2)
            if name in _OPENING:
                inner = LabelObject(str(value))
                stack[-1].objects.append(inner)
                stack.append(inner)
            elif name not in _CLOSING:
                stack[-1].keywords.setdefault(key, value)
                if unit:
                    stack[-1].keywords.setdefault(f"{key}.unit", unit)
        else:
            position += 1
        if name in _CLOSING and len(stack) > 1:
            stack.pop()
    if len(stack) > 1:
        raise ValueError(f"object {stack[-1].name} of its label is not closed")
    return root


def _value(tokens: list[tuple[str, str]], position: int) -> tuple[CardValue, str, int]:
    """Value that starts at a token, its unit, and the token after both."""
    kind, text = tokens[position]
    if kind == "stop":
        raise ValueError("its label ends inside a keyword")
    value: CardValue
    if text in ("(", "{") and kind == "mark":
        value, position = _items(tokens, position)
    else:
        value, position = _scalar(kind, text), position + 1
    if tokens[position][0] == "unit":
        return value, tokens[position][1].strip(), position + 1
    return value, "", position


def _items(tokens: list[tuple[str, str]], position: int) -> tuple[str, int]:
    items: list[str] = []
    depth = 0
    while True:
        kind, text = tokens[position]
        if kind == "stop":
            raise ValueError("a list in its label is not closed")
        position += 1
        if kind == "mark":
            depth += {"(": 1, "{": 1, ")": -1, "}": -1}.get(text, 0)
            if depth == 0:
                return ",".join(items), position
        elif kind == "unit":
            # Of units in lists only that of pointers, ("A.IMG", 2001 <BYTES>), changes what is meant.
            items += ["<BYTES>"] if text.strip().upper() == "BYTES" else []
        else:
            items.append(" ".join(text.split()))


def _scalar(kind: str, text: str) -> CardValue:
    if kind != "word":
        return " ".join(text.split())
    return _figure(text)


def _figure(text: str) -> CardValue:
    for convert in (int, float):
        try:
            # Python reads '1_000' and 'nan' as figures; labels mean names by them.
            return text if "_" in text or text[-1:].isalpha() else convert(text)
        except ValueError:
            continue
    return text


def parse_vicar(text: str) -> Keywords:
    """Keywords of a VICAR label: its system items, then those of its properties and tasks.

    Parameters
    ----------
    text
        The label.

    Returns
    -------
    dict
        Flat; ``TASK`` and ``PROPERTY`` hold the names of all sections with ',' between them.
    """
    found: Keywords = {}
    sections: dict[str, list[str]] = {"TASK": [], "PROPERTY": []}
    for key, raw in _VICAR_ITEM.findall(text):
        value = _vicar_value(raw)
        if key in sections:
            sections[key].append(str(value))
        else:
            found.setdefault(key, value)
    return found | {key: ",".join(names) for key, names in sections.items() if names}


def _vicar_value(raw: str) -> CardValue:
    if raw.startswith("("):
        return ",".join(str(_vicar_value(item)) for item in re.findall(r"'(?:[^']|'')*'|[^\s,()]+", raw))
    if raw.startswith("'"):
        # LABnn of Voyager's labels are read by columns: blanks stay.
        return raw[1:-1].replace("''", "'")
    return _figure(raw)


def parse_pds4(data: bytes) -> Keywords:
    """Elements of a PDS4 label by their dotted path below the product.

    Parameters
    ----------
    data
        XML.

    Returns
    -------
    dict
        Path without name spaces, for example ``Observation_Area.Time_Coordinates.start_date_time``; texts of elements
        that come several times have ',' between them. ``product`` is the name of the root.

    Raises
    ------
    ValueError
        If it is no XML.
    """
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(f"its label is no XML: {error}") from error
    found: Keywords = {"product": _local(root.tag)}
    for element, path in _leaves(root, ""):
        text = " ".join((element.text or "").split())
        value = _figure(text)
        found[path] = f"{found[path]},{text}" if path in found else value
        if "unit" in element.attrib:
            found.setdefault(f"{path}.unit", element.attrib["unit"])
    return found


def _leaves(element: ElementTree.Element, path: str) -> Iterator[tuple[ElementTree.Element, str]]:
    for child in element:
        here = f"{path}.{_local(child.tag)}" if path else _local(child.tag)
        if len(child):
            yield from _leaves(child, here)
        elif child.text and child.text.strip():
            yield child, here


def _local(tag: str) -> str:
    return tag.rpartition("}")[2]
