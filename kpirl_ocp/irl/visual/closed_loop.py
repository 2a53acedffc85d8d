"""From a learned cost to motion: plan once and execute the plan, or plan again after every image (MPC).

    u  <-  u' + plan(s_t | u') - plan(s'_t | u')

Here plan(s | u') minimises the remaining cost from state s, starting at the remaining plan u'; s_t = (z_t, theta_t,
theta_dot_t) is the measured state, and s'_t the one that the model predicted. Only the prediction error changes the
plan. For a converged solver plan(s'_t | u') = u' (Bellman), so that the right-hand side is plan(s_t | u'). With N
gradient steps it is not: N more steps from a plan that took N would move farther than was learned, even without any
prediction error.

Keypoints of low confidence (mu) are replaced by those that the model predicts.
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
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Sight, Solution, Trajectory


class Plant(Protocol):
    """The robot and its camera, or a simulation of them."""

    def look(self) -> Sight:
        """Detect keypoints and measure the joints."""
        ...

    def act(self, u: Array) -> None:
        """Command joint displacements u (n_joints,) [rad] and wait one period."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Execution(Brief):
    """Record of a motion.

    keypoints: (T+1, K, 3) detected. joints: (T+1, n_joints) measured [rad]. actions: (T, n_joints) commanded [rad].
    believed: (T+1, n_z) keypoints used for planning: the detected ones, or predicted ones where mu was too low.
    plans: the solutions from measured states, one in open loop, T in closed loop.
    """

    keypoints: Array
    joints: Array
    actions: Array
    believed: Array
    plans: tuple[Solution, ...]

    @property
    def tracking_error(self) -> float:
        """Root mean square difference of commanded and executed joint displacements, per step and joint [rad]."""
        return float(np.sqrt(np.mean((np.diff(self.joints, axis=0) - self.actions) ** 2)))


@dataclass(frozen=True, eq=False)
class KeypointController:
    """Plans with a learned cost.

    cost: its horizon T is the number of actions. closed_loop: plan again after every image.
    confidence: predicted keypoints replace the detected ones while the mu of any keypoint is below this share of its
        first one; an occlusion also draws away neighbouring keypoints, whose own mu stays high.
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
        return cls(planning_problem(dynamics, cost.horizon, cost.limits), dynamics, cost, closed_loop, confidence)

    def plan(
        self, state: Array, goal: Array, steps_taken: int = 0, guess: Solution | Trajectory | None = None
    ) -> Solution:
        """The plan from state (n_s,) to the goal (n_z,) with the remaining cost after `steps_taken`."""
        cost = self.cost.after(steps_taken)
        return cost.solver.solve(self.problem, state, cost.psi, goal, guess)

    def run(self, plant: Plant, goal: ArrayLike) -> Execution:
        """Take T steps towards the keypoints goal (n_z,) [half an image].

        Raises:
            ProblemError: the goal does not fit the keypoints.
        """
        goal = np.asarray(goal, float).ravel()
        sights = [plant.look()]
        believed = [positions(sights[0].keypoints)]
        if goal.shape != believed[0].shape:
            raise ProblemError(f"the goal must be ({len(believed[0])},), got {goal.shape}.")
        plans = [self.plan(self._state(sights[0], believed[0]), goal)]
        remaining, actions = plans[0].actions, []
        for step in range(1, self.cost.horizon + 1):
            actions.append(remaining[0])
            expected = self._predict(self._state(sights[-1], believed[-1]), remaining[0])
            plant.act(remaining[0])
            sights.append(plant.look())
            believed.append(self._believe(sights, expected[: self.dynamics.n_z]))
            remaining = np.vstack([remaining[1:], np.zeros_like(remaining[:1])])
            if self.closed_loop and step < self.cost.horizon:
                state = self._state(sights[-1], believed[-1])
                measured, predicted = (self._plan_on(start, remaining, goal, step) for start in (state, expected))
                plans.append(measured)
                remaining = remaining + measured.actions - predicted.actions
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
        return dense(self.problem.transition(state, u, self.cost.psi)).ravel()

    def _plan_on(self, state: Array, remaining: Array, goal: Array, steps_taken: int) -> Solution:
        """plan(state | remaining)."""
        return self.plan(state, goal, steps_taken, self.problem.simulate(state, remaining, self.cost.psi))

    def _believe(self, sights: list[Sight], expected: Array) -> Array:
        """The detected keypoints (n_z,), or the expected ones where mu is too low."""
        first, last = sights[0].keypoints, sights[-1].keypoints
        sure = bool(np.all(last[:, 2] >= self.confidence * first[:, 2]))
        return positions(last) if sure else expected
