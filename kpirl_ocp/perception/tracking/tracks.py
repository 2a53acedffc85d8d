"""Tracks of keypoints through a film, our own or anybody's, and the files that hold them.

A `.npz` may come from CoTracker, TAPIR or `write_tracks`; a `.csv` has the columns point, x, y, and time or frame, and
visibility if it is known; frames are counted from zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.episodes import atomic_write, check_archive
from kpirl_ocp.errors import DemonstrationError, FileError
from kpirl_ocp.perception.data.csv_table import read_table
from kpirl_ocp.perception.data.video import sampled
from kpirl_ocp.perception.tracking.model import Located
from kpirl_ocp.perception.tracking.similarity import transform
from kpirl_ocp.pictures import Brief
from kpirl_ocp.sizes import check_bytes
from kpirl_ocp.types import Array, Mask

_PLACES = ("tracks", "pred_tracks", "positions", "points")
_VISIBLE = ("confidence", "visibility", "pred_visibility", "visible")
_HIDDEN = ("occluded", "pred_occlusion")


@dataclass(frozen=True, eq=False, repr=False)
class Tracks(Brief):
    """Keypoints in a film.

    times: (n,) [s]. positions: (n, K, 2) [pixels], x to the right and y down.
    confidence: (n, K) in [0, 1], how much of what is around a keypoint was found in the frame and looked as it should.
    size: width and height of the frames [pixels].
    """

    times: Array
    positions: Array
    confidence: Array
    size: tuple[int, int]

    def __post_init__(self) -> None:
        n = len(self.times)
        if n < 2 or self.positions.ndim != 3 or self.positions.shape[0] != n or self.positions.shape[2] != 2:
            shape = self.positions.shape
            raise DemonstrationError(f"tracks must be (n, K, 2) with n = {n} times of at least 2, got {shape}.")
        if self.confidence.shape != self.positions.shape[:2]:
            raise DemonstrationError(f"visibility must be {self.positions.shape[:2]}, got {self.confidence.shape}.")
        if not (np.diff(self.times) > 0).all():
            raise DemonstrationError("the times of tracks must rise.")
        if not np.isfinite(self.positions[self.confidence > 0]).all():
            raise DemonstrationError("tracks hold NaN or infinity where the keypoint is visible.")

    @property
    def centre(self) -> Array:
        """(n, 2) mean of the keypoints [pixels]."""
        return np.asarray(self.positions.mean(axis=1), float)

    @property
    def rate(self) -> float:
        """Frames a second [Hz], in the median."""
        return 1 / float(np.median(np.diff(self.times)))

    def between(self, start: float, end: float) -> Tracks:
        """The part from `start` to `end` [s], its times from zero on."""
        part = (self.times >= start - 1e-9) & (self.times <= end + 1e-9)
        if part.sum() < 2:
            raise DemonstrationError(f"the tracks have fewer than two frames between {start:g} and {end:g} s.")
        return Tracks(self.times[part] - self.times[part][0], self.positions[part], self.confidence[part], self.size)

    def places_at(self, times: ArrayLike) -> Array:
        """Positions (m, K, 2) [pixels] at times (m,) [s], on straight lines between the frames."""
        columns = self.positions.reshape(len(self.times), -1).T
        straight = [np.interp(np.asarray(times, float), self.times, column) for column in columns]
        return np.stack(straight, axis=1).reshape(-1, *self.positions.shape[1:])

    def at_rate(self, rate: float) -> Tracks:
        """The frames nearest to k / rate [s]. Raises DemonstrationError if one would have to serve twice."""
        rows = [row for _, row in sampled(zip(self.times - self.times[0], range(len(self.times)), strict=True), rate)]
        if len(set(rows)) < len(rows):
            raise DemonstrationError(
                f"the motion takes {self.times[-1] - self.times[0]:.2f} s and is seen in {len(self.times)} frames, too "
                f"few for {len(rows) - 1} steps: take fewer (--steps), or film with more frames a second."
            )
        return Tracks(self.times[rows] - self.times[0], self.positions[rows], self.confidence[rows], self.size)


def of_object(located: Iterable[Located], keypoints: ArrayLike, size: tuple[int, int]) -> Tracks:
    """Tracks of keypoints (K, 2) [pixels] that are fixed to an object, given in the first frame.

    While it is not found they go straight from where it was last found to where it is found next, at a confidence of 0.
    """
    points = np.asarray(keypoints, float)
    times, positions, confidence, found = [], [], [], []
    reach = max(1.0, float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()), 0.05 * max(size))
    for frame in located:
        places = transform(frame.pose, points)
        gaps = np.linalg.norm(frame.points[None] - places[:, None], axis=-1)  # (K, n)
        near = np.exp(-0.5 * (gaps / reach) ** 2) * frame.in_view
        times.append(frame.time)
        positions.append(places)
        found.append(frame.found.any())
        confidence.append((near * frame.found).sum(axis=1) / np.maximum(near.sum(axis=1), 1e-9))
    bridged = _bridged(np.array(times), np.array(positions), np.array(found))
    return Tracks(np.array(times), bridged, np.array(confidence), size)


def _bridged(times: Array, positions: Array, found: Mask) -> Array:
    """Positions (n, K, 2), on straight lines where nothing was found (n,); as they are after it was found last."""
    last = 1 + max(np.flatnonzero(found), default=-1)
    known = found | (np.arange(len(times)) >= last)
    columns = positions.reshape(len(times), -1).T
    straight = np.stack([np.interp(times, times[known], column[known]) for column in columns], axis=1)
    return np.asarray(straight.reshape(positions.shape), float)


def check_size(tracks: Tracks, size: tuple[int, int]) -> None:
    """Raise DemonstrationError for tracks that are not in the pixels of frames of a size (width, height)."""
    frames = f"the film's are {size[0]} x {size[1]} here: scale the tracks to that."
    if tracks.size != size:
        raise DemonstrationError(f"the tracks are for frames of {tracks.size[0]} x {tracks.size[1]} pixels, {frames}")
    inside = np.all((tracks.positions >= 0) & (tracks.positions <= size), axis=-1)
    outside = np.flatnonzero(np.all(tracks.confidence > 0, axis=1) & ~np.any(inside, axis=1))
    if len(outside):
        x, y = tracks.centre[outside[0]]
        raise DemonstrationError(f"the tracks show all keypoints outside the frames, around {x:.0f},{y:.0f}; {frames}")


def spread(mask: Mask) -> Array:
    """Four keypoints (4, 2) [pixels] on an object (H, W): two deviations along each of its principal axes."""
    rows, columns = np.nonzero(mask)
    points = np.column_stack([columns, rows]) + 0.5
    lengths, axes = np.linalg.eigh(np.cov(points.T))
    arms = np.sqrt(lengths)[:, None] * axes.T
    return np.asarray(points.mean(axis=0) + np.concatenate([-arms, arms]), float)


def write_tracks(path: Path, tracks: Tracks) -> Path:
    """Write a `.npz` that `read_tracks` reads."""
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            tracks=tracks.positions,
            visibility=tracks.confidence,
            times=tracks.times,
            size=np.array(tracks.size),
        )
    return path


def read_tracks(path: str | Path, *, rate: float | None = None, size: tuple[int, int] | None = None) -> Tracks:
    """Tracks of a `.npz` or `.csv` file.

    Args:
        path: positions (n, K, 2) [pixels], a leading axis of length one is left out; visibility (n, K), true or
            false or in [0, 1], all ones if the file has none.
        rate: [Hz] of the frames, where the file has no times.
        size: width and height of the frames [pixels], where the file does not say; else what the tracks span.

    Raises:
        FileError: the file is missing, has another layout, or no times and no rate.
    """
    positions, confidence, times, known = _content(Path(path), rate, size)
    if times is None:
        if rate is None:
            raise FileError(f"{path} has no times: say the frame rate of the film (--source-rate).")
        times = np.arange(len(positions)) / rate
    if known is None:
        width, height = np.ceil(np.nanmax(positions, axis=(0, 1))).astype(int).tolist()
        known = (width, height)
    try:
        return Tracks(times, positions, confidence, known)
    except DemonstrationError as error:
        raise FileError(f"{path}: {error}") from error


def own_rate(path: str | Path) -> float | None:
    """Frames a second [Hz] of tracks; None if their file has no times. Raises FileError as `read_tracks` does."""
    times = _content(Path(path), None, None)[2]
    return None if times is None else read_tracks(path, size=(1, 1)).rate


def _content(
    path: Path, rate: float | None, size: tuple[int, int] | None
) -> tuple[Array, Array, Array | None, tuple[int, int] | None]:
    """Positions, confidence, times and the size of frames, the last two as far as they are known."""
    if not path.is_file():
        raise FileError(f"there are no tracks {path}.")
    if path.suffix.lower() == ".csv":
        return *_from_csv(path, rate), size
    if path.suffix.lower() == ".npz":
        return _from_npz(path, size)
    raise FileError(f"{path}: tracks come as .npz or .csv.")


def _from_npz(path: Path, size: tuple[int, int] | None) -> tuple[Array, Array, Array | None, tuple[int, int] | None]:
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise FileError(f"{path} cannot be read: {error}") from error
    positions = _taken(content, _PLACES)
    if positions is None:
        raise FileError(f"{path} has none of the keys {', '.join(_PLACES)}; it has {', '.join(content) or 'none'}.")
    seen, hidden = _taken(content, _VISIBLE), _taken(content, _HIDDEN)
    visible = np.ones(positions.shape[:-1]) if seen is None else seen
    visible = visible if hidden is None or seen is not None else 1.0 - hidden
    if "size" in content:
        width, height = content["size"].astype(int).tolist()
        size = (width, height)
    times = content.get("times")
    return positions, visible, None if times is None else times.astype(float), size


def _taken(content: Mapping[str, Array], names: tuple[str, ...]) -> Array | None:
    """The first of the named arrays, without a batch axis of length one."""
    name = next((name for name in names if name in content), None)
    if name is None:
        return None
    array = content[name].astype(float)
    batched = array.ndim == (4 if name in _PLACES else 3) and array.shape[0] == 1
    return np.asarray(array[0] if batched else array, float)


def _from_csv(path: Path, rate: float | None) -> tuple[Array, Array, Array | None]:
    try:
        table = read_table(path)
    except (OSError, ValueError) as error:
        raise FileError(f"{path} cannot be read as CSV: {error}") from error
    when = "time" if "time" in table.names else "frame"
    missing = table.missing(["point", "x", "y", when])
    if missing:
        raise FileError(f"{path} {missing} It needs point, x, y, and time or frame; visibility if it is known.")
    try:
        moments, step = np.unique(table.numbers(when), return_inverse=True)
        names = list(dict.fromkeys(table.column("point")))
        check_bytes(24 * len(moments) * len(names))
        known = "visibility" in table.names
        visible = table.numbers("visibility", empty="1") if known else np.ones(len(table.rows))
        places = np.column_stack([table.numbers("x"), table.numbers("y")])
    except ValueError as error:
        raise FileError(f"{path}, {error}") from error
    index = {name: i for i, name in enumerate(names)}
    keypoint = np.array([index[name] for name in table.column("point")])
    cells, first, count = np.unique(step * len(names) + keypoint, return_index=True, return_counts=True)
    if len(cells) < len(table.rows):
        line = table.lines[first[count > 1].min()]
        raise FileError(f"{path}, line {line}: this point has another place at the same {when}, further down.")
    positions = np.full((len(moments), len(names), 2), np.nan)
    confidence = np.zeros((len(moments), len(names)))
    positions[step, keypoint], confidence[step, keypoint] = places, visible
    seconds = 1.0 if when == "time" else None if rate is None else 1 / rate
    return positions, confidence, None if seconds is None else seconds * moments
