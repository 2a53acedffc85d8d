"""Where an arm and its keypoints are along a plan: what every viewer draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.types import Array


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """The motion of an arm over time.

    skeletons: (T+1, n, 3) the base, all joints, and the middle of the keypoints [m], one after the other.
    keypoints: (T+1, K, 3) [m]. times: (T+1,) [s].
    """

    skeletons: Array
    keypoints: Array
    times: Array

    @classmethod
    def of(cls, robot: Robot, joints: ArrayLike, rate: float) -> ArmMotion:
        """Of joint positions (T+1, n_joints) [rad] at `rate` [Hz]. Raises ProblemError for another shape."""
        theta = np.asarray(joints, float)
        if theta.ndim != 2 or theta.shape[1] != robot.n_joints or not len(theta) or not np.isfinite(theta).all():
            raise ProblemError(f"joints must be finite and (T+1, {robot.n_joints}), got {theta.shape}.")
        if not rate > 0:
            raise ProblemError(f"rate must be positive [Hz], got {rate!r}.")
        keypoints = np.array([robot.locate(row) for row in theta])
        skeletons = [np.vstack([robot.skeleton(row), k.mean(axis=0)]) for row, k in zip(theta, keypoints, strict=True)]
        return cls(np.array(skeletons), keypoints, np.arange(len(theta)) / rate)

    def box(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) [m] of all that is ever reached, the floor included."""
        points = np.concatenate([self.skeletons.reshape(-1, 3), self.keypoints.reshape(-1, 3), np.zeros((1, 3))])
        return points.min(axis=0), points.max(axis=0)
