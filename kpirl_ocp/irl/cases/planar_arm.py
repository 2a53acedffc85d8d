"""Learned dynamics of an arm that moves in the camera's plane only, as in the paper's experiments (appendix A.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics

HELD_JOINTS = (0, 2, 4, 6)  # joints 1, 3, 5 and 7 hardly move in the training data


def planar_dynamics(card: str | Path) -> NetworkDynamics:
    """The dynamics of a model card for plans that move joints 2, 4 and 6 only.

    Raises:
        ModelError: a file is missing or malformed (`load_dynamics`).
    """
    return without_joints(load_dynamics(card), HELD_JOINTS)


def without_joints(dynamics: NetworkDynamics, joints: Sequence[int]) -> NetworkDynamics:
    """The model with no influence of these joints on the keypoints, so that no plan moves them.

    For joints that hardly moved in the training data: the network has learned their tiny motions, scaled up to unit
    variance, and a planner would follow it far out of the data.
    """
    offsets = [dynamics.n_z + block * dynamics.n_joints for block in range(3)]  # theta, theta_dot, u
    columns = [offset + joint for offset in offsets for joint in joints]
    first = dynamics.mlp.weights[0].copy()
    first[:, columns] = 0.0
    return replace(dynamics, mlp=replace(dynamics.mlp, weights=(first, *dynamics.mlp.weights[1:])))
