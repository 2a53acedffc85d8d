"""Dynamic movement primitives, learned from several demonstrations (Ijspeert et al., 2013, as Hoffmann et al., 2009).

    tau v' = K (g - y) - D v - K (g - y_0) x + K f(x),    tau y' = v,    tau x' = -alpha x,    D = 2 sqrt(K)

f(x) = x sum_j psi_j(x) w_j / sum_j psi_j(x) is fitted to all demonstrations at once, by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.types import Array

_DECAY = 4.0  # alpha: x falls to 0.02 within one duration
_STIFFNESS = 150.0  # K, per squared duration
_SUBSTEPS = 20  # of the integration, per step of the path
_RANK = 1e-8  # singular values below this share of the largest are of kernels that the samples do not tell apart


@dataclass(frozen=True, eq=False)
class MovementPrimitive:
    """weights: w (J, n), one row per kernel."""

    weights: Array

    @classmethod
    def fit(cls, paths: Sequence[Array], kernels: int) -> MovementPrimitive:
        """To paths (T+1, n) that all take one unit of time; each ends at its own goal.

        Raises ProblemError for no paths, or fewer than one kernel.
        """
        if not paths or kernels < 1:
            raise ProblemError(f"a primitive needs paths and at least one kernel, got {len(paths)} and {kernels}.")
        rows, forces = [], []
        for path in paths:
            time = np.linspace(0.0, 1.0, len(path))
            velocity = np.gradient(path, time, axis=0)
            acceleration = np.gradient(velocity, time, axis=0)
            x = np.exp(-_DECAY * time)
            spring = path[-1] - path - (path[-1] - path[0]) * x[:, None]
            rows.append(_features(x, kernels))
            forces.append((acceleration + 2 * np.sqrt(_STIFFNESS) * velocity) / _STIFFNESS - spring)
        weights, *_ = np.linalg.lstsq(np.vstack(rows), np.vstack(forces), rcond=_RANK)
        return cls(weights)

    def run(self, start: Array, goal: Array, steps: int) -> Array:
        """The path (steps + 1, n) from start at rest towards goal, in one unit of time, by semi-implicit Euler."""
        dt = 1.0 / (steps * _SUBSTEPS)
        x = np.exp(-_DECAY * dt * np.arange(steps * _SUBSTEPS))
        forces = _features(x, len(self.weights)) @ self.weights
        y, v, path = np.array(start, float), np.zeros_like(start, float), [np.array(start, float)]
        for k, force in enumerate(forces):
            acceleration = _STIFFNESS * (goal - y - (goal - start) * x[k] + force) - 2 * np.sqrt(_STIFFNESS) * v
            v = v + dt * acceleration
            y = y + dt * v
            if (k + 1) % _SUBSTEPS == 0:
                path.append(y)
        return np.array(path)


def _features(x: Array, kernels: int) -> Array:
    """x psi_j(x) / sum psi (len(x), J); kernels are evenly spaced in time and overlap at half their height."""
    centres = np.linspace(0.0, 1.0, kernels)
    width = centres[1] / 2 if kernels > 1 else 1.0
    time = -np.log(x) / _DECAY
    heights = np.exp(-np.log(2.0) * ((time[:, None] - centres) / width) ** 2)
    return x[:, None] * heights / heights.sum(axis=1, keepdims=True)
