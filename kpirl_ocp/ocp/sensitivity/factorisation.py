"""Factorisation of the KKT system of `kpirl_ocp.ocp.sensitivity.kkt_system` by a Riccati recursion: solves in O(T)."""

from __future__ import annotations

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, Triple
from kpirl_ocp.types import Array


class Factorisation:
    """The factors of a KKT system, and two numbers on its conditioning.

    Decisions are scaled by their own curvature (`KKTSystem.roots`), so that neither number depends on units.

    system: the factorised system; its memory holds the factors.
    curvature: smallest eigenvalue of the reduced Hessian if all are positive, else one that is not. It is estimated
        from above by a few products with the matrix; where many eigenvalues lie close together, as with long horizons,
        it is too large by about ten per cent. Infinite when the active constraints leave no freedom.
    qualification: smallest singular value of the active rows as functions of the decisions, each of length one (LICQ);
        infinite when no row is active.
    """

    def __init__(self, system: KKTSystem) -> None:
        self.system = system
        c.library().kpirl_mpc_kkt_condition(system.address)
        self.curvature = float(system.structure.lowest)
        self.qualification = float(system.structure.qualification)

    def solve(self, right: PrimalDual, s0: Array) -> tuple[PrimalDual, float]:
        """x, lambda and mu for the right-hand side (r, d, c) and given entries of s_0, and the relative residual.

        With a singular reduced Hessian the result holds infinities and NaN; `curvature` is then not positive.
        """
        given, found = Triple(right, s0), self._empty()
        residual = c.library().kpirl_mpc_kkt_solve(self.system.address, given.address, found.address)
        return found.point, float(residual)

    def _empty(self) -> Triple:
        return Triple(PrimalDual(*(np.empty(size) for size in self.system.sizes_of_parts)))
