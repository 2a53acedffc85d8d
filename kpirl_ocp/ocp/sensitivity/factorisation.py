"""The KKT system of `kpirl_ocp.ocp.sensitivity.kkt_system`, factorised by one Riccati recursion and solved in O(T)."""

from __future__ import annotations

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, Triple
from kpirl_ocp.types import Array


class Factorisation:
    """The factors of a KKT system, and what it is conditioned by.

    Decisions are measured by their own curvature (`KKTSystem.roots`), so that no unit counts.

    curvature: smallest eigenvalue of the reduced Hessian (with a minimum; else one that is not positive). Estimated
        from above by a few products: where many eigenvalues lie close together, as in long horizons, by some ten per
        cent. Infinite when the active constraints leave no freedom.
    qualification: smallest singular value of the active rows in the decisions, of length one each (LICQ); infinite
        without.
    """

    def __init__(self, system: KKTSystem) -> None:
        self._system, self._library = system, c.library()
        self._library.kpirl_mpc_kkt_condition(system.address)
        self.curvature = float(system.structure.lowest)
        self.qualification = float(system.structure.qualification)

    def adjoint(self, slope: Array) -> tuple[PrimalDual, float]:
        """The solution for (slope, 0, 0), and its relative residual."""
        _, n_c, m = self._system.sizes_of_parts
        return self.solve(PrimalDual(slope, np.zeros(n_c), np.zeros(m)), np.zeros(len(self._system.instance.s0)))

    def newton_step(self) -> PrimalDual:
        """The Newton step on the KKT conditions; it need not be exact to tell how far the solution is."""
        self._library.kpirl_mpc_kkt_step(self._system.address)
        return self._system.read(self._system.structure.move)

    def solve(self, right: PrimalDual, s0: Array) -> tuple[PrimalDual, float]:
        """x, lambda and mu for (r, d, c) and given entries of s_0, and the relative residual.

        A singular reduced Hessian divides by zero: infinities and NaN come out, and `curvature` says why.
        """
        given, found = Triple(right, s0), self._empty()
        residual = self._library.kpirl_mpc_kkt_solve(self._system.address, given.address, found.address)
        return found.point, float(residual)

    def change_nearby(self, nearby: KKTSystem, slope: Array, adjoint: PrimalDual) -> float:
        """Relative change of the adjoint of a slope, in the decisions, when the system becomes one nearby.

        These factors find it when the two systems differ little: corrections get shorter, and so do residuals.
        Infinite if they do not.
        """
        moving = Triple(PrimalDual(adjoint.x.copy(), adjoint.costates.copy(), adjoint.forces.copy()))
        r = np.ascontiguousarray(slope, float)
        addresses = self._system.address, nearby.address, r.ctypes.data, moving.address
        return float(self._library.kpirl_mpc_kkt_change(*addresses))

    def _empty(self) -> Triple:
        return Triple(PrimalDual(*(np.empty(size) for size in self._system.sizes_of_parts)))
