"""The Hessian of SQP's quadratic programs: that of the Lagrangian, regularised where its curvature is negative.

A quadratic program needs positive curvature only on the null space of its active constraints. The pivots of a Riccati
recursion tell whether it has it (Rao, Wright and Rawlings, 1998); equalities and active inequalities enter there as
quadratic costs with a large weight. If the curvature is positive, the exact Hessian is used and steps are Newton steps,
whatever the eigenvalues of single stages. If not, a multiple of the identity is added for actions and free entries of
s_0: twice the smallest power of ten that is enough, similar to Ipopt's inertia correction (Waechter and Biegler, 2006,
section 3.1).
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.pivots import costates, least_pivot
from kpirl_ocp.ocp.conditions.program import Program, transcribe
from kpirl_ocp.ocp.problem.layout import limits
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

_MARGIN = 1e-7  # the smallest weight that is tried
_HALVINGS = 5  # bisection steps over the 2^5 weights _MARGIN, 10 _MARGIN, ..
_HEAVY = 1e6  # weight of constraints as quadratic costs, relative to the largest second derivative
_ROUNDING = 1e-12  # pivots below this, relative to the largest second derivative, do not count as positive
_AT_BOUND = 1e-8  # distance at which a bound counts as active: the tolerance of qrqp


def hessian(problem: OCP) -> ca.Function:
    """(w, (psi, c), factor of J, multipliers of the live rows) -> Hessian (n_w, n_w): sqpmethod's option hess_lag.

    Multipliers that are all zero, as at a cold start, carry no information on the curvature of constraints: if the cost
    alone has negative curvature, costates are used in their place.
    """
    program = transcribe(problem)
    *inputs, multipliers = _symbols(program)
    w, psi, context, factor = inputs
    p = ca.MX.sym("p", psi.numel() + context.numel())
    at = [w, *ca.vertsplit(p, [0, psi.numel(), p.numel()]), factor, multipliers]
    return ca.Function("hessian", [w, p, factor, multipliers], [_weighted(problem, program)(*at)])


def _symbols(program: Program) -> list[ca.MX]:
    """Symbols for w, psi, c, the factor of J, and the multipliers."""
    return [*program.symbols, ca.MX.sym("factor"), ca.MX.sym("multipliers", program.rows.numel())]


def _weighted(problem: OCP, program: Program) -> ca.Function:
    """(w, psi, c, factor, multipliers) -> the exact Hessian, plus a multiple of the identity where it is needed."""
    at = _symbols(program)
    jacobian = ca.jacobian(program.rows, at[0])
    used = _or_costates(problem, program, at, jacobian)
    exact, slope = _second(program)(*at[:-1], used)
    equal = _equalities(problem, program, jacobian)
    active = equal + _active(problem, program, jacobian, slope, used)
    plain = _positive(problem, jacobian, exact, equal)(0)
    weight = ca.if_else(plain, 0, 2 * _least(_positive(problem, jacobian, exact, active)))
    return ca.Function("weighted", at, [exact + weight * ca.diag(ca.sparsify(ca.DM(_free(problem))))])


def _or_costates(problem: OCP, program: Program, at: list[ca.MX], jacobian: ca.MX) -> ca.MX:
    """The multipliers, or costates where the multipliers are all zero and the cost has negative curvature."""
    *symbols, factor, multipliers = at
    of_cost, slope = ca.hessian(factor * program.values(*symbols)[0], symbols[0])
    bends_up = _positive(problem, jacobian, of_cost, _equalities(problem, program, jacobian))(0)
    found = costates(problem, jacobian, slope)
    instead = ca.vertcat(found, ca.MX.zeros(multipliers.numel() - found.numel()))
    return ca.if_else(ca.logic_or(ca.dot(multipliers, multipliers) > 0, bends_up), multipliers, instead)


def _second(program: Program) -> ca.Function:
    """(w, psi, c, factor, multipliers) -> Hessian and gradient of the Lagrangian."""
    at = *symbols, factor, multipliers = _symbols(program)
    lagrangian = factor * program.values(*symbols)[0] + ca.dot(multipliers, program.rows)
    exact, slope = ca.hessian(lagrangian, symbols[0])
    return ca.Function("second", at, [exact, ca.densify(slope)])


def _positive(problem: OCP, jacobian: ca.MX, exact: ca.MX, held: ca.MX) -> Callable[[ca.MX | float], ca.MX]:
    """A function of a weight: is the Hessian plus this weight positive on the null space of the held constraints?

    held: (n_w, n_w) of `_equalities` or `_active`; the defects are always held.
    """
    scale = ca.fmax(1, ca.mmax(ca.fabs(exact.nz[:]))) if exact.nnz() else ca.MX(1)
    matrix = exact + _HEAVY * scale * held
    slopes, curvature = (ca.MX.sym(name, value.sparsity()) for name, value in (("J", jacobian), ("H", matrix)))
    weight = ca.MX.sym("weight")
    pivot = ca.Function("pivot", [slopes, curvature, weight], [least_pivot(problem, slopes, curvature, weight)])
    return lambda trial: pivot(jacobian, matrix, trial) > _ROUNDING * scale


def _equalities(problem: OCP, program: Program, jacobian: ca.MX) -> ca.MX:
    """E^T E (n_w, n_w) with the Jacobian E of all equalities but the defects, which the recursion eliminates."""
    rows = jacobian[problem.horizon * problem.n_states : program.n_equalities, :]
    return rows.T @ rows


def _active(problem: OCP, program: Program, jacobian: ca.MX, slope: ca.MX, multipliers: ca.MX) -> ca.MX:
    """The same matrix for inequalities with positive multipliers, and for active bounds: those at which w is, and
    against which the negative gradient of the Lagrangian pushes."""
    w, rows = program.symbols[0], jacobian[program.n_equalities :, :]
    lower, upper = limits(problem)
    pushed = (w - lower <= _AT_BOUND) * (slope > 0) + (upper - w <= _AT_BOUND) * (slope < 0)
    if not program.n_inequalities:
        return ca.diag(pushed)
    return ca.diag(pushed) + rows.T @ (ca.diag(multipliers[program.n_equalities :] > 0) @ rows)


def _least(good: Callable[[ca.MX], ca.MX]) -> ca.MX:
    """The smallest weight that is good enough, by bisection over the powers of ten; the largest if none is."""
    below, above = ca.MX(-1), ca.MX(2**_HALVINGS - 1)
    for _ in range(_HALVINGS):
        middle = (below + above) / 2
        enough = good(_weight(middle))
        below, above = ca.if_else(enough, below, middle), ca.if_else(enough, middle, above)
    return _weight(above)


def _weight(rung: ca.MX) -> ca.MX:
    return _MARGIN * ca.constpow(10, rung)


def _free(problem: OCP) -> Array:
    """(n_w,) 1 for actions and free entries of s_0, 0 for the others."""
    states = np.zeros((problem.horizon + 1, problem.n_states))
    states[0] = problem.free_start
    return np.concatenate([states.ravel(), np.ones(problem.horizon * problem.n_actions)])
