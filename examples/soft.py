"""A soft constraint: the mass should stay below 0.5 where that does not cost too much."""

import casadi as ca

from kpirl_ocp import OCP, Riccati, Soft

T, dt = 20, 0.1
s, u, price = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("price")
problem = OCP.from_expressions(
    state=s,
    action=u,
    parameters=price,
    dynamics=ca.vertcat(s[0] + dt * s[1], s[1] + dt * u),
    stage_cost=(s[0] - 1) ** 2 + 0.1 * u**2,
    terminal_cost=(s[0] - 1) ** 2,
    soft=Soft(s[0] - 0.5, linear=price, quadratic=1.0),  # also at s_T, because it does not depend on u
    horizon=T,
)
for value in (0.1, 1.0, 10.0):
    solution = Riccati().solve(problem, [0.0, 0.0], [value]).raise_if_failed()
    print(f"price {value}: highest position {problem.stated(solution).states[:, 0].max():.4f}")
