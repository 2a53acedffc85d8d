"""Coefficients that change fast with psi: polynomials are as steep as their coefficients are large.

Most coefficients do not depend on psi at all, or as a weight does,

    c(psi) = a + b . psi,        with a and b numbers of the stage alone,

which is known once per problem: these are added up, and only the others are evaluated beside psi.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.codegen.numpy_calls import call_built
from kpirl_ocp.ocp.conditions.polynomials import is_polynomial
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Solution

_EVEN = 1e-3  # share of a coefficient by which it may change


def even_in_psi(problem: OCP, solution: Solution, move: Array) -> bool:
    """Do second derivatives of costs, and first ones of dynamics, hardly change beside psi? All of them polynomials.

    They are those by states, actions and psi together, at a plan. Each is compared with itself where psi changes by
    a move (n_psi,) to either side, so that no unit counts; one that is zero has to stay so. Dynamics that are no
    polynomials are left out. False at a plan that is not finite.
    """
    if not math.isfinite(solution.objective):
        return False
    split = _split(problem)
    if not split.affine_are_even(solution.psi, move):
        return False
    if not split.rest:
        return True
    steps = slice(problem.horizon), solution.states[:-1], solution.actions
    ends = slice(problem.horizon, None), solution.states[-1:]
    return _are_even(problem, _stage, solution, move, *steps) and _are_even(problem, _end, solution, move, *ends)


@dataclass(frozen=True, eq=False)
class _Affine:
    """Coefficients a + b psi of some stages.

    a: (stages, entries). rows, columns, b: the nonzeros of b (stages entries, n_psi), and where they are.
    """

    a: Array
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    b: Array

    def proportional(self) -> bool:
        """Is each of them proportional to one parameter, and so changes by the same share as that does?"""
        return not self.a.any() and len(np.unique(self.rows)) == len(self.rows)

    def are_even(self, psi: Array, move: Array) -> bool:
        """Do they change by a small share along the move?"""
        return _small(self._times(move), self.a + self._times(psi))

    def _times(self, along: Array) -> Array:
        """b times a vector (n_psi,): (stages, entries)."""
        products = np.asarray(np.bincount(self.rows, self.b * along[self.columns], self.a.size), float)
        return products.reshape(self.a.shape)


@dataclass(frozen=True, eq=False)
class _Split:
    """The coefficients of a problem by kind.

    affine: those of the stages and of the end. proportional: are all of them so? rest: are there others?
    """

    affine: tuple[_Affine, ...]
    proportional: bool
    rest: bool

    def affine_are_even(self, psi: Array, move: Array) -> bool:
        """Do those that are affine change by a small share along the move?"""
        if self.proportional and (np.abs(move) <= _EVEN * np.abs(psi)).all():
            return True
        return all(coefficients.are_even(psi, move) for coefficients in self.affine)


@lru_cache(maxsize=64)
def _split(problem: OCP) -> _Split:
    listed = _stage(problem), _end(problem)
    affine = tuple(map(_affine, listed))
    return _Split(affine, all(part.proportional() for part in affine), any(of.rest for of in listed))


def _small(changes: Array, values: Array) -> bool:
    """Is the largest change (stages, entries) of each a small share of the largest value?"""
    return bool((np.abs(changes).max(axis=0) <= _EVEN * np.abs(values).max(axis=0)).all())


Listed = Callable[[OCP], "_Coefficients"]


def _affine(of: _Coefficients) -> _Affine:
    """At all stages; no compiler is needed, as it is done once."""
    numbers = ca.Function("affine", [of.given[-1]], [ca.densify(of.constant), of.slopes])
    a, b = zip(*(numbers(row) for row in of.schedule), strict=True)
    slopes = ca.vertcat(*b)
    rows, columns = (np.array(places, int) for places in slopes.sparsity().get_triplet())
    values = np.array(slopes.nonzeros())
    there = values != 0
    return _Affine(np.stack([constant.full().ravel() for constant in a]), rows[there], columns[there], values[there])


def _are_even(problem: OCP, listed: Listed, solution: Solution, move: Array, stages: slice, *trajectory: Array) -> bool:
    """Of the coefficients that are not `_Affine`: evaluated at psi and beside."""
    if not listed(problem).rest:
        return True
    beside, count = solution.psi + np.array([[0.0], [1.0], [-1.0]]) * move, len(trajectory[0])
    schedule = np.asarray(problem.schedule, float)[stages]
    arrays = [np.tile(array, (3, 1)) for array in (*trajectory, schedule)]
    psis, contexts = np.repeat(beside, count, axis=0), np.tile(solution.context, (3 * count, 1))
    evaluate = call_built(_rest, problem, listed, 3 * count)
    (found,) = evaluate(*arrays[:-1], psis, contexts, arrays[-1])
    at, *sides = found.reshape(3, count, -1)
    return _small(np.concatenate([side - at for side in sides]), at)


@lru_cache(maxsize=64)
def _rest(problem: OCP, listed: Listed, columns: int) -> ca.Function:
    """The arguments, side by side -> the coefficients that are not affine, in columns."""
    of = listed(problem)
    return compiled(ca.Function("coefficients", of.given, [ca.densify(of.entries[of.rest])]).map(columns))


@lru_cache(maxsize=64)
def _stage(problem: OCP) -> _Coefficients:
    first = [problem.dynamics] if is_polynomial(problem.dynamics) else []
    return _Coefficients.of(problem.stage_cost, first, np.asarray(problem.schedule, float)[:-1])


@lru_cache(maxsize=64)
def _end(problem: OCP) -> _Coefficients:
    return _Coefficients.of(problem.terminal_cost, [], np.asarray(problem.schedule, float)[-1:])


@dataclass(frozen=True, eq=False)
class _Coefficients:
    """Expressions of the coefficients that depend on psi at all, and of which kind each of them is.

    given: the arguments (.., psi, c, d) of the cost. entries: (n, 1). constant, slopes: a (n_affine, 1) and
    b (n_affine, n_psi) of those that are affine. rest: which of the entries are not. schedule: (stages, n_d).
    """

    given: list[ca.SX]
    entries: ca.SX
    affine: list[int]
    constant: ca.SX
    slopes: ca.SX
    rest: list[int]
    schedule: Array

    @classmethod
    def of(cls, cost: ca.Function, first: list[ca.Function], schedule: Array) -> _Coefficients:
        """Second derivatives of the cost, and first ones of other functions."""
        given = [ca.SX.sym("x", *cost.size_in(i)) for i in range(cost.n_in())]
        unknowns, psi = ca.veccat(*given[:-2]), given[-3]
        matrices = [ca.hessian(*cost.expand().call(given, True, False), unknowns)[0]]
        matrices += [ca.jacobian(ca.vec(f.expand().call(given, True, False)[0]), unknowns) for f in first]
        listed = ca.vertcat(*(entry for matrix in matrices for entry in matrix.nonzeros()), 0)
        entries = listed[[i for i, depends in enumerate(ca.which_depends(listed, psi, 1, True)) if depends]]
        constant, slopes = ca.substitute(entries, psi, ca.SX.zeros(*psi.shape)), ca.jacobian(entries, psi)
        others = ca.veccat(*given[:-1])
        used = np.array(ca.which_depends(constant, others, 1, True), bool)
        used[[row for row, bends in zip(slopes.row(), _depend(slopes, others), strict=True) if bends]] = True
        affine, rest = (np.flatnonzero(kind).tolist() for kind in (~used, used))
        return cls(given, entries, affine, constant[affine], slopes[affine, :], rest, schedule)


def _depend(matrix: ca.SX, symbols: ca.SX) -> list[bool]:
    """Which nonzeros do."""
    return list(ca.which_depends(ca.vertcat(*matrix.nonzeros()), symbols, 1, True)) if matrix.nnz() else []
