"""Index tables of archives: PDS3's INDEX.TAB by its label, PDS4's collection inventories."""

import csv
import io
from collections.abc import Container

from catalogs.instruments import CardValue
from catalogs.label_text import Keywords, LabelObject, parse_label, parse_pds4
from pipeline.errors import ConfigurationError

Row = dict[str, CardValue]
Spans = list[tuple[int, int]]

_WHOLE, _REAL = ("ASCII_INTEGER", "INTEGER"), ("ASCII_REAL", "REAL", "FLOAT")


def read_pds3_index(table: bytes, label: bytes, name: str, wanted: Container[str] | None = None) -> list[Row]:
    """Rows of an ASCII table by the columns of its detached label.

    Parameters
    ----------
    table, label
        The two files.
    name
        Of the table, for messages.
    wanted
        Columns to keep, all by default: cumulative indexes have a hundred columns and half a million rows.

    Returns
    -------
    list of dict
        Values by column name, quotes and padding taken off, figures as figures; a column of several items has ','
        between them.

    Raises
    ------
    ConfigurationError
        If the label describes no columns, or the table is not as long as it says.
    """
    try:
        root = parse_label(label.decode("latin-1"))
    except ValueError as error:
        raise ConfigurationError(f"{name}: {error}") from error
    holder = next((found for found in _tables(root)), None)
    if holder is None:
        raise ConfigurationError(f"{name}: its label describes no columns")
    columns = [_column(item, name) for item in holder.objects if item.name.upper() == "COLUMN"]
    lines = [line for line in table.decode("latin-1").splitlines() if line.strip()]
    rows = holder.keywords.get("ROWS")
    if isinstance(rows, int) and len(lines) < rows:
        raise ConfigurationError(f"{name} has {len(lines)} rows of {rows}")
    shortest = max(end for _, spans, _ in columns for _, end in spans)
    bad = next((number for number, line in enumerate(lines, start=1) if len(line) < shortest), None)
    if bad is not None:
        raise ConfigurationError(f"{name}: row {bad} ends before column {columns[-1][0]}")
    kept = [column for column in columns if wanted is None or column[0] in wanted]
    return [{key: _cell(line, spans, kind) for key, spans, kind in kept} for line in lines]


def _tables(root: LabelObject) -> list[LabelObject]:
    """Objects with columns, those called an index first."""
    found = [item for item in _every(root) if any(inner.name.upper() == "COLUMN" for inner in item.objects)]
    return sorted(found, key=lambda item: "INDEX" not in item.name.upper())


def _every(item: LabelObject) -> list[LabelObject]:
    return [item, *(deep for inner in item.objects for deep in _every(inner))]


def _column(item: LabelObject, name: str) -> tuple[str, Spans, str]:
    """Name of a column, first and last byte of each of its items, and its data type."""
    keywords = {key.upper(): value for key, value in item.keywords.items()}
    title = str(keywords.get("NAME", "")).upper()
    figures = [keywords.get(key) for key in ("START_BYTE", "BYTES")]
    items = keywords.get("ITEMS", 1)
    size = keywords.get("ITEM_BYTES", figures[1])
    step = keywords.get("ITEM_OFFSET", size)
    numbers = [n for n in (*figures, items, size, step) if isinstance(n, int) and n > 0]
    if not title or len(numbers) != 5:
        raise ConfigurationError(f"{name}: column {title or '(without a name)'} of its label has no place in the row")
    start, _, count, width, distance = numbers
    spans = [(start - 1 + k * distance, start - 1 + k * distance + width) for k in range(count)]
    return title, spans, str(keywords.get("DATA_TYPE", "")).upper()


def _cell(line: str, spans: Spans, kind: str) -> CardValue:
    texts = [line[start:end].strip().strip('"').strip() for start, end in spans]
    # Frame counts stand in columns of characters, where a zero at either end counts.
    if len(texts) > 1 or kind not in _WHOLE + _REAL:
        return ",".join(texts)
    try:
        return int(texts[0]) if kind in _WHOLE else float(texts[0])
    except ValueError:
        return texts[0]


def read_collection(table: bytes, name: str) -> list[str]:
    """Members of a PDS4 collection inventory.

    Parameters
    ----------
    table
        The inventory: member status and identifier, without a header line.
    name
        For messages.

    Returns
    -------
    list of str
        Logical identifiers without versions, primary members only.

    Raises
    ------
    ConfigurationError
        If it is no inventory.
    """
    members = []
    for number, line in enumerate(csv.reader(io.StringIO(table.decode("utf-8", "replace"))), start=1):
        if not line:
            continue
        fields = [field.strip() for field in line]
        if len(fields) < 2 or fields[0] not in ("P", "S") or not fields[1].startswith("urn:"):
            raise ConfigurationError(f"{name}: line {number} is no member of a collection")
        # Secondary members belong to another collection, which lists them as its own.
        if fields[0] == "P":
            members.append(fields[1].partition("::")[0])
    return list(dict.fromkeys(members))


def pds4_product(label: bytes) -> tuple[str, Keywords] | None:
    """Logical identifier and elements of a PDS4 label.

    Parameters
    ----------
    label
        XML.

    Returns
    -------
    tuple or None
        None where it is no label of a product with observations.
    """
    try:
        found = parse_pds4(label)
    except ValueError:
        return None
    identifier = found.get("Identification_Area.logical_identifier")
    observed = found.get("product") == "Product_Observational"
    return (str(identifier), found) if observed and identifier is not None else None
