"""A model on disk: `NAME.json`, a card that says what it is, and `NAME.safetensors`, its weights."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from kpirl_ocp.episodes import replacing
from kpirl_ocp.errors import EpisodeError

_VERSION = 1
Tensors = dict[str, NDArray[np.float32]]


def write_model(path: Path, kind: str, tensors: Tensors, card: Mapping[str, Any]) -> Path:
    """Write the weights and then the card `path` (.json); both appear whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path.with_suffix(".safetensors")) as file:
        file.write(save(dict(tensors)))
    with replacing(path) as file:
        file.write((json.dumps({"kind": kind, "version": _VERSION, **card}, indent=2) + "\n").encode())
    return path


@contextmanager
def fitting(path: str | Path) -> Iterator[None]:
    """Report a card that does not describe the weights beside it as an EpisodeError that names the file."""
    try:
        yield
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        raise EpisodeError(f"{path} does not describe the weights beside it: {error!r}") from error


def read_model(path: Path, kind: str) -> tuple[dict[str, Any], Tensors]:
    """Card and weights. Raises EpisodeError, naming the file, if one is missing, damaged or of another kind."""
    try:
        card = json.loads(path.read_text())
        tensors = load(path.with_suffix(".safetensors").read_bytes())
    except FileNotFoundError as error:
        raise EpisodeError(f"{error.filename} does not exist: train a model first.") from None
    except (OSError, ValueError, SafetensorError) as error:
        raise EpisodeError(f"{path} or the .safetensors file beside it is damaged: {error}") from error
    found = (card.get("kind"), card.get("version")) if isinstance(card, dict) else (type(card).__name__, None)
    if found != (kind, _VERSION):
        raise EpisodeError(f"{path} must be a {kind} of version {_VERSION}, not {found[0]!r} of version {found[1]}.")
    bad = [name for name, value in tensors.items() if not np.isfinite(value).all()]
    if bad:
        raise EpisodeError(f"{path.with_suffix('.safetensors')}, {bad[0]}: holds NaN or infinity.")
    return card, tensors
