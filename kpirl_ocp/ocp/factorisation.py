"""The KKT system of `kpirl_ocp.ocp.sensitivity`, factorised by one Riccati recursion and solved in O(T).

Active rows enter as a stiff quadratic, H + C' S C with S = scale / (delta length^2): the system with -S^{-1} in the
place of its zero block. Refinement with the residuals of the true system (the method of multipliers) removes the
difference, by a factor of about delta each time. By Finsler's lemma the stiff Hessian is positive definite along the
dynamics when the Hessian is on the null space of the active rows, and by more than delta: the pivots show it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from kpirl_ocp.ocp import kkt_solves as compiled
from kpirl_ocp.ocp.calls import Call, call_one_of
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.sensitivity import KKTSystem, scatter
from kpirl_ocp.ocp.spectrum import ritz, start
from kpirl_ocp.types import Array

_DELTA = 1e-8  # balances the rounding of the recursion, 1e-16 / delta, against the rate of the refinement
_DEPENDENCE = 1e-11  # delta of `qualification`: singular values are known to its square root
_REFINEMENTS = 12
_EXACT = 1e-13  # relative residual at which refinement stops


class Factorisation:
    """The factors of a KKT system.

    curvature: smallest eigenvalue of the reduced Hessian (with a minimum; else one that is not positive) over the
        largest |eigenvalue| of the condensed one; infinite when the active constraints leave no freedom.
    softest: (n_w,) the direction of that eigenvalue, of length one.
    qualification: smallest singular value of the active rows in the actions, scaled to length one; infinite without.
    """

    def __init__(self, system: KKTSystem) -> None:
        self._system = system
        self._n_actions = system.instance.problem.horizon * system.instance.problem.n_actions
        F, _, H, H_last = system.matrices
        spectrum = self._call(compiled.condensed_spectrum)(F, H, H_last, start(self._n_actions))
        self._scale = float(np.abs(ritz(*spectrum)[0]).max())
        self._lengths = self._row_lengths()
        self._units = np.where(self._lengths > 0, self._lengths, 1.0)
        self._stiffness = np.where(system.active, (self._scale or 1.0) / (_DELTA * self._units**2), 0.0)
        self._factors = self._factor(system.matrices, system.stiffness + self._stiffness)

    @cached_property
    def curvature(self) -> float:
        """See the class."""
        return self._softest[0]

    @cached_property
    def softest(self) -> Array:
        """See the class."""
        return self._softest[1]

    @cached_property
    def _softest(self) -> tuple[float, Array]:
        """Inverse iteration: the largest eigenvalue of N (N' H N)^{-1} N' belongs to the smallest of N' H N."""
        nothing = np.zeros(self._system.point.w.shape)
        if int(self._system.active.sum()) >= self._n_actions:
            return np.inf, nothing
        at, pivots = (self._system.F.ravel(), *self._factors), self._factors[-1]
        values, vectors = ritz(*self._call(compiled.inverse_spectrum)(*at, start(self._n_actions)))
        if not np.isfinite(values).all() or self._scale == 0:
            return 0.0, nothing
        worst = 0 if (pivots < 0).any() else -1  # the pivots know the signs, the Lanczos method the size
        eigenvalue = 1 / values[worst]
        if worst == 0 and eigenvalue > 0:
            return np.nan, nothing  # there is a negative eigenvalue that the Lanczos method did not find
        (direction,) = self._call(compiled.back)(*at, vectors[:, worst])
        return float(eigenvalue / self._scale), direction / np.linalg.norm(direction)

    @cached_property
    def qualification(self) -> float:
        """See the class.

        Multipliers of the rows D C w = b with delta relaxation and cost |u|^2 / 2 are (D C Z Z' C' D + delta)^{-1} b.
        """
        system, active = self._system, self._system.active
        count, n_s, n_x = int(active.sum()), len(system.H_last), system.H.shape[1]
        if not count:
            return np.inf
        if count > self._n_actions or not (self._lengths[active] > 0).all():
            return 0.0
        if system.only_actions:
            return 1.0  # different entries of u
        F, G, *_ = system.matrices
        effort = np.zeros_like(system.H)
        effort[:, np.arange(n_s, n_x), np.arange(n_s, n_x)] = 1.0
        weights = np.where(active, 1 / (_DEPENDENCE * self._units**2), 0.0)
        factors = self._factor((F, G, effort.ravel(), np.zeros(n_s * n_s)), weights)
        scale, begin = np.where(active, 1 / self._units, 0.0), scatter(active, start(count))
        spectrum = self._call(compiled.dependence_spectrum)(F, G, *factors, scale, np.array([_DEPENDENCE]), begin)
        diagonal, beside, basis = spectrum
        basis = basis.reshape(len(diagonal), -1)[:count]  # there are no more dimensions than active rows
        largest = ritz(diagonal[:count], beside[:count], basis)[0][-1]
        return float(np.sqrt(max(1 / largest - _DEPENDENCE, 0.0)))

    def solve(
        self, right: Array, defects: Array, values: Array, system: KKTSystem | None = None
    ) -> tuple[Array, Array, Array, float]:
        """w, lambda and mu for (r_w, r_d, r_c), and the relative residual; r_c and mu (n_ineq,), zero where not active.

        system: another one nearby to solve with these factors; refinement then makes up for the difference, and the
        residual says if it could. A singular reduced Hessian divides by zero: infinities and NaN come out, and
        `curvature` says why.
        """
        system = system or self._system
        step = self._refinement(system, right, defects, values)
        point, off = [np.zeros(part.shape) for part in (right, defects, values)], [right, defects, values]
        result, best = point, np.inf
        for _ in range(_REFINEMENTS):
            *arrays, norms = step(*point, *off)
            point, off = arrays[:3], arrays[3:]
            error = self._error(norms, right)
            stalled = not error < best / 10
            if error < best:
                best, result = error, point
            if stalled or error <= _EXACT:
                break
        w, costates, forces = result if np.isfinite(best) else point
        return w, costates, forces, best

    def size(self, right: Array) -> float:
        """|r_w| over the largest |eigenvalue| of the condensed Hessian: the least that an unconstrained w can be."""
        return float(np.linalg.norm(right)) / (self._scale or 1.0)

    def _refinement(self, system: KKTSystem, right: Array, defects: Array, values: Array) -> Call:
        """A step of refinement towards the solution for these right-hand sides."""
        own, active = self._system, system.active.astype(float)
        fixed = [own.F.ravel(), own.G.ravel(), *self._factors, self._stiffness]
        fixed += [*system.matrices, system.stiffness, active, 1 / self._units, right, defects, values]
        return self._call(compiled.refine).fix(*fixed)

    def _error(self, norms: Array, right: Array) -> float:
        """The largest of the three residuals, relative to the right-hand side or to what w would be without rows."""
        off, gap, violation, length = norms
        size = max(length, self.size(right)) or 1.0
        return float(max(off / (float(np.linalg.norm(right)) or 1.0), gap / size, violation / size))

    def _factor(self, matrices: Sequence[Array], weights: Array) -> list[Array]:
        """P, W, Y and pivots of the Hessian with stiff rows."""
        return self._call(compiled.factor)(*matrices, weights)

    def _row_lengths(self) -> Array:
        """Length (n_ineq,) of every row as a function of the actions, from the covariance of w under white u."""
        if self._system.only_actions:
            return np.ones(len(self._system.active))
        F, G, *_ = self._system.matrices
        return np.sqrt(self._call(compiled.row_variances)(F, G)[0])

    def _call(self, build: Callable[[OCP], ca.Function]) -> Call:
        return call_one_of(self._system.instance.problem, compiled.ALL, build)
