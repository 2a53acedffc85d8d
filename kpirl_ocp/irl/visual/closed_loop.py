"""From a learned cost to motion: plan once and play the plan, or plan again after every look (MPC).

    u  <-  u' + plan(s_t | u') - plan(s'_t | u')

plans with what is left of the cost, from what is left of the plan, u'; s_t = (z_t, theta_t, theta_dot_t) is as seen and
measured, s'_t as the model expected it. Only what was not expected changes the plan. For a converged solver
plan(s'_t | u') = u' (Bellman), which leaves plan(s_t | u'). But N gradient steps more, on a plan of N gradient steps,
go farther than was learned, even where all went as planned.

A keypoint that the detector is not sure of (mu) is replaced by where the model expects it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.visual.demonstrations import positions
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Sight, Solution, Trajectory


class Plant(Protocol):
    """The robot and its camera, or something that stands for them."""

    def look(self) -> Sight:
        """See and measure."""
        ...

    def act(self, u: Array) -> None:
        """Command joint displacements u (n_joints,) [rad] and wait one period."""
        ...


@dataclass(frozen=True, eq=False)
class Execution:
    """What happened.

    keypoints: (T+1, K, 3) as seen. joints: (T+1, n_joints) as measured. actions: (T, n_joints) as commanded.
    believed: (T+1, n_z) keypoints that were planned from; the detected ones, unless mu was too low.
    plans: the solutions from what was seen, one if the loop was open, T if it was closed.
    """

    keypoints: Array
    joints: Array
    actions: Array
    believed: Array
    plans: tuple[Solution, ...]

    @property
    def tracking_error(self) -> float:
        """Root mean square of what the joints moved less than they were told, per step and joint [rad]."""
        return float(np.sqrt(np.mean((np.diff(self.joints, axis=0) - self.actions) ** 2)))


@dataclass(frozen=True, eq=False)
class KeypointController:
    """Plans with a learned cost.

    cost: its horizon T is the number of actions. closed_loop: plan again after every look.
    confidence: the model's prediction replaces what is seen while the mu of any keypoint is below this share of its
        first one: what hides a keypoint draws others along, whose own mu stays high.
    """

    problem: OCP
    dynamics: NetworkDynamics
    cost: PlanningCost
    closed_loop: bool = True
    confidence: float = 0.0

    @classmethod
    def build(
        cls, dynamics: NetworkDynamics, cost: PlanningCost, closed_loop: bool = True, confidence: float = 0.0
    ) -> KeypointController:
        """A controller with the problem that it needs."""
        return cls(planning_problem(dynamics, cost.horizon), dynamics, cost, closed_loop, confidence)

    def plan(
        self, state: Array, goal: Array, steps_taken: int = 0, guess: Solution | Trajectory | None = None
    ) -> Solution:
        """The plan from state (n_s,) with what is left of the cost after `steps_taken`."""
        cost = self.cost.after(steps_taken)
        return cost.solver.solve(self.problem, state, cost.psi, goal, guess)

    def run(self, plant: Plant, goal: ArrayLike) -> Execution:
        """T steps towards the keypoints goal (n_z,). Raises ProblemError if the goal does not fit the keypoints."""
        goal = np.asarray(goal, float).ravel()
        sights = [plant.look()]
        believed = [positions(sights[0].keypoints)]
        if goal.shape != believed[0].shape:
            raise ProblemError(f"the goal must be ({len(believed[0])},), got {goal.shape}.")
        plans = [self.plan(self._state(sights[0], believed[0]), goal)]
        left, actions = plans[0].actions, []
        for step in range(1, self.cost.horizon + 1):
            actions.append(left[0])
            expected = self._predict(self._state(sights[-1], believed[-1]), left[0])
            plant.act(left[0])
            sights.append(plant.look())
            believed.append(self._believe(sights, expected[: self.dynamics.n_z]))
            left = np.vstack([left[1:], np.zeros_like(left[:1])])
            if self.closed_loop and step < self.cost.horizon:
                state = self._state(sights[-1], believed[-1])
                seen, foreseen = (self._plan_on(start, left, goal, step) for start in (state, expected))
                plans.append(seen)
                left = left + seen.actions - foreseen.actions
        return Execution(
            keypoints=np.array([sight.keypoints for sight in sights]),
            joints=np.array([sight.joints for sight in sights]),
            actions=np.array(actions),
            believed=np.array(believed),
            plans=tuple(plans),
        )

    def _state(self, sight: Sight, keypoints: Array) -> Array:
        return self.dynamics.state(keypoints, sight.joints, sight.velocities)

    def _predict(self, state: Array, u: Array) -> Array:
        """The state (n_s,) that the model expects after u."""
        return np.array(self.problem.transition(state, u, self.cost.psi)).ravel()

    def _plan_on(self, state: Array, left: Array, goal: Array, steps_taken: int) -> Solution:
        """plan(state | left)."""
        return self.plan(state, goal, steps_taken, self.problem.simulate(state, left, self.cost.psi))

    def _believe(self, sights: list[Sight], expected: Array) -> Array:
        """The keypoints (n_z,) as seen, or as expected where mu is too low."""
        first, last = sights[0].keypoints, sights[-1].keypoints
        sure = bool(np.all(last[:, 2] >= self.confidence * first[:, 2]))
        return positions(last) if sure else expected
