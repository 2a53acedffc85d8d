"""The result of every part of the benchmark: tables to read, and numbers for metrics.json, figure and bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Numbers = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows of text with a title, and a note on how to read them."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    note: str = ""

    def __str__(self) -> str:
        """Markdown."""
        lines = [f"### {self.title}", ""]
        for cells in (self.header, ["---"] * len(self.header), *self.rows):
            lines.append("| " + " | ".join(map(str, cells)) + " |")
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


@dataclass(frozen=True)
class Part:
    """The answer to one question."""

    numbers: Numbers
    tables: Sequence[Table]
