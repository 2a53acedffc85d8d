"""Writing LeRobot data sets, version 3.0; each episode and each of its videos has a file of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.formats.lerobot import BOOKKEEPING, parquet
from kpirl_ocp.perception.data.formats.take import Take
from kpirl_ocp.perception.data.video import Frames

_CHUNK = 1000  # files per folder
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_PIXELS = 100_000  # of a video, for its statistics


def write_lerobot(directory: str | Path, takes: Sequence[Take], rate: float, robot: str = "unknown") -> Path:
    """Write takes recorded at `rate` [Hz] as a LeRobot data set into a new directory.

    Numbers keep their types; videos are H.264 in mp4, which is not lossless. `meta/info.json` comes last: a directory
    without it is not complete.

    Raises:
        DependencyError: `pyarrow` is not installed.
        EpisodeError: the directory is not empty, there is nothing to write, takes differ in names or shapes, their
            times are not those of the rate, or a number takes more than eight bytes.
    """
    root = Path(directory)
    tables = parquet()
    if root.exists() and any(root.iterdir()):
        raise EpisodeError(f"{root} is not empty; a data set is written into a new directory.")
    features = _features(takes, rate)
    tasks = list(dict.fromkeys(take.task for take in takes))
    rows: list[dict[str, Any]] = []
    pixels: dict[str, list[NDArray[Any]]] = {name: [] for name in takes[0].videos}
    start = 0
    for number, take in enumerate(takes):
        place = {"chunk_index": number // _CHUNK, "file_index": number % _CHUNK}
        table = _table(take, features, number, start, tasks.index(take.task))
        _save(tables, table, root / _DATA.format(**place))
        for name in take.videos:
            frames = take.frames(name)
            _film(root / _VIDEO.format(video_key=name, **place), frames, rate)
            pixels[name].append(_some(frames, len(takes)))
        rows.append(_row(take, number, start, place, rate))
        start += len(take)
    arrow: Any = import_module("pyarrow")
    _save(tables, arrow.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    _save(tables, _task_table(arrow, tasks), root / "meta/tasks.parquet")
    _write_json(root / "meta/stats.json", _statistics(takes, features, pixels))
    _write_json(root / "meta/info.json", _info(takes, features, rate, robot, len(tasks)))
    return root


def _row(take: Take, number: int, start: int, place: dict[str, int], rate: float) -> dict[str, Any]:
    """Metadata of one episode: its task, its length, its files."""
    row: dict[str, Any] = {"episode_index": number, "tasks": [take.task], "length": len(take)}
    row |= {"dataset_from_index": start, "dataset_to_index": start + len(take)}
    row |= {f"data/{key}": value for key, value in place.items()}
    for name in take.videos:
        row |= {f"videos/{name}/{key}": value for key, value in place.items()}
        row |= {f"videos/{name}/from_timestamp": 0.0, f"videos/{name}/to_timestamp": len(take) / rate}
    return row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}


def _film(path: Path, frames: Frames, rate: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, frames, rate, codec="h264")


def _features(takes: Sequence[Take], rate: float) -> dict[str, dict[str, Any]]:
    """Type and shape of every array and video, which all takes share."""
    if not takes or not rate > 0:
        raise EpisodeError(f"a data set needs at least one take and a positive rate; got {len(takes)} and {rate:g}.")
    described = [_describe(take, rate) for take in takes]
    for number, (take, found) in enumerate(zip(takes, described, strict=True)):
        if found != described[0]:
            raise EpisodeError(f"take {number} has {found}; the first has {described[0]}.")
        if np.abs(take.times - take.times[0] - np.arange(len(take)) / rate).max() > 0.5 / rate:
            raise EpisodeError(f"take {number} was not recorded at {rate:g} Hz: its times say otherwise.")
    return described[0]


def _describe(take: Take, rate: float) -> dict[str, dict[str, Any]]:
    features: dict[str, dict[str, Any]] = {}
    for name, array in take.arrays.items():
        if "/" in name or name in BOOKKEEPING:
            raise EpisodeError(f"LeRobot allows no array of the name {name!r}.")
        if array.ndim > 2:
            raise EpisodeError(f"{name} must be (n,) or (n, size), got {array.shape}; flatten it.")
        if array.dtype.itemsize > 8:
            raise EpisodeError(f"{name} has numbers of the type {array.dtype}, which LeRobot lacks: make them float64.")
        features[name] = {"dtype": str(_native(array).dtype), "shape": list(array.shape[1:]) or [1], "names": None}
    for name in take.videos:
        height, width = (side // 2 * 2 for side in take.frame_size(name))
        info: dict[str, Any] = {"video.fps": rate, "video.height": height, "video.width": width, "video.channels": 3}
        info |= {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False}
        shape = [height, width, 3]
        features[name] = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}
    return features


def _table(take: Take, features: dict[str, dict[str, Any]], number: int, start: int, task: int) -> Any:
    arrow: Any = import_module("pyarrow")
    n = len(take)
    columns: dict[str, Any] = {}
    for name, array in take.arrays.items():
        flat = arrow.array(np.ascontiguousarray(_native(array)).ravel())
        wide = array.ndim == 2 and features[name]["shape"] != [1]
        columns[name] = arrow.FixedSizeListArray.from_arrays(flat, array.shape[1]) if wide else flat
    columns["timestamp"] = arrow.array((take.times - take.times[0]).astype(np.float32))
    columns["frame_index"] = arrow.array(np.arange(n))
    columns["episode_index"] = arrow.array(np.full(n, number))
    columns["index"] = arrow.array(np.arange(start, start + n))
    columns["task_index"] = arrow.array(np.full(n, task))
    return arrow.table(columns)


def _native(array: NDArray[Any]) -> NDArray[Any]:
    """The array with its bytes in this machine's order, which Arrow expects."""
    return array.astype(array.dtype.newbyteorder("="))


