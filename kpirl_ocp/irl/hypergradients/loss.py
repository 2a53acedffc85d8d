"""The IRL loss (paper, section "Cost functions and IRL Loss"):  L(tau, tau_demo) = sum_{t=0}^{T} |z_t - z_demo,t|^2."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from kpirl_ocp.ocp.problem.ocp import OCP

Loss = Callable[[OCP], ca.Function]
"""problem -> function (S (n_s, T+1), U (n_u, T), Z_demo (n_z, T+1)) -> scalar."""


def squared_distance(problem: OCP) -> ca.Function:
    """Squared distance between planned and demonstrated observations, summed over time and coordinates."""
    states = ca.MX.sym("S", problem.n_states, problem.horizon + 1)
    actions = ca.MX.sym("U", problem.n_actions, problem.horizon)
    seen = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    return ca.Function("loss", [states, actions, seen], [ca.sumsqr(problem.observe(states) - seen)])
