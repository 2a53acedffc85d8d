"""Two phases, each with dynamics and a duration of its own: a car drives with a force of at most 1, then brakes with 2.

From rest to rest at 3: the top speed v gives v^2 / 2 + v^2 / 4 = 3, so v = 2, and the phases take 2 s and 1 s.
"""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

n = 10  # steps of each phase
s, u, durations, first = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("q", 2), ca.SX.sym("d")
dt = (first * durations[0] + (1 - first) * durations[1]) / n
force = first * u + (1 - first) * 2 * (u - 1)  # u from 0 to 1
problem = OCP.from_expressions(
    state=s,
    action=u,
    static=durations,
    static_bounds=(0.1, 10),
    stage=first,  # 1 in the first phase
    schedule=(np.arange(2 * n + 1) < n)[:, None],
    dynamics=ca.vertcat(s[0] + dt * s[1] + dt**2 / 2 * force, s[1] + dt * force),
    terminal_cost=ca.sum1(durations),
    terminal_equality=s - ca.DM([3, 0]),
    action_bounds=(0, 1),
    horizon=2 * n,
)
solution = Riccati().solve(problem, [0, 0, 1, 1]).raise_if_failed()  # durations begin at 1 s
print(f"durations {problem.static_of(solution).round(6)}, top speed {solution.states[n, 1]:.6f}")
