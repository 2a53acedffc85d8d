"""Two checks of a problem: is it a quadratic program, and are user-supplied derivatives correct?"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.polynomials import is_affine_in, is_polynomial, is_quadratic_in
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

_SIZE = 0.5  # of random numbers: a network does not saturate there
_ROUNDING = 1e-9


@lru_cache(maxsize=64)
def quadratic_program(problem: OCP) -> bool:
    """True if, in states and actions, the cost is quadratic and all else affine: second derivatives are constant."""
    rows = problem.path_constraint, problem.path_equality, problem.terminal_inequality, problem.terminal_equality
    constraints = [problem.dynamics, *(function for function in rows if function is not None)]
    costs = [problem.stage_cost, problem.terminal_cost]
    return (
        problem.derivatives is None
        and all(map(is_polynomial, constraints + costs))
        and all(is_affine_in(function, _trajectory(function)) for function in constraints)
        and all(is_quadratic_in(function, _trajectory(function)) for function in costs)
    )


def _trajectory(function: ca.Function) -> list[int]:
    """Indices of the arguments s and u, or s alone: those before psi, the context and the schedule."""
    return list(range(function.n_in() - 3))


@lru_cache(maxsize=64)
def own_derivatives_agree(problem: OCP) -> bool:
    """True if `OCP.derivatives`, where a problem supplies them, agree with AD at a random point.

    Analytic functions that agree at a random point agree everywhere, with probability one.
    """
    if problem.derivatives is None:
        return True
    own, known = (
        _linearised(problem, derivatives)
        for derivatives in (problem.derivatives, DynamicsDerivatives.by_ad(problem.transition))
    )
    rng = np.random.default_rng(0)
    numbers = [_SIZE * rng.normal(size=own.size1_in(i)) for i in range(own.n_in())]
    return same_numbers(dense(own(*numbers)), dense(known(*numbers)))


def same_numbers(given: Array, expected: Array) -> bool:
    """True if both arrays are finite in the same entries, and equal there up to rounding."""
    finite = np.isfinite(expected)
    if (np.isfinite(given) != finite).any():
        return False
    size = np.abs(expected[finite]).max(initial=0.0)
    return bool(np.abs(given[finite] - expected[finite]).max(initial=0.0) <= _ROUNDING * size)


def _linearised(problem: OCP, derivatives: DynamicsDerivatives) -> ca.Function:
    """(s, u, psi, lambda) -> f, F' lambda, F and (lambda . f)'', stacked in one column."""
    sizes = problem.n_states, problem.n_actions, problem.transition.size1_in(2), problem.n_states
    s, u, psi, costate = at = [ca.MX.sym("x", size) for size in sizes]
    given = psi if depends_on_psi(problem.transition) else ca.MX(0, 1)
    found = derivatives.linearise(s, u, given, costate)
    second, arguments = found.second()
    matrices = second.call(arguments, True, False)
    return ca.Function("linearised", at, [ca.densify(ca.veccat(found.value, found.Ft_lambda, *matrices))])
