"""Learned dynamics on disk: a card `NAME.json` next to the weights `NAME.safetensors`; read without torch.

    {"kind": "kpirl_ocp.dynamics", "version": 1,
     "inputs": {"keypoints": 8, "joints": 7, "velocities": 7, "actions": 7},
     "hidden": [100, 25], "activation": "relu", "residual": true, "rate": 5.0, ...}

The tensors are "layers.{i}.weight" (n_out, n_in) and "layers.{i}.bias" (n_out,), and of the normalisation
"input.mean", "input.scale" (n_in,), "output.mean", "output.scale" (n_z,). Other keys of the card are only notes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kpirl_ocp.model_cards import DYNAMICS, Card, read_model
from kpirl_ocp.ocp.models.activations import ACTIVATIONS
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import MLP


def load_dynamics(path: str | Path) -> NetworkDynamics:
    """The dynamics of a card `NAME.json` and the weights next to it.

    Raises:
        ModelError: a file, key or tensor is missing, of the wrong kind, version or shape, or not finite.
    """
    card, tensors = read_model(Path(path), DYNAMICS)
    build = _Architecture.of(card)
    widths = [build.n_in, *build.hidden, build.n_z]
    layers = list(pairwise(widths))
    weights = [tensors.take(f"layers.{i}.weight", (n_out, n_in)) for i, (n_in, n_out) in enumerate(layers)]
    biases = [tensors.take(f"layers.{i}.bias", (n_out,)) for i, (_, n_out) in enumerate(layers)]
    normalisation = [
        tensors.take("input.mean", (build.n_in,)),
        tensors.take("input.scale", (build.n_in,), positive=True),
        tensors.take("output.mean", (build.n_z,)),
        tensors.take("output.scale", (build.n_z,), positive=True),
    ]
    tensors.check_all_taken()
    mlp = MLP.from_layers(weights, biases, build.activation).normalised(*normalisation)
    return NetworkDynamics(mlp, build.n_z, build.n_joints, build.residual, build.rate)


@dataclass(frozen=True)
class _Architecture:
    """The architecture of the network, as its card states it."""

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
    def of(cls, card: Card) -> _Architecture:
        entries, require = card.entries, card.require
        sizes: Any = entries.get("inputs")
        hidden: Any = entries.get("hidden")
        rate: Any = entries.get("rate")
        names = ("keypoints", "joints", "velocities", "actions")
        known = isinstance(sizes, dict) and all(_is_count(sizes.get(name)) for name in names)
        require(
            "inputs",
            known and len({sizes[n] for n in names[1:]}) == 1,
            f"counts of {', '.join(names)}, the last three equal",
        )
        require("hidden", isinstance(hidden, list) and all(map(_is_count, hidden)), "a list of layer widths")
        require("activation", entries.get("activation") in tuple(ACTIVATIONS), f"one of {', '.join(ACTIVATIONS)}")
        require("residual", isinstance(entries.get("residual"), bool), "true or false")
        require(
            "rate",
            isinstance(rate, int | float) and not isinstance(rate, bool) and 0 < rate < np.inf,
            "a positive number [Hz]",
        )
        return cls(
            sizes["keypoints"], sizes["joints"], tuple(hidden), entries["activation"], entries["residual"], float(rate)
        )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0
