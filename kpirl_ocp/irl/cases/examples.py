"""Small named problems with a demonstration and psi each; built once, so that compiled functions are shared.

Use: `lqr()`, `integrator()`, `pendulum()`, `iiwa()`, or `CASES["lqr"]()`; `unconstrained(case)` drops the constraints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, Weighted
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp, keypoint_state
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.types import Demonstration


@dataclass(frozen=True, eq=False)
class Case:
    """A problem with a demonstration, and parameters at which to differentiate it.

    psi: (n_psi,) where to differentiate; away from the demonstration, so that no gradient vanishes.
    step_size, steps: of a gradient descent that converges to rounding on the problem without state constraints.
    """

    problem: OCP
    demonstration: Demonstration
    psi: np.ndarray
    step_size: float
    steps: int


@dataclass(frozen=True)
class ScalarLQR:
    """s_{t+1} = a s_t + b u_t,  J = sum_{t<T} (q s_t^2 + r u_t^2) + w s_T^2,  psi = (q, r, w)."""

    a: float = 0.9
    b: float = 0.5
    s0: float = 2.0
    horizon: int = 6
    psi: tuple[float, float, float] = (1.3, 0.7, 2.1)

    @property
    def observed(self) -> np.ndarray:
        """(T+1, 1): a demonstration that decays faster than the plan."""
        return self.s0 * 0.4 ** np.arange(self.horizon + 1.0)[:, None]


@lru_cache
def lqr(data: ScalarLQR = ScalarLQR()) -> Case:
    """The scalar LQR as an OCP that observes the state."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi", 3)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=data.a * s + data.b * u,
        stage_cost=psi[0] * s**2 + psi[1] * u**2,
        terminal_cost=psi[2] * s**2,
        horizon=data.horizon,
    )
    return Case(problem, Demonstration(np.array([data.s0]), np.zeros(0), data.observed), np.array(data.psi), 0.17, 150)


@lru_cache
def integrator() -> Case:
    """A mass (position, velocity) driven by a force, psi = (tracking weight, target offset, power limit).

    Bounds on force and velocity and the limit psi_2 on the power u v are all active somewhere, strictly.
    """
    dt, s, u = 0.2, ca.SX.sym("s", 2), ca.SX.sym("u")
    psi, goal = ca.SX.sym("psi", 3), ca.SX.sym("goal")
    distance = (s[0] - goal - psi[1]) ** 2
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=ca.vertcat(s[0] + dt * s[1] + dt**2 / 2 * u, s[1] + dt * u),
        stage_cost=psi[0] * distance + 0.05 * s[1] ** 2 + 0.2 * u**2,
        terminal_cost=5 * psi[0] * distance + 0.5 * s[1] ** 2,
        path_constraint=u * s[1] - psi[2],
        action_bounds=(-1.0, 1.0),
        state_bounds=([-np.inf, -0.6], [np.inf, 0.6]),
        horizon=12,
    )
    times = np.linspace(0.0, 1.0, 13)
    observed = np.column_stack([times, np.sin(np.pi * times) / 2])
    return Case(problem, Demonstration(np.zeros(2), np.ones(1), observed), np.array([1.2, 0.15, 0.3]), 0.11, 700)


@lru_cache
def pendulum() -> Case:
    """A torque-driven pendulum of unknown mass and length, psi = (m [kg], l [m]); semi-implicit Euler, 0.05 s."""
    dt, gravity = 0.05, 9.81
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    mass, length = psi[0], psi[1]
    omega = s[1] + dt * (u / (mass * length**2) - gravity / length * ca.sin(s[0]))
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=ca.vertcat(s[0] + dt * omega, omega),
        stage_cost=(s[0] - 1) ** 2 + 0.1 * s[1] ** 2 + 0.5 * u**2,
        terminal_cost=5 * (s[0] - 1) ** 2,
        horizon=20,
    )
    observed = problem.simulate([0.3, 0.0], np.full((20, 1), 1.5), [0.8, 0.6]).states
    return Case(problem, Demonstration(np.array([0.3, 0.0]), np.zeros(0), observed), np.array([1.0, 0.5]), 0.5, 80)


@lru_cache
def iiwa(effort: float = 0.5) -> Case:
    """The iiwa reaches for a pose with three keypoints at its flange; psi = (9 weights, effort) before softplus.

    Joint limits are far away; the demonstration moves at most 0.08 rad a step too, so some displacements are at it.
    """
    horizon, robot = 5, Robot.iiwa()
    cost = KeypointCost(Weighted(), effort=effort, learn_effort=effort > 0, positivity="softplus")
    problem = keypoint_ocp(robot, cost, horizon, max_displacement=0.08, joint_limits=False)
    theta = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.6, 0.0])
    reach = np.array([0.3, 0.3, 0.0, 0.3, 0.0, 0.0, 0.0])
    states = [keypoint_state(robot, theta + share * reach) for share in np.linspace(0, 1, horizon + 1)]
    observed = np.array(states)[:, : problem.n_observations]
    weights = np.linspace(0.5, 2.0, problem.n_observations)
    psi = cost.initial(horizon, problem.n_observations, weights)
    return Case(problem, Demonstration(states[0], observed[-1], observed), psi, 0.012, 2500)


CASES = {"lqr": lqr, "integrator": integrator, "pendulum": pendulum, "iiwa": iiwa}


@lru_cache
def unconstrained(case: Case) -> Case:
    """A case without its bounds and path constraints."""
    return replace(case, problem=case.problem.unconstrained())


def converging_descent(case: Case, steps: int | None = None) -> GradientDescent:
    """Gradient descent for the case: a converged one, or a given number of steps."""
    return GradientDescent(steps or case.steps, case.step_size, project=case.problem.has_action_bounds)
