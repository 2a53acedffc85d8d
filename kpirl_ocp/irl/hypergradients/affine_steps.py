"""Problems whose gradient steps are affine in the actions, and whose costs are quadratic: without kinks, and steep only
where coefficients are.
"""

from __future__ import annotations

from functools import lru_cache

from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.conditions.polynomials import is_affine_in, is_quadratic, is_quadratic_in
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP


@lru_cache(maxsize=64)
def has_affine_dynamics(problem: OCP, constant_jacobians: bool) -> bool:
    """True if the dynamics are affine or as good as affine.

    constant_jacobians: they are a network whose Jacobians hardly change near all iterates.
    """
    return _affine(problem) or (constant_jacobians and not depends_on_psi(problem.transition))


@lru_cache(maxsize=64)
def has_quadratic_costs(problem: OCP, loss: Loss) -> bool:
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
