"""Whether an arm can follow a path in its camera's image at all, and if not, which motion its joints do not allow."""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.irl.cases.cost_files import ArmSetting
from kpirl_ocp.irl.cases.tasks import tracking_problem
from kpirl_ocp.irl.visual.camera_learning import path_distance
from kpirl_ocp.ocp.models.keypoint_problems import visible_keypoints
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Demonstration

_OUT_OF_REACH = 0.1  # largest path distance of the arm's best path from the demonstration
_SHOWN = 0.1  # a motion is part of the demonstration if it makes up this share of the way
_HARDLY = 0.1  # a motion is not possible below this share of the best motion's pixels per radian
_ACROSS = 0.3  # share of a motion that may be left out when it is composed of singular vectors


def check_reach(setting: ArmSetting, robot: Robot, demonstration: Demonstration) -> float:
    """The path distance of the arm's best plan from the demonstration. Raises DemonstrationError if it is too large."""
    n_z = demonstration.observations.shape[1]
    tracker = tracking_problem(robot, demonstration.horizon, setting.unit, setting.camera)
    theta = demonstration.s0[n_z : n_z + robot.n_joints]
    plan = Riccati(tolerance=1e-9).solve(tracker, theta, (), demonstration.observations[1:].ravel())
    found = np.array([setting.state(robot, at)[:n_z] for at in plan.states])
    distance = path_distance(found, demonstration.observations)
    if not plan.status.ok or distance > _OUT_OF_REACH:
        raise DemonstrationError(
            f"the arm cannot follow this path: at best it is off by {distance:.0%} of the way. "
            f"{_remedy(setting, robot, theta, demonstration.observations)}"
        )
    return distance


def _remedy(setting: ArmSetting, robot: Robot, theta: Array, observations: Array) -> str:
    missing = " and ".join(impossible_motions(setting, robot, theta, observations))
    if not missing:
        return "Choose a smaller scale, or a shorter part of the film."
    return (
        f"The object moves {missing} in the image, which the arm's {robot.n_joints} joints hardly allow at its start. "
        "Choose another arm or link that holds the object (--robot, --flange), or a part of the film without it."
    )


def impossible_motions(setting: ArmSetting, robot: Robot, theta: Array, observations: Array) -> list[str]:
    """Motions in the image that a demonstration (T+1, 2 K) shows and the joints at theta (n_joints,) [rad] hardly make.

    Of "sideways", "up or down" and "in a turn" those for which a radian of the joints moves the keypoints less than a
    tenth as far as their best motion does, or turns them by less than a tenth of a radian.
    """
    places, jacobian = _image_jacobian(setting, robot, theta)
    directions, sizes, _ = np.linalg.svd(jacobian, full_matrices=False)
    best = {"in a turn": np.linalg.norm(places - places.mean(axis=0))}
    ways = observations - observations[0]
    longest = np.linalg.norm(ways, axis=1).max()
    return [
        name
        for name, motion in _motions(places).items()
        if np.abs(ways @ motion).max() > _SHOWN * longest
        and _mobility(motion, directions, sizes) < _HARDLY * best.get(name, sizes[0])
    ]


def _mobility(motion: Array, directions: Array, sizes: Array) -> float:
    """Pixels per radian of a motion (2 K,), from the image Jacobian's left singular vectors and its singular values.

    The singular value of the last of the vectors that are needed to make up the motion; 0 if all are too few.
    """
    left = 1 - np.cumsum((motion @ directions) ** 2)  # of the motion's squared norm, after each vector
    enough = np.flatnonzero(left < _ACROSS**2)
    return float(sizes[enough[0]]) if len(enough) else 0.0


def _motions(places: Array) -> dict[str, Array]:
    """Rigid motions in the image of keypoints at places (K, 2), as unit vectors (2 K,); one point has no turn."""
    arms = places - places.mean(axis=0)
    turn = np.column_stack([-arms[:, 1], arms[:, 0]])
    motions = {"sideways": np.tile([1.0, 0.0], len(arms)), "up or down": np.tile([0.0, 1.0], len(arms))}
    if turn.any():
        motions["in a turn"] = turn.ravel()
    return {name: motion / np.linalg.norm(motion) for name, motion in motions.items()}


def _image_jacobian(setting: ArmSetting, robot: Robot, theta: Array) -> tuple[Array, Array]:
    """Keypoints (K, 2) [pixels] at theta, and their derivative (2 K, n_joints)."""
    symbol = ca.SX.sym("theta", robot.n_joints)
    pixels = visible_keypoints(robot, setting.camera, symbol)
    places, jacobian = ca.Function("pixels", [symbol], [pixels, ca.jacobian(pixels, symbol)])(theta)
    return dense(places).reshape(-1, 2), dense(jacobian)
