from pathlib import Path

from workflows.dictionary import data_dictionary


def test_published_dictionary_is_that_of_the_schemas() -> None:
    published = Path(__file__).parents[2] / "outputs" / "README.md"
    assert published.read_text(encoding="utf-8") == data_dictionary()
