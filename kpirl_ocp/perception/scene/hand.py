"""A person's demonstration: a hand, made of simple shapes, carries the bottle past the camera; there is no robot.

The path has a person's speed profile (minimum jerk) and a small tremor: a slow wander of the hand, normally distributed
and smoothed over a tenth of a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpirl_ocp.errors import SceneError
from kpirl_ocp.motion import forward_then_down, minimum_jerk
from kpirl_ocp.perception.scene.bodies import write_hand_with_bottle
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.perception.scene.world import World
from kpirl_ocp.types import Array

RATE = 30.0  # [Hz] of the paper's human demonstrations


@dataclass
class HandScene(World):
    """The scene with a hand in the place of the robot; use it in a `with` block."""

    def __enter__(self) -> HandScene:
        super().__enter__()
        self._bottle = self._load(write_hand_with_bottle(self._directory))
        return self

    def look(self, position: ArrayLike) -> Frame:
        """The frame with the bottle, upright, at position (3,) [m]."""
        place = np.asarray(position, float)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise SceneError(f"position must be three finite numbers [m], got {position!r}.")
        self._client.resetBasePositionAndOrientation(self._bottle, place.tolist(), (0.0, 0.0, 0.0, 1.0))
        return self._render(self._bottle, -1, place)

    def film(self, path: ArrayLike) -> NDArray[np.uint8]:
        """Frames (n, H, W, 3) along a path (n, 3) [m] of the bottle."""
        return np.array([self.look(position).rgb for position in np.asarray(path, float)])


def placing_path(rng: np.random.Generator, *, seconds: float = 2.0, rate: float = RATE, tremor: float = 1e-3) -> Array:
    """Path (n, 3) [m] of the bottle onto the shelf: along x, then down, from a random start.

    seconds: duration; 2 s at 5 Hz are the paper's ten steps. tremor: standard deviation of the wander [m].
    """
    times = np.linspace(0, 1, round(seconds * rate) + 1)
    forward, down = rng.uniform(0.15, 0.22), rng.uniform(0.10, 0.15)
    # The bottle comes to stand on the board: its foot is 0.105 m below its frame, the board's top at 0.31 m.
    end = np.array([rng.uniform(0.66, 0.72), 0.0, 0.31 + 0.105])
    return _trembling(end - [forward, 0.0, -down] + forward_then_down(forward, down, times), rng, rate, tremor)


def wandering_path(
    rng: np.random.Generator, *, seconds: float = 4.0, rate: float = RATE, tremor: float = 1e-3
) -> Array:
    """Path (n, 3) [m] of a bottle that is carried about in front of the camera, to a new random place every second."""
    places = rng.uniform([0.40, 0.0, 0.42], [0.75, 0.0, 0.74], (max(1, round(seconds)) + 1, 3))
    times = np.linspace(0, len(places) - 1, round(seconds * rate) + 1)
    leg = np.minimum(times.astype(int), len(places) - 2)
    progress = minimum_jerk(times - leg)[:, None]
    return _trembling(places[leg] + progress * (places[leg + 1] - places[leg]), rng, rate, tremor)


def _trembling(path: Array, rng: np.random.Generator, rate: float, tremor: float) -> Array:
    """The path (n, 3) [m] with smoothed noise of standard deviation `tremor` [m]."""
    window = max(1, round(0.1 * rate))
    noise = rng.normal(0.0, tremor * np.sqrt(window), (len(path) + window - 1, 3))
    kernel = np.full(window, 1 / window)
    return path + np.column_stack([np.convolve(noise[:, axis], kernel, mode="valid") for axis in range(3)])