def _task_table(arrow: Any, tasks: list[str]) -> Any:
    """Numbers by task; pandas is told that the words are the index."""
    text = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    number = text | {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    note = {"index_columns": ["task"], "column_indexes": [], "columns": [number, text], "pandas_version": "2.0.0"}
    table = arrow.table({"task_index": np.arange(len(tasks)), "task": tasks})
    return table.replace_schema_metadata({"pandas": json.dumps(note)})


def _info(
    takes: Sequence[Take], features: dict[str, dict[str, Any]], rate: float, robot: str, n_tasks: int
) -> dict[str, Any]:
    kinds = {"timestamp": "float32"} | dict.fromkeys(BOOKKEEPING[1:], "int64")
    books = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}
    return {
        "codebase_version": "v3.0",
        "robot_type": robot,
        "total_episodes": len(takes),
        "total_frames": sum(map(len, takes)),
        "total_tasks": n_tasks,
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(rate) if float(rate).is_integer() else rate,
        "splits": {"train": f"0:{len(takes)}"},
        "data_path": _DATA,
        "video_path": _VIDEO if takes[0].videos else None,
        "features": features | books,
    }


def _statistics(
    takes: Sequence[Take], features: dict[str, dict[str, Any]], pixels: dict[str, list[NDArray[Any]]]
) -> dict[str, Any]:
    """Smallest, largest, mean and deviation of every number; of every colour channel in [0, 1], as (3, 1, 1)."""
    found = {}
    for name, feature in features.items():
        if feature["dtype"] == "video":
            values = np.concatenate(pixels[name]) / 255.0
            found[name] = _summary(values, (3, 1, 1), len(values))
        else:
            values = np.concatenate([take[name].reshape(len(take), -1) for take in takes]).astype(float)
            found[name] = _summary(values, (values.shape[1],), len(values))
    return found


def _summary(values: NDArray[Any], shape: tuple[int, ...], count: int) -> dict[str, Any]:
    parts = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {key: part.reshape(shape).tolist() for key, part in parts.items()} | {"count": [count]}


def _some(frames: Frames, videos: int) -> NDArray[Any]:
    """A share of the pixels (n, 3), evenly spread."""
    flat = frames.reshape(-1, 3)
    return flat[:: max(1, len(flat) * videos // _PIXELS)]


def _save(tables: Any, table: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tables.write_table(table, path)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4) + "\n")
