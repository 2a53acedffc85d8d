"""Identification, without actions: stiffness, damping and initial speed of an oscillator from its measured motion."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati, discretise

T, dt = 40, 0.1
s, q, y = ca.MX.sym("s", 2), ca.MX.sym("q", 2), ca.MX.sym("y")
time = dt * np.arange(T + 1)
measured = np.exp(-0.1 * time) * np.cos(np.sqrt(4 - 0.01) * time)  # stiffness 4, damping 0.2
problem = OCP.from_expressions(
    state=s,
    static=q,
    static_bounds=([0.1, 0.0], [10.0, 2.0]),
    stage=y,
    schedule=measured[:, None],
    dynamics=discretise(ca.vertcat(s[1], -q[0] * s[0] - q[1] * s[1]), s, step=dt, intervals=4),
    stage_cost=(s[0] - y) ** 2,
    terminal_cost=(s[0] - y) ** 2,
    initial_bounds=([0, -2], [0, 2]),  # the position is given by s0
    horizon=T,
)
solution = Riccati().solve(problem, [1.0, 0.0]).raise_if_failed()
print(f"stiffness and damping {problem.static_of(solution).round(4)}, initial speed {solution.states[0, 1]:.4f}")
