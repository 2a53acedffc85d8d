"""A pinhole camera in a plan: keypoints of a robot's kinematics as pixels, where no dynamics have to be learned.

p ~ K (R x + t)
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import numbers
from kpirl_ocp.types import Array


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera that stands still.

    intrinsics: K (3, 3) [pixels]. rotation, translation: R (3, 3) and t (3,) [m], from the world to the camera, which
    looks along its z axis, x to the right and y down.
    """

    intrinsics: Array
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        for name, shape in (("intrinsics", (3, 3)), ("rotation", (3, 3)), ("translation", (3,))):
            value = numbers(f"the camera's {name}", getattr(self, name))
            if value.shape != shape or not np.isfinite(value).all():
                raise ProblemError(f"the camera's {name} must be {shape} finite numbers, got {value.tolist()}.")
            object.__setattr__(self, name, value)

    def project(self, points: ca.SX | ca.DM) -> ca.SX | ca.DM:
        """Pixels x0 y0 x1 y1 ... (2 K,) of points x0 y0 z0 x1 ... (3 K,) [m]; they must be in front of the camera."""
        points = ca.reshape(points, 3, -1)
        in_camera = ca.mtimes(ca.DM(self.rotation), points) + ca.repmat(ca.DM(self.translation), 1, points.size2())
        image = ca.mtimes(ca.DM(self.intrinsics), in_camera)
        return ca.vec(image[:2, :] / ca.vertcat(image[2, :], image[2, :]))
