"""Demonstrations on disk: one directory with `meta.json` and one compressed `.npz` (no pickle) per episode.

Keys are LeRobot's names:
    observation.state      (T+1, n_joints)  joint positions [rad]
    observation.keypoints  (T+1, K, 3)      keypoint positions [m]
    action                 (T, n_joints)    joint displacements [rad]
    timestamp              (T+1,)           [s]
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import BadZipFile

import numpy as np

from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.types import Array

_VERSION = 1
_KEYS = {"joints": "observation.state", "keypoints": "observation.keypoints", "actions": "action", "times": "timestamp"}


@dataclass(frozen=True)
class Episode:
    """One demonstration.

    joints: (T+1, n_joints) [rad]. keypoints: (T+1, K, 3) [m]. actions: (T, n_joints) [rad]. times: (T+1,) [s].
    """

    joints: Array
    keypoints: Array
    actions: Array
    times: Array

    @property
    def horizon(self) -> int:
        """T."""
        return len(self.actions)


def write_episodes(directory: str | Path, episodes: Sequence[Episode], meta: Mapping[str, Any]) -> None:
    """Write `episode_000.npz` ... and then `meta.json`; every file appears whole or not at all.

    Raises EpisodeError for arrays of wrong shape or with NaN, before anything is written.
    """
    directory = Path(directory)
    for index, episode in enumerate(episodes):
        _check(directory / _name(index), {key: getattr(episode, field) for field, key in _KEYS.items()})
    directory.mkdir(parents=True, exist_ok=True)
    for index, episode in enumerate(episodes):
        arrays = {key: np.asarray(getattr(episode, field), np.float64) for field, key in _KEYS.items()}
        with _replacing(directory / _name(index)) as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    with _replacing(directory / "meta.json") as file:
        file.write(json.dumps({"version": _VERSION, "episodes": len(episodes), **meta}, indent=2).encode())


def read_episodes(directory: str | Path) -> tuple[list[Episode], dict[str, Any]]:
    """Episodes and meta data of a directory. Raises EpisodeError, naming file and key, if anything is amiss."""
    directory = Path(directory)
    meta = _read_meta(directory / "meta.json")
    return [_read_episode(directory / _name(index)) for index in range(meta["episodes"])], meta


def _name(index: int) -> str:
    return f"episode_{index:03d}.npz"


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(path.read_text())
    except FileNotFoundError:
        raise EpisodeError(f"{path} does not exist: make demonstrations with scripts/make_demonstrations.py.") from None
    except (OSError, ValueError) as error:
        raise EpisodeError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(meta, dict) or meta.get("version") != _VERSION or not isinstance(meta.get("episodes"), int):
        raise EpisodeError(f"{path} must hold 'version': {_VERSION} and the number of 'episodes'.")
    return meta


def _read_episode(path: Path) -> Episode:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in _KEYS.values()}
    except KeyError as error:
        raise EpisodeError(f"{path} has no key {error}; it needs {', '.join(_KEYS.values())}.") from None
    except (OSError, ValueError, BadZipFile) as error:
        raise EpisodeError(f"{path} cannot be read as an episode: {error}") from error
    _check(path, arrays)
    return Episode(**{field: arrays[key] for field, key in _KEYS.items()})


def _check(path: Path, arrays: Mapping[str, Any]) -> None:
    for key, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype != np.float64:
            raise EpisodeError(f"{path}, {key}: expected a float64 array, got {getattr(array, 'dtype', type(array))}.")
        if not np.isfinite(array).all():
            raise EpisodeError(f"{path}, {key}: holds NaN or infinity.")
    steps, joints = arrays["action"].shape if arrays["action"].ndim == 2 else (0, 0)
    points = arrays["observation.keypoints"].shape[1] if arrays["observation.keypoints"].ndim == 3 else 0
    shapes = {
        "action": (max(steps, 1), joints),
        "observation.state": (steps + 1, joints),
        "observation.keypoints": (steps + 1, points, 3),
        "timestamp": (steps + 1,),
    }
    for key, shape in shapes.items():
        if arrays[key].shape != shape:
            raise EpisodeError(f"{path}, {key}: expected the shape {shape}, got {arrays[key].shape}.")


class _replacing:
    """A file that takes its name only when it has been written to the end."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> BinaryIO:
        self.file = tempfile.NamedTemporaryFile(dir=self.path.parent, prefix=".", suffix=".part", delete=False)
        return self.file  # type: ignore[return-value]

    def __exit__(self, kind: object, *_: object) -> None:
        self.file.close()
        if kind is None:
            os.replace(self.file.name, self.path)
        else:
            os.unlink(self.file.name)
