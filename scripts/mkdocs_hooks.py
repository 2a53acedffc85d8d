"""Hooks of MkDocs: the examples, which are next to `docs`, become part of the site, so that links to them work."""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

EXAMPLES = Path(__file__).parents[1] / "examples"


def on_files(files: Files, config: Any) -> Files:
    """MkDocs calls this with all files of `docs`."""
    for path in sorted(EXAMPLES.glob("*.py")):
        files.append(File.generated(config, f"examples/{path.name}", content=path.read_text()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """MkDocs calls this with the text of every page."""
    return markdown.replace("](../examples/", "](examples/").replace("](../../examples/", "](../examples/")
