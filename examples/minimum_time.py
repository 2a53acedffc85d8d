"""A free final time: a unit mass from rest at 0 to rest at 1 with a force of at most 1. The shortest time is 2."""

import casadi as ca

from kpirl_ocp import OCP, Riccati

T = 20
s, u, duration = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("q")
dt = duration / T
problem = OCP.from_expressions(
    state=s,
    action=u,
    static=duration,  # a decision that does not change over the horizon
    static_bounds=(0.1, 10.0),
    dynamics=ca.vertcat(s[0] + dt * s[1] + dt**2 / 2 * u, s[1] + dt * u),
    terminal_cost=duration,
    terminal_equality=s - ca.DM([1, 0]),
    action_bounds=(-1.0, 1.0),
    horizon=T,
)
solution = Riccati().solve(problem, [0.0, 0.0]).raise_if_failed()
print(f"time {problem.static_of(solution)[0]:.6f} s, switching after {(solution.actions > 0).sum()} of {T} steps")
