"""The implicit function theorem on the KKT conditions: products with the derivative of a solution.

With v = (x, lambda, mu), p = (psi, s_0, c) and F(v; p) = (grad_x Lagrangian, defects, active constraints) = 0,

    dv/dp = -(dF/dv)^{-1} dF/dp.

`push` is the Jacobian-vector product for a tangent of p; the vector-Jacobian product for a cotangent of x is that of
`kpirl_ocp.ocp.sensitivity.evidence.measure`. Whether the derivative exists is not checked here: `sensitivity` returns
it with a certificate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, at_solution
from kpirl_ocp.types import Array, Solution


class ByParameters(NamedTuple):
    """Gradients by psi (n_psi,), s_0 (n_s,) and the context (n_c,)."""

    psi: Array
    s0: Array
    context: Array

    @classmethod
    def empty(cls, problem: OCP) -> ByParameters:
        """Uninitialised arrays."""
        return cls(np.empty(problem.n_parameters), np.empty(problem.n_states), np.empty(problem.n_context))

    @property
    def structure(self) -> Any:
        """The structure `kpirl_mpc_by_parameters` that shows these arrays to the C code."""
        return c.ByParameters(c.address_of(self.psi), c.address_of(self.s0), c.address_of(self.context))


@dataclass(frozen=True)
class ImplicitFunction:
    """The linearised KKT conditions at a solution, factorised once for any number of products."""

    system: KKTSystem
    factors: Factorisation

    @classmethod
    def at(cls, problem: OCP, solution: Solution) -> ImplicitFunction:
        """Linearise and factorise at a solution; one with a barrier is a solution of the smoothed problem."""
        system = at_solution(problem, solution)
        return cls(system, Factorisation(system))

    def push(self, direction: ByParameters) -> tuple[PrimalDual, float]:
        """Change of the solution when psi, s_0 and the context change, and the relative residual of its system.

        Free entries of s_0 are decisions: their entries in `direction` are ignored.
        """
        system, instance = self.system, self.system.instance
        at, (z, nu) = system.point, instance.rows.split(system.point.forces)[1:]
        dr, ddefects, dpath, dequality = call(instance.problem, parameter_derivatives.push)(
            at.x, instance.psi, instance.context, at.costates, z, nu, direction.psi, direction.context
        )
        values = np.concatenate([np.zeros(instance.rows.n_bounds), dpath, dequality])  # change of all rows
        right = -dr - system.transposed_times(system.stiffness * values)
        fixed = np.where(system.active, -values, 0.0)
        return self.factors.solve(PrimalDual(right, -ddefects, fixed), direction.s0)
