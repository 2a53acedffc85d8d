"""From heatmaps to keypoints and back (Minderer et al., Unsupervised Learning of Object Structure, 2019).

A keypoint is (x, y, mu): x to the right and y down, from -1 to 1 across the image, and mu in [0, 1], how sure it is.
The centre of cell i of n is at (2 i + 1) / n - 1.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kpirl_ocp.types import Array


def to_pixels(keypoints: ArrayLike, size: int) -> Array:
    """Positions (..., 2) in pixels of a square image from x and y of keypoints (..., 2 or 3)."""
    return (np.asarray(keypoints, float)[..., :2] + 1) / 2 * size


def centres(count: int) -> Tensor:
    """Coordinates (count,) of the cells along one axis."""
    return (2 * torch.arange(count) + 1) / count - 1


def expectation(heat: Tensor) -> Tensor:
    """Keypoints (..., K, 3) of positive heatmaps (..., K, h, w).

    x = sum_ij p_ij x_j with p = heat / sum heat, and mu_k = mean(heat_k) / max_l mean(heat_l).
    """
    height, width = heat.shape[-2:]
    total = heat.sum((-2, -1)).clamp_min(1e-12)
    x = (heat.sum(-2) * centres(width)).sum(-1) / total
    y = (heat.sum(-1) * centres(height)).sum(-1) / total
    return torch.stack([x, y, total / total.amax(-1, keepdim=True)], -1)


def sharpened(heat: Tensor, radius: int = 2) -> Tensor:
    """Keypoints as by `expectation`, but x and y from the cells within `radius` of the peak only."""
    height, width = heat.shape[-2:]
    peak = heat.flatten(-2).argmax(-1)  # (..., K)
    near_x = (torch.arange(width) - (peak % width)[..., None]).abs() <= radius  # (..., K, w)
    near_y = (torch.arange(height) - (peak // width)[..., None]).abs() <= radius
    window = heat * (near_y[..., :, None] & near_x[..., None, :])
    return torch.cat([expectation(window)[..., :2], expectation(heat)[..., 2:]], -1)


def gaussian_maps(keypoints: Tensor, cells: int, width: float = 1.5) -> Tensor:
    """Maps (..., K, cells, cells): mu exp(-d^2 / (2 width^2)), d in cells from the keypoints (..., K, 3)."""
    x, y, mu = keypoints.unbind(-1)
    scale = cells / 2 / width  # from image units to standard deviations
    along_x = torch.exp(-0.5 * ((centres(cells) - x[..., None]) * scale) ** 2)
    along_y = torch.exp(-0.5 * ((centres(cells) - y[..., None]) * scale) ** 2)
    return mu[..., None, None] * along_y[..., :, None] * along_x[..., None, :]
