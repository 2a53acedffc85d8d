"""Reach a goal exactly, along a curve: equalities at the end and at every stage."""

import casadi as ca

from kpirl_ocp import OCP, Riccati

T, dt = 30, 0.1
s, u = ca.SX.sym("s", 4), ca.SX.sym("u", 2)  # position, velocity; acceleration
position, velocity = s[:2] + dt * s[2:] + dt**2 / 2 * u, s[2:] + dt * u  # one step later
problem = OCP.from_expressions(
    state=s,
    action=u,
    dynamics=ca.vertcat(position, velocity),
    stage_cost=ca.sumsqr(u),
    path_equality=position[1] - position[0] ** 2,  # along a parabola
    terminal_equality=ca.vertcat(s[0] - 1.0, s[2]),  # to rest at x = 1
    horizon=T,
)
solution = Riccati().solve(problem, [0.0, 0.0, 0.0, 0.0]).raise_if_failed()
off = abs(solution.states[:, 1] - solution.states[:, 0] ** 2).max()
print(f"ends at {solution.states[-1, :2].round(6)}, off the curve by {off:.0e}; cost {solution.objective:.5f}")
