"""One self-contained page: headings, text, tables, and figures as SVG, which are also written to files next to it."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.pictures import svg_file
from kpirl_ocp.reporting import cell

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
table {{ border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem; }}
th, td {{ border-bottom: 1px solid #ccc; padding: 0.25rem 0.7rem; text-align: left; vertical-align: top; }}
td + td {{ min-width: 9rem; }} /* of text */
.words td {{ min-width: 0; }} .words .long {{ min-width: 18rem; }}
.number {{ text-align: right; }} td.number {{ white-space: nowrap; min-width: 0; }}
.wide {{ overflow-x: auto; }} nav ul {{ padding-left: 1.2rem; }} nav .level3 {{ margin-left: 1.2rem; }}
img {{ max-width: 100%; height: auto; }} figure {{ margin: 1.5rem 0; }}
figcaption, .note {{ color: #555; font-size: 0.9rem; }}
pre {{ background: #f5f5f5; padding: 0.7rem; overflow-x: auto; font-size: 0.8rem; }}
@media (max-width: 45rem) {{
  .wide img {{ max-width: none; }} /* figures keep the size of their text */
  .words .long {{ min-width: 0; }} th, td {{ padding: 0.25rem 0.4rem; }}
}}
</style></head><body>
<h1>{title}</h1>
<nav><ul>{contents}</ul></nav>
{body}
</body></html>
"""


_NUMBER = ' class="number"'


class Page:
    """A report that grows from top to bottom; every call adds one element."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._parts: list[str] = []
        self._contents: list[str] = []
        self._figures: list[bytes] = []

    def heading(self, text: str, level: int = 2) -> None:
        """A heading, which the table of contents lists."""
        anchor = f"section-{len(self._contents) + 1}"
        self._contents.append(f'<li class="level{level}"><a href="#{anchor}">{html.escape(text)}</a></li>')
        self._parts.append(f'<h{level} id="{anchor}">{html.escape(text)}</h{level}>')

    def text(self, text: str) -> None:
        """A paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[Any]], note: str = "") -> None:
        """A table; numbers get four digits. Columns of text are aligned to the left, and so is the first one."""
        cells = [[cell(value) for value in row] for row in rows]
        columns = enumerate(zip(header, *cells, strict=True))
        kinds = [_kind(column[1:]) if place else "" for place, column in columns]
        lines = [_row("th", header, kinds), *(_row("td", row, kinds) for row in cells)]
        table = "".join(f"<tr>{line}</tr>" for line in lines)
        words = "" if _NUMBER in kinds else ' class="words"'
        self._parts.append(f'<div class="wide"><table{words}>{table}</table></div>')
        if note:
            self._parts.append(f'<p class="note">{html.escape(note)}</p>')

    def figure(self, figure: Figure, caption: str) -> None:
        """A figure."""
        drawn = svg_file(figure).encode()
        self._figures.append(drawn)
        text, data = html.escape(caption), base64.b64encode(drawn).decode()
        image = f'<div class="wide"><img alt="{text}" src="data:image/svg+xml;base64,{data}"></div>'
        self._parts.append(f"<figure>{image}<figcaption>{text}</figcaption></figure>")

    def listing(self, text: str) -> None:
        """Text as it is."""
        self._parts.append(f"<pre>{html.escape(text)}</pre>")

    def write(self, path: Path) -> Path:
        """Write the page, whole or not at all, and its figures figure_01.svg, ... next to it."""
        for number, data in enumerate(self._figures, 1):
            with atomic_write(path.with_name(f"figure_{number:02d}.svg")) as file:
                file.write(data)
        with atomic_write(path) as file:
            file.write(
                _PAGE.format(
                    title=html.escape(self.title), contents="".join(self._contents), body="\n".join(self._parts)
                ).encode()
            )
        path.chmod(0o644)
        return path


def _row(tag: str, cells: Sequence[str], kinds: Sequence[str]) -> str:
    pairs = zip(cells, kinds, strict=True)
    return "".join(f"<{tag}{kind}>{html.escape(cell)}</{tag}>" for cell, kind in pairs)


def _kind(column: Sequence[str]) -> str:
    """The class of a column's cells."""
    if _numeric(column):
        return _NUMBER
    return ' class="long"' if max(map(len, column), default=0) > 40 else ""


def _numeric(column: Sequence[str]) -> bool:
    """True if most of the cells that are not empty are numbers, maybe with a unit."""
    filled = [cell for cell in column if cell]
    return 2 * sum(bool(re.match(r"\(?-?\d", cell)) and len(cell) < 24 for cell in filled) > len(filled)
