"""Keep out of a disc, also at the last state, and end within a small one: inequalities on states and at the end."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati, Trajectory

T, dt = 20, 0.2
s, u = ca.SX.sym("s", 2), ca.SX.sym("u", 2)
problem = OCP.from_expressions(
    state=s,
    action=u,
    dynamics=s + dt * u,
    stage_cost=0.1 * ca.sumsqr(u) + ca.sumsqr(s - ca.DM([2, 0])),
    path_constraint=0.25 - ca.sumsqr(s - ca.DM([1, 0.1])),  # does not depend on u: holds at s_T too
    terminal_constraint=ca.sumsqr(s - ca.DM([2, 0])) - 0.01,
    action_bounds=(-1.0, 1.0),
    horizon=T,
)
below = np.column_stack([np.linspace(0, 2, T + 1), -np.sin(np.linspace(0, np.pi, T + 1))])
guess = Trajectory(below, np.diff(below, axis=0) / dt)
solution = Riccati().solve(problem, [0.0, 0.0], guess=guess).raise_if_failed()
print(f"smallest distance {np.linalg.norm(solution.states - [1, 0.1], axis=1).min():.6f} of 0.5; {solution}")
