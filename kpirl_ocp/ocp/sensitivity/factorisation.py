"""Factorisation of the KKT system of `kpirl_ocp.ocp.sensitivity.kkt_system` by a Riccati recursion: solves in O(T)."""

from __future__ import annotations

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, Triple
from kpirl_ocp.types import Array


class Factorisation:
    """The factors of a KKT system, and two numbers on its conditioning.

    Decisions are scaled by their own curvature (`KKTSystem.roots`), so that neither number depends on units.

    curvature: smallest eigenvalue of the reduced Hessian if all are positive, else one that is not. It is estimated
        from above by a few products with the matrix; where many eigenvalues lie close together, as with long horizons,
        it is too large by about ten per cent. Infinite when the active constraints leave no freedom.
    qualification: smallest singular value of the active rows as functions of the decisions, each of length one (LICQ);
        infinite when no row is active.
    """

    def __init__(self, system: KKTSystem) -> None:
        self._system, self._library = system, c.library()
        self._library.kpirl_mpc_kkt_condition(system.address)
        self.curvature = float(system.structure.lowest)
        self.qualification = float(system.structure.qualification)

    def adjoint(self, slope: Array) -> tuple[PrimalDual, float]:
        """The solution for the right-hand side (slope, 0, 0), and its relative residual."""
        _, n_c, m = self._system.sizes_of_parts
        return self.solve(PrimalDual(slope, np.zeros(n_c), np.zeros(m)), np.zeros(len(self._system.instance.s0)))

    def newton_step(self) -> PrimalDual:
        """The Newton step on the KKT conditions, without iterative refinement: it only estimates an error."""
        self._library.kpirl_mpc_kkt_step(self._system.address)
        return self._system.read(self._system.structure.move)

    def solve(self, right: PrimalDual, s0: Array) -> tuple[PrimalDual, float]:
        """x, lambda and mu for the right-hand side (r, d, c) and given entries of s_0, and the relative residual.

        With a singular reduced Hessian the result holds infinities and NaN; `curvature` is then not positive.
        """
        given, found = Triple(right, s0), self._empty()
        residual = self._library.kpirl_mpc_kkt_solve(self._system.address, given.address, found.address)
        return found.point, float(residual)

    def change_nearby(self, nearby: KKTSystem, slope: Array, adjoint: PrimalDual) -> float:
        """Relative change of the adjoint of a slope, in the decisions, from this system to one nearby.

        The nearby system is solved by iterative refinement with the factors of this one, which converges if the two
        differ little. Infinite if it does not converge.
        """
        moving = Triple(PrimalDual(adjoint.x.copy(), adjoint.costates.copy(), adjoint.forces.copy()))
        r = np.ascontiguousarray(slope, float)
        addresses = self._system.address, nearby.address, r.ctypes.data, moving.address
        return float(self._library.kpirl_mpc_kkt_change(*addresses))

    def _empty(self) -> Triple:
        return Triple(PrimalDual(*(np.empty(size) for size in self._system.sizes_of_parts)))
