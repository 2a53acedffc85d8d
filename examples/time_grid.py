"""A time grid that is not uniform and a known payload: numbers of the stage and the context in the dynamics."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

T = 15
s, u, mass, dt = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("mass"), ca.SX.sym("dt")
grid = np.geomspace(0.05, 0.4, T + 1)[:, None]  # short steps first; the last row belongs to s_T
problem = OCP.from_expressions(
    state=s,
    action=u,
    context=mass,
    stage=dt,
    schedule=grid,
    dynamics=ca.vertcat(s[0] + dt * s[1] + dt**2 / 2 * u / mass, s[1] + dt * u / mass),
    stage_cost=dt * (ca.sumsqr(s - ca.DM([1, 0])) + 0.1 * u**2),
    terminal_cost=10 * ca.sumsqr(s - ca.DM([1, 0])),
    horizon=T,
)
for payload in (1.0, 3.0):
    solution = Riccati().solve(problem, [0.0, 0.0], context=[payload]).raise_if_failed()
    print(
        f"{payload} kg: first force {solution.actions[0, 0]:.4f} N over {grid[0, 0]} s, cost {solution.objective:.4f}"
    )
