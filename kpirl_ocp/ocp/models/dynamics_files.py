"""Learned dynamics on disk: a card `NAME.json` beside the weights `NAME.safetensors`; read without torch.

    {"kind": "kpirl_ocp.dynamics", "version": 1,
     "inputs": {"keypoints": 8, "joints": 7, "velocities": 7, "actions": 7},
     "hidden": [100, 25], "activation": "relu", "residual": true, "rate": 5.0, ...}

The tensors are "layers.{i}.weight" (n_out, n_in) and "layers.{i}.bias" (n_out,), and of the normalisation
"input.mean", "input.scale" (n_in,), "output.mean", "output.scale" (n_z,). Other keys of the card are notes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from kpirl_ocp.errors import ModelError
from kpirl_ocp.ocp.models.activations import ACTIVATIONS
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.types import Array

KIND = "kpirl_ocp.dynamics"
VERSION = 1


def load_dynamics(path: str | Path) -> NetworkDynamics:
    """The dynamics of a card `NAME.json` and its weights beside it.

    Raises:
        ModelError: a file, key or tensor is missing, of the wrong kind, version or shape, or not finite.
    """
    card = _Card.read(Path(path))
    tensors = _Tensors.read(Path(path).with_suffix(".safetensors"))
    widths = [card.n_in, *card.hidden, card.n_z]
    layers = list(pairwise(widths))
    weights = [tensors.take(f"layers.{i}.weight", (n_out, n_in)) for i, (n_in, n_out) in enumerate(layers)]
    biases = [tensors.take(f"layers.{i}.bias", (n_out,)) for i, (_, n_out) in enumerate(layers)]
    normalisation = [
        tensors.take("input.mean", (card.n_in,)),
        tensors.take("input.scale", (card.n_in,), positive=True),
        tensors.take("output.mean", (card.n_z,)),
        tensors.take("output.scale", (card.n_z,), positive=True),
    ]
    tensors.check_all_taken()
    mlp = MLP.from_layers(weights, biases, card.activation).normalised(*normalisation)
    return NetworkDynamics(mlp, card.n_z, card.n_joints, card.residual, card.rate)


@dataclass(frozen=True)
class _Card:
    """What the card says about the network."""

    n_z: int
    n_joints: int
    hidden: tuple[int, ...]
    activation: str
    residual: bool
    rate: float

    @property
    def n_in(self) -> int:
        return self.n_z + 3 * self.n_joints

    @classmethod
    def read(cls, path: Path) -> _Card:
        try:
            card = json.loads(path.read_text())
        except FileNotFoundError:
            raise ModelError(f"there is no dynamics card {path}.") from None
        except (OSError, ValueError) as error:
            raise ModelError(f"{path} cannot be read as JSON: {error}") from error
        if not isinstance(card, dict):
            raise ModelError(f"{path} must hold one JSON object.")

        def require(key: str, holds: bool, expected: str) -> None:
            if not holds:
                raise ModelError(f"{path}: {key!r} must be {expected}; it is {card.get(key, 'missing')!r}.")

        require("kind", card.get("kind") == KIND, repr(KIND))
        require("version", card.get("version") == VERSION, str(VERSION))
        sizes: Any = card.get("inputs")
        hidden: Any = card.get("hidden")
        rate: Any = card.get("rate")
        names = ("keypoints", "joints", "velocities", "actions")
        known = isinstance(sizes, dict) and all(_is_count(sizes.get(name)) for name in names)
        require(
            "inputs",
            known and len({sizes[n] for n in names[1:]}) == 1,
            f"counts of {', '.join(names)}, the last three equal",
        )
        require("hidden", isinstance(hidden, list) and all(map(_is_count, hidden)), "a list of layer widths")
        require("activation", card.get("activation") in tuple(ACTIVATIONS), f"one of {', '.join(ACTIVATIONS)}")
        require("residual", isinstance(card.get("residual"), bool), "true or false")
        require(
            "rate",
            isinstance(rate, int | float) and not isinstance(rate, bool) and 0 < rate < np.inf,
            "a positive number [Hz]",
        )
        return cls(
            sizes["keypoints"], sizes["joints"], tuple(hidden), card["activation"], card["residual"], float(rate)
        )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


@dataclass(frozen=True)
class _Tensors:
    """The tensors of a file; `take` removes them one by one."""

    path: Path
    left: dict[str, Array]

    @classmethod
    def read(cls, path: Path) -> _Tensors:
        try:
            return cls(path, load_file(path))
        except FileNotFoundError:
            raise ModelError(f"there is no weight file {path}; it belongs beside the card.") from None
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise ModelError(f"{path} cannot be read as safetensors: {error}") from error

    def take(self, key: str, shape: tuple[int, ...], positive: bool = False) -> Array:
        """The tensor as float64. Raises ModelError when it is missing, or not what the card promises."""
        if key not in self.left:
            raise ModelError(f"{self.path}: {key!r} is missing.")
        found = self.left.pop(key)
        if found.dtype.kind != "f" or found.shape != shape:
            raise ModelError(f"{self.path}: {key!r} must be floats {shape}; it is {found.dtype} {found.shape}.")
        if not np.isfinite(found).all():
            raise ModelError(f"{self.path}: {key!r} holds NaN or infinity.")
        if positive and not (found > 0).all():
            raise ModelError(f"{self.path}: {key!r} must be positive.")
        return found.astype(float)

    def check_all_taken(self) -> None:
        """Raise ModelError for tensors that the card does not speak of."""
        if self.left:
            raise ModelError(f"{self.path}: the card does not account for {', '.join(sorted(self.left))}.")
