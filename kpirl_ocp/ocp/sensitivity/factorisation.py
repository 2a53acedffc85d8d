"""The KKT system of `kpirl_ocp.ocp.sensitivity.kkt_system`, factorised by one Riccati recursion and solved in O(T)."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual
from kpirl_ocp.types import Array

_REFINEMENTS = 12
_EXACT = 1e-13  # relative residual at which refinement stops
_FOLLOWED = 1e-6  # the same of a Newton step, which need not be exact to tell how far the solution is


class Factorisation:
    """The factors of a KKT system, and what it is conditioned by.

    Decisions are measured by their own curvature (`KKTSystem.roots`), so that no unit counts.
    """

    def __init__(self, system: KKTSystem) -> None:
        self._system, self._linear = system, system.linear
        self._n_decisions, self._n_active = len(system.roots), int(system.active.sum())
        self._immovable = self._linear.factor(system.roots, start(self._n_decisions))

    @property
    def curvature(self) -> float:
        """Smallest eigenvalue of the reduced Hessian (with a minimum; else one that is not positive).

        Estimated from above by a few products: where many eigenvalues lie close together, as in long horizons, by some
        ten per cent. Infinite when the active constraints leave no freedom.
        """
        return self._softest[0]

    @property
    def softest(self) -> Array:
        """Direction (n_w,) of that eigenvalue, of length one in the decisions."""
        return self._softest[1]

    @cached_property
    def _softest(self) -> tuple[float, Array]:
        """Inverse iteration: the largest eigenvalue of N (N' H N)^{-1} N' belongs to the smallest of N' H N."""
        nowhere = np.zeros(len(self._system.point.x))
        if self._n_active >= self._n_decisions:
            return np.inf, nowhere
        negative = bool((self._linear.pivots < 0).any())  # pivots know the signs, the Lanczos method the size
        value, direction = self._linear.softest(negative, start(self._n_decisions))
        if not math.isfinite(value):
            return 0.0, nowhere
        if negative != (value < 0):
            return np.nan, nowhere  # the Lanczos method did not find what the pivots know
        return 1 / value, direction

    @cached_property
    def qualification(self) -> float:
        """Smallest singular value of the active rows in the decisions, of length one each; infinite without (LICQ)."""
        if not self._n_active:
            return np.inf
        if self._immovable or self._n_active > self._n_decisions:
            return 0.0
        active, bounds = self._system.active, self._system.instance.rows.bounds
        entries = bounds.entries[active[: len(bounds.entries)]]
        if len(entries) == self._n_active and np.isin(entries, self._system.instance.rows.decisions).all():
            return 1.0  # different decisions
        return self._linear.qualification(start(len(active)))

    def adjoint(self, slope: Array) -> tuple[PrimalDual, float]:
        """The solution for (slope, 0, 0), and its relative residual."""
        zeros = [np.zeros(len(part)) for part in (self._system.point.costates, self._system.active)]
        return self._solved([slope, *zeros, np.zeros(len(self._system.instance.s0))], _EXACT)

    def newton_step(self) -> PrimalDual:
        """The Newton step on the KKT conditions; it need not be exact to tell how far the solution is."""
        return self._solved(self._system.newton, _FOLLOWED)[0]

    def solve(self, r: Array, d: Array, values: Array, s0: Array) -> tuple[PrimalDual, float]:
        """x, lambda and mu for (r, d, c) and given entries of s_0, and the relative residual.

        A singular reduced Hessian divides by zero: infinities and NaN come out, and `curvature` says why.
        """
        return self._solved([r, d, values, s0], _EXACT)

    def _solved(self, right: list[Array], enough: float) -> tuple[PrimalDual, float]:
        point, residual = self._linear.solve(right, enough, _REFINEMENTS)
        return PrimalDual(*point), residual

    def change_nearby(self, nearby: KKTSystem, slope: Array, adjoint: PrimalDual) -> float:
        """Relative change of the adjoint of a slope, in the decisions, when the system becomes one nearby.

        These factors find it when the two systems differ little: corrections get shorter, and so do residuals.
        """
        return self._linear.change(nearby.linear, slope, [adjoint.x, adjoint.costates, adjoint.forces])


@lru_cache(maxsize=64)
def start(size: int) -> Array:
    """A vector that is random but always the same."""
    vector = np.random.default_rng(0).normal(size=size)
    vector.flags.writeable = False
    return vector
