"""Problems whose gradient steps are affine, so that nothing but steep coefficients can bend what they make of psi."""

from __future__ import annotations

from functools import lru_cache

from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.conditions.polynomials import is_affine_in, is_quadratic, is_quadratic_in
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP


@lru_cache(maxsize=64)
def has_straight_steps(problem: OCP, loss: Loss, clear: bool) -> bool:
    """Are costs and loss quadratic, and the dynamics affine, or a network of which this is clear?"""
    return _quadratic(problem, loss) and (_affine(problem) or (clear and not depends_on_psi(problem.transition)))


def _quadratic(problem: OCP, loss: Loss) -> bool:
    """Are costs and loss quadratic in states and actions together?"""
    after = loss(problem)
    costs = problem.stage_cost, problem.terminal_cost
    return (
        all(is_quadratic(function) for function in (*costs, after))
        and is_quadratic_in(after, [0, 1])
        and all(is_quadratic_in(cost, list(range(cost.n_in() - 3))) for cost in costs)
    )


def _affine(problem: OCP) -> bool:
    """Are the dynamics affine in states and actions, and at most quadratic in psi and the context?"""
    return is_quadratic(problem.dynamics) and is_affine_in(problem.dynamics, [0, 1])
