"""Speed profiles and paths of human motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.types import Array


def minimum_jerk(times: ArrayLike) -> Array:
    """Progress 10 t^3 - 15 t^4 + 6 t^5 at times in [0, 1] (Flash and Hogan, 1985)."""
    t = np.asarray(times, np.float64)
    return t**3 * (10 - 15 * t + 6 * t**2)


def forward_then_down(forward: float, down: float, times: ArrayLike) -> Array:
    """Displacement (n, 3) at times (n,) in [0, 1]: `forward` along x in the first half, then `down` along -z."""
    halves = np.clip(2 * np.asarray(times, np.float64)[:, None] - np.array([0, 1]), 0, 1)
    along = minimum_jerk(halves)
    return np.column_stack([forward * along[:, 0], np.zeros(len(halves)), -down * along[:, 1]])
