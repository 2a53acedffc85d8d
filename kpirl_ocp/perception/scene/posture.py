"""The arm in the camera's plane: where joints 2, 4 and 6 carry the bottle, and which joints carry it there.

With the other joints at zero the iiwa is a planar arm of three links. With angles from the vertical

    a = theta_2,   b = a - theta_4,   pitch = b + theta_6,
    (x, z) = (0, 0.36) + 0.42 (sin a, cos a) + 0.40 (sin b, cos b) + 0.196 (sin pitch, cos pitch).

At pitch pi/2 the bottle is upright.
"""

from __future__ import annotations

import numpy as np

from kpirl_ocp.errors import SceneError
from kpirl_ocp.types import Array

UPRIGHT = np.pi / 2
_SHOULDER, _UPPER_ARM, _FOREARM, _HAND = 0.36, 0.42, 0.40, 0.196  # [m]


def inverse_kinematics(x: float, z: float, pitch: float = UPRIGHT) -> Array:
    """Joint positions (7,) [rad] that hold the bottle at (x, 0, z) [m], elbow up.

    Raises SceneError if the arm is too short or the place too near.
    """
    wrist = np.array([x, z - _SHOULDER]) - _HAND * np.array([np.sin(pitch), np.cos(pitch)])
    distance = np.hypot(*wrist)
    # Law of cosines for the angle between upper arm and forearm.
    bend = (distance**2 - _UPPER_ARM**2 - _FOREARM**2) / (2 * _UPPER_ARM * _FOREARM)
    if not abs(bend) <= 1:
        raise SceneError(f"the arm cannot hold the bottle at x = {x:g}, z = {z:g} m with pitch {pitch:g} rad.")
    elbow = np.arccos(bend)
    upper = np.arctan2(*wrist) - np.arctan2(_FOREARM * np.sin(elbow), _UPPER_ARM + _FOREARM * np.cos(elbow))
    return np.array([0.0, upper, 0.0, -elbow, 0.0, pitch - upper - elbow, 0.0])
