"""The KKT system of `kpirl_ocp.ocp.sensitivity.kkt_system`, factorised by one Riccati recursion and solved in O(T).

Active rows enter as a stiff quadratic, H + C' S C with S = scale / (delta length^2): the system with -S^{-1} in the
place of its zero block. Refinement with the residuals of the true system (the method of multipliers) removes the
difference, by a factor of about delta each time. By Finsler's lemma the stiff Hessian is positive definite along the
dynamics when the Hessian is on the null space of the active rows, and by more than delta: the pivots show it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cached_property

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import Call, call_one_of
from kpirl_ocp.ocp.linear.lanczos import start
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity import refinement as compiled
from kpirl_ocp.ocp.sensitivity.conditioning import DEPENDENCE
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, scatter
from kpirl_ocp.types import Array

_REFINEMENTS = 12
_EXACT = 1e-13  # relative residual at which refinement stops
_CLOSE = 1e-10  # below it, a step that gains less than three digits has met the rounding
_DIGITS = 0.03  # relative distance from some eigenvalue, the outermost or one close to it, at which to stop
_STARTS = 4
_SETTLED = 0.1  # `change_nearby` stops when the last correction is below this share of the total change
_FOLLOWED = 1e-6  # or this of the adjoint, and the relative residual is below this: else the factors do not serve there
_NOTHING = 1e-8  # an adjoint this much shorter than a free one is zero up to rounding: the constraints leave no freedom


class Factorisation:
    """The factors of a KKT system.

    curvature: smallest eigenvalue of the reduced Hessian (with a minimum; else one that is not positive), relative to
        `KKTSystem.local_curvature`, estimated from above by a few products: where many eigenvalues lie close together,
        as in long horizons, by some ten per cent. Infinite when the active constraints leave no freedom.
    softest: (n_w,) the direction of that eigenvalue, of length one.
    qualification: smallest singular value of the active rows in the actions, scaled to length one; infinite without.
    """

    def __init__(self, system: KKTSystem, slope: Array | None = None) -> None:
        """slope: (n_w,) if given, the adjoint of this one and the Newton step are begun on the way."""
        self._system, self._slope = system, slope
        self._n_actions = system.instance.problem.horizon * system.instance.problem.n_actions
        self._lengths = self._row_lengths()
        active = system.active.astype(float)
        given = [*system.matrices, system.stiffness, active, self._lengths, start(self._n_actions)]
        if slope is None:
            found = self._call(compiled.factor)(*given)
        else:
            found = self._call(compiled.begin)(*given, slope, *system.newton)
        *self._factors, stiffness, self._per_unit, (self._scale,) = found[:7]
        self._inverse, steps = found[7:11], found[11:]
        self._adjoint, self._newton = [steps[:7], steps[7:14]] if steps else [], [steps[14:]] if steps else []
        self._matrices = [system.F.ravel(), system.G.ravel(), *self._factors, stiffness]
        self._rows = [active, self._per_unit]

    @property
    def curvature(self) -> float:
        """Smallest eigenvalue of the reduced Hessian, relative."""
        return self._softest[0]

    @property
    def softest(self) -> Array:
        """Direction (n_w,) of that eigenvalue."""
        return self._softest[1]

    @cached_property
    def _softest(self) -> tuple[float, Array]:
        """Inverse iteration: the largest eigenvalue of N (N' H N)^{-1} N' belongs to the smallest of N' H N."""
        _, *parts = self._factors
        if int(self._system.active.sum()) >= self._n_actions:
            return np.inf, np.zeros(self._system.point.w.shape)
        negative = bool((parts[-1] < 0).any())  # the pivots know the signs, the Lanczos method the size
        again = self._call(compiled.inverse_spectrum)
        value, (_, direction) = _known(self._inverse, lambda v: again(self._system.F, *parts, v), negative)
        scale = self._system.local_curvature
        if not math.isfinite(value) or scale == 0:
            return 0.0, np.zeros(direction.shape)
        if negative != (value < 0):
            return np.nan, np.zeros(direction.shape)  # the Lanczos method did not find what the pivots know
        return float(1 / (value * scale)), direction / _norm(direction)

    @cached_property
    def qualification(self) -> float:
        """Smallest singular value of the active rows: the root of the eigenvalue of a square, here of its inverse."""
        system, active = self._system, self._system.active
        count = int(active.sum())
        if not count:
            return np.inf
        if count > self._n_actions or not (self._lengths[active] > 0).all():
            return 0.0
        if system.only_actions:
            return 1.0  # different entries of u
        scale = np.where(active, self._per_unit, 0.0)

        def spectrum(begin: Array) -> list[Array]:
            return self._call(compiled.dependence_spectrum)(system.F, system.G, scale, begin)

        largest, _ = _known(spectrum(scatter(active, start(count))), spectrum, negative=False)
        return float(np.sqrt(max(1 / largest - DEPENDENCE, 0.0)))

    def adjoint(self, slope: Array) -> tuple[PrimalDual, float]:
        """The solution for (slope, 0, 0), and its relative residual."""
        right = slope, np.zeros(len(self._system.defects)), np.zeros(len(self._system.active))
        return self._refined(right, _norm(slope), _EXACT, self._adjoint if slope is self._slope else [])

    def newton_step(self) -> PrimalDual:
        """The Newton step on the KKT conditions; it need not be exact to tell how far the solution is."""
        right = self._system.newton
        return self._refined(right, _norm(right[0]), _FOLLOWED, self._newton)[0]

    def solve(self, right: Array, defects: Array, values: Array) -> tuple[PrimalDual, float]:
        """w, lambda and mu for (r_w, r_d, r_c), and the relative residual; r_c and mu (n_ineq,), zero where not active.

        A singular reduced Hessian divides by zero: infinities and NaN come out, and `curvature` says why.
        """
        size = max(_norm(right), float(self._scale) * max(_norm(defects), _norm(values)))
        return self._refined((right, defects, values), size, _EXACT, [])

    def _refined(
        self, right: tuple[Array, Array, Array], size: float, enough: float, begun: list[list[Array]]
    ) -> tuple[PrimalDual, float]:
        """Steps of refinement, of which some were done, until the residual is small enough or meets the rounding.

        size: that residuals of the first equation are relative to.
        """
        least = self._least(size)
        result: list[Array] = []
        best = np.inf
        for *arrays, norms in self._steps(right, begun):
            error = _error(norms, size, least)
            stalled = not error < best / (10 if error > _CLOSE else 1000)
            if error < best or not result:
                best, result = error, arrays[:3]
            if stalled or error <= enough:
                break
        return PrimalDual(*result), best

    def _steps(self, right: tuple[Array, Array, Array], begun: list[list[Array]]) -> Iterator[list[Array]]:
        """The results of `refine` step by step, from zero on."""
        yield from begun
        system = self._system
        at = begun[-1][:6] if begun else [*(np.zeros(part.shape) for part in right), *right]
        given = [*self._matrices, system.H, system.H_last, system.stiffness, *self._rows, *right]
        step = self._call(compiled.refine).fix(*given)
        for _ in range(_REFINEMENTS - len(begun)):
            found = step(*at)
            at = found[:6]
            yield found

    def change_nearby(self, nearby: PrimalDual, right: Array, adjoint: PrimalDual) -> float:
        """Relative change at a point nearby of the w that solves (r_w, 0, 0), `adjoint` here; infinite if not found.

        These factors find it when the two systems differ little: corrections get shorter, and so do residuals.
        """
        instance = self._system.instance
        at = *instance.arguments(nearby), np.array([instance.barrier])
        step = self._call(compiled.refine_nearby).fix(*self._matrices, *at, *self._rows, right)
        size = _norm(right)
        least = self._least(size)
        whole = max(_norm(adjoint.w), _NOTHING * least)
        triple = [adjoint.w, adjoint.costates, adjoint.forces]
        for _ in range(_REFINEMENTS // 2):
            *triple, norms = step(*triple)
            with np.errstate(over="ignore"):  # at a fold
                change, last = _norm(triple[0] - adjoint.w), norms[-1]
            if _error(norms, size, least) <= _FOLLOWED and last <= max(_SETTLED * change, _FOLLOWED * whole):
                return change / whole if change else 0.0
        return np.inf

    def _least(self, size: float) -> float:
        """|r_w| over the largest |eigenvalue| of the condensed Hessian: the least that an unconstrained w can be."""
        return size / (self._scale or 1.0)

    def _row_lengths(self) -> Array:
        """Length (n_ineq,) of every row as a function of the actions, from the covariance of w under white u."""
        if self._system.only_actions:
            return np.ones(len(self._system.active))
        return np.sqrt(self._call(compiled.row_variances)(self._system.F, self._system.G)[0])

    def _call(self, build: Callable[[OCP], ca.Function]) -> Call:
        return call_one_of(self._system.instance.problem, compiled.ALL, build)


def _known(found: list[Array], again: Callable[[Array], list[Array]], negative: bool) -> tuple[float, list[Array]]:
    """An eigenvalue to its first digits, and its vectors, by a Lanczos process that starts again with what it found."""
    for left in reversed(range(_STARTS)):
        (value,), (error,), *vectors = found
        right = (value < 0) == negative and error <= _DIGITS * abs(value)
        if right or not left or not math.isfinite(value):
            break
        found = again(vectors[0])
    return float(value), vectors


def _error(norms: Array, size: float, least: float) -> float:
    """The largest of the three residuals, relative to the right-hand side or to what w would be without rows.

    norms: of the residuals and of w. size: of the right-hand side. least: of w, see `Factorisation._least`.
    """
    off, gap, violation, length = norms[:4].tolist()
    scale = max(length, least) or 1.0
    parts = off / (size or 1.0), gap / scale, violation / scale
    return math.nan if math.isnan(sum(parts)) else max(parts)


def _norm(vector: Array) -> float:
    return math.sqrt(vector.dot(vector))
