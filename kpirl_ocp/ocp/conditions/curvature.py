"""The Hessian of the quadratic programs of SQP: the exact one of the Lagrangian, plus a weight where it bends down.

A quadratic program needs curvature along its constraints only. Whether there is some, the pivots of a Riccati recursion
tell (Rao, Wright and Rawlings, 1998), with equalities and active inequalities as heavy quadratic costs. If there is,
steps are Newton's, whatever the eigenvalues of the stages; if not, twice the least power of ten that helps is added for
actions and free entries of s_0, as the inertia correction of Ipopt does (Waechter and Biegler, 2006, section 3.1).
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

_MARGIN = 1e-7  # the least weight that is tried
_HALVINGS = 5  # of the 2^5 weights _MARGIN, 10 _MARGIN, ..
_HEAVY = 1e6  # cost of leaving a constraint, relative to the largest second derivative
_ROUNDING = 1e-12  # pivots below it, relative to the largest second derivative, are not positive
_AT_BOUND = 1e-8  # the tolerance of qrqp


def hessian(problem: OCP) -> ca.Function:
    """(w, (psi, c), factor of J, multipliers of the live rows) -> (n_w, n_w), the option hess_lag of sqpmethod.

    Multipliers that are all zero say nothing of curvature: if the cost alone bends down, costates take their place.
    """
    program = transcribe(problem)
    *inputs, multipliers = _symbols(program)
    w, psi, context, factor = inputs
    p = ca.MX.sym("p", psi.numel() + context.numel())
    at = [w, *ca.vertsplit(p, [0, psi.numel(), p.numel()]), factor, multipliers]
    return ca.Function("hessian", [w, p, factor, multipliers], [_weighted(problem, program)(*at)])


def _symbols(program: Program) -> list[ca.MX]:
    """w, psi, c, the factor of J, and multipliers."""
    return [*program.symbols, ca.MX.sym("factor"), ca.MX.sym("multipliers", program.rows.numel())]


def _weighted(problem: OCP, program: Program) -> ca.Function:
    """(w, psi, c, factor, multipliers) -> the exact Hessian plus the weight."""
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
    """The multipliers, or costates."""
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
    """Of a weight: whether the Hessian is positive with it, along the defects and the rows that are held."""
    scale = ca.fmax(1, ca.mmax(ca.fabs(exact.nz[:]))) if exact.nnz() else ca.MX(1)
    matrix = exact + _HEAVY * scale * held
    slopes, curvature = (ca.MX.sym(name, value.sparsity()) for name, value in (("J", jacobian), ("H", matrix)))
    weight = ca.MX.sym("weight")
    pivot = ca.Function("pivot", [slopes, curvature, weight], [least_pivot(problem, slopes, curvature, weight)])
    return lambda trial: pivot(jacobian, matrix, trial) > _ROUNDING * scale


def _equalities(problem: OCP, program: Program, jacobian: ca.MX) -> ca.MX:
    """(n_w, n_w) whose form is the squared change of all equalities but the defects, which the recursion keeps."""
    rows = jacobian[problem.horizon * problem.n_states : program.n_equalities, :]
    return rows.T @ rows


def _active(problem: OCP, program: Program, jacobian: ca.MX, slope: ca.MX, multipliers: ca.MX) -> ca.MX:
    """The same of inequalities with a multiplier, and of bounds that the slope of the Lagrangian pushes against."""
    w, rows = program.symbols[0], jacobian[program.n_equalities :, :]
    lower, upper = limits(problem)
    pushed = (w - lower <= _AT_BOUND) * (slope > 0) + (upper - w <= _AT_BOUND) * (slope < 0)
    if not program.n_inequalities:
        return ca.diag(pushed)
    return ca.diag(pushed) + rows.T @ (ca.diag(multipliers[program.n_equalities :] > 0) @ rows)


def _least(good: Callable[[ca.MX], ca.MX]) -> ca.MX:
    """The first good one of the weights, by bisection; the last one if none is."""
    below, above = ca.MX(-1), ca.MX(2**_HALVINGS - 1)
    for _ in range(_HALVINGS):
        middle = (below + above) / 2
        enough = good(_weight(middle))
        below, above = ca.if_else(enough, below, middle), ca.if_else(enough, middle, above)
    return _weight(above)


def _weight(rung: ca.MX) -> ca.MX:
    return _MARGIN * ca.constpow(10, rung)


def _free(problem: OCP) -> Array:
    """(n_w,) one for actions and free entries of s_0."""
    states = np.zeros((problem.horizon + 1, problem.n_states))
    states[0] = problem.free_start
    return np.concatenate([states.ravel(), np.ones(problem.horizon * problem.n_actions)])
