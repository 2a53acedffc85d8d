"""Training state on disk, to go on exactly where a killed run was: weights, Adam's moments, loss curves.

One safetensors file, replaced as a whole; nothing is unpickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.errors import FileError
from kpirl_ocp.sizes import check_file

Curves = dict[str, list[float]]
_CONTENT = "training"  # one key of metadata: the format keeps no order of several, and the same state the same bytes


class Checkpoint:
    """A file (or none) that belongs to one configuration."""

    def __init__(self, path: Path | None, configuration: Mapping[str, Any]) -> None:
        self.path = path
        self.configuration = json.dumps(configuration, sort_keys=True)

    def save(self, model: nn.Module, optimiser: torch.optim.Optimizer, curves: Curves) -> None:
        """Write the state after as many steps, or epochs, as the curves have numbers."""
        if self.path is None:
            return
        tensors = {f"model.{name}": value.contiguous() for name, value in model.state_dict().items()}
        for index, state in optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": value.contiguous() for name, value in state.items()}
        content = json.dumps({"configuration": self.configuration, "curves": curves})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as file:
            file.write(save(tensors, {_CONTENT: content}))

    def load(self, model: nn.Module, optimiser: torch.optim.Optimizer, terms: Sequence[str]) -> Curves:
        """Bring model and Adam to the stored state and give its curves; empty curves if nothing was stored.

        Raises FileError if the file is damaged or belongs to another configuration.
        """
        if self.path is None or not self.path.exists():
            return {term: [] for term in terms}
        try:
            check_file(self.path)
            with safe_open(self.path, "pt") as file:
                metadata = file.metadata()
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no iterator)
        except (OSError, ValueError, SafetensorError) as error:
            raise FileError(f"{self.path} is no checkpoint: {error}. Delete it to start anew.") from error
        content = json.loads((metadata or {}).get(_CONTENT, "{}"))
        if content.get("configuration") != self.configuration:
            raise FileError(
                f"{self.path} belongs to a training with other settings or data: delete it, or use another --out."
            )
        model.load_state_dict(_below("model.", tensors))
        state = optimiser.state_dict()
        count = len(state["param_groups"][0]["params"])
        state["state"] = {index: _below(f"adam.{index}.", tensors) for index in range(count)}
        optimiser.load_state_dict(state)
        curves: Curves = content["curves"]
        return curves


def _below(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
