"""Whether a trained detector is good, by clips alone: its keypoints must move, and be where something moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.autoencoder import STRIDE
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.losses import motion
from kpirl_ocp.perception.detector.training import resize
from kpirl_ocp.types import Array

_CHANGE = 0.02  # share of the pixels that change in a clip in which something moves
_GREY = 25  # grey levels that are a change
_STILL = 0.02  # keypoints that go no farther than this stand still [half an image]
_MOVING = 0.1  # of the largest motion in a clip, where something moves
_SHARE = 0.5  # of frames and keypoints that must be there


def faults(detector: KeypointDetector, clips: Sequence[Frames]) -> list[str]:
    """The faults of a detector in plain words; none if it is good.

    clips: (n, H, W, 3) uint8 RGB square, best such as it was not trained on.
    """
    moving = [clip for clip in clips if _something_moves(clip)]
    if not moving:
        return ["nothing moves in the clips, so that nothing can be said of the keypoints"]
    tracks = [detector.detect(clip)[..., :2] for clip in moving]
    ways = np.array([np.linalg.norm(track - track[0], axis=-1).max(axis=0) for track in tracks])
    found = []
    still = int((ways < _STILL).all(axis=1).sum())
    if still > len(moving) / 2:
        found.append(f"the keypoints stand still in {still} of {len(moving)} clips, although something moves in them")
    there = float(np.mean([_on_motion(clip, track, detector.size) for clip, track in zip(moving, tracks, strict=True)]))
    if there < _SHARE:
        found.append(f"only {there:.0%} of the keypoints are where something moves; the others are on still things")
    return found


def _something_moves(clip: Frames) -> bool:
    change = np.abs(clip.astype(int) - np.median(clip, axis=0)).max(axis=(0, 3))
    return bool((change > _GREY).mean() > _CHANGE)


def _on_motion(clip: Frames, track: Array, size: int) -> float:
    """Share of frames and keypoints (n, K, 2) in cells where something moves."""
    small = torch.from_numpy(resize(clip, size)).permute(0, 3, 1, 2)[None].float() / 255
    cells = size // STRIDE
    moves = motion(small, cells)[0].numpy() > _MOVING  # (n, cells, cells)
    columns, rows = np.moveaxis(np.clip(((track + 1) / 2 * cells).astype(int), 0, cells - 1), -1, 0)
    return float(moves[np.arange(len(clip))[:, None], rows, columns].mean())
