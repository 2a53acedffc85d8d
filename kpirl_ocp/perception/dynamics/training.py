"""Train the dynamics of keypoints, and compare it with persistence, "nothing moves".

    NMSE = mean over coordinates of  mean |z_hat - z|^2 / var z

(paper, A.3). Because keypoints move little in one step, predicting no motion at all already has a small NMSE: every
score is therefore given together with that of persistence.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR
from tqdm import tqdm

from kpirl_ocp.episodes import ArmTrack
from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.detector.checkpoint import Checkpoint, Curves
from kpirl_ocp.perception.dynamics.model import Activation, DynamicsModel
from kpirl_ocp.types import Array

_VALIDATION = 0.1  # share of the trajectories that decides when to stop


@dataclass(frozen=True)
class DynamicsSettings:
    """Settings of the training.

    activation: of the hidden layers. steps: H >= 1, number of predicted steps in the loss.
    epochs: at most. batch: stretches of H steps per update. step_size: of Adam, falling to zero along a cosine.
    weight_decay: of Adam. patience: epochs without a better validation loss before it stops.
    """

    activation: Activation = "relu"
    steps: int = 1
    epochs: int = 300
    batch: int = 256
    step_size: float = 3e-3
    weight_decay: float = 1e-4
    patience: int = 60

    def __post_init__(self) -> None:
        for name in ("steps", "epochs", "batch", "patience"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} must be at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class Stretches:
    """Stretches of H steps from trajectories: z (n, H+1, n_z), theta and velocity (n, n_q), actions (n, H, n_q)."""

    z: Tensor
    theta: Tensor
    velocity: Tensor
    actions: Tensor

    @classmethod
    def of(cls, tracks: Sequence[ArmTrack], steps: int) -> Stretches:
        """All stretches of `steps` steps. Raises TrainingError if no trajectory is that long."""
        parts: list[tuple[Array, ...]] = []
        for track in tracks:
            z = track.keypoints[..., :2].reshape(len(track.times), -1)
            for t in range(len(track.actions) - steps + 1):
                parts.append((z[t : t + steps + 1], track.joints[t], track.velocities[t], track.actions[t : t + steps]))
        if not parts:
            raise TrainingError(f"no trajectory has {steps} steps.")
        return cls(*(torch.from_numpy(np.array(column)).float() for column in zip(*parts, strict=True)))

    def __len__(self) -> int:
        return len(self.z)

    def __getitem__(self, rows: Tensor) -> Stretches:
        return Stretches(self.z[rows], self.theta[rows], self.velocity[rows], self.actions[rows])

    def predict(self, model: DynamicsModel) -> Tensor:
        """Predicted z_1 .. z_H (n, H, n_z)."""
        return model.rollout(self.z[:, 0], self.theta, self.velocity, self.actions)


class _Training(nn.Module):
    """All tensors of a training: the model, that of the best epoch, the step size, and torch's random numbers."""

    step_size: Tensor
    random: Tensor

    def __init__(self, model: DynamicsModel) -> None:
        super().__init__()
        self.model, self.best = model, deepcopy(model)
        self.register_buffer("step_size", torch.zeros((), dtype=torch.float64))
        self.register_buffer("random", torch.get_rng_state())

    def store(self, schedule: CosineAnnealingLR) -> None:
        """Store step size and random numbers in the tensors."""
        self.step_size.fill_(schedule.optimizer.param_groups[0]["lr"])
        self.random.copy_(torch.get_rng_state())

    def restore(self, schedule: CosineAnnealingLR, epochs: int) -> None:
        """Bring the stored step size and random numbers back, after so many epochs."""
        schedule.optimizer.param_groups[0]["lr"], schedule.last_epoch = float(self.step_size), epochs
        torch.set_rng_state(self.random)


