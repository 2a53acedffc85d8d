"""The scene: an iiwa that holds a bottle in front of a shelf, in front of one fixed camera (PyBullet, no window).

The arm is not an ideal integrator. `step(u)` commands the measured position plus u and lets the motors follow for one
period, with limited gain and velocity, so that the executed motion falls short of the commanded one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.scene.bodies import BOTTLE, FLANGE, write_arm_with_bottle
from kpirl_ocp.perception.scene.bullet import pybullet
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.perception.scene.world import World
from kpirl_ocp.types import Array

PHYSICS_RATE = 240  # [Hz]


@dataclass(frozen=True)
class Motors:
    """Position control of the joints.

    position_gain, velocity_gain: of PyBullet's position control. velocity_limit: [rad/s].
    ideal: jump to the commanded position instead, for tests.
    """

    position_gain: float = 0.1
    velocity_gain: float = 1.0
    velocity_limit: float = 0.5
    ideal: bool = False


@dataclass(frozen=True)
class JointState:
    """Measured joint positions (7,) [rad] and velocities (7,) [rad/s]."""

    positions: Array
    velocities: Array


@dataclass
class Scene(World):
    """The simulated robot; use it in a `with` block. The same commands give the same motion and frames.

    rate: [Hz] of `step`; a divisor of 240.
    arm: URDF of the arm, None for the iiwa. flange: its link that holds the bottle.
    joints: names of the joints that move, in the order of theta; None for all.
    """

    motors: Motors = field(default_factory=Motors)
    rate: int = 5
    arm: Path | None = None
    flange: str = FLANGE
    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.rate < 1 or PHYSICS_RATE % self.rate:
            raise SceneError(f"rate must divide the {PHYSICS_RATE} Hz of the simulation, got {self.rate!r}.")

    def __enter__(self) -> Scene:
        super().__enter__()
        self._client.setGravity(0.0, 0.0, -9.81)
        self._client.setTimeStep(1 / PHYSICS_RATE)
        self.urdf = write_arm_with_bottle(self._directory, self.arm, self.flange)
        self._arm = self._load(self.urdf)
        infos = [self._client.getJointInfo(self._arm, i) for i in range(self._client.getNumJoints(self._arm))]
        self._links = {info[12].decode(): info[0] for info in infos}
        moving = {i[1].decode(): i for i in infos if i[2] in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)}
        chosen = [moving[name] for name in self.joints] if self.joints else list(moving.values())
        self._joints = [info[0] for info in chosen]
        lower, upper = (np.array([info[side] for info in chosen]) for side in (8, 9))
        endless = lower > upper  # a continuous joint
        self.joint_limits = np.where(endless, -np.inf, lower), np.where(endless, np.inf, upper)
        self.reset(np.clip(np.zeros(len(chosen)), *self.joint_limits))
        return self

    def reset(self, theta: ArrayLike) -> JointState:
        """Put the arm at rest at theta (7,) [rad]. Raises SceneError outside the joint limits."""
        positions = self._checked("theta", theta)
        lower, upper = self.joint_limits
        if ((positions < lower) | (positions > upper)).any():
            raise SceneError(f"theta must be within the joint limits {lower} .. {upper}, got {positions}.")
        for joint, position in zip(self._joints, positions, strict=True):
            self._client.resetJointState(self._arm, joint, position, 0.0)
        return self.measure()

    @property
    def ticks(self) -> int:
        """Of the physics in one period."""
        return PHYSICS_RATE // self.rate

    def step(self, u: ArrayLike) -> JointState:
        """Command the measured joint positions plus u (7,) [rad], at most to the limits, and wait one period."""
        self.command(u)
        for _ in range(self.ticks):
            self.tick()
        return self.measure()

    def command(self, u: ArrayLike) -> None:
        """Set the motors' targets: the measured joint positions plus u (7,) [rad], at most to the limits."""
        target = np.clip(self.measure().positions + self._checked("u", u), *self.joint_limits)
        if self.motors.ideal:
            self.reset(target)
            return
        for joint, position in zip(self._joints, target, strict=True):
            self._client.setJointMotorControl2(
                self._arm,
                joint,
                pybullet.POSITION_CONTROL,
                targetPosition=position,
                positionGain=self.motors.position_gain,
                velocityGain=self.motors.velocity_gain,
                maxVelocity=self.motors.velocity_limit,
            )

    def tick(self) -> None:
        """Let 1/240 s pass; the motors follow their targets."""
        if not self.motors.ideal:
            self._client.stepSimulation()

    def measure(self) -> JointState:
        """Joint positions and velocities as the encoders see them."""
        states = self._client.getJointStates(self._arm, self._joints)
        return JointState(np.array([state[0] for state in states]), np.array([state[1] for state in states]))

    def link_pose(self, link: str) -> tuple[Array, Array]:
        """World rotation (3, 3) and position (3,) [m] of a link's frame. Raises SceneError for an unknown link."""
        if link not in self._links:
            raise SceneError(f"the scene's arm has no link {link!r}; its links are: {', '.join(self._links)}.")
        state = self._client.getLinkState(self._arm, self._links[link], computeForwardKinematics=True)
        rotation = self._client.getMatrixFromQuaternion(state[5])
        return np.array(rotation).reshape(3, 3), np.array(state[4])

    def render(self) -> Frame:
        """The camera's present image."""
        return self._render(self._arm, self._links[BOTTLE], self.link_pose(BOTTLE)[1])

    def _checked(self, name: str, values: ArrayLike) -> Array:
        array = np.asarray(values, float)
        if array.shape != (len(self._joints),) or not np.isfinite(array).all():
            raise SceneError(f"{name} must be {len(self._joints)} finite numbers [rad], got {values!r}.")
        return array
