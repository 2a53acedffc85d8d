"""Joint paths for the robot to follow, with the bottle in the camera's image and above the shelf."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.scene.bodies import BOTTLE
from kpirl_ocp.perception.scene.posture import UPRIGHT, inverse_kinematics
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.types import Array

# Where the bottle may be in the plane of the camera [m, m, rad]: above the shelf and well inside the image.
_NEAR, _FAR = np.array([0.50, 0.42, -0.3]), np.array([0.76, 0.72, 0.3])
IN_PLANE = np.array([False, True, False, True, False, True, False])  # joints 2, 4 and 6
_MARGIN = 25.0  # least distance of the middle of the bottle from the image's edge [pixels]
SHELF = 0.415  # height of the middle of a bottle that stands on the shelf [m]


def random_posture(rng: np.random.Generator) -> Array:
    """A posture (7,) [rad] with the bottle somewhere in front of the camera."""
    x, z, tilt = rng.uniform(_NEAR, _FAR)
    return inverse_kinematics(x, z, UPRIGHT + tilt)


def carried(path: Array, pitch: float) -> Array:
    """Postures (n, 7) [rad] along a path (n, 3) [m] of the bottle in the plane."""
    return np.array([inverse_kinematics(x, z, pitch) for x, _, z in path])


def sine(
    rng: np.random.Generator, count: int, rate: int, amplitude: tuple[float, float], frequency: tuple[float, float]
) -> Array:
    """A sine (count,) [rad] of random amplitude [rad], frequency [Hz] and phase."""
    times = np.arange(count) / rate
    return rng.uniform(*amplitude) * np.sin(2 * np.pi * (rng.uniform(*frequency) * times + rng.uniform()))


def first_visible(scene: Scene, draw: Callable[[], Array]) -> Array:
    """The first drawn reference (n, 7) [rad] within the joint limits, with the bottle in the image, above the shelf."""
    low, high = scene.joint_limits
    size = np.array([scene.camera.width, scene.camera.height])
    for _ in range(1000):
        try:
            reference = draw()
        except SceneError:
            continue  # out of reach
        if ((reference >= low) & (reference <= high)).all():
            positions = np.array([_position(scene, theta) for theta in reference])
            places = scene.camera.project(positions)
            if ((places > _MARGIN) & (places < size - _MARGIN)).all() and (positions[:, 2] > SHELF - 1e-3).all():
                return reference
    raise SceneError("no motion with the bottle in the image was found in 1000 draws: use smaller amplitudes.")


def _position(scene: Scene, theta: Array) -> Array:
    """Position of the bottle (3,) [m] with the arm at theta (7,) [rad]."""
    scene.reset(theta)
    return scene.link_pose(BOTTLE)[1]
