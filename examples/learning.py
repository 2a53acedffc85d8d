"""Learn, within bounds, from demonstrations of different lengths, of which one shows only three time steps."""

import casadi as ca
import numpy as np

from kpirl_ocp import LBFGS, OCP, Demonstration, Implicit, Riccati, learn
from kpirl_ocp.irl.hypergradients import KeyFrames


def mass(horizon: int) -> OCP:
    """A mass pulled to a goal; psi = (weight of the distance, weight of the force)."""
    s, u, psi, goal = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2), ca.SX.sym("goal")
    away = psi[0] * (s[0] - goal) ** 2
    moved = ca.vertcat(s[0] + 0.2 * s[1], s[1] + 0.2 * u)
    symbols = {"state": s, "action": u, "parameters": psi, "context": goal, "horizon": horizon}
    return OCP.from_expressions(**symbols, dynamics=moved, stage_cost=away + psi[1] * u**2, terminal_cost=s[1] ** 2)


truth = np.array([0.4, 0.05])
short, long = (Riccati().solve(mass(T), [0.0, 0.0], truth, [goal]).states for T, goal in ((8, 1.0), (15, -0.5)))
frames = np.array([0, 6, 15])
demonstrations = [
    Demonstration([0.0, 0.0], [1.0], short),
    Demonstration([0.0, 0.0], [-0.5], long[frames], frames=frames),
]
method = Implicit(loss=KeyFrames())
result = learn(mass, demonstrations, [1.0, 1.0], method, LBFGS(), bounds=(1e-3, 10.0), progress=False)
print(f"ratio of the weights {result.psi[0] / result.psi[1]:.3f}, true {truth[0] / truth[1]:.3f}; {result}")
