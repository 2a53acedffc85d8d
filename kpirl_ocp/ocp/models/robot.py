"""Symbolic forward kinematics of an arm, built from its Pinocchio model.

The `pin` wheels carry no `pinocchio.casadi`, so the chain of transforms is written down here from the joint
placements and axes of the `pin.Model` (Featherstone, Rigid Body Dynamics Algorithms, section 4):

    oM_i = oM_parent(i) * placement_i * J_i(theta_i),   J_i a rotation about, or a translation along, a fixed axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
import pinocchio as pin

from kpirl_ocp.assets import iiwa_urdf
from kpirl_ocp.errors import RobotError
from kpirl_ocp.ocp.models.robot_files import CONTINUOUS, MIMIC, example_urdf, link_names, read_urdf, tool_link
from kpirl_ocp.ocp.problem.guards import dense

# Corners of a held object in its link's frame [m]: the bottom of a bottle and two points at its shoulder.
_OBJECT = ((0.0, 0.0, 0.10), (0.06, 0.0, 0.22), (0.0, 0.06, 0.22))


@dataclass(frozen=True)
class Keypoint:
    """A point fixed to a link.

    link: name of the link.
    position: (3,) [m] in the link's frame.
    """

    link: str
    position: tuple[float, float, float]


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """An arm with keypoints on it: joint positions theta (n_joints,) [rad or m] to keypoints (n_keypoints, 3) [m].

    Joint positions are Pinocchio's tangent coordinates: a continuous joint is one angle, not (cos, sin).
    Build it with `from_urdf`, `iiwa` or `from_example_data`.
    """

    model: pin.Model
    keypoints: tuple[Keypoint, ...]

    def __repr__(self) -> str:
        links = ", ".join(dict.fromkeys(keypoint.link for keypoint in self.keypoints))
        return f"<Robot {self.model.name}: {self.n_joints} joints, {self.n_keypoints} keypoints on {links}>"

    @classmethod
    def from_urdf(cls, path: str | Path, keypoints: Mapping[str, object] | tuple[Keypoint, ...] = ()) -> Robot:
        """Read a URDF; `keypoints` are `Keypoint`s, or a mapping from link name to points (n, 3) [m].

        Without keypoints the tool holds an object with three of them, not on one line. The tool is the link that is
        named so (tool0, tcp, end_effector and the like) or the only one at the end of the joints. Joints that mimic
        another one follow it and have no coordinate.

        Raises:
            RobotError: the file cannot be read, no joint moves, one has no range or an unknown type, a keypoint names
                a missing link, or there are none and several links could be the tool.
        """
        model = read_urdf(Path(path))
        robot = cls(model, _as_keypoints(keypoints) or held_object(tool_link(model)))
        for keypoint in robot.keypoints:
            robot.frame_id(keypoint.link)
        return robot

    @classmethod
    def iiwa(cls, keypoints: Mapping[str, object] | tuple[Keypoint, ...] = ()) -> Robot:
        """The KUKA LBR iiwa 14."""
        return cls.from_urdf(iiwa_urdf(), keypoints)

    @classmethod
    def from_example_data(cls, name: str, keypoints: Mapping[str, object] | tuple[Keypoint, ...] = ()) -> Robot:
        """An arm of the package example-robot-data (extra `robots`) by name, e.g. "panda" or "ur5"."""
        return cls.from_urdf(example_urdf(name), keypoints)

    @property
    def n_joints(self) -> int:
        """Number of joint coordinates."""
        return self.model.nv

    @property
    def n_keypoints(self) -> int:
        """Number of keypoints."""
        return len(self.keypoints)

    @cached_property
    def joint_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper joint positions of the URDF, each (n_joints,); infinite for continuous joints."""
        lower, upper = np.full(self.n_joints, -np.inf), np.full(self.n_joints, np.inf)
        for joint in list(self.model.joints)[1:]:
            if joint.shortname() not in (*CONTINUOUS, MIMIC):
                lower[joint.idx_v] = self.model.lowerPositionLimit[joint.idx_q]
                upper[joint.idx_v] = self.model.upperPositionLimit[joint.idx_q]
        return lower, upper

    def frame_id(self, link: str) -> int:
        """Index of a link in the Pinocchio model. Raises RobotError, listing the links, if there is none."""
        if not self.model.existFrame(link, pin.FrameType.BODY):
            links = ", ".join(link_names(self.model))
            raise RobotError(f"the robot {self.model.name!r} has no link {link!r}; its links are: {links}.")
        return self.model.getFrameId(link, pin.FrameType.BODY)

    def configuration(self, theta: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration q (nq,) of the joint positions theta (n_joints,)."""
        return pin.integrate(self.model, pin.neutral(self.model), np.asarray(theta, float))

    @cached_property
    def keypoint_function(self) -> ca.Function:
        """theta (n_joints,) -> keypoints (3 * n_keypoints,) [m], ordered x0 y0 z0 x1 ...; expanded to SX."""
        theta = ca.SX.sym("theta", self.n_joints)
        joints = _joint_placements(self.model, theta)
        points = []
        for keypoint in self.keypoints:
            frame = self.model.frames[self.frame_id(keypoint.link)]
            rotation, translation = joints[frame.parentJoint]
            local = frame.placement.act(np.array(keypoint.position))
            points.append(translation + rotation @ local)
        return ca.Function("keypoints", [theta], [ca.vertcat(*points)], ["theta"], ["z"])

    def link_function(self, link: str) -> ca.Function:
        """theta (n_joints,) -> rotation (3, 3) and translation (3,) [m] of a link in the world frame."""
        theta = ca.SX.sym("theta", self.n_joints)
        frame = self.model.frames[self.frame_id(link)]
        rotation, translation = _joint_placements(self.model, theta)[frame.parentJoint]
        outputs = [rotation @ frame.placement.rotation, translation + rotation @ frame.placement.translation]
        return ca.Function("link", [theta], outputs, ["theta"], ["rotation", "translation"])

    def locate(self, theta: np.ndarray) -> np.ndarray:
        """Keypoints (n_keypoints, 3) [m] at the joint positions theta (n_joints,)."""
        return dense(self.keypoint_function(theta)).reshape(self.n_keypoints, 3)

    def skeleton(self, theta: np.ndarray) -> np.ndarray:
        """Origins (n_joints + 1, 3) [m] of the base and all joints, for drawing."""
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.configuration(theta))
        return np.array([placement.translation for placement in data.oMi])


def _joint_placements(model: pin.Model, theta: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
    """World rotation (3, 3) and translation (3,) of every joint frame, the universe first."""
    placements = [(ca.SX.eye(3), ca.SX.zeros(3))]
    for index, motion in enumerate(_joint_motions(model), start=1):
        fixed, position = model.jointPlacements[index], motion.scaling * theta[motion.coordinate] + motion.offset
        parent_rotation, parent_translation = placements[model.parents[index]]
        rotation = parent_rotation @ fixed.rotation
        translation = parent_translation + parent_rotation @ fixed.translation
        if np.any(motion.linear):
            translation = translation + rotation @ (motion.linear * position)
        else:
            rotation = rotation @ _rotation_about(motion.angular, position)
        placements.append((rotation, translation))
    return placements


def _rotation_about(axis: np.ndarray, angle: ca.SX) -> ca.SX:
    """Rodrigues' formula R = I + sin(a) [n]x + (1 - cos(a)) [n]x^2 for a unit axis n (3,)."""
    cross = ca.sparsify(ca.DM(pin.skew(axis)))
    outer = ca.sparsify(ca.DM(np.outer(axis, axis)))
    return outer + ca.cos(angle) * (ca.DM.eye(3) - outer) + ca.sin(angle) * cross


class _JointMotion(NamedTuple):
    """An axis (3,) of translation or of rotation, the other zero; position = scaling theta[coordinate] + offset."""

    linear: np.ndarray
    angular: np.ndarray
    coordinate: int
    scaling: float
    offset: float


def _joint_motions(model: pin.Model) -> list[_JointMotion]:
    """The motion of every joint in its own frame; that of a mimic joint by the coordinate of the joint it follows."""
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))  # sets the subspaces of mimic joints
    motions = []
    for joint, subspace in list(zip(model.joints, (joint.S for joint in data.joints), strict=True))[1:]:
        mimic = joint.extract() if joint.shortname() == MIMIC else None
        scaling, offset = (mimic.scaling, mimic.offset) if mimic else (1.0, 0.0)
        linear, angular = np.split(np.array(subspace).ravel() / scaling + 0.0, 2)
        motions.append(_JointMotion(linear, angular, joint.idx_v, scaling, offset))
    return motions


def _as_keypoints(keypoints: Mapping[str, object] | tuple[Keypoint, ...]) -> tuple[Keypoint, ...]:
    pairs = keypoints.items() if isinstance(keypoints, Mapping) else [(k.link, k.position) for k in keypoints]
    return tuple(Keypoint(link, (x, y, z)) for link, points in pairs for x, y, z in _as_points(link, points))


def _as_points(link: str, points: object) -> list[list[float]]:
    try:
        array = np.atleast_2d(np.asarray(points, float))  # (n, 3)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise RobotError(f"keypoints of link {link!r} must be finite points (n, 3) [m], got {points!r}.")
    return array.tolist()


def held_object(link: str) -> tuple[Keypoint, ...]:
    """Three keypoints on an object in a link, not on one line: the bottom of a bottle and two at its shoulder."""
    return tuple(Keypoint(link, position) for position in _OBJECT)
