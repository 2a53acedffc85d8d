"""The structure of a problem by the operations of its functions: is it smooth, is it a quadratic program?"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.smooth_graphs import is_polynomial, is_smooth
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

_SIZE = 0.5  # of random numbers: a network does not saturate there
_ROUNDING = 1e-9


@lru_cache(maxsize=64)
def smooth_problem(problem: OCP) -> bool:
    """Are costs, dynamics and constraints smooth in all that they depend on, with derivatives that are theirs?

    Then no plan, start, psi or context has a kink for a certificate to look for.
    """
    own = [] if problem.derivatives is None else [_linearised(problem, problem.derivatives)]
    return all(map(is_smooth, _constraints(problem) + _costs(problem) + own)) and own_derivatives_agree(problem)


@lru_cache(maxsize=64)
def quadratic_program(problem: OCP) -> bool:
    """Is the cost quadratic and is all else affine in states and actions, so that second derivatives are constant?"""
    constraints, costs = _constraints(problem), _costs(problem)
    return (
        problem.derivatives is None
        and all(map(is_polynomial, constraints + costs))
        and not any(_bends(function, 0) for function in constraints)
        and not any(_bends(function, 1) for function in costs)
    )


def _constraints(problem: OCP) -> list[ca.Function]:
    rows = problem.path_constraint, problem.path_equality, problem.terminal_inequality, problem.terminal_equality
    return [problem.dynamics, *(function for function in rows if function is not None)]


def _costs(problem: OCP) -> list[ca.Function]:
    return [problem.stage_cost, problem.terminal_cost]


def _bends(function: ca.Function, derivatives: int) -> bool:
    """Is the function, or its first derivative, more than affine in states and actions?"""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    count = function.n_in() - 3  # s, and u where there is one, before psi, the context and the schedule
    x = kind.sym("x", sum(function.size1_in(i) for i in range(count)))
    ends = np.cumsum([0, *(function.size1_in(i) for i in range(count))]).tolist()
    numbers = [kind.sym("p", function.size1_in(count + i)) for i in range(3)]
    value = function.call([*ca.vertsplit(x, ends), *numbers], True, False)[0]
    return any(ca.which_depends(ca.gradient(value, x) if derivatives else value, x, 2, False))


@lru_cache(maxsize=64)
def own_derivatives_agree(problem: OCP) -> bool:
    """Are the derivatives of the dynamics that a problem brings those of AD at a random point?

    Analytic functions that agree at a random point agree everywhere.
    """
    if problem.derivatives is None:
        return True
    own, known = (
        _linearised(problem, derivatives)
        for derivatives in (problem.derivatives, DynamicsDerivatives.by_ad(problem.transition))
    )
    rng = np.random.default_rng(0)
    numbers = [_SIZE * rng.normal(size=own.size1_in(i)) for i in range(own.n_in())]
    return same_numbers(own(*numbers).full(), known(*numbers).full())


def same_numbers(given: Array, expected: Array) -> bool:
    """Are the finite ones the same up to rounding, and is none finite in one place alone?"""
    finite = np.isfinite(expected)
    if (np.isfinite(given) != finite).any():
        return False
    size = np.abs(expected[finite]).max(initial=0.0)
    return bool(np.abs(given[finite] - expected[finite]).max(initial=0.0) <= _ROUNDING * size)


def _linearised(problem: OCP, derivatives: DynamicsDerivatives) -> ca.Function:
    """(s, u, psi, lambda) -> f, F' lambda, F and (lambda . f)'' one below the other."""
    sizes = problem.n_states, problem.n_actions, problem.transition.size1_in(2), problem.n_states
    s, u, psi, costate = at = [ca.MX.sym("x", size) for size in sizes]
    given = psi if depends_on_psi(problem.transition) else ca.MX(0, 1)
    found = derivatives.linearise(s, u, given, costate)
    second, arguments = found.second()
    matrices = second.call(arguments, True, False)
    return ca.Function("linearised", at, [ca.densify(ca.veccat(found.value, found.Ft_lambda, *matrices))])
