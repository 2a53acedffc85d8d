"""Coefficients that change fast with psi: polynomials are as steep as their coefficients are large."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.codegen.numpy_calls import call_function
from kpirl_ocp.ocp.conditions.polynomials import is_polynomial
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Solution

_STEP = 1e-6  # of psi, as where slopes to both sides are compared
_EVEN = 1e-3  # share of a coefficient by which it may change over that


def even_in_psi(problem: OCP, solution: Solution, direction: Array) -> bool:
    """Do second derivatives of costs, and first ones of dynamics, hardly change beside psi? All of them polynomials.

    They are those by states, actions and psi together, at a plan. Each is compared with itself along a direction
    (n_psi,), so that no unit counts; one that is zero has to stay so. Dynamics that are no polynomials are left out.
    """
    beside = solution.psi + _STEP * np.array([[0.0], [1.0], [-1.0]]) * direction
    schedule = np.asarray(problem.schedule, float)
    steps = slice(problem.horizon), solution.states[:-1], solution.actions
    ends = slice(problem.horizon, None), solution.states[-1:]
    found = [_at(problem, _stage, beside, schedule, solution.context, *steps)]
    found.append(_at(problem, _end, beside, schedule, solution.context, *ends))
    return all(
        bool((np.abs(values[1:] - values[0]).max(axis=(0, 1)) <= _EVEN * np.abs(values[0]).max(axis=0)).all())
        for values in found
    )


def _at(
    problem: OCP,
    build: Callable[[OCP, int], ca.Function],
    psi: Array,
    schedule: Array,
    context: Array,
    stages: slice,
    *trajectory: Array,
) -> Array:
    """(3, stages, entries)."""
    count = len(trajectory[0])
    arrays = [np.tile(array, (len(psi), 1)) for array in (*trajectory, schedule[stages])]
    psis, contexts = np.repeat(psi, count, axis=0), np.tile(context, (len(psi) * count, 1))
    (found,) = call_function(build(problem, len(psi) * count))(*arrays[:-1], psis, contexts, arrays[-1])
    return np.asarray(found).reshape(len(psi), count, -1)


@lru_cache(maxsize=64)
def _stage(problem: OCP, columns: int) -> ca.Function:
    first = [problem.dynamics] if is_polynomial(problem.dynamics) else []
    return _coefficients(problem.stage_cost, first, columns)


@lru_cache(maxsize=64)
def _end(problem: OCP, columns: int) -> ca.Function:
    return _coefficients(problem.terminal_cost, [], columns)


def _coefficients(cost: ca.Function, first: list[ca.Function], columns: int) -> ca.Function:
    """The arguments, side by side -> second derivatives of the cost, and first ones of other functions, in columns."""
    given = [ca.SX.sym("x", *cost.size_in(i)) for i in range(cost.n_in())]
    unknowns = ca.veccat(*given[:-2])
    entries = [ca.hessian(*cost.expand().call(given, True, False), unknowns)[0]]
    entries += [ca.jacobian(ca.vec(f.expand().call(given, True, False)[0]), unknowns) for f in first]
    listed = ca.vertcat(*(entry for matrix in entries for entry in matrix.nonzeros()), 0)
    return compiled(ca.Function("coefficients", given, [ca.densify(listed)]).map(columns))
