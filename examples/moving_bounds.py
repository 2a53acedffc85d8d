"""Bounds that change from stage to stage, and bounds that are parameters and can be learned."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

T, dt = 20, 0.1
s, u, limit = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("limit")
problem = OCP.from_expressions(
    state=s,
    action=u,
    parameters=limit,
    dynamics=ca.vertcat(s[0] + dt * s[1], s[1] + dt * u),
    stage_cost=(s[0] - 1) ** 2 + 0.1 * s[1] ** 2 + 1e-3 * u**2,
    terminal_cost=10 * (s[0] - 1) ** 2,
    action_bounds=(-limit, limit),  # expressions become rows of the path constraint, so that they are differentiated
    state_bounds=(-np.inf, np.column_stack([np.full(T + 1, np.inf), np.linspace(1.5, 0.5, T + 1)])),
    horizon=T,
)
solution = Riccati().solve(problem, [0.0, 0.0], [2.0]).raise_if_failed()
print(f"cost {solution.objective:.5f}; forces at the limit: {(abs(solution.actions) > 1.999).sum()} of {T}")
