"""Small named problems for tests: those of `kpirl_ocp.irl.examples`, and what is known of them without the package.

The closed forms of the scalar LQR are written in numpy; `derivatives` asks CasADi directly.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp import Default, KeypointCost, Robot, keypoint_ocp
from kpirl_ocp.irl.examples import CASES, Case, ScalarLQR, descent, free, iiwa, integrator, lqr, pendulum

__all__ = [
    "CASES",
    "Case",
    "ScalarLQR",
    "derivatives",
    "descent",
    "free",
    "iiwa",
    "integrator",
    "lqr",
    "lqr_gradient",
    "nothing_to_learn",
    "pendulum",
    "quadratic",
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
def nothing_to_learn() -> Case:
    """The iiwa with the Default cost: psi is empty."""
    problem = keypoint_ocp(Robot.iiwa(), KeypointCost(Default(), effort=0.5), 5).unconstrained()
    return Case(problem, iiwa().demonstration, np.zeros(0), 0.012, 2000)


def derivatives(case: Case, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """At actions: Hessian of the cost J(u), d2J/du dpsi (n, n_psi), dL/du (n,), partial dL/dpsi; by CasADi alone."""
    problem, demonstration = case.problem, case.demonstration
    u, psi = ca.MX.sym("u", actions.size), ca.MX.sym("psi", problem.n_parameters)
    U = ca.reshape(u, problem.n_actions, problem.horizon)
    states = problem.rollout(demonstration.s0, U, psi)
    slope = ca.gradient(problem.cost(states, U, psi, demonstration.context), u)
    loss = ca.sumsqr(problem.observe(states) - demonstration.observations.T)
    outputs = [ca.jacobian(slope, u), ca.jacobian(slope, psi), ca.gradient(loss, u), ca.gradient(loss, psi)]
    H, C, dL, direct = map(np.array, ca.Function("derivatives", [u, psi], outputs)(actions.ravel(), case.psi))
    return H, C, dL.ravel(), direct.ravel()
