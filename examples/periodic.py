"""A periodic motion: s_T = s_0, both free. A static decision carries s_0 to the end."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

T = 40
phase = 2 * np.pi * np.arange(T + 1) / T
s, u, q, d = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("q", 2), ca.SX.sym("d", 2)
dt = 2 * np.pi / T
problem = OCP.from_expressions(
    state=s,
    action=u,
    static=q,
    stage=d,  # reference, and 1 at the first stage only
    schedule=np.column_stack([np.sign(np.sin(phase)), np.arange(T + 1) == 0]),
    dynamics=ca.vertcat(s[0] + dt * s[1], s[1] + dt * u),
    stage_cost=(s[0] - d[0]) ** 2 + 0.01 * u**2,
    initial_bounds=(-np.inf, np.inf),
    path_equality=d[1] * (s - q),  # s_0 = q; switched off at later stages
    terminal_equality=s - q,
    horizon=T,
)
solution = Riccati().solve(problem, [0.0, 0.0]).raise_if_failed()
gap = np.abs(solution.states[-1] - solution.states[0]).max()
print(f"from {solution.states[0, :2].round(4)} and back, to within {gap:.0e}; cost {solution.objective:.5f}")
