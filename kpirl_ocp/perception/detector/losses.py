"""The losses of the detector, which need no labels.

Reconstruction, separation and sparsity are those of Minderer et al. (2019). Alone they let keypoints settle on whatever
helps to paint the image; the others tie them to one object that moves and make them follow it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from kpirl_ocp.perception.detector.keypoints import spatial_softmax


@dataclass(frozen=True)
class LossWeights:
    """Factors of the terms. All but the separation and the sparsity at zero: the published losses."""

    separation: float = 2.0
    repulsion: float = 2.0
    cohesion: float = 50.0
    sparsity: float = 5.0
    attention: float = 2.0
    appearance: float = 20.0
    equivariance: float = 5.0


def reconstruction(clips: Tensor, painted: Tensor) -> Tensor:
    """Half the squared error, summed over a frame and averaged over frames; clips (B, T, 3, S, S).

    Taken as if the frames were of the published 64 x 64 pixels, so that the other weights serve any size.
    """
    scale = (64 / clips.shape[-1]) ** 2
    return 0.5 * scale * (clips - painted).square().sum((2, 3, 4)).mean()


def separation(keypoints: Tensor, width: float = 0.1) -> Tensor:
    """Keypoints (B, T, K, 3) that move alike cost up to 1:  mean_{k != l} exp(-d_kl / (2 width^2)).

    d_kl is the mean over time of the squared distance between the centred paths of k and l.
    """
    position = keypoints[..., :2]
    paths = position - position.mean(1, keepdim=True)
    distance = (paths[:, :, :, None] - paths[:, :, None]).square().sum(-1).mean(1)  # (B, K, K)
    return _off_diagonal_mean(torch.exp(-distance / (2 * width**2)).mean(0))


def repulsion(keypoints: Tensor, width: float = 0.1) -> Tensor:
    """Keypoints (B, T, K, 3) in the same place cost up to 1:  mean_{k != l} mean_t exp(-|z_k - z_l|^2 / (2 width^2)).

    On an object that moves without turning all paths are alike wherever the keypoints are, so that `separation` alone
    lets them sit on one spot.
    """
    position = keypoints[..., :2]
    distance = (position[:, :, :, None] - position[:, :, None]).square().sum(-1)  # (B, T, K, K)
    return _off_diagonal_mean(torch.exp(-distance / (2 * width**2)).mean((0, 1)))


def cohesion(keypoints: Tensor, radius: float = 0.08) -> Tensor:
    """Distance of keypoints (B, T, K, 3) from their middle:  mean_k max(0, |z_k - mean_l z_l| - radius).

    They belong on one object; the arm that carries it moves too.
    """
    position = keypoints[..., :2]
    distance = torch.linalg.vector_norm(position - position.mean(-2, keepdim=True), dim=-1)
    return functional.relu(distance - radius).mean()


def _off_diagonal_mean(alike: Tensor) -> Tensor:
    """Mean over the pairs k != l of a matrix (K, K) with ones on its diagonal; 0 if there are no pairs."""
    count = len(alike)
    return (alike.sum() - count) / max(1, count * (count - 1))


def sparsity(scores: Tensor) -> Tensor:
    """Mean heat softplus(scores) of the cells (B, T, K, h, w)."""
    return functional.softplus(scores).mean()


def motion(clips: Tensor, cells: int) -> Tensor:
    """Motion per cell (B, T, cells, cells): |frame - median over time|, its largest value in a clip being 1."""
    change = (clips - clips.median(1, keepdim=True).values).abs().sum(2)  # (B, T, S, S)
    pooled = functional.adaptive_avg_pool2d(change, cells)
    return pooled / pooled.amax((1, 2, 3), keepdim=True).clamp_min(1e-3)


def attention(scores: Tensor, moving: Tensor) -> Tensor:
    """-log(1e-3 + sum_ij p_ij m_ij): keypoints belong to cells with motion m (B, T, cells, cells)."""
    return -torch.log(1e-3 + (spatial_softmax(scores) * moving[:, :, None]).sum((-2, -1))).mean()


def appearance(clips: Tensor, scores: Tensor) -> Tensor:
    """Variance over frames and clips of the colour under each keypoint, sum_ij p_ij colour_ij, summed over colours.

    Only the object is common to all clips; robot, gripper, hand and sleeve are not.
    """
    colours = functional.adaptive_avg_pool2d(clips.flatten(0, 1), scores.shape[-1]).unflatten(0, clips.shape[:2])
    under = torch.einsum("btkij,btcij->btkc", spatial_softmax(scores), colours)
    return under.flatten(0, 1).var(0, correction=0).sum(-1).mean()


def shifted(frames: Tensor, offset: Tensor) -> Tensor:
    """Frames (B, 3, S, S) moved by offset (B, 2) in image units, +x to the right, +y down; edges are continued."""
    identity = torch.eye(2, 3).to(frames).expand(len(frames), 2, 3).clone()
    identity[:, :, 2] = -offset
    grid = functional.affine_grid(identity, list(frames.shape), align_corners=False)
    return functional.grid_sample(frames, grid, padding_mode="border", align_corners=False)


def equivariance(moved: Tensor, keypoints: Tensor, offset: Tensor) -> Tensor:
    """L1 between keypoints (B, K, 3) of shifted frames and the shifted keypoints, where those are in the image."""
    target = keypoints[..., :2].detach() + offset[:, None]
    inside = (target.abs() < 1).all(-1, keepdim=True)
    return ((moved[..., :2] - target).abs() * inside).mean()
