"""The relative change of psi up to which derivatives of the dynamics, along gradient steps, stay the same.

Steps beside psi look for steep places and kinks within a millionth of psi. Dynamics that bound how fast their
derivatives change (`TrajectoryPasses.clearance`) have none where states and actions move but little. That bound is
proven; the size of the move is measured, at the last iterate, for a psi that changes by its own size:

    dU = N alpha d(dJ/dU),    dS = the tangent of the rollout along dU,

and a tenth of each state and action at least. What the steps enlarge differences by is left to the caller.
"""

from __future__ import annotations

import casadi as ca

from kpirl_ocp.irl.hypergradients.unrolled_slopes import SMALL
from kpirl_ocp.ocp.problem.columns import largest_by_row
from kpirl_ocp.ocp.problem.reduced_cost import Linearisation, ReducedCost
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent

_SHARE = 0.1  # of its size by which everything is taken to move at least: other iterates may move more than the last


def allowed_move(
    reduced: ReducedCost,
    solver: GradientDescent,
    at: Linearisation,
    psi: ca.MX,
    theta: Coefficients,
    extremes: ca.MX,
) -> ca.MX:
    """The one of psi (n_psi, B) for all B trajectories; 0 where no bound is known.

    Args:
        reduced: the cost of B trajectories.
        solver: the descent, of N steps of length alpha.
        at: the last iterate.
        psi, theta: parameters and coefficients of the cost.
        extremes: (n, 1) the smallest of all iterates.
    """
    if at.rollout.extremes is None:
        return ca.MX(0.0)
    moves = ca.vertcat(*map(largest_by_row, _moves(reduced, solver, at, psi, theta)))
    sizes, nearest = -extremes[: moves.size1()], extremes[moves.size1() :]
    return reduced.passes.clearance(ca.fmax(moves, _SHARE * sizes), nearest)


def _moves(
    reduced: ReducedCost, solver: GradientDescent, at: Linearisation, psi: ca.MX, theta: Coefficients
) -> tuple[ca.MX, ca.MX]:
    """dS and dU for a change of psi by its own size."""
    by_theta = Coefficients(*(ca.jtimes(part, psi, _own_size(psi)) for part in theta))
    by_states, by_actions = reduced.cost.first_along(at.rollout.states, at.rollout.actions, theta, by_theta)
    change = by_actions + reduced.passes.adjoint(at.rollout, psi, by_states).by_actions
    dU = solver.steps * solver.step_size * change
    return reduced.passes.tangent(at.rollout, psi, dU), dU


def _own_size(psi: ca.MX) -> ca.MX:
    """As in `direction`: at least a share of the largest, and ones where all are zero."""
    size = ca.mmax(ca.fabs(psi))
    return ca.if_else(size > 0, ca.fmax(ca.fabs(psi), SMALL * size), 1)
