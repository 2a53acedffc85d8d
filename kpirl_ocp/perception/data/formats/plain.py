"""Takes from CSV files and from `.npz` files of plain arrays."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from kpirl_ocp.episodes import check_archive
from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.perception.data.formats.take import Take
from kpirl_ocp.sizes import read_text
from kpirl_ocp.types import Array


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
        rows = list(csv.reader(StringIO(read_text(Path(path)), newline=""), skipinitialspace=True))
    except (OSError, ValueError, csv.Error) as error:
        raise EpisodeError(f"{path} cannot be read as CSV: {error}") from error
    header = [name.strip() for name in rows[0]] if rows else []
    wanted = [*(name for names in columns.values() for name in names), *([time] if time else [])]
    missing = [name for name in wanted if name not in header]
    if missing:
        raise EpisodeError(f"{path} has no column {', '.join(missing)}; it has {', '.join(header)}.")
    table = {name: _numbers(path, rows[1:], header.index(name), name) for name in wanted}
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
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise EpisodeError(f"{path} cannot be read as plain arrays: {error}") from error
    if time is not None and time not in arrays:
        raise EpisodeError(f"{path} has no array {time!r}; it has {', '.join(arrays)}.")
    times = arrays.pop(time) if time is not None else None
    if not arrays:
        raise EpisodeError(f"{path} holds no arrays.")
    return _take(path, arrays, times, rate, len(next(iter(arrays.values()))))


def _take(path: str | Path, arrays: Mapping[str, Array], times: Array | None, rate: float | None, count: int) -> Take:
    if (times is None) == (rate is None):
        raise EpisodeError(f"{path}: say either where the times are (time=...) or the rate (rate=... [Hz]).")
    stamps = np.arange(count) / rate if times is None and rate is not None else np.asarray(times, float)
    if (np.diff(stamps) <= 0).any():
        raise EpisodeError(f"{path}: times do not rise from step {int(np.argmax(np.diff(stamps) <= 0)) + 1} on.")
    try:
        return Take(arrays, stamps - stamps[:1])
    except EpisodeError as error:
        raise EpisodeError(f"{path}: {error}") from error


def _numbers(path: str | Path, rows: Sequence[Sequence[str]], index: int, name: str) -> Array:
    values = np.empty(len(rows))
    for line, row in enumerate(rows):
        try:
            values[line] = float(row[index])
        except (ValueError, IndexError):
            found = row[index] if index < len(row) else "nothing"
            raise EpisodeError(f"{path}, line {line + 2}, {name}: expected a number, got {found!r}.") from None
    return values
