"""Small named problems for tests: those of `examples`, and what is known of them without the package.

The closed forms of the scalar LQR are written in numpy; `derivatives` asks CasADi directly.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Demonstration
from kpirl_ocp.irl.cases.examples import (
    CASES,
    Case,
    ScalarLQR,
    converging_descent,
    iiwa,
    integrator,
    lqr,
    pendulum,
    unconstrained,
)
from kpirl_ocp.ocp.models import Default, KeypointCost, Robot, Weighted, keypoint_ocp, keypoint_state

__all__ = [
    "CASES",
    "TABLE",
    "Case",
    "ScalarLQR",
    "converging_descent",
    "derivatives",
    "iiwa",
    "integrator",
    "limited_iiwa",
    "lqr",
    "lqr_gradient",
    "network",
    "nothing_to_learn",
    "pendulum",
    "quadratic",
    "swing_up",
    "unconstrained",
]


def response(data: ScalarLQR) -> tuple[np.ndarray, np.ndarray]:
    """F (T,) and G (T, T) of (s_1 .. s_T) = F s0 + G u."""
    times = np.arange(data.horizon)
    return data.a ** (times + 1.0), data.b * np.tril(data.a ** np.maximum(times[:, None] - times, 0.0))


def quadratic(data: ScalarLQR) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """H and g of J = u.H u / 2 + g.u + constant, and their derivatives by psi, (3, T, T) and (3, T)."""
    (F, G), T = response(data), data.horizon
    last = np.eye(T)[-1]
    dQ = np.array([np.diag(1 - last), np.zeros((T, T)), np.diag(last)])
    dR = np.array([0.0, 1.0, 0.0])[:, None, None] * np.eye(T)
    dH, dg = 2 * (G.T @ dQ @ G + dR), 2 * G.T @ (dQ @ F).T * data.s0
    return np.tensordot(data.psi, dH, 1), dg @ data.psi, dH, dg.T


def lqr_gradient(data: ScalarLQR, u: np.ndarray, du: np.ndarray) -> np.ndarray:
    """dL/dpsi for actions u (T,) whose derivative is du (3, T)."""
    F, G = response(data)
    return 2 * du @ G.T @ (F * data.s0 + G @ u - data.observed[1:, 0])


@lru_cache
def swing_up(horizon: int = 30) -> Case:
    """A pendulum from hanging to upright with too little torque to lift it slowly; psi = (mass [kg], target weight)."""
    dt, length = 0.1, 1.0
    s, u, psi, goal = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2), ca.SX.sym("goal")
    omega = s[1] + dt * (u / (psi[0] * length**2) - 9.81 / length * ca.sin(s[0]))
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=ca.vertcat(s[0] + dt * omega, omega),
        stage_cost=0.1 * psi[1] * (s[0] - goal) ** 2 + 0.01 * s[1] ** 2 + 0.05 * u**2,
        terminal_cost=10 * psi[1] * (s[0] - goal) ** 2 + s[1] ** 2,
        horizon=horizon,
        action_bounds=(-5.0, 5.0),
        state_bounds=([-np.inf, -6.0], [np.inf, 6.0]),
    )
    observed = np.linspace([0.0, 1.0], [3.0, 0.0], horizon + 1)
    return Case(problem, Demonstration(np.zeros(2), np.array([np.pi]), observed), np.array([0.8, 1.2]), 0.0, 0)


@lru_cache
def limited_iiwa(horizon: int = 6) -> Case:
    """The iiwa reaches beyond a joint limit, so that displacements and a joint end at their bounds."""
    robot, cost = Robot.iiwa(), KeypointCost(Weighted(), effort=0.05, learn_effort=True, positivity="softplus")
    problem = keypoint_ocp(robot, cost, horizon, max_displacement=0.08)
    theta = np.array([0.1, 0.4, 0.0, -1.9, 0.0, 0.6, 0.0])
    start, end = (keypoint_state(robot, theta + np.array([0.2, 0.1, 0, move, 0, 0.1, 0])) for move in (0.0, -0.6))
    observed = np.linspace(start, end, horizon + 1)[:, : problem.n_observations]
    psi = cost.initial(horizon, problem.n_observations, np.linspace(5.0, 20.0, problem.n_observations))
    return Case(problem, Demonstration(start, observed[-1], observed), psi, 0.0, 0)


ACTIVATIONS = {"tanh": ca.tanh, "softplus": lambda x: ca.fmax(x, 0) + ca.log1p(ca.exp(-ca.fabs(x)))}
ACTIVATIONS["relu"] = lambda x: ca.fmax(x, 0)


@lru_cache
def network(activation: str, horizon: int = 8) -> Case:
    """Keypoint dynamics of a random network: s = (4 coordinates, 3 joints, 3 velocities), u moves the joints."""
    rng = np.random.default_rng(3)
    sizes = (13, 20, 8, 4)
    weights = [rng.normal(size=(m, n)) / np.sqrt(n) for n, m in pairwise(sizes)]
    biases = [0.1 * rng.normal(size=n) for n in sizes[1:]]
    s, u, psi, goal = ca.MX.sym("s", 10), ca.MX.sym("u", 3), ca.MX.sym("psi", 5), ca.MX.sym("goal", 4)
    x = ca.vertcat(s, u)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = ACTIVATIONS[activation](ca.DM(weight) @ x + ca.DM(bias))
    moved = s[:4] + 0.5 * (ca.DM(weights[-1]) @ x + ca.DM(biases[-1]))
    distance = ca.sum1(psi[:4] ** 2 * (s[:4] - goal) ** 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=ca.vertcat(moved, s[4:7] + u, s[7:]),
        stage_cost=distance + psi[4] ** 2 * ca.sumsqr(u),
        terminal_cost=distance,
        horizon=horizon,
        action_bounds=(-0.3, 0.3),
        state_bounds=(np.repeat([-np.inf, -1.03, -np.inf], [4, 3, 3]), np.repeat([np.inf, 1.03, np.inf], [4, 3, 3])),
    )
    demonstration = Demonstration(0.3 * rng.normal(size=10), rng.normal(size=4), rng.normal(size=(horizon + 1, 10)))
    return Case(problem, demonstration, np.array([1.0, 0.8, 1.2, 0.9, 1.1]), 0.0, 0)


TABLE = CASES | {
    "swing-up": swing_up,
    "iiwa at a limit": limited_iiwa,
    "tanh network": lambda: network("tanh"),
    "softplus network": lambda: network("softplus"),
}


@lru_cache
def nothing_to_learn() -> Case:
    """The iiwa with the Default cost: psi is empty."""
    problem = keypoint_ocp(Robot.iiwa(), KeypointCost(Default(), effort=0.5), 5).unconstrained()
    return Case(problem, iiwa().demonstration, np.zeros(0), 0.012, 2000)


def derivatives(case: Case, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """At actions: Hessian of the cost J(u), d2J/du dpsi (n, n_psi), dL/du (n,), partial dL/dpsi; by CasADi alone."""
    problem, demonstration = case.problem, case.demonstration
    u, psi = ca.MX.sym("u", actions.size), ca.MX.sym("psi", problem.n_parameters)
    U = ca.reshape(u, problem.n_actions, problem.horizon)
    states = problem.rollout(demonstration.s0, U, psi, demonstration.context)
    slope = ca.gradient(problem.cost(states, U, psi, demonstration.context), u)
    loss = ca.sumsqr(problem.observe(states) - demonstration.observations.T)
    outputs = [ca.jacobian(slope, u), ca.jacobian(slope, psi), ca.gradient(loss, u), ca.gradient(loss, psi)]
    H, C, dL, direct = map(np.array, ca.Function("derivatives", [u, psi], outputs)(actions.ravel(), case.psi))
    return H, C, dL.ravel(), direct.ravel()
