"""Continuous time: a pendulum on a cart, stated implicitly as M(s) a = F, by collocation and by other integrators."""

import casadi as ca

from kpirl_ocp import OCP, Riccati, discretise

s, u, a = ca.MX.sym("s", 4), ca.MX.sym("u"), ca.MX.sym("a", 2)  # cart, angle and their speeds; accelerations
angle, speed = s[1], s[3]
forces = ca.vertcat(
    2.0 * a[0] + 0.5 * (a[1] * ca.cos(angle) - speed**2 * ca.sin(angle)) - u,
    0.5 * a[0] * ca.cos(angle) + 0.5 * a[1] + 0.5 * 9.81 * ca.sin(angle),
)
ode = ca.vertcat(s[2:], a)
for method in ("midpoint", "collocation", "idas"):
    problem = OCP.from_expressions(
        state=s,
        action=u,
        dynamics=discretise(ode, s, step=0.05, method=method, algebraic=a, residual=forces),
        stage_cost=0.05 * (ca.sumsqr(s - ca.DM([0.5, 0, 0, 0])) + 0.01 * u**2),
        terminal_equality=s - ca.DM([0.5, 0, 0, 0]),
        horizon=30,
    )
    print(f"{method:12s} {Riccati(1e-8).solve(problem, [0.0, 0.3, 0.0, 0.0])}")
