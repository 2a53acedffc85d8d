"""The learned dynamics of keypoints (paper, A.1):

    z_{t+1} = z_t + m + d * MLP((x_t - m_x) / d_x),   x_t = (z_t, theta_t, theta_dot_t, u_t),
    theta_{t+1} = theta_t + u_t,   theta_dot_{t+1} = theta_dot_t.

z holds x and y of the K keypoints (mu is a confidence, not a state). The normalisation (means m, deviations d) is part
of the model. On disk it is a card and a safetensors file that `ocp` reads without torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from kpirl_ocp.model_cards import DYNAMICS, read_model, report_mismatch, write_model

Activation = Literal["relu", "tanh", "softplus", "silu"]
ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "softplus": nn.Softplus,
    "silu": nn.SiLU,
}
HIDDEN = (100, 25)
_LEAST_SPEED = 1e-2  # by which velocities are scaled [rad/s]


class DynamicsModel(nn.Module):
    """The network f_mlp between its normalisations.

    keypoints: length of z, 2 K. joints: of the arm. activation: after each layer but the last.
    """

    def __init__(
        self, keypoints: int, joints: int, activation: Activation = "relu", hidden: tuple[int, ...] = HIDDEN
    ) -> None:
        super().__init__()
        self.sizes = {"keypoints": keypoints, "joints": joints, "velocities": joints, "actions": joints}
        self.hidden, self.activation = hidden, activation
        widths = [sum(self.sizes.values()), *hidden, keypoints]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.between = ACTIVATIONS[activation]()
        for name, width in (("input", widths[0]), ("output", keypoints)):
            self.register_buffer(f"{name}_mean", torch.zeros(width))
            self.register_buffer(f"{name}_scale", torch.ones(width))

    def normalise(self, inputs: Tensor, changes: Tensor) -> None:
        """Take means and deviations from training data: x (n, n_x) and z_{t+1} - z_t (n, n_z).

        A number that never changes (a joint that is not used) carries no information and is left unscaled. Velocities
        are scaled to at least 1e-2 rad/s: those of an arm that rests at every look are rounding, and no other arm's
        encoders are as quiet.
        """
        for name, values in (("input", inputs), ("output", changes)):
            deviation = values.std(0)
            self.get_buffer(f"{name}_mean").copy_(values.mean(0))
            self.get_buffer(f"{name}_scale").copy_(torch.where(deviation > 1e-6, deviation, 1.0))
        first = self.sizes["keypoints"] + self.sizes["joints"]
        velocities = self.get_buffer("input_scale")[first : first + self.sizes["velocities"]]
        velocities.copy_(torch.where(velocities == 1.0, velocities, velocities.clamp_min(_LEAST_SPEED)))

    def forward(self, z: Tensor, theta: Tensor, velocity: Tensor, u: Tensor) -> Tensor:
        """One step of the dynamics.

        Args:
            z: (..., n_z) x and y of the keypoints [half an image]. theta: (..., n_joints) [rad].
            velocity: (..., n_joints) [rad/s]. u: (..., n_joints) joint displacements [rad].

        Returns:
            z_{t+1} (..., n_z).
        """
        inputs = torch.cat([z, theta, velocity, u], -1)
        x = (inputs - self.get_buffer("input_mean")) / self.get_buffer("input_scale")
        for layer in self.layers[:-1]:
            x = self.between(layer(x))
        return z + self.get_buffer("output_mean") + self.get_buffer("output_scale") * self.layers[-1](x)

    def rollout(self, z: Tensor, theta: Tensor, velocity: Tensor, actions: Tensor) -> Tensor:
        """Predicted z_{t+1} .. z_{t+H} (..., H, n_z) for actions (..., H, n_u), from one state."""
        predicted = []
        for u in actions.unbind(-2):
            z, theta = self(z, theta, velocity, u), theta + u
            predicted.append(z)
        return torch.stack(predicted, -2)

    def save(self, path: str | Path, card: Mapping[str, Any]) -> Path:
        """Write weights and card; the architecture is added to `card`."""
        names = {f"{kind}_{what}": f"{kind}.{what}" for kind in ("input", "output") for what in ("mean", "scale")}
        tensors = {names.get(name, name): value.numpy() for name, value in self.state_dict().items()}
        build = {"inputs": self.sizes, "hidden": list(self.hidden), "activation": self.activation, "residual": True}
        return write_model(Path(path), DYNAMICS, tensors, build | dict(card))

    @classmethod
    def load(cls, path: str | Path) -> DynamicsModel:
        """The model of a card. Raises ModelError for missing or damaged files."""
        card, tensors = read_model(Path(path), DYNAMICS)
        with report_mismatch(path):
            build = card.entries
            sizes = build["inputs"]
            model = cls(sizes["keypoints"], sizes["joints"], build["activation"], tuple(build["hidden"]))
            renamed = {name.replace("put.", "put_"): torch.from_numpy(value) for name, value in tensors.left.items()}
            model.load_state_dict(renamed)
        return model.eval()
