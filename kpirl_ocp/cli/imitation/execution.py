"""A plan, executed in the scene: every step commands what is missing to the planned joint positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.cli.imitation.arm import Arm
from kpirl_ocp.errors import DemonstrationError, SceneError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.visual.camera_learning import camera_demonstration, path_distance, plan_from
from kpirl_ocp.irl.visual.reach import check_reach
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.scene.scene import PHYSICS_RATE, Scene
from kpirl_ocp.types import Array

_RATES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 24, 30)  # [Hz] that the scene keeps
ALLOWED = 0.1  # relative distance from the demonstration that an execution may have
_FILM_RATE = 10  # of a film, at least, if the steps take longer [Hz]
_SPEED = 0.35  # of the fastest joint, so that the motors keep up [rad/s]


@dataclass(frozen=True, eq=False)
class Executed:
    """One execution from one start.

    keypoints, wanted: (T+1, K, 2) where the arm's keypoints came, and where the demonstration has them [pixels].
    planned: path distance of the plan to the demonstration. reached: that of the execution. rate: [Hz] of the steps.
    images: (T+1, H, W, 3) of the scene's camera. postures: (m T + 1, n_joints) [rad] for a film, m a step.
    """

    keypoints: Array
    wanted: Array
    planned: float
    reached: float
    rate: int
    images: Frames
    postures: Array

    @property
    def film_rate(self) -> float:
        """Postures a second [Hz]."""
        return self.rate * (len(self.postures) - 1) / (len(self.images) - 1)


def execute(arm: Arm, learned: LearnedCost, displacements: Array, start: Array) -> Executed:
    """Plan with the learned cost from a start (n_joints,) [rad], and follow the plan.

    displacements: (T+1, K, 2) of the demonstration [pixels].

    Raises:
        SolveError: there is no plan from this start.
        SceneError: a step is too large for any rate of the scene.
    """
    setting, robot = learned.setting, arm.robot
    demonstration = camera_demonstration(setting, robot, start, displacements)
    n_z = demonstration.observations.shape[1]
    plan = plan_from(learned, robot, start)
    joints = plan.states[:, n_z : n_z + robot.n_joints]
    rate = _rate_for(plan.actions)
    with arm.scene(rate) as scene:
        postures, images = [scene.reset(start).positions], [scene.render().rgb]
        for target in joints[1:]:
            postures += _step(scene, target - postures[-1])
            images.append(scene.render().rgb)
    keypoints = arm.keypoints(postures[:: (len(postures) - 1) // (len(images) - 1)])
    seen = keypoints.reshape(len(images), -1) / setting.unit
    return Executed(
        keypoints=keypoints,
        wanted=setting.unit * demonstration.observations.reshape(len(images), -1, 2),
        planned=path_distance(plan.states[:, :n_z], demonstration.observations),
        reached=path_distance(seen, demonstration.observations),
        rate=rate,
        images=np.array(images),
        postures=np.array(postures),
    )


def _step(scene: Scene, u: Array) -> list[Array]:
    """`scene.step(u)`; the joint positions at regular times on its way, with those at its end."""
    ticks = max(n for n in range(1, PHYSICS_RATE // _FILM_RATE + 1) if scene.ticks % n == 0)
    scene.command(u)
    passed = []
    for _ in range(scene.ticks // ticks):
        for _ in range(ticks):
            scene.tick()
        passed.append(scene.measure().positions)
    return passed


def _rate_for(actions: Array) -> int:
    """The fastest rate [Hz] at which the motors keep up with actions (T, n_joints) [rad]."""
    largest = float(np.abs(actions).max())
    slow_enough = [rate for rate in _RATES if largest * rate <= _SPEED]
    if not slow_enough:
        raise SceneError(f"a step of {largest:.2f} rad takes the arm more than a second: plan more steps (--steps).")
    return slow_enough[-1]


def shortfall(arm: Arm, displacements: Array, start: Array, run: Executed, *, reused: bool) -> str:
    """The reason why an execution stays far from the demonstration (arm, cost or motors), and what to do about it.

    displacements, start: as in `execute`. reused: the cost was not learned from this demonstration.
    """
    try:
        best = check_reach(arm.setting, arm.robot, camera_demonstration(arm.setting, arm.robot, start, displacements))
    except DemonstrationError as error:
        return str(error)
    if run.planned >= ALLOWED:
        remedy = (
            "it was learned from something else, and this film may show another motion: learn from this one, without "
            "--cost"
            if reused
            else "learn longer (--iterations) if it used them all, or from a shorter part of the film (--start, --end)"
        )
        return (
            f"the arm could follow the path to within {best:.1%} of the way, the plan of the cost is off by "
            f"{run.planned:.1%}: {remedy}."
        )
    remedy = "learn a cost of more steps (--steps, without --cost)" if reused else "plan more steps (--steps)"
    return f"the plan is off the path by {run.planned:.1%} of the way, and the motors do not keep up with it: {remedy}."
