"""A trained model on disk: a card `NAME.json` that describes it, and its weights `NAME.safetensors` next to it.

    {"kind": "kpirl_ocp.dynamics", "version": 1, ...}

Each kind of model has entries of its own, and names for its tensors; other entries of the card are notes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.errors import ModelError
from kpirl_ocp.sizes import check_file, read_json
from kpirl_ocp.types import Array

DETECTOR, DYNAMICS = "kpirl_ocp.detector", "kpirl_ocp.dynamics"
VERSION = 1
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Card:
    """The entries of a card; `require` checks them one by one."""

    path: Path
    entries: dict[str, Any]

    def require(self, key: str, holds: bool, expected: str) -> None:
        """Raise ModelError, naming file and key, unless the entry `holds`."""
        if not holds:
            raise ModelError(f"{self.path}: {key!r} must be {expected}; it is {self.entries.get(key, 'missing')!r}.")


@dataclass(frozen=True)
class Tensors:
    """The tensors of a weight file by name; `take` removes them one by one."""

    path: Path
    left: dict[str, Floats]

    def take(self, key: str, shape: tuple[int, ...], positive: bool = False) -> Array:
        """The tensor as float64. Raises ModelError when it is missing, or not what the card promises."""
        if key not in self.left:
            raise ModelError(f"{self.path}: {key!r} is missing.")
        found = self.left.pop(key)
        if found.dtype.kind != "f" or found.shape != shape:
            raise ModelError(f"{self.path}: {key!r} must be floats {shape}; it is {found.dtype} {found.shape}.")
        if positive and not (found > 0).all():
            raise ModelError(f"{self.path}: {key!r} must be positive.")
        return found.astype(float)

    def check_all_taken(self) -> None:
        """Raise ModelError for tensors that the card does not speak of."""
        if self.left:
            raise ModelError(f"{self.path}: the card does not account for {', '.join(sorted(self.left))}.")


def write_model(path: Path, kind: str, tensors: Mapping[str, Floats], entries: Mapping[str, Any]) -> Path:
    """Write the weights and then the card `path` (.json), each whole or not at all; gives `path` back."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path.with_suffix(".safetensors")) as file:
        file.write(save(dict(tensors)))
    with atomic_write(path) as file:
        file.write((json.dumps({"kind": kind, "version": VERSION, **entries}, indent=2) + "\n").encode())
    return path


def read_model(path: Path, kind: str) -> tuple[Card, Tensors]:
    """The card `path` (.json) and the tensors next to it.

    Raises:
        ModelError: a file is missing or unreadable, of another kind or version, or a tensor is not finite.
    """
    card = Card(path, _entries(path))
    card.require("kind", card.entries.get("kind") == kind, repr(kind))
    card.require("version", card.entries.get("version") == VERSION, str(VERSION))
    return card, Tensors(path.with_suffix(".safetensors"), _tensors(path.with_suffix(".safetensors")))


@contextmanager
def report_mismatch(path: str | Path) -> Iterator[None]:
    """Report a card that does not describe its weights as a ModelError that names the file."""
    try:
        yield
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        raise ModelError(f"{path} does not describe its weights: {error!r}") from error


def _entries(path: Path) -> dict[str, Any]:
    try:
        entries = read_json(path)
    except FileNotFoundError:
        raise ModelError(f"there is no model card {path}: train a model first.") from None
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(entries, dict):
        raise ModelError(f"{path} must hold one JSON object.")
    return entries


def _tensors(path: Path) -> dict[str, Floats]:
    try:
        check_file(path)
        tensors = load(path.read_bytes())
    except FileNotFoundError:
        raise ModelError(f"there is no weight file {path}; it belongs next to the card.") from None
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ModelError(f"{path} cannot be read as safetensors: {error}") from error
    bad = [key for key, value in tensors.items() if not np.isfinite(value).all()]
    if bad:
        raise ModelError(f"{path}: {bad[0]!r} holds NaN or infinity.")
    return tensors