def train_dynamics(
    tracks: Sequence[ArmTrack], settings: DynamicsSettings, seed: int = 0, *, checkpoint: Path | None = None
) -> tuple[DynamicsModel, dict[str, Array]]:
    """Train on trajectories; gives the model of the best epoch and the curves "train" and "validation" (NMSE).

    Args:
        checkpoint: a file written every ten epochs; if it exists, training resumes from there.

    Raises:
        FileError: the checkpoint is damaged or belongs to another training.
        TrainingError: fewer than two trajectories, none of `settings.steps` steps, a coordinate that never changes, or
            a loss that becomes NaN.
    """
    if len(tracks) < 2:
        raise TrainingError(f"training needs at least two trajectories, got {len(tracks)}.")
    torch.manual_seed(seed)
    order = np.random.default_rng(seed).permutation(len(tracks))
    held = max(1, round(_VALIDATION * len(tracks)))
    validation = Stretches.of([tracks[i] for i in order[:held]], settings.steps)
    train = Stretches.of([tracks[i] for i in order[held:]], settings.steps)

    model = DynamicsModel(train.z.shape[-1], train.theta.shape[-1], settings.activation)
    inputs = torch.cat([train.z[:, 0], train.theta, train.velocity, train.actions[:, 0]], -1)
    model.normalise(inputs, train.z[:, 1] - train.z[:, 0])
    variance = train.z[:, 1:].flatten(0, 1).var(0)
    still = [f"{'xy'[i % 2]} of keypoint {i // 2}" for i in np.flatnonzero(variance.numpy() == 0)]
    if still:
        raise TrainingError(f"{', '.join(still)} never changes in the training data: look at the detector.")
    optimiser = torch.optim.AdamW(model.parameters(), settings.step_size, weight_decay=settings.weight_decay)
    schedule = CosineAnnealingLR(optimiser, settings.epochs)
    state = _Training(model)
    file = Checkpoint(checkpoint, {"seed": seed, "data": _digest(train, validation), **asdict(settings)})
    curves = file.load(state, optimiser, ("train", "validation"))
    done = len(curves["train"])
    if done:
        state.restore(schedule, done)
    with tqdm(total=settings.epochs, initial=done, desc="dynamics", unit="epoch") as bar:
        for epoch in range(done, settings.epochs):
            if epoch and _waited(curves) >= settings.patience:
                break
            curves["train"].append(_epoch(model, optimiser, train, variance, settings.batch))
            with torch.inference_mode():
                curves["validation"].append(float(_nmse(model, validation, variance)))
            if not np.isfinite([curves["train"][-1], curves["validation"][-1]]).all():
                raise TrainingError("the loss became NaN or infinite: use a smaller step size.")
            schedule.step()
            bar.update()
            bar.set_postfix(validation=f"{curves['validation'][-1]:.2g}")
            if _waited(curves) == 0:
                state.best.load_state_dict(model.state_dict())
            if (epoch + 1) % 10 == 0 or epoch + 1 == settings.epochs:
                state.store(schedule)
                file.save(state, optimiser, curves)
    return state.best.eval(), {name: np.array(values) for name, values in curves.items()}


def _digest(*data: Stretches) -> str:
    """A fingerprint of the training data."""
    digest = hashlib.sha256()
    for part in data:
        for column in (part.z, part.theta, part.velocity, part.actions):
            digest.update(column.numpy().tobytes())
    return digest.hexdigest()


def _waited(curves: Curves) -> int:
    """Epochs since the best validation loss."""
    return len(curves["validation"]) - 1 - int(np.argmin(curves["validation"]))


def _epoch(
    model: DynamicsModel, optimiser: torch.optim.Optimizer, data: Stretches, variance: Tensor, batch: int
) -> float:
    losses = []
    for rows in torch.randperm(len(data)).split(batch):
        loss = _nmse(model, data[rows], variance)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return float(np.mean(losses))


def _nmse(model: DynamicsModel, data: Stretches, variance: Tensor) -> Tensor:
    return ((data.predict(model) - data.z[:, 1:]).square().mean((0, 1)) / variance).mean()


@dataclass(frozen=True)
class DynamicsScores:
    """NMSE per step ahead and keypoint coordinate, (H, n_z), of the model and of persistence z_{t+h} = z_t."""

    model: Array
    persistence: Array


@torch.inference_mode()
def score_dynamics(model: DynamicsModel, tracks: Sequence[ArmTrack], steps: int = 10) -> DynamicsScores:
    """Open-loop prediction over 1 .. `steps` steps on held-out trajectories."""
    data = Stretches.of(tracks, steps)
    targets = data.z[:, 1:].double()
    variance = targets.flatten(0, 1).var(0)

    def nmse(predicted: Tensor) -> Array:
        return ((predicted - targets).square().mean(0) / variance).numpy()

    return DynamicsScores(nmse(data.predict(model).double()), nmse(data.z[:, :1].double()))
