"""Units in which weights of different keypoint coordinates can be compared: weight times squared gain.

A weight w on a coordinate z_i adds 2 w sum_t |dz_t,i/du|^2 to the trace of the cost's Gauss-Newton Hessian in the
actions. Where the joints move an image along y three times as far as along x, the same weight holds y nine times as
firmly: its stiffness, not the number itself, is what the demonstrator's intent can be read from.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.identifiability.plan_jacobian import observation_jacobians
from kpirl_ocp.ocp.conditions.stage_derivatives import dynamics_jacobian
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Trajectory


def squared_gains(problem: OCP, trajectory: Trajectory, psi: ArrayLike = (), context: ArrayLike = ()) -> Array:
    """(T, n_z): sum over all actions of (dz_t,i/du)^2 along a trajectory, t = 1 .. T; psi (n_psi,), context (n_c,)."""
    linearised = dynamics_jacobian(problem).map(problem.horizon)
    numbers = problem.transition_numbers(*(ca.DM(np.asarray(value, float)) for value in (psi, context)))
    blocks = linearised(trajectory.states[:-1].T, trajectory.actions.T, numbers)
    by_state, by_action = (np.split(dense(block), problem.horizon, axis=1) for block in blocks)
    slopes = observation_jacobians(problem, trajectory.states)
    gains, moved = [], np.zeros((problem.n_states, 0))  # ds_t/du, one column per action so far
    for f_s, f_u, slope in zip(by_state, by_action, slopes, strict=True):
        moved = np.hstack([f_s @ moved, f_u])
        gains.append(((slope @ moved) ** 2).sum(axis=1))
    return np.array(gains)


def stiffness(basis: Array, gains: Array, weight_slopes: Array | None = None) -> Array:
    """(J n_z,): stiffness that a unit of each entry of Psi (J, n_z) adds, row by row.

    basis: B (T, J) of W = B g(Psi). gains: (T, n_z) squared gains. weight_slopes: g'(Psi) (J, n_z); by default one.
    """
    units = 2 * basis.T @ gains
    return (units if weight_slopes is None else units * weight_slopes).ravel()
