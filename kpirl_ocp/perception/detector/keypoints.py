"""From scores of image cells to keypoints and back (Minderer et al., Unsupervised Learning of Object Structure, 2019).

A keypoint is (x, y, mu): x to the right and y down, from -1 to 1 across the image, and a confidence mu in [0, 1].
The centre of cell i of n is at (2 i + 1) / n - 1.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from kpirl_ocp.types import Array


def to_pixels(keypoints: ArrayLike, size: int) -> Array:
    """Positions (..., 2) in pixels of a square image from x and y of keypoints (..., 2 or 3)."""
    return (np.asarray(keypoints, float)[..., :2] + 1) / 2 * size


def cell_centres(count: int) -> Tensor:
    """Coordinates (count,) of the cells along one axis."""
    return (2 * torch.arange(count) + 1) / count - 1


def spatial_softmax(scores: Tensor) -> Tensor:
    """Distribution p (..., h, w) of a keypoint over the cells: the softmax of scores (..., h, w)."""
    return scores.flatten(-2).softmax(-1).unflatten(-1, scores.shape[-2:])


def soft_argmax(scores: Tensor) -> Tensor:
    """Keypoints (..., K, 3) of scores (..., K, h, w).

    (x, y) is the mean under `spatial_softmax`, and mu_k = heat_k / max_l heat_l with heat = mean of softplus(scores).
    """
    heat = functional.softplus(scores).mean((-2, -1))
    return torch.cat([_mean_place(spatial_softmax(scores)), (heat / heat.amax(-1, keepdim=True))[..., None]], -1)


def local_soft_argmax(scores: Tensor, radius: int = 2) -> Tensor:
    """Keypoints as by `soft_argmax`, with x and y from the cells within `radius` of the peak only."""
    height, width = scores.shape[-2:]
    peak = scores.flatten(-2).argmax(-1)  # (..., K)
    columns, rows = torch.arange(width, device=peak.device), torch.arange(height, device=peak.device)
    near_x = (columns - (peak % width)[..., None]).abs() <= radius  # (..., K, w)
    near_y = (rows - (peak // width)[..., None]).abs() <= radius
    near = near_y[..., :, None] & near_x[..., None, :]
    place = _mean_place(spatial_softmax(scores.masked_fill(~near, -torch.inf)))
    return torch.cat([place, soft_argmax(scores)[..., 2:]], -1)


def _mean_place(probability: Tensor) -> Tensor:
    height, width = probability.shape[-2:]
    x = (probability.sum(-2) * cell_centres(width).to(probability)).sum(-1)
    y = (probability.sum(-1) * cell_centres(height).to(probability)).sum(-1)
    return torch.stack([x, y], -1)


def gaussian_maps(keypoints: Tensor, cells: int, width: float = 1.5) -> Tensor:
    """Maps (..., K, cells, cells): mu exp(-d^2 / (2 width^2)), d in cells from the keypoints (..., K, 3)."""
    x, y, mu = keypoints.unbind(-1)
    scale = cells / 2 / width  # from image units to standard deviations
    centres = cell_centres(cells).to(x)
    along_x = torch.exp(-0.5 * ((centres - x[..., None]) * scale) ** 2)
    along_y = torch.exp(-0.5 * ((centres - y[..., None]) * scale) ** 2)
    return mu[..., None, None] * along_y[..., :, None] * along_x[..., None, :]
