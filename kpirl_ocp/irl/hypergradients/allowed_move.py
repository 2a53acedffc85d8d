"""The relative change of psi up to which the derivatives of the dynamics, at all gradient steps, hardly change.

A certificate looks for kinks and steep places by descending again at psi moved by a millionth. That can be left out
where states and actions provably move too little to meet any. `TrajectoryPasses.clearance` gives a proven bound: how
far states and actions may move before derivatives of the dynamics change. How far they do move is estimated at the last
iterate, for a psi that changes by its own size:

    dU = N alpha d(dJ/dU),    dS = the tangent of the rollout along dU,

and at least a tenth of each state and action. The amplification of differences by the steps is left to the caller.
"""

from __future__ import annotations

import casadi as ca

from kpirl_ocp.irl.hypergradients.unrolled_slopes import SMALL
from kpirl_ocp.ocp.problem.columns import largest_block
from kpirl_ocp.ocp.problem.reduced_cost import Linearisation, ReducedCost
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent

_SHARE = 0.1  # least move of states and actions, relative to their size: other iterates may move more than the last


def allowed_move(
    reduced: ReducedCost,
    solver: GradientDescent,
    at: Linearisation,
    psi: ca.MX,
    theta: Coefficients,
    extremes: ca.MX,
) -> ca.MX:
    """The relative change (1, B) of psi (n_psi, B) that is allowed for each trajectory; 0 where no bound is known.

    Args:
        reduced: the cost of B trajectories.
        solver: the descent, of N steps of length alpha.
        at: linearisation at the last iterate.
        psi, theta: parameters and coefficients of the cost.
        extremes: (n, B) the smallest over all iterates, see `Rollout.extremes`.
    """
    if at.rollout.extremes is None:
        return ca.MX.zeros(1, reduced.columns)
    moves = ca.vertcat(*(largest_block(x, reduced.columns) for x in _moves(reduced, solver, at, psi, theta)))
    sizes, nearest = -extremes[: moves.size1(), :], extremes[moves.size1() :, :]
    return reduced.passes.clearance(ca.fmax(moves, _SHARE * sizes), nearest)


def _moves(
    reduced: ReducedCost, solver: GradientDescent, at: Linearisation, psi: ca.MX, theta: Coefficients
) -> tuple[ca.MX, ca.MX]:
    """dS and dU for a change of psi by its own size."""
    by_theta = Coefficients(*(ca.jtimes(part, psi, _own_size(psi)) for part in theta))
    by_states, by_actions = reduced.cost.first_along(at.rollout.states, at.rollout.actions, theta, by_theta)
    change = by_actions + reduced.passes.adjoint(at.rollout, psi, by_states).by_actions
    dU = solver.steps * solver.step_size * change
    return reduced.passes.tangent(at.rollout, psi, dU).states, dU


def _own_size(psi: ca.MX) -> ca.MX:
    """|psi|, but at least a share of the largest parameter; ones if all are zero. As in `direction`."""
    size = ca.mmax(ca.fabs(psi))
    return ca.if_else(size > 0, ca.fmax(ca.fabs(psi), SMALL * size), 1)
