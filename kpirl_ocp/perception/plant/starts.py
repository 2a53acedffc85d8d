"""Starts of the arm and goal of the bottle for a robot that is to repeat a person's placing motion.

Start 1 is near the person's start, start 2 nearer the goal. The goal is where the person's displacement takes the
bottle from start 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.plant.camera_plant import CameraPlant
from kpirl_ocp.perception.scene.posture import UPRIGHT, inverse_kinematics
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.types import Array

RATE = 1  # [Hz] of the robot, at which the shipped placing model was trained
_SPREAD, _TILT = 0.015, 0.05  # largest offset of the arm at a start [m], [rad]
_WAY_LEFT = 0.4  # of the way to the goal, at start 2


@dataclass(frozen=True, eq=False)
class PlacingStarts:
    """The two starts of the arm and the goal of the bottle.

    joints: (2, 7) [rad]. keypoints: (K, 3) detected at start 1.
    goal: (2,) where the middle of the bottle should end [pixels], known to the simulation only.
    """

    joints: Array
    keypoints: Array
    goal: Array


def placing_starts(detector: KeypointDetector, places: Array, rng: np.random.Generator) -> PlacingStarts:
    """Put the arm at both starts, and look once from the first.

    A start beyond the arm's reach is moved along x into it.

    Args:
        places: (T+1, 2) the middle of the bottle in the person's video [pixels].
        rng: draws the small offsets of the starts.

    Raises:
        SceneError: the arm reaches no place near a start.
    """
    with Scene(rate=RATE) as scene:
        end = scene.camera.in_plane(places[-1])
        points = [scene.camera.in_plane(places[0])]
        points.append(end + _WAY_LEFT * (points[0] - end))
        joints = [_posture(scene, point + rng.uniform(-_SPREAD, _SPREAD, 3), rng) for point in points]
        scene.reset(joints[0])
        plant = CameraPlant(scene, detector)
        keypoints = plant.look().keypoints
    return PlacingStarts(np.array(joints), keypoints, plant.places[0] + places[-1] - places[0])


def _posture(scene: Scene, point: Array, rng: np.random.Generator) -> Array:
    """Joints (7,) [rad] that hold the bottle at the point (3,) [m], or as little farther along x as the arm needs."""
    pitch = UPRIGHT + rng.uniform(-_TILT, _TILT)
    low, high = scene.joint_limits
    for farther in np.arange(0.0, 0.3, 0.005):
        try:
            theta = inverse_kinematics(point[0] + farther, point[2], pitch)
        except SceneError:
            continue
        if ((theta >= low) & (theta <= high)).all():
            return theta
    raise SceneError(f"the arm cannot hold the bottle at {point} m, nor farther along x.")
