"""Episodes on disk: one directory with `meta.json` and one compressed `.npz` (no pickle) per episode.

An episode is a dataclass of arrays; each field says under which key (LeRobot's names), with which type and shape it is
stored. `Episode` holds a demonstration in 3-D keypoints; perception has others with camera images.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import glob
import json
import math
import os
import platform
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from zipfile import BadZipFile, ZipFile, is_zipfile

import numpy as np
from numpy.typing import DTypeLike

from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.pictures import Brief
from kpirl_ocp.sizes import check_bytes, check_file, read_json
from kpirl_ocp.types import Array

_VERSION = 1


def stored(key: str, dtype: DTypeLike, *shape: int | str) -> Any:
    """A field of an episode: its key on disk, its type, and its shape in numbers and named sizes.

    A name stands for the same number in all fields of one episode; "T" and "T+1" go together.
    """
    return field(metadata={"key": key, "dtype": np.dtype(dtype), "shape": shape})


@dataclass(frozen=True, eq=False, repr=False)
class Episode(Brief):
    """One demonstration.

    joints: (T+1, n_joints) [rad]. keypoints: (T+1, K, 3) [m]. actions: (T, n_joints) [rad]. times: (T+1,) [s].
    """

    joints: Array = stored("observation.state", np.float64, "T+1", "n_joints")
    keypoints: Array = stored("observation.keypoints", np.float64, "T+1", "K", 3)
    actions: Array = stored("action", np.float64, "T", "n_joints")
    times: Array = stored("timestamp", np.float64, "T+1")

    @property
    def horizon(self) -> int:
        """T."""
        return len(self.actions)


@dataclass(frozen=True, eq=False)
class KeypointTrack:
    """Detected keypoints of a clip.

    keypoints: (T+1, K, 3), x to the right, y down [half an image], and mu in [0, 1]. times: (T+1,) [s].
    """

    keypoints: Array = stored("observation.keypoints", np.float64, "T+1", "K", 3)
    times: Array = stored("timestamp", np.float64, "T+1")


@dataclass(frozen=True, eq=False)
class ArmTrack(KeypointTrack):
    """Detected keypoints of a robot's clip, with its measured joints and its commands.

    joints: (T+1, n_joints) [rad]. velocities: (T+1, n_joints) [rad/s]. actions: (T, n_joints) [rad].
    """

    joints: Array = stored("observation.state", np.float64, "T+1", "n_joints")
    velocities: Array = stored("observation.velocity", np.float64, "T+1", "n_joints")
    actions: Array = stored("action", np.float64, "T", "n_joints")


E = TypeVar("E")


def write_episodes(directory: str | Path, episodes: Sequence[Any], meta: Mapping[str, Any]) -> None:
    """Write `episode_000.npz` ... and then `meta.json`; every file appears whole or not at all.

    Raises EpisodeError for arrays of wrong shape or with NaN, before anything is written.
    """
    directory = Path(directory)
    for index, episode in enumerate(episodes):
        check_episode(episode_path(directory, index), episode)
    directory.mkdir(parents=True, exist_ok=True)
    for index, episode in enumerate(episodes):
        write_episode(episode_path(directory, index), episode)
    write_meta(directory, len(episodes), meta)


def write_episode(path: Path, episode: Any) -> None:
    """Write one episode; the file appears whole or not at all. Raises EpisodeError for malformed arrays."""
    check_episode(path, episode)
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **_arrays(episode))


def write_meta(directory: Path, count: int, meta: Mapping[str, Any]) -> None:
    """Write `meta.json`: the version, the number of episodes, and further entries."""
    write_whole(directory / "meta.json", json.dumps({"version": _VERSION, "episodes": count, **meta}, indent=2))


def read_episodes(directory: str | Path, kind: type[E]) -> tuple[list[E], dict[str, Any]]:
    """Episodes and meta data of a directory. Raises EpisodeError, naming file and key, if anything is amiss."""
    directory = Path(directory)
    meta = read_meta(directory)
    return list(iterate_episodes(directory, meta["episodes"], kind)), meta


def iterate_episodes(directory: Path, count: int, kind: type[E]) -> Iterable[E]:
    """The first `count` episodes one by one, for those who need not hold all of them in memory."""
    return (read_episode(episode_path(directory, index), kind) for index in range(count))


def episode_path(directory: Path, index: int) -> Path:
    """The file of one episode."""
    return directory / f"episode_{index:03d}.npz"


def read_meta(directory: Path) -> dict[str, Any]:
    """The meta data of a directory of episodes. Raises EpisodeError if there are none, or of another version."""
    path = directory / "meta.json"
    try:
        meta = read_json(path)
    except FileNotFoundError:
        raise EpisodeError(
            f"{path} does not exist: make demonstrations with `kpirl demonstrate`, camera data with `kpirl collect`."
        ) from None
    except (OSError, ValueError) as error:
        raise EpisodeError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(meta, dict) or meta.get("version") != _VERSION or not _is_count(meta.get("episodes")):
        raise EpisodeError(f"{path} must hold 'version': {_VERSION} and the number of 'episodes'.")
    return meta


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0  # True is an int, too


def read_episode(path: Path, kind: type[E]) -> E:
    """One episode. Raises EpisodeError, naming file and key, if anything is amiss."""
    keys = [entry.metadata["key"] for entry in _entries(kind)]
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            if missing := [key for key in keys if key not in file.files]:
                raise KeyError(missing[0])
            arrays = {entry.name: file[key] for entry, key in zip(_entries(kind), keys, strict=True)}
    except FileNotFoundError:
        raise EpisodeError(f"{path} is missing: the collection was interrupted; run its command again.") from None
    except KeyError as error:
        raise EpisodeError(f"{path} has no key {error}; it needs {', '.join(keys)}.") from None
    except (OSError, ValueError, TypeError, EOFError, NotImplementedError, BadZipFile, zlib.error) as error:
        raise EpisodeError(f"{path} cannot be read as an episode: {error}") from error
    episode = kind(**arrays)
    check_episode(path, episode)
    return episode


def check_episode(path: Path, episode: Any) -> None:
    """Raise EpisodeError, with file and key, for an array of another type or shape, NaN, or times that do not rise."""
    sizes: dict[str, int] = {}
    for entry in _entries(type(episode)):
        array, key, dtype = getattr(episode, entry.name), entry.metadata["key"], entry.metadata["dtype"]
        if not isinstance(array, np.ndarray) or array.dtype != dtype:
            raise EpisodeError(f"{path}, {key}: expected a {dtype} array, got {getattr(array, 'dtype', type(array))}.")
        if not np.isfinite(array).all():
            raise EpisodeError(f"{path}, {key}: holds NaN or infinity.")
        if not _fits(array.shape, entry.metadata["shape"], sizes):
            expected = ", ".join(map(str, entry.metadata["shape"]))
            known = ", ".join(f"{name} = {size}" for name, size in sizes.items())
            raise EpisodeError(f"{path}, {key}: expected the shape ({expected}) with {known}, got {array.shape}.")
        if key == "timestamp" and not (np.diff(array) > 0).all():
            raise EpisodeError(f"{path}, {key}: must rise from frame to frame.")


def _fits(shape: tuple[int, ...], expected: tuple[int | str, ...], sizes: dict[str, int]) -> bool:
    """True if a shape agrees with the expected one; names met for the first time get their size here."""
    if len(shape) != len(expected):
        return False
    for size, name in zip(shape, expected, strict=True):
        if name == "T+1":
            size, name = size - 1, "T"
        wanted = name if isinstance(name, int) else sizes.setdefault(name, size)
        if size != wanted or size < 1:
            return False
    return True


def _entries(kind: type[Any]) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(kind)


def _arrays(episode: Any) -> dict[str, np.ndarray[Any, Any]]:
    return {entry.metadata["key"]: getattr(episode, entry.name) for entry in _entries(type(episode))}


def check_archive(path: Path) -> None:
    """Look at a file, and at the sizes that an archive of arrays (.npz) and the headers in it announce.

    Raises:
        OSError: there is no file.
        ValueError: no regular file, more than 2 GiB in all, or a header that announces more than is there.
    """
    check_file(path)
    if not is_zipfile(path):
        return
    with ZipFile(path) as archive:
        members = archive.infolist()
        check_bytes(sum(member.file_size for member in members))
        for member in members:
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise ValueError(f"{member.filename} announces an array of {shape} {dtype}, and is too short for it.")


class atomic_write:
    """A file that takes its name only when it has been written to the end.

    What a killed process of this machine left of the same file is removed: nobody holds its lock.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(f".{path.name}.{platform.node()}.{os.getpid()}.part")

    def __enter__(self) -> BinaryIO:
        for left in self.path.parent.glob(f".{glob.escape(self.path.name)}.{glob.escape(platform.node())}.*.part"):
            _remove_unless_locked(left)
        self.file = _locked(self.part)
        return self.file

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.file.flush()
                self.part.replace(self.path)
                self.file.close()
        finally:
            self.part.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # another error is on its way: of the block, or of flushing
                self.file.close()


def write_whole(path: Path, text: str) -> None:
    """Write a text; the file appears whole or not at all."""
    with atomic_write(path) as file:
        file.write(text.encode())


def _locked(path: Path) -> BinaryIO:
    """An empty file that this process holds; where the file system has no locks, it is not held."""
    while True:
        file = path.open("wb")
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # another process took it for a left one before it was locked


def _remove_unless_locked(path: Path) -> None:
    with contextlib.suppress(OSError), path.open("rb") as file:  # of others, locked, or gone
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
