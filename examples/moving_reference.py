"""Model-predictive control along a moving reference: its next T + 1 points are the context of every solve."""

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Riccati

T, dt = 15, 0.1
s, u, ahead, at = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("c", T + 1), ca.SX.sym("d", T + 1)
gap = s[0] - ca.dot(ahead, at)  # row t of the identity picks the point of stage t
problem = OCP.from_expressions(
    state=s,
    action=u,
    context=ahead,
    stage=at,
    schedule=np.eye(T + 1),
    dynamics=ca.vertcat(s[0] + dt * s[1] + dt**2 / 2 * u, s[1] + dt * u),
    stage_cost=gap**2 + 1e-3 * u**2,
    terminal_cost=10 * gap**2,
    action_bounds=(-1.0, 1.0),
    horizon=T,
)
state, plan, reference = np.zeros(2), None, 0.5 * dt * np.arange(100)  # a target at 0.5 m/s
for k in range(80):
    plan = Riccati().solve(problem, state, context=reference[k : k + T + 1], guess=plan).raise_if_failed()
    state = plan.states[1]  # here the plant is the model
print(f"after 8 s, {abs(state[0] - reference[80]):.0e} m from the target; {plan.iterations} iterations in a solve")
