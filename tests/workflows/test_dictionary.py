from pathlib import Path

from pipeline.tables import SCHEMAS
from workflows.dictionary import data_dictionary


def test_published_dictionary_is_that_of_the_schemas() -> None:
    published = Path(__file__).parents[2] / "outputs" / "README.md"
    assert published.read_text(encoding="utf-8") == data_dictionary()


def test_every_column_says_its_unit_and_meaning() -> None:
    for schema in SCHEMAS.values():
        for field in schema:
            assert set(field.metadata) == {b"unit", b"meaning"}, field.name
            assert field.metadata[b"meaning"], field.name
