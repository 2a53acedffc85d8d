"""Data sets of robomimic and robosuite: one HDF5 file, one group per demonstration.

data/demo_0: actions (n, n_u), obs/NAME (n, ...), and more;   mask/NAME: names of the demonstrations of a split
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import DependencyError, EpisodeError
from kpirl_ocp.perception.data.formats.take import Take, checked_rate, one_line, read_as
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.sizes import check_bytes, check_file


def read_robomimic(path: str | Path, split: str | None = None, rate: float | None = None) -> list[Take]:
    """The demonstrations of a file, in the order of their numbers.

    actions become "action", obs/NAME becomes "observation.NAME", or a camera where it is (n, H, W, 3) uint8; states,
    rewards and dones keep their names. next_obs, which repeats obs, is left out.

    Args:
        path: the HDF5 file.
        split: name of a filter key (e.g. "train"); None reads all.
        rate: steps per second [Hz]; None takes the control frequency that the file states.

    Raises:
        DependencyError: `h5py` is not installed.
        EpisodeError: the file is no such data set, or states no rate where none is given.
    """
    try:
        h5py: Any = import_module("h5py")
    except ImportError as error:
        raise DependencyError('robomimic data sets need the package h5py: pip install "kpirl-ocp[data]".') from error
    try:
        check_file(Path(path))
        file = h5py.File(path, "r")
    except (OSError, ValueError) as error:
        raise EpisodeError(f"{path} cannot be read as HDF5: {one_line(error)}") from error
    with file, read_as("robomimic data set", path):
        if "data" not in file:
            raise EpisodeError(f"{path} has no group 'data'; it is no robomimic data set.")
        steps = _control_rate(path, file["data"].attrs) if rate is None else checked_rate(rate)
        reader = _Reader()
        return [reader.take(f"{path}, {name}", file["data"][name], steps) for name in _names(path, file, split)]


def _names(path: str | Path, file: Any, split: str | None) -> list[str]:
    """The demonstrations of a split, by number."""
    if split is None:
        names = list(file["data"])
    else:
        masks = file.get("mask", {})
        if split not in masks:
            raise EpisodeError(f"{path} has no split {split!r}; it has {', '.join(masks) or 'none'}.")
        check_bytes(masks[split].nbytes)
        names = [name.decode() for name in masks[split][:]]
    return sorted(names, key=lambda name: int(name.rsplit("_", 1)[-1]))


def _control_rate(path: str | Path, attributes: Any) -> float:
    """The control frequency of the environment [Hz]."""
    try:
        return checked_rate(json.loads(attributes["env_args"])["env_kwargs"]["control_freq"])
    except (KeyError, TypeError, ValueError, RecursionError):  # among them EpisodeError
        raise EpisodeError(f"{path} does not state its control frequency: pass rate=... [Hz].") from None


@dataclass
class _Reader:
    """Reads arrays of a file while all have at most 2 GiB; what links repeat counts as often as it is read."""

    count: int = 0

    def take(self, place: str, group: Any, rate: float) -> Take:
        if "actions" not in group:
            raise EpisodeError(f"{place} has no 'actions'; it has {', '.join(group)}.")
        with read_as("demonstration of robomimic", place):
            arrays = {"action": self.array(group, "actions")}
            videos: dict[str, Frames] = {}
            for name in group.get("obs", {}):
                array = self.array(group["obs"], name)
                picture = array.dtype == np.uint8 and array.ndim == 4 and array.shape[-1] == 3
                (videos if picture else arrays)[f"observation.{name}"] = array
            arrays |= {name: self.array(group, name) for name in ("states", "rewards", "dones") if name in group}
        try:
            return Take(arrays, np.arange(len(arrays["action"])) / rate, videos)
        except EpisodeError as error:
            raise EpisodeError(f"{place}: {one_line(error)}") from error

    def array(self, group: Any, name: str) -> NDArray[Any]:
        found = group[name]
        if not found.shape or found.dtype.kind not in "biuf":
            raise EpisodeError(f"{found.file.filename}: {found.name} must be an array of numbers, one row per step.")
        self.count += found.nbytes
        try:
            check_bytes(self.count)
        except ValueError as error:
            raise EpisodeError(f"{found.file.filename} cannot be read: {one_line(error)}") from error
        return np.array(found)
