"""The keypoint detector: an autoencoder for clips whose bottleneck is K keypoints per frame.

    frame_t -> encoder -> scores -> keypoints z_t -> Gaussian maps -> decoder -> frame_0 + predicted change

The decoder also sees features and maps of the first frame, so that the keypoints need to encode changes only
(Minderer et al., 2019). The encoder is a small ResNet-18 with group normalisation (paper, A.1), or plain convolutions.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.perception.detector.keypoints import cell_centres, gaussian_maps, soft_argmax

EncoderKind = Literal["resnet", "plain"]
STRIDE = 4  # image pixels per heatmap cell


class Encoded(NamedTuple):
    """features (B, F, h, w), scores (B, K, h, w) of cells and keypoints (B, K, 3) of B frames."""

    features: Tensor
    scores: Tensor
    keypoints: Tensor


class BasicBlock(nn.Module):
    """relu(norm(conv(relu(norm(conv x)))) + x), the block of ResNet-18 (He et al., 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = _convolution(inputs, outputs, stride)
        self.second = nn.Sequential(nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), _norm(outputs))
        same = inputs == outputs and stride == 1
        self.skip = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1, bias=False)
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, outputs, h / stride, w / stride)."""
        # Not a convolution with a stride: its weights' gradient writes past its workspace when channels are few
        # (oneDNN issue 6035, in torch up to 2.13 at least).
        picked = x[:, :, :: self.stride, :: self.stride]
        return functional.relu(self.second(self.first(x)) + self.skip(picked))


def encoder(kind: EncoderKind, filters: int) -> nn.Sequential:
    """(B, 5, S, S), colours and coordinates -> features (B, 2 filters, S / 4, S / 4)."""
    if kind == "resnet":
        return nn.Sequential(
            _convolution(5, filters, stride=2),
            BasicBlock(filters, filters),
            BasicBlock(filters, filters),
            BasicBlock(filters, 2 * filters, stride=2),
            BasicBlock(2 * filters, 2 * filters),
            BasicBlock(2 * filters, 2 * filters),
            BasicBlock(2 * filters, 2 * filters),
        )
    return nn.Sequential(
        _convolution(5, filters),
        _convolution(filters, filters, stride=2),
        _convolution(filters, filters),
        _convolution(filters, 2 * filters, stride=2),
        _convolution(2 * filters, 2 * filters),
        _convolution(2 * filters, 2 * filters),
    )


class KeypointAutoencoder(nn.Module):
    """Encoder and decoder for frames of size S x S, S a multiple of 4.

    keypoints: K. filters: channels of the first layer.
    """

    def __init__(self, size: int, keypoints: int = 4, kind: EncoderKind = "resnet", filters: int = 16) -> None:
        super().__init__()
        if size % STRIDE:
            raise ProblemError(f"the image size must be a multiple of {STRIDE}, got {size}.")
        self.architecture = {"size": size, "keypoints": keypoints, "encoder": kind, "filters": filters}
        self.cells = size // STRIDE
        self.encoder = encoder(kind, filters)
        self.head = nn.Conv2d(2 * filters, keypoints, 1)
        self.decoder = nn.Sequential(
            _convolution(2 * filters + 2 * keypoints + 2, 2 * filters),
            _convolution(2 * filters, 2 * filters),
            nn.Upsample(scale_factor=2, mode="bilinear"),
            _convolution(2 * filters, filters),
            nn.Upsample(scale_factor=2, mode="bilinear"),
            _convolution(filters, filters),
            nn.Conv2d(filters, 3, 3, padding=1),
        )

    def encode(self, frames: Tensor) -> Encoded:
        """Features, scores and keypoints of frames (B, 3, S, S) with values in [0, 1]."""
        features = self.encoder(_concatenated(frames - 0.5, _coordinates(frames)))
        scores = self.head(features)
        return Encoded(features, scores, soft_argmax(scores))

    def forward(self, clips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Clips (B, T, 3, S, S) -> reconstruction (B, T, 3, S, S), keypoints (B, T, K, 3), scores (B, T, K, h, w)."""
        batch, steps = clips.shape[:2]
        features, scores, keypoints = self.encode(clips.flatten(0, 1))
        maps = gaussian_maps(keypoints, self.cells)

        def first(x: Tensor) -> Tensor:
            return x.unflatten(0, (batch, steps))[:, :1].expand(-1, steps, -1, -1, -1).flatten(0, 1)

        change = self.decoder(_concatenated(first(features), first(maps), maps, _coordinates(maps)))
        painted = clips[:, :1] + change.unflatten(0, (batch, steps))
        return painted, keypoints.unflatten(0, (batch, steps)), scores.unflatten(0, (batch, steps))


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), _norm(outputs), nn.ReLU())


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(max(1, channels // 8), channels)


def _concatenated(*images: Tensor) -> Tensor:
    """Along the channels, which come last in memory, as convolutions on a CPU like it."""
    return torch.cat(images, 1).contiguous(memory_format=torch.channels_last)


def _coordinates(images: Tensor) -> Tensor:
    """x and y of every pixel (B, 2, h, w)."""
    count, _, height, width = images.shape
    x, y = cell_centres(width).expand(height, width), cell_centres(height)[:, None].expand(height, width)
    return torch.stack([x, y]).to(images).expand(count, 2, height, width)
