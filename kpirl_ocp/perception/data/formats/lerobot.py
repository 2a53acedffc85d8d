"""LeRobot data sets on disk, versions 2.0 to 3.0, without the package lerobot: Parquet tables and videos.

meta/info.json                                 rate, features, paths
data/chunk-000/...parquet                      one row per step
videos/...mp4                                  one video per camera; version 3 puts several episodes into one file
meta/episodes/, meta/tasks.parquet             lengths, files and tasks (version 2: meta/*.jsonl)
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import DependencyError, EpisodeError, FileError
from kpirl_ocp.perception.data.formats.take import Take, VideoPart, checked_rate, one_line, read_as
from kpirl_ocp.perception.data.pictures import decode_picture
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.sizes import check_bytes, check_file, read_json, read_text

_ROWS = 64  # of a table that are read at once
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def read_lerobot(directory: str | Path, episodes: Sequence[int] | None = None) -> list[Take]:
    """The episodes of a data set; those of the given numbers, or all.

    Videos are decoded when `Take.frames` asks for them.

    Raises:
        DependencyError: `pyarrow` is not installed.
        EpisodeError: a file, key or episode is missing or of another kind.
    """
    data_set = _DataSet(Path(directory))
    with read_as("LeRobot data set", directory):
        known = range(len(data_set.episodes))
    if episodes is None:
        return [data_set.take(number) for number in known]
    return [data_set.take(_number(number)) for number in episodes]


def _number(number: object) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise EpisodeError(f"episodes must be whole numbers, got {number!r}.")
    return int(number)


def parquet() -> Any:
    """The module pyarrow.parquet. Raises DependencyError if it is not installed."""
    try:
        return import_module("pyarrow.parquet")
    except ImportError as error:
        raise DependencyError('LeRobot data sets need the package pyarrow: pip install "kpirl-ocp[data]".') from error


@dataclass(frozen=True)
class _DataSet:
    root: Path

    @cached_property
    def info(self) -> dict[str, Any]:
        path = self.root / "meta" / "info.json"
        try:
            info = read_json(path)
        except (OSError, ValueError) as error:
            raise EpisodeError(
                f"{path} cannot be read; is {self.root} a LeRobot data set? ({one_line(error)})"
            ) from error
        if not isinstance(info, dict):
            raise EpisodeError(f"{path} must hold an object, with names and values.")
        missing = [key for key in ("codebase_version", "fps", "features", "data_path") if key not in info]
        if missing:
            raise EpisodeError(f"{path} has no {', '.join(missing)}.")
        if not str(info["codebase_version"]).startswith(("v2.", "v3.")):
            raise EpisodeError(f"{path}: version {info['codebase_version']!r} is not known, only v2.0 to v3.0.")
        return dict(info)

    @cached_property
    def rate(self) -> float:
        return checked_rate(self.info["fps"])

    @cached_property
    def latest(self) -> bool:
        """Version 3: several episodes in one file."""
        return str(self.info["codebase_version"]).startswith("v3.")

    @cached_property
    def episodes(self) -> list[dict[str, Any]]:
        """The metadata of each episode, in order."""
        if not self.latest:
            found = list(_lines(self.root / "meta" / "episodes.jsonl"))
        else:
            paths = sorted((self.root / "meta" / "episodes").glob("*/*.parquet"))
            found = [row for path in paths for row in self._table(path).to_pylist()]
        return sorted(found, key=lambda row: row["episode_index"])

    def take(self, number: int) -> Take:
        if not 0 <= number < len(self.episodes):
            raise EpisodeError(f"{self.root} has {len(self.episodes)} episodes; there is no number {number}.")
        known, place = self.episodes[number], f"{self.root}, episode {number}"
        with read_as("take", place):
            table = self._rows(known)
            try:
                return self._take(known, table)
            except EpisodeError as error:
                raise EpisodeError(f"{place}: {error}") from error

    def _take(self, known: dict[str, Any], table: Any) -> Take:
        features = self.info["features"]
        arrays: dict[str, NDArray[Any]] = {}
        videos: dict[str, Frames | VideoPart] = {}
        for name, feature in features.items():
            if feature["dtype"] == "video":
                videos[name] = self._video(known, name, table.num_rows)
            elif feature["dtype"] == "image":
                videos[name] = _pictures(table.column(name).to_pylist(), name)
            elif feature["dtype"] != "string" and name not in BOOKKEEPING:
                arrays[name] = _numbers(table.column(name), name, np.dtype(feature["dtype"]))
        times = _numbers(table.column("timestamp"), "timestamp", np.dtype(float))
        return Take(arrays, times - times[0], videos, "; ".join(known.get("tasks") or ()))

    def _rows(self, known: dict[str, Any]) -> Any:
        """The rows of one episode."""
        number = known["episode_index"]
        path = self.root / self.info["data_path"].format(**self._place(known, "data"))
        table = self._table(path)
        wanted = [name for name, f in self.info["features"].items() if f["dtype"] != "video"]
        missing = sorted({*wanted, "timestamp"} - set(table.column_names))
        if missing:
            raise EpisodeError(f"{path} has no column {', '.join(missing)}.")
        if self.latest:
            index = _numbers(table.column("episode_index"), "episode_index", np.dtype(np.int64))
            table = table.take(np.flatnonzero(index == number))
        if table.num_rows != known["length"]:
            raise EpisodeError(f"{path} has {table.num_rows} steps of episode {number}, not {known['length']!r}.")
        return table

    def _video(self, known: dict[str, Any], name: str, count: int) -> VideoPart:
        place = self._place(known, f"videos/{name}")
        path = self.root / self.info["video_path"].format(video_key=name, **place)
        return VideoPart(path, float(known.get(f"videos/{name}/from_timestamp", 0.0)), count, self.rate)

    def _place(self, known: dict[str, Any], kind: str) -> dict[str, int]:
        """The numbers in a path."""
        if self.latest:
            return {key: known[f"{kind}/{key}"] for key in ("chunk_index", "file_index")}
        number = known["episode_index"]
        return {"episode_chunk": number // int(self.info.get("chunks_size", 1000)), "episode_index": number}

    def _table(self, path: Path) -> Any:
        arrow = parquet()
        try:
            check_file(path)
            with arrow.ParquetFile(path) as file:
                return _whole(file)
        except (OSError, ValueError, NotImplementedError, KeyError, TypeError) as error:  # pyarrow's own are of these
            raise EpisodeError(f"{path} cannot be read as Parquet: {one_line(error)}") from error


def _whole(file: Any) -> Any:
    """The table of an open Parquet file. Raises ValueError for more than 2 GiB, however few bytes encode them."""
    about, arrow = file.metadata, import_module("pyarrow")
    check_bytes(max(8 * about.num_rows * about.num_columns, _announced(about)))
    batches, count = [], 0
    for batch in file.iter_batches(_ROWS):
        columns = [column.dictionary_decode() if hasattr(column, "dictionary_decode") else column for column in batch]
        batches.append(arrow.RecordBatch.from_arrays(columns, batch.schema.names))
        count += batches[-1].nbytes
        check_bytes(count)
    return arrow.Table.from_batches(batches) if batches else file.schema_arrow.empty_table()


def _numbers(column: Any, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The numbers (n, ...) of a column, or of lists of one length. Raises EpisodeError for anything else."""
    values, shape = column.combine_chunks(), [len(column)]
    while hasattr(values.type, "value_type"):
        lengths = import_module("pyarrow.compute").list_value_length(values).unique().to_pylist()
        if len(lengths) > 1 or values.null_count:
            raise EpisodeError(f"{name}: all steps must have lists of one length, not of {lengths}.")
        shape += lengths
        values = values.flatten()
    found = values.to_numpy(zero_copy_only=False)
    if values.null_count or found.dtype.kind not in "biuf" or not np.can_cast(found.dtype, dtype, "same_kind"):
        raise EpisodeError(f"{name} must hold numbers of the type {dtype}, not {values.type} or nothing.")
    return found.astype(dtype).reshape(shape)


def _announced(about: Any) -> int:
    return sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    try:
        yield from (json.loads(line) for line in read_text(path).splitlines() if line.strip())
    except (OSError, ValueError, RecursionError) as error:
        raise EpisodeError(f"{path} cannot be read as JSON lines: {one_line(error)}") from error


def _pictures(cells: Iterable[dict[str, Any]], place: str) -> Frames:
    """Frames (n, H, W, 3) RGB of PNG or JPEG files in a table."""
    images = []
    for cell in cells:
        content = (cell or {}).get("bytes")
        try:
            images.append(decode_picture(content or b"", "a picture"))
            check_bytes(len(images) * images[-1].nbytes)
        except (FileError, ValueError) as error:
            raise EpisodeError(f"{place}: {one_line(error)}") from error
    return np.array(images, np.uint8)
