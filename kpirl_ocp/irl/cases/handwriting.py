"""Handwriting as optimal control: a pen point that is pushed and held over time, and reaches the goal.

    sum_t sum_i 1/2 W[t, i] (z_t[i] - goal[i])^2 + F[t, i] (z_t[i] - goal[i])  +  rho |u_t|^2  +  firm weights at T

The state is position and velocity, the action the acceleration, over one unit of time. W = B g(Psi_W), F = B Psi_F with
a basis B of kernels in time; psi = (Psi_W, Psi_F), row by row. Where W holds the pen, it holds it at goal - F / W.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.models import RBF
from kpirl_ocp.ocp.models.keypoint_costs import softplus
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Demonstration

_EFFORT = 1e-5  # rho; with weights of one the pen follows within about a twentieth of the duration
_END = (1.0, 1e-3)  # weights on position and velocity at the end, times the horizon


def handwriting_ocp(horizon: int = 50, kernels: int = 10) -> OCP:
    """The problem; the goal (2,) is the context, and positions (2,) are seen."""
    dt, basis = 1.0 / horizon, RBF(kernels).matrix(horizon)  # (T, J)
    s, u, goal = ca.SX.sym("s", 4), ca.SX.sym("u", 2), ca.SX.sym("goal", 2)
    psi, row = ca.SX.sym("psi", 4 * kernels), ca.SX.sym("d", kernels)
    held, pushed = (ca.reshape(part, 2, kernels) @ row for part in (softplus(psi[: 2 * kernels]), psi[2 * kernels :]))
    error = s[:2] - goal
    place = 0.5 * ca.dot(held, error**2) + ca.dot(pushed, error)
    velocity = s[2:] + dt * u
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        stage=row,
        dynamics=ca.vertcat(s[:2] + dt * velocity, velocity),
        stage_cost=place + _EFFORT * ca.sumsqr(u),
        terminal_cost=place + horizon * (_END[0] * ca.sumsqr(error) + _END[1] * ca.sumsqr(s[2:])),
        observation=s[:2],
        horizon=horizon,
        schedule=np.vstack([np.zeros(kernels), basis]),
    )


def handwriting_start(kernels: int = 10) -> Array:
    """psi (4 J,) of a pen that is held with W = 1 and not pushed."""
    return np.concatenate([np.full(2 * kernels, np.log(np.expm1(1.0))), np.zeros(2 * kernels)])


def stroke(path: Array) -> Demonstration:
    """A path (T+1, 2) as a demonstration that starts at rest; its end is the goal."""
    return Demonstration(np.concatenate([path[0], np.zeros(2)]), path[-1], path)
