"""Keypoints that are robust to surroundings, by domain randomisation (Tobin et al., 2017), without labels.

A teacher, trained in front of a white wall, says where the keypoints of a rendered frame are. A student that starts
with the same weights sees the frame in front of another wall, in other colours and light, and has to find them there:

    mean of  KL(g || p) + 2 |z - z_teacher|_1 + BCE(mu, in view),    mu = 1 / (1 + exp(-s / 2))

p is the softmax of the student's scores over the cells, g a Gaussian of one cell's width around the teacher's keypoint,
z the student's keypoint and s its largest score. Frames from which the bottle has been taken teach mu: it is the
probability that the keypoint is in view. A keypoint of the teacher that something hides most of the time (fingers) is
moved to where the bottle is seen, to a place that moves and turns with it and the other keypoints.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.data.surroundings import random_view, without_bottle
from kpirl_ocp.perception.detector.checkpoint import Checkpoint, Curves
from kpirl_ocp.perception.detector.confidence import Confidence
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import gaussian_maps, local_soft_argmax, to_pixels
from kpirl_ocp.perception.detector.training import device_called
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.types import Array, Mask

TERMS = ("heatmap", "place", "in_view", "total")
_PLACE = 2.0  # weight of the L1 term
_SHARPNESS = 2.0  # largest scores per unit of the logit of mu
_WARM_UP = 50  # steps over which the step size rises
_CLIP_NORM = 10.0
_HIDDEN = 0.8  # a keypoint that is on the visible bottle in fewer of the frames is moved
_NEAREST = 0.3  # to the middle of the others, of its distance from there
_NEARLY = 0.1  # by which the two shares of a place farther from there, together, may be less


@dataclass(frozen=True)
class RobustSettings:
    """Settings of the student's training.

    steps: of Adam, with a step size that falls to zero along a cosine. batch: frames per step.
    absent: share of the frames without the bottle.
    """

    steps: int = 400
    batch: int = 48
    step_size: float = 1e-3
    absent: float = 0.2

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1:
            raise TrainingError(f"steps and batch must be at least 1, got {self.steps} and {self.batch}.")


@dataclass(frozen=True, eq=False)
class Views:
    """A batch.

    images: (B, 3, S, S) in [0, 1]. keypoints: (B, K, 2) of the teacher. present: (B,), whether the bottle is there.
    """

    images: Tensor
    keypoints: Tensor
    present: Tensor


def train_robust(
    teacher: KeypointDetector,
    frames: Iterable[Frame],
    settings: RobustSettings,
    seed: int = 0,
    *,
    checkpoint: Path | None = None,
    device: str = "auto",
) -> tuple[KeypointDetector, dict[str, Array]]:
    """Train a student of the teacher on rendered frames; gives it with its loss terms over the steps, each (steps,).

    Args:
        frames: square, in front of the white wall, with `parts`.
        checkpoint, device: as in `train_detector`.

    Raises:
        TrainingError: there are no frames, or the loss becomes NaN.
        FileError: the checkpoint is damaged or belongs to another training.
    """
    torch.manual_seed(seed)
    place, model = device_called(device), deepcopy(teacher.model).train()
    model.to(place)
    taught = _taught(teacher, frames)
    optimiser = torch.optim.Adam(model.parameters(), settings.step_size)
    stored = Checkpoint(checkpoint, {"seed": seed, "data": _digest(taught), **asdict(settings)})
    curves = stored.load(model, optimiser, TERMS)
    for step in _progress(curves, settings.steps):
        rng = np.random.default_rng([seed, step])
        for group in optimiser.param_groups:
            group["lr"] = settings.step_size * min(1.0, (step + 1) / _WARM_UP) * _cosine(step / settings.steps)
        views = draw_views(taught, settings, rng)
        terms = loss_terms(model.encode(views.images.to(place)).scores, views)
        optimiser.zero_grad()
        terms["total"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), _CLIP_NORM)
        optimiser.step()
        for name, value in terms.items():
            curves[name].append(float(value.detach()))
        if not np.isfinite(curves["total"][-1]):
            raise TrainingError(f"the loss became {curves['total'][-1]} in step {step}: use a smaller step size.")
        if (step + 1) % 100 == 0 or step + 1 == settings.steps:
            stored.save(model, optimiser, curves)
    count = model.head.out_channels
    confidence = Confidence(np.zeros(count), np.full(count, _SHARPNESS))
    student = KeypointDetector(model.cpu().eval(), teacher.size, confidence)
    return student, {name: np.array(values) for name, values in curves.items()}


def draw_views(frames: Sequence[Frame], settings: RobustSettings, rng: np.random.Generator) -> Views:
    """Random frames, each in its own surroundings; `place` of the frames are their keypoints (K, 2) [pixels]."""
    present = rng.random(settings.batch) >= settings.absent
    chosen = [frames[index] for index in rng.integers(len(frames), size=settings.batch)]
    seen = [random_view(f if there else without_bottle(f), rng) for f, there in zip(chosen, present, strict=True)]
    images = torch.from_numpy(np.array([view.rgb for view in seen])).permute(0, 3, 1, 2).float() / 255
    keypoints = np.array([view.place for view in seen]) / images.shape[-1] * 2 - 1
    return Views(images, torch.from_numpy(keypoints).float(), torch.from_numpy(present))


def loss_terms(scores: Tensor, views: Views) -> dict[str, Tensor]:
    """The unweighted terms and their weighted total, for scores (B, K, h, w) of the views."""
    wanted, present = views.keypoints.to(scores), views.present.to(scores.device)[:, None].expand(scores.shape[:2])
    counts = ((wanted.abs() < 1).all(-1) & present).to(scores)  # (B, K)
    maps = gaussian_maps(torch.cat([wanted, torch.ones_like(wanted[..., :1])], -1), scores.shape[-1], 1.0).flatten(-2)
    target = maps / maps.sum(-1, keepdim=True).clamp_min(torch.finfo(maps.dtype).tiny)
    divergence = functional.kl_div(scores.flatten(-2).log_softmax(-1), target, reduction="none").sum(-1)
    gap = (local_soft_argmax(scores)[..., :2] - wanted).abs().sum(-1)
    terms = {
        "heatmap": (divergence * counts).sum() / counts.sum().clamp_min(1),
        "place": (gap * counts).sum() / counts.sum().clamp_min(1),
        "in_view": functional.binary_cross_entropy_with_logits(
            scores.flatten(-2).amax(-1) / _SHARPNESS, present.to(scores)
        ),
    }
    return terms | {"total": terms["heatmap"] + _PLACE * terms["place"] + terms["in_view"]}


def _taught(teacher: KeypointDetector, frames: Iterable[Frame]) -> list[Frame]:
    """The frames at the detector's size, with the teacher's keypoints (K, 2) [pixels] as their place."""
    small = [_reduced(frame, teacher.size) for frame in frames]
    if not small:
        raise TrainingError("training needs frames; there are none.")
    keypoints = to_pixels(teacher.detect(np.array([frame.rgb for frame in small])), teacher.size)
    points = in_sight(keypoints, np.array([frame.bottle for frame in small]))
    return [Frame(f.rgb, f.bottle, at, f.parts) for f, at in zip(small, points, strict=True)]


def in_sight(keypoints: Array, bottles: Mask) -> Array:
    """Keypoints (n, K, 2) [pixels] of frames with visible bottles (n, S, S), the hidden ones moved to where it is seen.

    A place is fixed in the frame of axes from the middle m of the others to the hidden keypoint and across,

        m + a (z - m) + b R (z - m),    R the quarter turn,

    and is good if it is on the bottle, a pixel from its outline, in many frames; the farthest from m is taken of those
    that are nearly the best, as it shows the most of how the bottle turns. If all are hidden, or none, they stay as
    they are.
    """
    hidden = _share_on(keypoints, bottles) < _HIDDEN
    if hidden.all():
        return keypoints
    middle, moved = keypoints[:, ~hidden].mean(axis=1), keypoints.copy()
    inside = np.array([cv2.erode(bottle.astype(np.uint8), np.ones((3, 3), np.uint8)) for bottle in bottles])
    a, b = (axis.ravel() for axis in np.meshgrid(np.arange(-15, 16) / 10, np.arange(-10, 11) / 10))
    distance = np.hypot(a, b)
    for k in np.flatnonzero(hidden):
        along = keypoints[:, k] - middle
        across = along[:, ::-1] * [-1, 1]
        places = middle[:, None] + a[:, None] * along[:, None] + b[:, None] * across[:, None]
        shares = np.where(distance >= _NEAREST, _share_on(places, bottles) + _share_on(places, inside), 0.0)
        moved[:, k] = places[:, np.where(shares >= shares.max() - _NEARLY, distance, 0.0).argmax()]
    return moved


def _share_on(points: Array, masks: Mask) -> Array:
    """Share (m,) of the frames in which points (n, m, 2) [pixels] are on the masks (n, S, S)."""
    columns, rows = np.moveaxis(np.clip(np.floor(points), 0, masks.shape[1] - 1).astype(int), -1, 0)
    return np.asarray(masks[np.arange(len(masks))[:, None], rows, columns].mean(axis=0), float)


def _reduced(frame: Frame, size: int) -> Frame:
    if frame.parts is None:
        raise TrainingError("training in random surroundings needs frames with `parts`, the body in each pixel.")
    rows, columns = (((np.arange(size) + 0.5) * length / size).astype(int) for length in frame.bottle.shape)
    rgb = np.asarray(cv2.resize(frame.rgb, (size, size), interpolation=cv2.INTER_AREA), np.uint8)
    return Frame(rgb, frame.bottle[rows][:, columns], frame.place, frame.parts[rows][:, columns])


def _digest(frames: Sequence[Frame]) -> str:
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(frame.rgb.tobytes() + np.asarray(frame.place).tobytes())
    return digest.hexdigest()


def _progress(curves: Curves, steps: int) -> Iterator[int]:
    """The steps that are left, with a bar that shows the loss."""
    done = len(curves["total"])
    with tqdm(total=steps, initial=done, desc="robust detector", unit="step") as bar:
        for step in range(done, steps):
            yield step
            bar.update()
            bar.set_postfix(loss=f"{curves['total'][-1]:.3g}")


def _cosine(share: float) -> float:
    return float(0.5 * (1 + np.cos(np.pi * share)))
