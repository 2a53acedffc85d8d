"""Takes from CSV files and from `.npz` files of plain arrays."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np

from kpirl_ocp.episodes import check_archive
from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.perception.data.formats.take import Take, checked_rate, one_line
from kpirl_ocp.sizes import check_bytes, read_text
from kpirl_ocp.types import Array

_CELL = 64  # [bytes] that Python takes for a cell of a table
# KeyError, RuntimeError: of archives whose index is wrong, that are encrypted or packed in another way.
_NO_ARRAYS = (OSError, ValueError, TypeError, AttributeError, KeyError, RuntimeError, EOFError, BadZipFile, ZlibError)


def read_csv(
    path: str | Path, columns: Mapping[str, Sequence[str]], *, time: str | None = None, rate: float | None = None
) -> Take:
    """A take from a CSV file with a line of names at its top.

    Args:
        path: the file.
        columns: name of each array and the columns that it consists of: {"action": ["u1", "u2"]} gives (n, 2).
        time: name of the column of times [s].
        rate: instead of it, steps per second [Hz].

    Raises:
        EpisodeError: a column is missing, or a cell is no number; it names the line.
    """
    try:
        text = read_text(Path(path)).removeprefix("\ufeff")  # which spreadsheets write
        check_bytes(_CELL * (text.count(",") + text.count("\n")))
        rows = list(csv.reader(StringIO(text, newline=""), skipinitialspace=True))
    except (OSError, ValueError, csv.Error) as error:
        raise EpisodeError(f"{path} cannot be read as CSV: {one_line(error)}") from error
    header = [name.strip() for name in rows[0]] if rows else []
    wanted = [*(name for names in columns.values() for name in names), *([time] if time else [])]
    missing = [name for name in wanted if name not in header]
    if missing:
        raise EpisodeError(f"{path} has no column {', '.join(missing)}; it has {', '.join(header)}.")
    table = {name: _numbers(path, rows[1:], header.index(name), name) for name in wanted}
    empty = [name for name, names in columns.items() if not names]
    if empty:
        raise EpisodeError(f"{path}: columns must name at least one column of {', '.join(empty)}.")
    arrays = {name: np.column_stack([table[column] for column in names]) for name, names in columns.items()}
    return _take(path, arrays, table[time] if time else None, rate, len(rows) - 1)


def read_npz(path: str | Path, *, time: str | None = None, rate: float | None = None) -> Take:
    """A take from an `.npz` file of arrays (n, ...) without pickle; their names are kept.

    Args:
        path: the file.
        time: name of the array of times (n,) [s].
        rate: instead of it, steps per second [Hz].

    Raises:
        EpisodeError: the file cannot be read, an array is missing, or lengths differ.
    """
    try:
        check_archive(Path(path))
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.atleast_1d(file[name]) for name in file.files}
    except _NO_ARRAYS as error:
        raise EpisodeError(f"{path} cannot be read as plain arrays: {one_line(error)}") from error
    if time is not None and time not in arrays:
        raise EpisodeError(f"{path} has no array {time!r}; it has {', '.join(arrays)}.")
    times = arrays.pop(time) if time is not None else None
    if not arrays:
        raise EpisodeError(f"{path} holds no arrays.")
    return _take(path, arrays, times, rate, len(next(iter(arrays.values()))))


def _take(path: str | Path, arrays: Mapping[str, Array], times: Array | None, rate: float | None, count: int) -> Take:
    if (times is None) == (rate is None):
        raise EpisodeError(f"{path}: say either where the times are (time=...) or the rate (rate=... [Hz]).")
    if rate is not None:
        times = np.arange(count) / checked_rate(rate)
    try:
        with np.errstate(invalid="ignore"):  # infinity is refused
            return Take(arrays, np.asarray(times) - np.asarray(times)[:1])
    except (EpisodeError, TypeError) as error:  # times that are no numbers
        raise EpisodeError(f"{path}: {one_line(error)}") from error


def _numbers(path: str | Path, rows: Sequence[Sequence[str]], index: int, name: str) -> Array:
    values = np.empty(len(rows))
    for line, row in enumerate(rows):
        try:
            values[line] = float(row[index])
        except (ValueError, IndexError):
            found = row[index] if index < len(row) else "nothing"
            raise EpisodeError(f"{path}, line {line + 2}, {name}: expected a number, got {found!r}.") from None
    return values
