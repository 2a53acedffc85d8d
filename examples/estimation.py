"""Moving-horizon estimation: the initial state, which has a prior, and the disturbances are decisions."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

T, dt = 20, 0.1
s, w, d = ca.SX.sym("s", 2), ca.SX.sym("w"), ca.SX.sym("d", 3)  # state, disturbance, numbers of the stage
force, true = np.sin(np.arange(T + 1.0)), [np.array([1.0, -0.5])]
for t in range(T):
    true.append(true[t] + dt * np.array([true[t][1], force[t] - true[t][0]]))
measured = np.array(true)[:, 0] + 0.01 * np.random.default_rng(0).normal(size=T + 1)
fit = (s[0] - d[0]) ** 2 / 0.01**2
problem = OCP.from_expressions(
    state=s,
    action=w,
    stage=d,
    schedule=np.column_stack([measured, force, np.arange(T + 1) == 0]),
    dynamics=s + dt * ca.vertcat(s[1], d[1] - s[0] + w),
    stage_cost=fit + w**2 / 0.1**2 + d[2] * ca.sumsqr(s - ca.DM([0.9, 0])) / 0.5**2,  # arrival cost
    terminal_cost=fit,
    initial_bounds=(-np.inf, np.inf),
    horizon=T,
)
solution = Riccati().solve(problem, [0.0, 0.0]).raise_if_failed()
for name, t in (("first", 0), ("last", -1)):
    print(f"{name} state {solution.states[t].round(3)}, true {true[t].round(3)}")
