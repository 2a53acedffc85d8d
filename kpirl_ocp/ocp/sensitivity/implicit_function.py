"""The implicit function theorem on the KKT conditions: products with the derivative of a solution.

With v = (x, lambda, mu), p = (psi, s_0, c) and F(v; p) = (grad_x Lagrangian, defects, active constraints) = 0,

    dv/dp = -(dF/dv)^{-1} dF/dp.

`pull` is the vector-Jacobian product for a cotangent of x, `push` the Jacobian-vector product for a tangent of p.
Whether the derivative exists is for a certificate to say (`sensitivity`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, PrimalDual, linearise, primal_dual
from kpirl_ocp.types import Array, Solution


class ByParameters(NamedTuple):
    """Gradients by psi (n_psi,), s_0 (n_s,) and the context (n_c,)."""

    psi: Array
    s0: Array
    context: Array


@dataclass(frozen=True)
class ImplicitFunction:
    """The linearised KKT conditions at a solution, factorised once for any number of products."""

    system: KKTSystem
    factors: Factorisation

    @classmethod
    def at(cls, problem: OCP, solution: Solution) -> ImplicitFunction:
        """At a solution of a problem, smoothed with the solution's barrier."""
        instance = Instance.of(problem, solution)
        system = linearise(instance, primal_dual(instance, solution))
        return cls(system, Factorisation(system))

    def pull(self, adjoint: PrimalDual) -> ByParameters:
        """Gradients of a function of x, from the solution of its adjoint system (`Factorisation.adjoint`)."""
        system, problem = self.system, self.system.instance.problem
        by_start = -system.linear.balance([adjoint.x, adjoint.costates, adjoint.forces])[: problem.n_states]
        by_start[problem.free_start] = 0.0
        by_psi, by_context = self.pull_at(adjoint, system.instance.psi, system.instance.context)
        return ByParameters(by_psi, by_start, by_context)

    def pull_at(self, adjoint: PrimalDual, psi: Array, context: Array) -> tuple[Array, Array]:
        """Gradients by psi and the context, taken at others than those of the solution."""
        system = self.system
        forces = self._changed_forces(adjoint)
        changes = adjoint.x, adjoint.costates, *system.instance.rows.split(forces)[1:]
        at, (z, nu) = system.point, system.instance.rows.split(system.point.forces)[1:]
        by_psi, by_context = call(system.instance.problem, parameter_derivatives.pull)(
            at.x, psi, context, at.costates, z, nu, *changes
        )
        return -by_psi, -by_context

    def weights(self, adjoint: PrimalDual) -> Array:
        """The weights of `conditions` in the gradients."""
        forces = self._changed_forces(adjoint)[self.system.instance.rows.n_bounds :]
        return np.concatenate([adjoint.x, adjoint.costates, forces])

    def conditions(self, direction: ByParameters, length: float) -> Array:
        """Gradient of the Lagrangian, defects, path constraints and equalities when psi, s_0 and the context move."""
        instance, free = self.system.instance, self.system.instance.problem.free_start
        moved = replace(
            instance,
            psi=instance.psi + length * direction.psi,
            s0=instance.s0 + length * direction.s0,
            context=instance.context + length * direction.context,
        )
        x = self.system.point.x.copy()
        x[: len(free)] += np.where(free, 0.0, length * direction.s0)
        at = moved.values(replace(self.system.point, x=x))
        return np.concatenate([at.gradient, at.defects, at.path, at.equality])

    def push(self, direction: ByParameters) -> tuple[PrimalDual, float]:
        """Change of the solution when psi, s_0 and the context move, and the relative residual of its system.

        Entries of s_0 that are free do not follow `direction`.
        """
        system, instance = self.system, self.system.instance
        at, (z, nu) = system.point, instance.rows.split(system.point.forces)[1:]
        dr, ddefects, dpath, dequality = call(instance.problem, parameter_derivatives.push)(
            at.x, instance.psi, instance.context, at.costates, z, nu, direction.psi, direction.context
        )
        values = np.concatenate([np.zeros(instance.rows.n_bounds), dpath, dequality])  # change of all rows
        right = -dr - system.linear.transposed_times(system.stiffness * values)
        return self.factors.solve(right, -ddefects, np.where(system.active, -values, 0.0), direction.s0)

    def _changed_forces(self, adjoint: PrimalDual) -> Array:
        """Changes of the rows' forces (n_rows,), of the smoothed ones too."""
        system = self.system
        if not system.instance.barrier > 0:
            return adjoint.forces
        return adjoint.forces + system.stiffness * system.linear.times(adjoint.x)
