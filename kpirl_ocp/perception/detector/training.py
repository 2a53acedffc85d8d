"""Train the keypoint detector on clips without labels.

Step i draws its batch from the seed and i alone, so that a run that was killed resumes exactly where its last
checkpoint was written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector import losses
from kpirl_ocp.perception.detector.autoencoder import EncoderKind, KeypointAutoencoder
from kpirl_ocp.perception.detector.checkpoint import Checkpoint
from kpirl_ocp.perception.detector.losses import LossWeights
from kpirl_ocp.types import Array

TERMS = (
    "reconstruction",
    "separation",
    "repulsion",
    "cohesion",
    "sparsity",
    "attention",
    "appearance",
    "equivariance",
    "total",
)
_CLIP_NORM = 10.0  # of the gradient, as published
_SHIFT = 1 / 3  # largest shift of a frame for the equivariance: a sixth of its side [half an image]
_WINDOW = 50  # steps over which the loss is averaged to see whether it still falls
_PROGRESS = 0.01  # relative fall of that average that counts


@dataclass(frozen=True)
class DetectorSettings:
    """Settings of the detector and its training.

    size: side of the images it sees [pixels]. keypoints: K. encoder: "resnet" or "plain". filters: of its first layer.
    steps: of Adam, with a step size that falls to zero along a cosine. batch: clips per step. frames: per clip.
    other_share: share of a batch that comes from the second kind of clips (a person's hand).
    patience: stop when the loss has not fallen for that many steps.
    """

    size: int = 60
    keypoints: int = 4
    encoder: EncoderKind = "resnet"
    filters: int = 16
    steps: int = 500
    batch: int = 8
    frames: int = 6
    step_size: float = 1e-3
    other_share: float = 0.5
    patience: int = 300
    losses: LossWeights = field(default_factory=LossWeights)

    def __post_init__(self) -> None:
        for name in ("keypoints", "filters", "steps", "batch", "frames", "patience"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} must be at least 1, got {getattr(self, name)}.")


PRESETS: Mapping[str, DetectorSettings] = {
    "tiny": DetectorSettings(encoder="plain", filters=8, steps=120, patience=120),
    "default": DetectorSettings(),
    "full": DetectorSettings(size=96),
    "minderer": DetectorSettings(
        encoder="plain",
        filters=32,
        losses=LossWeights(
            separation=10.0, repulsion=0.0, cohesion=0.0, sparsity=5.0, attention=0.0, appearance=0.0, equivariance=0.0
        ),
    ),
}


@dataclass(frozen=True)
class Trained:
    """A trained model and its loss terms over the steps, each (steps,)."""

    model: KeypointAutoencoder
    curves: dict[str, Array]


def train_detector(
    clips: Sequence[Frames],
    settings: DetectorSettings,
    seed: int = 0,
    *,
    others: Sequence[Frames] = (),
    start: KeypointAutoencoder | None = None,
    checkpoint: Path | None = None,
    device: str = "auto",
) -> Trained:
    """Train on clips (n, H, W, 3) uint8 RGB of any square size, and on unlabelled `others` if there are any.

    Args:
        start: a trained model of the same architecture to begin with; None for random weights.
        checkpoint: a file written every hundred steps; if it exists, training resumes from there.
        device: of torch; "auto" for a GPU where there is one. The model comes back to the CPU.

    Raises:
        TrainingError: there are no clips, one is shorter than `settings.frames`, or the loss becomes NaN.
        FileError: the checkpoint is damaged or belongs to another training.
    """
    torch.manual_seed(seed)
    model = KeypointAutoencoder(settings.size, settings.keypoints, settings.encoder, settings.filters)
    if start is not None:
        _begin_with(model, start)
    place = device_called(device)
    model.to(place)
    optimiser = torch.optim.Adam(model.parameters(), settings.step_size)
    sources = [_resized(clips, settings)] + ([_resized(others, settings)] if others else [])
    began = None if start is None else float(sum(value.double().sum() for value in start.state_dict().values()))
    stored = Checkpoint(checkpoint, {"seed": seed, "data": _digest(sources), "start": began, **asdict(settings)})
    curves = stored.load(model, optimiser, TERMS)
    with tqdm(total=settings.steps, initial=len(curves["total"]), desc="detector", unit="step") as bar:
        for step in range(len(curves["total"]), settings.steps):
            if _plateau(curves["total"], settings.patience):
                break
            rng = np.random.default_rng([seed, step])
            _set_step_size(optimiser, settings, step)
            terms = _step(model, optimiser, _batch(sources, settings, rng).to(place), settings.losses, rng)
            for name, value in terms.items():
                curves[name].append(value)
            if not np.isfinite(terms["total"]):
                raise TrainingError(f"the loss became {terms['total']} in step {step}: use a smaller step size.")
            bar.update()
            bar.set_postfix(loss=f"{terms['total']:.3g}")
            if (step + 1) % 100 == 0 or step + 1 == settings.steps:
                stored.save(model, optimiser, curves)
    return Trained(model.cpu().eval(), {name: np.array(values) for name, values in curves.items()})


def device_called(name: str) -> torch.device:
    """A device of torch; "auto" is a GPU where there is one. Raises TrainingError if there is no such device."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.zeros(1, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise TrainingError(f"torch cannot use the device {name!r}: {error}") from error


def _begin_with(model: KeypointAutoencoder, start: KeypointAutoencoder) -> None:
    try:
        model.load_state_dict(start.state_dict())
    except RuntimeError as error:
        raise TrainingError("the detector to start from has another architecture: choose its preset.") from error


def _step(
    model: KeypointAutoencoder,
    optimiser: torch.optim.Optimizer,
    clips: Tensor,
    weights: LossWeights,
    rng: np.random.Generator,
) -> dict[str, float]:
    """One step of Adam on clips (B, T, 3, S, S); gives the unweighted terms and the weighted total."""
    painted, keypoints, scores = model(clips)
    terms = {
        "reconstruction": losses.reconstruction(clips, painted),
        "separation": losses.separation(keypoints),
        "repulsion": losses.repulsion(keypoints),
        "cohesion": losses.cohesion(keypoints),
        "sparsity": losses.sparsity(scores),
        "attention": losses.attention(scores, losses.motion(clips, model.cells)),
        "appearance": losses.appearance(clips, scores),
        "equivariance": torch.zeros((), device=clips.device),
    }
    if weights.equivariance:
        half = clips.shape[1] // 2
        frames = clips[:, :half].flatten(0, 1)
        offset = torch.from_numpy(rng.uniform(-_SHIFT, _SHIFT, (len(frames), 2))).to(frames)
        moved = model.encode(losses.shifted(frames, offset)).keypoints
        terms["equivariance"] = losses.equivariance(moved, keypoints[:, :half].flatten(0, 1), offset)
    total = terms["reconstruction"] + sum(factor * terms[name] for name, factor in asdict(weights).items())
    optimiser.zero_grad()
    total.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), _CLIP_NORM)
    optimiser.step()
    return {name: float(value.detach()) for name, value in (terms | {"total": total}).items()}


