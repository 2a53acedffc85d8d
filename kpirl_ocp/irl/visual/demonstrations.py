"""Demonstrations from detected keypoints: z_t are x and y of K keypoints, z_goal is the last of them.

A robot's own demonstration (paper, section 5.1) comes with its joints. A person's (section 5.2) does not: only the
displacements of the keypoints from the first frame are kept, and the robot starts from its own keypoints,

    z_demo,t = z_robot,0 + (z_person,t - z_person,0).

The third number of a keypoint, mu, is a confidence and no part of z.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.episodes import ArmTrack, KeypointTrack
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.types import Array, Demonstration, Mask

# A keypoint counts as moving if it moves at least this share of the distance of the one that moves farthest.
_MOVES = 0.5


def positions(keypoints: ArrayLike) -> Array:
    """z (..., 2 K) of keypoints (..., K, 3): x and y of the first, of the second, ..."""
    array = np.asarray(keypoints, float)
    return array[..., :2].reshape(*array.shape[:-2], -1)


def robot_demonstration(dynamics: NetworkDynamics, track: ArmTrack) -> Demonstration:
    """A demonstration by the robot itself: z (T+1, n_z) of the track, its first state, and its last z as the goal."""
    observations = positions(track.keypoints)
    start = dynamics.state(observations[0], track.joints[0], track.velocities[0])
    return Demonstration(start, observations[-1], observations)


def transferred_demonstration(
    dynamics: NetworkDynamics, track: KeypointTrack, keypoints: ArrayLike, joints: ArrayLike
) -> Demonstration:
    """A person's demonstration for a robot at rest.

    Args:
        keypoints: (K, 3) of the robot at its start.
        joints: (n_joints,) of the robot [rad].

    Raises:
        ProblemError: person and robot have different numbers of keypoints.
    """
    start, person = positions(keypoints), positions(track.keypoints)
    if start.shape != person[0].shape:
        raise ProblemError(f"the robot sees {len(start) // 2} keypoints, the demonstration has {len(person[0]) // 2}.")
    observations = start + person - person[0]
    return Demonstration(dynamics.state(start, joints), observations[-1], observations)


def moving_keypoints(demonstrations: Sequence[Demonstration]) -> Mask:
    """Mask (K,) of the keypoints that move in the demonstrations, by their mean way from first to last frame."""
    ways = [demo.observations[-1] - demo.observations[0] for demo in demonstrations]
    lengths = np.linalg.norm(np.reshape(ways, (len(ways), -1, 2)), axis=-1).mean(axis=0)
    return np.asarray(lengths >= _MOVES * lengths.max())
