"""Factors of, and refinement with, the KKT system of `kkt_system`: each one compiled function.

Lists of inequalities and matrices are those of `kkt_operators`. Refinement is the method of multipliers:
with r, d, c the residuals of the right-hand sides and S the stiffness of the active rows,

    K (dw, dlambda) = (r + C' S c, d),    dmu = S (C dw - c),    K the factorised system, H + C' S C in its corner.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.hessian_products import Lagrangian
from kpirl_ocp.ocp.conditions.nlp import bound_rows
from kpirl_ocp.ocp.conditions.stage_derivatives import symbols
from kpirl_ocp.ocp.linear.riccati_recursion import factor_symbols, substitute
from kpirl_ocp.ocp.linear.stage_operators import by_stage, flat, len_x, matrices
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.conditioning import (
    condensed_scale,
    dependence_spectrum,
    inverse_spectrum,
    largest_inverse,
    row_variances,
)
from kpirl_ocp.ocp.sensitivity.kkt_operators import (
    Operator,
    Stored,
    bound_columns,
    n_rows,
    rows,
    split,
    stiffened,
    transposed_rows,
)

DELTA = 1e-8  # balances the rounding of the recursion, 1e-16 / DELTA, against the rate of the refinement


class _Triple(NamedTuple):
    """w, lambda and mu, or what stands opposite to them on the right."""

    w: ca.MX
    costates: ca.MX
    forces: ca.MX

    @classmethod
    def symbols(cls, problem: OCP, *names: str) -> _Triple:
        sizes = problem.horizon * len_x(problem), problem.horizon * problem.n_states, n_rows(problem)
        return cls(*(ca.MX.sym(name, size) for name, size in zip(names, sizes, strict=True)))

    def plus(self, other: _Triple) -> _Triple:
        return _Triple(*(a + b for a, b in zip(self, other, strict=True)))


@lru_cache(maxsize=64)
def factor(problem: OCP) -> ca.Function:
    """(F, G, H, H_T, sigma, active (0 or 1), lengths (n_ineq,), start (T n_u,)) -> P, W, Y, pivots, S, 1/units, scale,

    and the four of `largest_inverse`. The factors are those of

        H + rows' (sigma + S) rows,    S = scale / (DELTA units^2) where active,

    with the largest |eigenvalue| of the condensed Hessian as scale; units are the lengths where they are not zero.
    """
    F, G, H, last = matrices(problem)
    sigma, active, lengths = (ca.MX.sym(name, n_rows(problem)) for name in ("sigma", "active", "lengths"))
    start = ca.MX.sym("start", problem.horizon * problem.n_actions)
    scale = condensed_scale(problem, F, H, last, start)
    units = ca.if_else(lengths > 0, lengths, 1)
    stiffness = active * ca.if_else(scale > 0, scale, 1) / (DELTA * units**2)
    found = stiffened(problem, F, G, H, last, sigma + stiffness)
    outputs = [*found, stiffness, 1 / units, scale, *largest_inverse(problem, F, found[1:], start)]
    inputs = [F, G, H, last, sigma, active, lengths, start]
    return ca.Function("factor", inputs, [ca.densify(x) for x in outputs])


@lru_cache(maxsize=64)
def refine(problem: OCP) -> ca.Function:
    """One step of refinement towards the solution of

        (H + rows' sigma rows) w + A' lambda + C' mu = r,    A w = d,    C w = c.

    (F, G, P, W, Y, pivots, S, H, H_T, sigma, active (0 or 1), 1/units, r, d, c, and w, lambda, mu with the residuals of
    r, d, c at them) -> the last six after the step, and |r|, |d|, |c / units|, |w| of them.
    """
    factors, system = factor_symbols(problem), matrices(problem)
    F, G, H, last = system
    stiffness, sigma, active, scale = (ca.MX.sym(name, n_rows(problem)) for name in ("S", "sigma", "active", "scale"))
    right, point, residual = (
        _Triple.symbols(problem, *names)
        for names in (("r", "d", "c"), ("w", "lambda", "mu"), ("r_off", "d_off", "c_off"))
    )
    point_after = point.plus(_correction(problem, F, G, factors, stiffness, residual))
    residual_after = _residuals(problem, Stored(problem, *system), sigma, active, right, point_after)
    norms = ca.vertcat(_norms(residual_after, scale), ca.norm_2(point_after.w))
    inputs = [F, G, *factors, stiffness, H, last, sigma, active, scale, *right, *point, *residual]
    return ca.Function("refine", inputs, [ca.densify(x) for x in (*point_after, *residual_after, norms)])


@lru_cache(maxsize=64)
def begin(problem: OCP) -> ca.Function:
    """The arguments of `factor`, r' and (r, d, c) -> its outputs, then those of three steps of `refine` from zero on.

    Two are for (r', 0, 0), one after the other, and one for (r, d, c).
    """
    inputs = factor(problem).mx_in()
    F, G, H, last, sigma, active, *_ = inputs
    slope, newton = ca.MX.sym("slope", problem.horizon * len_x(problem)), _Triple.symbols(problem, "r", "d", "c")
    factored = factor(problem).call(inputs)
    P, W, Y, pivots, stiffness, scale, *_ = factored
    nothing = _Triple(*(ca.MX.zeros(part.shape) for part in newton))

    def step(right: _Triple, at: list[ca.MX]) -> list[ca.MX]:
        system = [F, G, P, W, Y, pivots, stiffness, H, last, sigma, active, scale]
        return list(refine(problem).call([*system, *right, *at]))

    adjoint = nothing._replace(w=slope)
    one = step(adjoint, [*nothing, *adjoint])
    outputs = [*factored, *one, *step(adjoint, one[:6]), *step(newton, [*nothing, *newton])]
    return ca.Function("begin", [*inputs, slope, *newton], outputs)


@lru_cache(maxsize=64)
def refine_nearby(problem: OCP) -> ca.Function:
    """Two such steps towards the solution of the system at a point nearby, whose matrices are never formed.

    (F, G, P, W, Y, pivots, S, the arguments of `stages.first` at that point, tau, active (0 or 1), 1/units, r, w,
    lambda, mu) -> w, lambda, mu after both steps, and |r|, |d|, |c / units|, |w| after the first one, and the lengths
    of both steps in w.
    """
    factors = factor_symbols(problem)
    F, G, *_ = matrices(problem)
    at, tau = symbols(problem), ca.MX.sym("tau")
    stiffness, active, scale = (ca.MX.sym(name, n_rows(problem)) for name in ("S", "active", "scale"))
    right, begin = _Triple.symbols(problem, "r", "d", "c"), _Triple.symbols(problem, "w", "lambda", "mu")
    right = _Triple(right.w, ca.MX.zeros(right.costates.shape), ca.MX.zeros(right.forces.shape))
    operator = Lagrangian(problem, *at)
    sigma = _smoothing(problem, operator, tau)

    def residual(point: _Triple) -> _Triple:
        return _residuals(problem, operator, sigma, active, right, point)

    one = _correction(problem, F, G, factors, stiffness, residual(begin))
    middle = begin.plus(one)
    remaining = residual(middle)
    other = _correction(problem, F, G, factors, stiffness, remaining)
    norms = ca.vertcat(_norms(remaining, scale), *(ca.norm_2(part.w) for part in (middle, one, other)))
    inputs = [F, G, *factors, stiffness, *at, tau, active, scale, right.w, *begin]
    return ca.Function("refine_nearby", inputs, [ca.densify(x) for x in (*middle.plus(other), norms)])


def _correction(problem: OCP, F: ca.MX, G: ca.MX, factors: list[ca.MX], stiffness: ca.MX, residual: _Triple) -> _Triple:
    """dw, dlambda and dmu of one step."""
    n_s, steps = problem.n_states, problem.horizon
    q, last = by_stage(problem, -residual.w - transposed_rows(problem, G, stiffness * residual.forces))
    d = ca.reshape(-residual.costates, n_s, steps)
    states, actions, costates = substitute(problem)(F, *factors, q, last, d, ca.MX.zeros(n_s))
    dw = ca.vertcat(ca.vec(states[:, 1:]), ca.vec(actions))
    stored = Stored(problem, F, G, ca.MX(0, 0), ca.MX(0, 0))
    return _Triple(dw, ca.vec(costates), stiffness * (rows(problem, stored, dw) - residual.forces))


def _residuals(
    problem: OCP, operator: Operator, sigma: ca.MX, active: ca.MX, right: _Triple, point: _Triple
) -> _Triple:
    """The residuals of the right-hand sides at a point."""
    n_s, steps = problem.n_states, problem.horizon
    x, end = by_stage(problem, point.w)
    values = rows(problem, operator, point.w)
    bounds, path = split(problem, sigma * values + point.forces)
    product, last = operator.balance(x, end, ca.reshape(point.costates, n_s, steps), path)
    balance = flat(problem, product, last) + bound_columns(problem) @ bounds
    balance[: n_s * steps] -= point.costates
    successors = ca.vec(operator.F_times(x)) - point.w[: n_s * steps]
    return _Triple(right.w - balance, right.costates - successors, active * (right.forces - values))


def _smoothing(problem: OCP, at: Lagrangian, tau: ca.MX) -> ca.MX:
    """tau / slack^2 (n_ineq,) of inequalities that are no equalities, zero for those and without smoothing."""
    path, w = at.path_values, ca.vertcat(ca.vec(at.states[:, 1:]), ca.vec(at.actions))
    bounds = bound_rows(problem)
    room = ca.DM(bounds.signs) * (ca.DM(bounds.limits) - w[bounds.entries.tolist()])
    slack = ca.densify(ca.vertcat(room, -ca.vec(path)))
    smoothed = ca.DM(np.concatenate([~bounds.equal, np.ones(path.numel(), bool)]).astype(float))
    return ca.if_else(smoothed * tau > 0, tau / slack**2, 0)


def _norms(residual: _Triple, scale: ca.MX) -> ca.MX:
    """|r|, |d|, |c / units|."""
    return ca.vertcat(ca.norm_2(residual.w), ca.norm_2(residual.costates), ca.norm_2(residual.forces * scale))


ALL = (factor, refine, begin, refine_nearby, inverse_spectrum, dependence_spectrum, row_variances)
"""To be compiled together: they have the recursion in common."""
