"""A table in a CSV file: a line of names, and lines of as many entries."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from kpirl_ocp.sizes import check_bytes, read_text
from kpirl_ocp.types import Array

_CELL = 64  # [bytes] that Python takes for a cell


@dataclass(frozen=True)
class CsvTable:
    """Rows without those that are blank.

    names: of the columns.
    rows: texts, as many as there are names.
    lines: of the file, counted from 1, on which the rows end.
    """

    names: list[str]
    rows: list[list[str]]
    lines: list[int]

    def column(self, name: str) -> list[str]:
        """Its texts."""
        index = self.names.index(name)
        return [row[index] for row in self.rows]

    def numbers(self, name: str, empty: str = "") -> Array:
        """A column as numbers (n,); empty: what stands for an empty entry. Raises ValueError, which names the line."""
        values = np.empty(len(self.rows))
        for i, text in enumerate(self.column(name)):
            try:
                values[i] = float(text or empty)
            except ValueError:
                raise ValueError(f"line {self.lines[i]}, {name}: expected a number, got {text!r}.") from None
        return values

    def missing(self, names: Iterable[str]) -> str:
        """Whichever of the names are no column, in a sentence with those that are; empty if all are there."""
        missing = list(dict.fromkeys(name for name in names if name not in self.names))
        if not missing:
            return ""
        return f"has no column {', '.join(missing)}; it has {_listed(self.names)}."


def _listed(names: Iterable[str]) -> str:
    return ", ".join(name if name.isprintable() else repr(name) for name in names)


def read_table(path: Path) -> CsvTable:
    """The table of a file in UTF-8, with line ends of any system, as spreadsheets write it.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not text, or too large; it has other marks than commas, no rows, two columns of one name, or a
            row of another length than the line of names.
    """
    text = read_text(path).removeprefix("\ufeff")  # the mark of UTF-8 that spreadsheets write
    check_bytes(_CELL * (text.count(",") + text.count("\n")))
    reader = csv.reader(StringIO(text, newline=""), skipinitialspace=True)
    try:
        found = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}.") from error
    if not found:
        raise ValueError("it is empty.")
    names = [name.strip() for name in found[0][1]]
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        raise ValueError("its columns must be separated by commas, and numbers have a decimal point.")
    twice = {name for name in names if name and names.count(name) > 1}
    if twice:
        raise ValueError(f"it has several columns {_listed(sorted(twice))}.")
    for line, row in found[1:]:
        if len(row) != len(names):
            raise ValueError(f"line {line}: expected {len(names)} entries, one for each name, got {len(row)}.")
    if len(found) == 1:
        raise ValueError("it has a line of names, and no rows.")
    return CsvTable(names, [row for _, row in found[1:]], [line for line, _ in found[1:]])
