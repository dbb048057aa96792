"""Pages of the documentation that are made from the code while it is built (a hook of MkDocs)."""

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from workflows.config_cli import all_keys
from workflows.dictionary import data_dictionary


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the data dictionary and the list of configuration keys.

    Parameters
    ----------
    files
        What MkDocs found.
    config
        Of the site.

    Returns
    -------
    mkdocs.structure.files.Files
        The same with two more.
    """
    files.append(File.generated(config, "tables.md", content=data_dictionary().replace("# Outputs", "# Tables", 1)))
    files.append(File.generated(config, "configuration.md", content=configuration_page()))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Lead links to the data dictionary to its page.

    Parameters
    ----------
    markdown
        A page.

    Returns
    -------
    str
        The page.
    """
    return markdown.replace("../outputs/README.md", "tables.md")


def configuration_page() -> str:
    """Markdown of every key with its default and meaning.

    Returns
    -------
    str
        One table.
    """
    lines = ["# Configuration", "", "| key | default | meaning |", "|---|---|---|"]
    for key, field in all_keys():
        default = "" if field.is_required() else f"`{field.get_default(call_default_factory=True)!r}`"
        lines.append(f"| `{key}` | {default.replace('|', ' or ')} | {field.description} |")
    return "\n".join(lines) + "\n"
