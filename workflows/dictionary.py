"""The data dictionary: every table and column, from the schemas themselves.

``python -m workflows.dictionary`` writes ``outputs/README.md``.
"""

from pathlib import Path

import pyarrow as pa

from pipeline.status import StatusReason, status_of
from pipeline.tables import SCHEMAS

TARGET = Path("outputs/README.md")

_HEAD = """# Outputs

`make demo` and `make bench` write here; nothing but this file is kept. A run folder holds

| path | what |
|---|---|
| `images/<id>.json` | per image: answer, covariance, corrected pointing, every technique's features, provenance |
| `offsets/`, `techniques/`, `features/`, `timings/` | Parquet datasets, partitioned by mission and camera |
| `state/<id>.json` | what an image was made from (sizes, times, sha256) and its timings: marks for resuming |
| `plan.json`, `run.json` | images of the latest run; versions, configuration, catalogues, counts, start and end |

Every file is written under a temporary name and renamed. Two runs on the same input compare equal byte for byte,
whatever the number of workers, but for `timings`, `state` and `run.json`, which hold clocks. Pixels are (v, u), rows
first, the centre of the first pixel at (0, 0); null means not known or not observable, never a sentinel.

"""

_TABLES = {
    "offsets": "One row per image.",
    "techniques": "One row per technique that ran on an image, about the technique's own pivot.",
    "features": "One row per predicted feature, technique and image.",
    "ring_edges": "One row per measured piece of a ring's edge and image, some 24 pixels long.",
    "landmarks": "One row per landmark looked for and image.",
    "poses": "One row per image with a pose of its own, after `pilotage pose` per image of an arc, smoothed.",
    "arcs": "One row per arc, written by `pilotage pose`.",
    "timings": "One row per stage and image, and one for the total.",
}


def _describe(parts: list[str], name: str, text: str, schema: pa.Schema) -> None:
    """Append the section of one table."""
    parts.append(f"## {name}\n\n{text}\n\n")
    parts.append("| column | type | unit | meaning |\n|---|---|---|---|\n")
    for field in schema:
        said = {key.decode(): value.decode() for key, value in field.metadata.items()}
        parts.append(f"| `{field.name}` | {field.type} | {said['unit']} | {said['meaning']} |\n")
    parts.append("\n")


def data_dictionary() -> str:
    """Markdown of all tables and of the reasons behind a status.

    Returns
    -------
    str
        Content of ``outputs/README.md``.
    """
    parts = [_HEAD]
    for name, schema in SCHEMAS.items():
        _describe(parts, name, f"{_TABLES[name]} Partition columns (`mission`, `camera`) live in the path.", schema)
    parts.append("## Status and reason\n\n| status | reasons |\n|---|---|\n")
    for status in dict.fromkeys(status_of(reason) for reason in StatusReason):
        reasons = ", ".join(f"`{reason.value}`" for reason in StatusReason if status_of(reason) is status)
        parts.append(f"| `{status.value}` | {reasons} |\n")
    return "".join(parts)


if __name__ == "__main__":
    TARGET.write_text(data_dictionary(), encoding="utf-8")
