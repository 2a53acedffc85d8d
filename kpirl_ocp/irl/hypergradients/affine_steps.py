"""Problems whose gradient steps are affine in the actions: only steep coefficients can make the result steep in psi."""

from __future__ import annotations

from functools import lru_cache

from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.conditions.polynomials import is_affine_in, is_quadratic, is_quadratic_in
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP


@lru_cache(maxsize=64)
def has_affine_steps(problem: OCP, loss: Loss, constant_jacobians: bool) -> bool:
    """True if costs and loss are quadratic, and the dynamics affine or as good as affine.

    constant_jacobians: the dynamics are a network whose Jacobians hardly change near all iterates.
    """
    return _quadratic(problem, loss) and (
        _affine(problem) or (constant_jacobians and not depends_on_psi(problem.transition))
    )


def _quadratic(problem: OCP, loss: Loss) -> bool:
    """True if costs and loss are quadratic in states and actions together."""
    after = loss(problem)
    costs = problem.stage_cost, problem.terminal_cost
    return (
        all(is_quadratic(function) for function in (*costs, after))
        and is_quadratic_in(after, [0, 1])
        and all(is_quadratic_in(cost, list(range(cost.n_in() - 3))) for cost in costs)
    )


def _affine(problem: OCP) -> bool:
    """True if the dynamics are affine in states and actions, and at most quadratic in psi and in the context."""
    return is_quadratic(problem.dynamics) and is_affine_in(problem.dynamics, [0, 1])
