"""The KKT system of `kpirl_ocp.ocp.sensitivity`, factorised by one Riccati recursion and solved in O(T).

Active rows enter as a stiff quadratic, H + C' S C with S = scale / (delta length^2): the system with -S^{-1} in the
place of its zero block. Refinement with the residuals of the true system (the method of multipliers) removes the
difference, by a factor of about delta each time. By Finsler's lemma the stiff Hessian is positive definite along the
dynamics when the Hessian is on the null space of the active rows, and by more than delta: the pivots show it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from kpirl_ocp.ocp.calls import call
from kpirl_ocp.ocp.recursion import condense, factorise, substitute
from kpirl_ocp.ocp.sensitivity import KKTSystem
from kpirl_ocp.ocp.spectrum import lanczos
from kpirl_ocp.types import Array

_DELTA = 1e-8  # balances the rounding of the recursion, 1e-16 / delta, against the rate of the refinement
_DEPENDENCE = 1e-11  # delta of `qualification`: singular values are known to its square root
_REFINEMENTS = 12
_PRODUCTS = 10  # Lanczos steps; for `scale` half of them give the first digits
_EXACT = 1e-13  # relative residual at which refinement stops


class Factorisation:
    """The factors of a KKT system.

    curvature: smallest eigenvalue of the reduced Hessian (with a minimum; else one that is not positive) over the
        largest |eigenvalue| of the condensed one; infinite when the active constraints leave no freedom.
    softest: (n_w,) the direction of that eigenvalue, of length one.
    qualification: smallest singular value of the active rows in the actions, scaled to length one; infinite without.
    """

    def __init__(self, system: KKTSystem) -> None:
        problem = system.instance.problem
        functions = (factorise, substitute, condense)
        self._factorise, self._substitute, self._condense = (call(problem, build) for build in functions)
        self._system, self._n_actions = system, problem.horizon * problem.n_actions
        self._lengths = _row_lengths(system)
        extremes = lanczos(self._times_condensed, self._n_actions, _PRODUCTS // 2)[0]
        self._scale = float(np.abs(extremes).max())
        self._units = np.where(self._lengths > 0, self._lengths, 1.0)
        self._stiffness = (self._scale or 1.0) / (_DELTA * self._units**2)
        weights = system.stiffness.copy()
        weights[system.active] += self._stiffness
        self._factors, self._pivots = self._factor(system.H, system.H_last, weights)

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
        n_states = len(nothing) - self._n_actions

        def inverse(v: Array) -> Array:
            return self._back(np.concatenate([np.zeros(n_states), v]), np.zeros(n_states))[0][n_states:]

        values, vectors = lanczos(inverse, self._n_actions, _PRODUCTS)
        if not np.isfinite(values).all() or self._scale == 0:
            return 0.0, nothing
        worst = 0 if (self._pivots < 0).any() else -1  # the pivots know the signs, the Lanczos method the size
        eigenvalue = 1 / values[worst]
        if worst == 0 and eigenvalue > 0:
            return np.nan, nothing  # there is a negative eigenvalue that the Lanczos method did not find
        direction = self._back(np.concatenate([np.zeros(n_states), vectors[:, worst]]), np.zeros(n_states))[0]
        return float(eigenvalue / self._scale), direction / np.linalg.norm(direction)

    @cached_property
    def qualification(self) -> float:
        """See the class.

        Multipliers of the rows D C w = b with delta relaxation and cost |u|^2 / 2 are (D C Z Z' C' D + delta)^{-1} b.
        """
        system, lengths = self._system, self._lengths
        count = len(lengths)
        if not count:
            return np.inf
        if count > self._n_actions or not (lengths > 0).all():
            return 0.0
        if system.only_actions:
            return 1.0  # different entries of u
        H, H_last = np.zeros_like(system.H), np.zeros_like(system.H_last)
        n_s = len(H_last)
        H[:, np.arange(n_s, H.shape[1]), np.arange(n_s, H.shape[1])] = 1.0
        weights = np.zeros(len(system.active))
        weights[system.active] = 1 / (_DEPENDENCE * lengths**2)
        factors, _ = self._factor(H, H_last, weights)
        C, transposed = system.constraints, system.transposed_constraints

        def inverse(b: Array) -> Array:
            w, _ = self._back(transposed @ (b / lengths) / _DEPENDENCE, np.zeros(len(system.defects)), factors)
            return (b - C @ w / lengths) / _DEPENDENCE

        largest = lanczos(inverse, count, _PRODUCTS)[0][-1]
        return float(np.sqrt(max(1 / largest - _DEPENDENCE, 0.0)))

    def solve(
        self, right: Array, defects: Array, active: Array, system: KKTSystem | None = None
    ) -> tuple[Array, Array, Array, float]:
        """w, lambda and mu of the active rows for (r_w, r_d, r_c), and the relative residual.

        system: another one nearby to solve with these factors; refinement then makes up for the difference, and the
        residual says if it could. A singular reduced Hessian divides by zero: infinities and NaN come out, and
        `curvature` says why.
        """
        system = system or self._system
        own, C, transposed = self._system, system.constraints, system.transposed_constraints
        w, costates, forces = np.zeros(len(right)), np.zeros(len(defects)), np.zeros(len(active))
        parts, best = (right, defects, active), np.inf
        result, error = (w, costates, forces), np.inf
        for _ in range(_REFINEMENTS):
            r, d, c = parts
            with np.errstate(all="ignore"):
                dw, dcostates = self._back(r + own.transposed_constraints @ (self._stiffness * c), d)
                w, costates = w + dw, costates + dcostates
                forces = forces + self._stiffness * (own.constraints @ dw - c)
                product = (
                    system.times_stiff_hessian(w) + system.times_transposed_jacobian(costates) + transposed @ forces
                )
                parts = right - product, defects - system.times_jacobian(w), active - C @ w
                error = self._error(parts, right, w)
            stalled = not error < best / 10
            if error < best:
                best, result = error, (w, costates, forces)
            if stalled or error <= _EXACT:
                break
        return (*(result if np.isfinite(best) else (w, costates, forces)), best)

    def size(self, right: Array) -> float:
        """|r_w| over the largest |eigenvalue| of the condensed Hessian: the least that an unconstrained w can be."""
        return float(np.linalg.norm(right)) / (self._scale or 1.0)

    def _error(self, parts: tuple[Array, Array, Array], right: Array, w: Array) -> float:
        """The largest of the three residuals, relative to the right-hand side or to what w would be without rows."""
        off, gap, violation = (float(np.linalg.norm(part)) for part in (*parts[:2], parts[2] / self._units))
        size = max(float(np.linalg.norm(w)), self.size(right)) or 1.0
        return max(off / (float(np.linalg.norm(right)) or 1.0), gap / size, violation / size)

    def _factor(self, H: Array, H_last: Array, weights: Array) -> tuple[list[Array], Array]:
        """Factors of the Hessian with stiff rows: the arguments F, P, W, Y, pivots of `substitute`; and the pivots."""
        system = self._system
        stiff, last = system.with_rows(H, H_last, weights)
        with np.errstate(all="ignore"):
            P, W, Y, pivots = self._factorise(system.F.ravel(), stiff.ravel(), last.ravel())
        return [system.F.ravel(), P, W, Y, pivots], pivots

    def _back(self, right: Array, defects: Array, factors: list[Array] | None = None) -> tuple[Array, Array]:
        """w and lambda of the stiff system for (r_w, r_d)."""
        n_s = len(self._system.H_last)
        q, last = self._system.by_stage(-right)
        gap = np.zeros(n_s)
        states, actions, costates = self._substitute(*(factors or self._factors), q.ravel(), last, -defects, gap)
        return np.concatenate([states[n_s:], actions]), costates

    def _times_condensed(self, u: Array) -> Array:
        """Z' H Z u (T n_u,), without stiffness."""
        system = self._system
        return self._condense(system.F.ravel(), system.H.ravel(), system.H_last.ravel(), u)[0]


def _row_lengths(system: KKTSystem) -> Array:
    """Length (n_active,) of every active row as a function of the actions, from the covariance of s under white u."""
    if system.only_actions:
        return np.ones(int(system.active.sum()))
    n_s, n_x = len(system.H_last), system.H.shape[1]
    covariance, all_of = np.zeros((n_x, n_x)), np.zeros_like(system.H)
    for t, F in enumerate(system.F):
        covariance[n_s:, n_s:] = np.eye(n_x - n_s)
        all_of[t] = covariance
        covariance[:n_s, :n_s] = F.T @ covariance @ F
    last = covariance[:n_s, :n_s]
    return np.sqrt(system.row_variances(all_of, last)[system.active])
