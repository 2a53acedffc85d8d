"""Whether the coefficients of polynomial costs and dynamics change fast with psi.

A polynomial of low degree has no kink, but it is as steep as its coefficients make it: where these change fast with
psi, a derivative holds only very close to psi. Most coefficients do not depend on psi at all, or only as a weight does,

    c(psi) = a + b . psi,        where a and b depend on nothing but the stage.

For these, a and b are computed once per problem; only the other coefficients are evaluated at psi and to both sides.
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
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Solution

_SMALL_CHANGE = 1e-3  # relative to the largest value of the coefficient over the stages


def nearly_constant_in_psi(problem: OCP, solution: Solution, move: Array) -> bool:
    """True if second derivatives of costs and first derivatives of dynamics hardly change when psi moves a little.

    All costs must be polynomials; dynamics that are not are left out. The derivatives are those with respect to
    states, actions and psi together, at a plan. Each is compared with its own value where psi is moved by `move`
    (n_psi,) to either side, so that the test does not depend on units; one that is zero must stay zero.

    False at a plan that is not finite.
    """
    if not math.isfinite(solution.objective):
        return False
    split = _split(problem)
    if not split.affine_nearly_constant(solution.psi, move):
        return False
    if not split.rest:
        return True
    steps = slice(problem.horizon), solution.states[:-1], solution.actions
    ends = slice(problem.horizon, None), solution.states[-1:]
    return _rest_nearly_constant(problem, _stage_coefficients, solution, move, *steps) and _rest_nearly_constant(
        problem, _end_coefficients, solution, move, *ends
    )


@dataclass(frozen=True, eq=False)
class _Affine:
    """Coefficients a + b psi at several stages.

    a: (stages, entries). b: the nonzeros of the matrix b (stages entries, n_psi), at these rows and columns.
    """

    a: Array
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    b: Array

    def proportional(self) -> bool:
        """True if each is proportional to a single parameter, so that both change by the same factor."""
        return not self.a.any() and len(np.unique(self.rows)) == len(self.rows)

    def nearly_constant(self, psi: Array, move: Array) -> bool:
        """True if all change little, relatively, when psi moves."""
        return _small(self._times(move), self.a + self._times(psi))

    def _times(self, along: Array) -> Array:
        """b times a vector (n_psi,), as (stages, entries)."""
        products = np.asarray(np.bincount(self.rows, self.b * along[self.columns], self.a.size), float)
        return products.reshape(self.a.shape)


@dataclass(frozen=True, eq=False)
class _Split:
    """The coefficients of a problem that depend on psi, by the way in which they do.

    affine: the affine ones, of the stages and of the end. proportional: True if all of these are proportional to a
    single parameter. rest: True if there are coefficients that are not affine.
    """

    affine: tuple[_Affine, ...]
    proportional: bool
    rest: bool

    def affine_nearly_constant(self, psi: Array, move: Array) -> bool:
        """True if all affine coefficients change little, relatively, when psi moves."""
        if self.proportional and (np.abs(move) <= _SMALL_CHANGE * np.abs(psi)).all():
            return True
        return all(coefficients.nearly_constant(psi, move) for coefficients in self.affine)


@lru_cache(maxsize=64)
def _split(problem: OCP) -> _Split:
    both = _stage_coefficients(problem), _end_coefficients(problem)
    affine = tuple(map(_affine, both))
    return _Split(affine, all(part.proportional() for part in affine), any(coefficients.rest for coefficients in both))


def _small(changes: Array, values: Array) -> bool:
    """True if the largest change of each coefficient (stages, entries) is a small share of its largest value."""
    return bool((np.abs(changes).max(axis=0) <= _SMALL_CHANGE * np.abs(values).max(axis=0)).all())


CoefficientsOf = Callable[[OCP], "_Coefficients"]


def _affine(coefficients: _Coefficients) -> _Affine:
    """The affine coefficients at all stages; not worth compiling, since it is evaluated once."""
    numbers = ca.Function("affine", coefficients.inputs[-1:], [ca.densify(coefficients.constant), coefficients.slopes])
    a, b = zip(*(numbers(row) for row in coefficients.schedule), strict=True)
    slopes = ca.vertcat(*b)
    rows, columns = (np.array(places, int) for places in slopes.sparsity().get_triplet())
    values = np.array(slopes.nonzeros())
    nonzero = values != 0
    constants = np.stack([dense(constant).ravel() for constant in a])
    return _Affine(constants, rows[nonzero], columns[nonzero], values[nonzero])


def _rest_nearly_constant(
    problem: OCP, coefficients_of: CoefficientsOf, solution: Solution, move: Array, stages: slice, *trajectory: Array
) -> bool:
    """True if the coefficients that are not affine change little, evaluated at psi and to both sides of it."""
    if not coefficients_of(problem).rest:
        return True
    nearby, count = solution.psi + np.array([[0.0], [1.0], [-1.0]]) * move, len(trajectory[0])
    schedule = np.asarray(problem.schedule, float)[stages]
    arrays = [np.tile(array, (3, 1)) for array in (*trajectory, schedule)]
    psis, contexts = np.repeat(nearby, count, axis=0), np.tile(solution.context, (3 * count, 1))
    evaluate = call_built(_rest, problem, coefficients_of, 3 * count)
    (found,) = evaluate(*arrays[:-1], psis, contexts, arrays[-1])
    at, *sides = found.reshape(3, count, -1)
    return _small(np.concatenate([side - at for side in sides]), at)


@lru_cache(maxsize=64)
def _rest(problem: OCP, coefficients_of: CoefficientsOf, columns: int) -> ca.Function:
    """The inputs, a column for each point -> the coefficients that are not affine, a column for each point."""
    coefficients = coefficients_of(problem)
    rest = ca.densify(coefficients.entries[coefficients.rest])
    return compiled(ca.Function("coefficients", coefficients.inputs, [rest]).map(columns))


@lru_cache(maxsize=64)
def _stage_coefficients(problem: OCP) -> _Coefficients:
    first = [problem.dynamics] if is_polynomial(problem.dynamics) else []
    return _Coefficients.of(problem.stage_cost, first, np.asarray(problem.schedule, float)[:-1])


@lru_cache(maxsize=64)
def _end_coefficients(problem: OCP) -> _Coefficients:
    return _Coefficients.of(problem.terminal_cost, [], np.asarray(problem.schedule, float)[-1:])


@dataclass(frozen=True, eq=False)
class _Coefficients:
    """Expressions of those coefficients that depend on psi.

    inputs: the arguments (.., psi, c, d) of the cost. entries: (n, 1) the coefficients. constant, slopes: a
    (n_affine, 1) and b (n_affine, n_psi) of the affine ones. rest: indices of the others. schedule: (stages, n_d).
    """

    inputs: list[ca.SX]
    entries: ca.SX
    constant: ca.SX
    slopes: ca.SX
    rest: list[int]
    schedule: Array

    @classmethod
    def of(cls, cost: ca.Function, first: list[ca.Function], schedule: Array) -> _Coefficients:
        """Entries of the second derivatives of a cost, and of the first derivatives of other functions."""
        inputs = [ca.SX.sym("x", *cost.size_in(i)) for i in range(cost.n_in())]
        unknowns, psi = ca.veccat(*inputs[:-2]), inputs[-3]
        matrices = [ca.hessian(*cost.expand().call(inputs, True, False), unknowns)[0]]
        matrices += [ca.jacobian(ca.vec(f.expand().call(inputs, True, False)[0]), unknowns) for f in first]
        listed = ca.vertcat(*(entry for matrix in matrices for entry in matrix.nonzeros()), 0)
        entries = listed[[i for i, depends in enumerate(ca.which_depends(listed, psi, 1, True)) if depends]]
        constant, slopes = ca.substitute(entries, psi, ca.SX.zeros(*psi.shape)), ca.jacobian(entries, psi)
        all_but_schedule = ca.veccat(*inputs[:-1])
        varies = np.array(ca.which_depends(constant, all_but_schedule, 1, True), bool)
        varies[[row for row, yes in zip(slopes.row(), _depends(slopes, all_but_schedule), strict=True) if yes]] = True
        affine, rest = (np.flatnonzero(kind).tolist() for kind in (~varies, varies))
        return cls(inputs, entries, constant[affine], slopes[affine, :], rest, schedule)


def _depends(matrix: ca.SX, symbols: ca.SX) -> list[bool]:
    """For each nonzero of a matrix: does it depend on the symbols?"""
    return list(ca.which_depends(ca.vertcat(*matrix.nonzeros()), symbols, 1, True)) if matrix.nnz() else []
