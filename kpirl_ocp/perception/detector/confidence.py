"""The confidence mu in absolute terms: 0.9 for a typical frame with the object, 0.1 for a typical one without.

    mu_k = 1 / (1 + exp(-(s_k - c_k) / w_k)),    s_k = largest score of keypoint k over the cells

The frames without the object are made from the clips themselves: the median over a clip in which it moves away from
wherever it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.types import Array

_LOGIT = float(np.log(9.0))  # of 0.9


@dataclass(frozen=True, eq=False)
class Confidence:
    """c and w of every keypoint, each (K,)."""

    centre: Array
    width: Array

    def of(self, scores: Tensor) -> Tensor:
        """mu (n, K) of scores (n, K, h, w)."""
        peak = scores.flatten(-2).amax(-1)
        centre, width = (torch.from_numpy(value).to(peak) for value in (self.centre, self.width))
        return torch.sigmoid((peak - centre) / width)

    def as_card(self) -> dict[str, list[float]]:
        """For the card of a detector."""
        return {"centre": self.centre.tolist(), "width": self.width.tolist()}


def calibrate(peaks_with: Array, peaks_without: Array) -> Confidence:
    """The confidence for largest scores (n, K) of frames with the object and (m, K) of frames without.

    Raises TrainingError if a keypoint scores no higher where the object is.
    """
    high, low = np.median(peaks_with, axis=0), np.median(peaks_without, axis=0)
    blind = np.flatnonzero(high <= low)
    if len(blind):
        raise TrainingError(f"keypoint {blind[0]} scores as high without the object as with it: train longer.")
    return Confidence((high + low) / 2, (high - low) / (2 * _LOGIT))


def without_object(clips: Sequence[Frames]) -> Frames:
    """One frame (H, W, 3) per clip (n, H, W, 3): the median over time, from which whatever moves about is gone."""
    return np.array([np.median(clip, axis=0) for clip in clips], np.uint8)
