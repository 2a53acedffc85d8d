"""Takes from CSV files and from `.npz` files of plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np

from kpirl_ocp.episodes import check_archive
from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.perception.data.csv_table import read_table
from kpirl_ocp.perception.data.formats.take import Take, checked_rate, one_line
from kpirl_ocp.types import Array

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
        EpisodeError: a column is missing, a line has more or fewer entries than there are names, or an entry is no
            number; it names the line.
    """
    columns = _checked(columns)
    try:
        table = read_table(Path(path))
    except (OSError, ValueError) as error:
        raise EpisodeError(f"{path} cannot be read as CSV: {one_line(error)}") from error
    wanted = [*(name for names in columns.values() for name in names), *([time] if time else [])]
    missing = table.missing(wanted)
    if missing:
        raise EpisodeError(f"{path} {missing}")
    try:
        numbers = {name: table.numbers(name) for name in wanted}
    except ValueError as error:
        raise EpisodeError(f"{path}, {error}") from error
    arrays = {name: np.column_stack([numbers[column] for column in names]) for name, names in columns.items()}
    return _take(path, arrays, numbers[time] if time else None, rate, len(table.rows))


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
        raise EpisodeError(f"{path}: give either the name of the times (time=...) or the rate (rate=... [Hz]).")
    if rate is not None:
        times = np.arange(count) / checked_rate(rate)
    try:
        with np.errstate(invalid="ignore"):  # infinity is refused
            return Take(arrays, np.asarray(times) - np.asarray(times)[:1])
    except (EpisodeError, TypeError) as error:  # times that are no numbers
        raise EpisodeError(f"{path}: {one_line(error)}") from error


def _checked(columns: Mapping[str, Sequence[str]]) -> Mapping[str, Sequence[str]]:
    """The columns, if they are names of arrays and lists of names."""
    if not isinstance(columns, Mapping) or any(isinstance(names, str) for names in columns.values()):
        raise EpisodeError(f'columns must be a dictionary such as {{"action": ["u1", "u2"]}}, got {columns!r}.')
    empty = [name for name, names in columns.items() if not names]
    if empty:
        raise EpisodeError(f"columns must name at least one column of {', '.join(empty)}.")
    return columns
