"""Optimal costs and their derivatives, by the envelope theorem.

    V(psi, s_0, c) = min J,      dV/dp = dL/dp  at the solution,      L = J + lambda . g_E + mu . g_I

A plan need not have a derivative where its cost has one; the derivative of a cost is that of the Lagrangian at a fixed
plan and fixed multipliers. With a barrier tau the same holds for min J - tau sum log(slack).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.constraints import BoundRows, Inequalities
from kpirl_ocp.ocp.problem.guards import dense, one_at_a_time
from kpirl_ocp.ocp.problem.layout import equality_multipliers, inequality_multipliers, limits, pack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Solution


class ValueSlopes(NamedTuple):
    """Derivatives of an optimal cost: by psi (n_psi,), s_0 (n_s,), zero where it is free, and context (n_c,)."""

    psi: Array
    s0: Array
    context: Array


@one_at_a_time
def value_of(problem: OCP, solution: Solution) -> float:
    """V, or min J - tau sum log(slack) of a solution with a barrier."""
    if not solution.barrier > 0:
        return solution.objective
    w = pack(solution.trajectory)
    _, _, g = transcribe(problem).values(w, solution.psi, solution.context)
    rows = Inequalities.at(BoundRows.of(*limits(problem)), w, dense(g).ravel())
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(solution.objective - solution.barrier * np.log(rows.slack[~rows.equal]).sum())


@one_at_a_time
def value_slopes(problem: OCP, solution: Solution) -> ValueSlopes:
    """dV/dp at a solution."""
    multipliers = solution.multipliers
    duals = equality_multipliers(multipliers), inequality_multipliers(multipliers)
    slopes = _lagrangian_slopes(problem)(pack(solution.trajectory), solution.psi, solution.context, *duals)
    psi, s0, context = (dense(slope).ravel() for slope in slopes)
    return ValueSlopes(psi, np.where(problem.free_start, 0.0, s0), context)


@lru_cache(maxsize=64)
def _lagrangian_slopes(problem: OCP) -> ca.Function:
    """(w, psi, c, lambda, mu) -> dL/dpsi, dL/ds_0, dL/dc."""
    program = transcribe(problem)
    (w, psi, context), values = program.symbols, program.values(*program.symbols)
    lam, mu = (ca.MX.sym(name, value.numel()) for name, value in zip(("lambda", "mu"), values[1:], strict=True))
    lagrangian = values[0] + ca.dot(lam, values[1]) + ca.dot(mu, values[2])
    by_psi, by_w, by_context = (ca.densify(ca.gradient(lagrangian, x)) for x in (psi, w, context))
    return ca.Function("slopes", [w, psi, context, lam, mu], [by_psi, by_w[: problem.n_states], by_context])