def _resized(clips: Sequence[Frames], settings: DetectorSettings) -> list[NDArray[np.uint8]]:
    """Clips (n, size, size, 3), by area averaging."""
    check_lengths(clips, settings.frames)
    return [resize(clip, settings.size) for clip in clips]


def check_lengths(clips: Sequence[Frames], frames: int) -> None:
    """Raise TrainingError if there are no clips, or one has too few frames."""
    short = [len(clip) for clip in clips if len(clip) < frames]
    if not clips or short:
        raise TrainingError(
            f"training needs clips of at least {frames} frames; "
            + (f"the shortest has {min(short)}." if short else "there are none.")
        )


def _digest(sources: list[list[Frames]]) -> str:
    """A fingerprint of the training data."""
    digest = hashlib.sha256()
    for source in sources:
        for clip in source:
            digest.update(clip.tobytes())
    return digest.hexdigest()


def resize(images: Frames, size: int) -> Frames:
    """Images (n, H, W, 3) as (n, size, size, 3), by area averaging."""
    return np.array([cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in images], np.uint8)


def _batch(sources: list[list[Frames]], settings: DetectorSettings, rng: np.random.Generator) -> Tensor:
    """Random frames of random clips (B, T, 3, S, S) in [0, 1], the stated share of them from the second source."""
    others = round(settings.other_share * settings.batch) if len(sources) > 1 else 0
    chosen = []
    for index in range(settings.batch):
        source = sources[1 if index < others else 0]
        clip = source[rng.integers(len(source))]
        frames = np.sort(rng.choice(len(clip), settings.frames, replace=False))
        chosen.append(clip[frames])
    return torch.from_numpy(np.array(chosen)).permute(0, 1, 4, 2, 3).float() / 255


def _set_step_size(optimiser: torch.optim.Optimizer, settings: DetectorSettings, step: int) -> None:
    for group in optimiser.param_groups:
        group["lr"] = settings.step_size * 0.5 * (1 + np.cos(np.pi * step / settings.steps))


def _plateau(total: list[float], patience: int) -> bool:
    """True if the average of the last window is not below the one of `patience` steps ago."""
    if len(total) < patience + _WINDOW:
        return False
    before = np.mean(total[-patience - _WINDOW : -patience])
    return bool(np.mean(total[-_WINDOW:]) > (1 - _PROGRESS) * before)
