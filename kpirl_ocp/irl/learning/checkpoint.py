"""Learning on disk: state and history in one `.npz` file without pickle, written to the end or not at all."""

from __future__ import annotations

import hashlib
import json
import re
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kpirl_ocp.episodes import atomic_write, check_archive
from kpirl_ocp.errors import FileError
from kpirl_ocp.irl.learning.optimisers import Point
from kpirl_ocp.ocp.export.manifest import functions_of
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory

_FORMAT = 1
_PAUSE = 1.0  # seconds between two writes, at least
_RECORDS: dict[str, Any] = {kind.__name__: kind for kind in (Point, Solution, Trajectory, Multipliers, KKTResiduals)}
_DAMAGED = (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile)

History = list[tuple[Point, float]]
"""All points, without their plans, with the seconds since the start."""


class Saved(NamedTuple):
    """Content of a checkpoint: the last point, the optimiser's memory, the best point, and the history."""

    point: Point
    memory: Any
    best: Point
    history: History


class Checkpoint:
    """A file of one learning, told from others by its fingerprint; without a path nothing is written or found."""

    def __init__(self, path: str | Path | None, fingerprint: str) -> None:
        if path is not None and not isinstance(path, str | Path):
            raise FileError(f"checkpoint must be the path of a file, got {path!r}.")
        self.path = None if path is None else Path(path)
        self._fingerprint, self._written = fingerprint, time.monotonic()

    def save(self, saved: Saved, now: bool = False) -> None:
        """Write the file, unless it was written a moment ago; `now` writes in any case.

        Raises FileError where it cannot be written.
        """
        if self.path is None or not (now or time.monotonic() - self._written > _PAUSE):
            return
        arrays: dict[str, Any] = {
            "psis": np.array([point.psi for point, _ in saved.history]),
            "losses": np.array([point.loss for point, _ in saved.history]),
            "uncertified": np.array([point.uncertified for point, _ in saved.history]),
            "seconds": np.array([seconds for _, seconds in saved.history]),
        }
        tree = _encode(tuple(saved[:3]), arrays)
        header = json.dumps({"format": _FORMAT, "fingerprint": self._fingerprint, "state": tree})
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path) as file:
                np.savez(file, header=np.array(header), **arrays)
        except OSError as error:
            raise FileError(f"the checkpoint {self.path} cannot be written: {error}") from error
        self._written = time.monotonic()

    def load(self) -> Saved | None:
        """The content; None if there is no file. Raises FileError for a damaged file, or one of another learning."""
        if self.path is None or not self.path.exists():
            return None
        try:
            check_archive(self.path)
            with np.load(self.path, allow_pickle=False) as file:
                arrays = dict(file)
            header = json.loads(str(arrays["header"]))
            known = header["format"], header["fingerprint"]
            if known != (_FORMAT, self._fingerprint):
                raise FileError(f"{self.path} is the checkpoint of another learning: give another path, or remove it.")
            columns = (arrays[name] for name in ("psis", "losses", "uncertified", "seconds"))
            history = [
                (Point(psi, float(loss), np.zeros(0), int(uncertified)), float(seconds))
                for psi, loss, uncertified, seconds in zip(*columns, strict=True)
            ]
            point, memory, best = _decode(header["state"], arrays)
            return Saved(point, memory, best, history)
        except FileError:
            raise
        except _DAMAGED as error:
            raise FileError(f"{self.path} cannot be read as a checkpoint of learning: {error}") from error


def statement_of(problem: OCP) -> list[Any]:
    """Everything that the plans of a problem depend on: serialised functions, bounds, schedule."""
    functions = [*functions_of(problem), problem.observation]
    bounds = [problem.action_bounds, problem.state_bounds, problem.initial_bounds or ()]
    serialised = [None if function is None else function.serialize() for function in functions]
    return [*serialised, *(np.array(bound) for bound in bounds), np.asarray(problem.schedule), problem.horizon]


def fingerprint(*parts: Any) -> str:
    """A hash of arrays and of whatever else says by its `repr` what it is."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(part.tobytes())
        digest.update(re.sub(r" at 0x[0-9a-f]+", "", repr(part)).encode())
    return digest.hexdigest()


def _encode(value: Any, arrays: dict[str, Any]) -> Any:
    """A tree for JSON of records, tuples and numbers; its arrays go into `arrays`."""
    kind = type(value).__name__
    if kind in _RECORDS:
        fields = value._asdict() if isinstance(value, Point) else vars(value)
        return {"record": kind, "fields": {name: _encode(field, arrays) for name, field in fields.items()}}
    if isinstance(value, Status):
        return {"status": value.name}
    if isinstance(value, np.ndarray):
        arrays[name := f"array_{len(arrays)}"] = value
        return {"array": name}
    if isinstance(value, tuple | list):
        return {"tuple": [_encode(item, arrays) for item in value]}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, float | int | str | None):
        return value
    raise FileError(f"an optimiser's memory of {kind} cannot be saved: it may hold tuples, numbers and arrays.")


def _decode(tree: Any, arrays: Mapping[str, Array]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "record" in tree:
        fields = {name: _decode(field, arrays) for name, field in tree["fields"].items()}
        return _RECORDS[tree["record"]](**fields)
    if "status" in tree:
        return Status[tree["status"]]
    if "array" in tree:
        return arrays[tree["array"]]
    return tuple(_decode(item, arrays) for item in tree["tuple"])
