"""Direct collocation of the pendulum on a cart: states and accelerations inside a step are decisions as well."""

import casadi as ca

from kpirl_ocp import OCP, Riccati

s, u = ca.SX.sym("s", 4), ca.SX.sym("u")  # cart, angle and their speeds; force
inside, a = ca.SX.sym("inside", 12), ca.SX.sym("a", 6)  # at the three points of Radau
states = ca.horzcat(s, ca.reshape(inside, 4, 3))
slopes, end, _ = ca.collocation_coeff(ca.collocation_points(3, "radau"))
rows = []
for i in range(3):
    _, angle, _, speed = ca.vertsplit(states[:, i + 1])
    first, second = ca.vertsplit(a[2 * i : 2 * i + 2])
    rows.append(states @ slopes[:, i] - 0.05 * ca.vertcat(states[2:, i + 1], first, second))
    rows.append(2.0 * first + 0.5 * (second * ca.cos(angle) - speed**2 * ca.sin(angle)) - u)
    rows.append(0.5 * first * ca.cos(angle) + 0.5 * second + 0.5 * 9.81 * ca.sin(angle))
problem = OCP.from_expressions(
    state=s,
    action=ca.vertcat(u, inside, a),
    dynamics=states @ end,
    path_equality=ca.vertcat(*rows),
    stage_cost=0.05 * (ca.sumsqr(s - ca.DM([0.5, 0, 0, 0])) + 0.01 * u**2),
    terminal_equality=s - ca.DM([0.5, 0, 0, 0]),
    horizon=30,
)
print(Riccati().solve(problem, [0.0, 0.3, 0.0, 0.0]))
