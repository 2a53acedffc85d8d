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
class WeightedConditions:
    """The sum of weights times the KKT conditions at a point, as a function of psi, s_0 and the context."""

    instance: Instance
    point: PrimalDual
    weights: PrimalDual

    def gradients(self, by_start: Array) -> ByParameters:
        """Its derivatives; that by s_0 is given."""
        by_psi, by_context = self.gradients_at(self.instance.psi, self.instance.context)
        return ByParameters(by_psi, by_start, by_context)

    def gradients_at(self, psi: Array, context: Array) -> tuple[Array, Array]:
        """Those by psi and the context, taken at others than those of the instance."""
        split, at, w = self.instance.rows.split, self.point, self.weights
        by_psi, by_context = call(self.instance.problem, parameter_derivatives.pull)(
            at.x, psi, context, at.costates, *split(at.forces)[1:], w.x, w.costates, *split(w.forces)[1:]
        )
        return by_psi, by_context

    @property
    def flat(self) -> Array:
        """The weights of `conditions`."""
        return np.concatenate(
            [self.weights.x, self.weights.costates, self.weights.forces[self.instance.rows.n_bounds :]]
        )

    def conditions(self, direction: ByParameters, length: float) -> Array:
        """Gradient of the Lagrangian, defects, path constraints and equalities when psi, s_0 and the context move."""
        instance, free = self.instance, self.instance.problem.free_start
        moved = replace(
            instance,
            psi=instance.psi + length * direction.psi,
            s0=instance.s0 + length * direction.s0,
            context=instance.context + length * direction.context,
        )
        x = self.point.x.copy()
        x[: len(free)] += np.where(free, 0.0, length * direction.s0)
        at = moved.values(replace(self.point, x=x))
        return np.concatenate([at.gradient, at.defects, at.path, at.equality])


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
        return ByParameters(*(-by for by in self.weighted(adjoint).gradients(self._by_start(adjoint))))

    def weighted(self, adjoint: PrimalDual) -> WeightedConditions:
        """The conditions, weighed by an adjoint; of smoothed rows with the change of their forces."""
        system = self.system
        forces = adjoint.forces
        if system.instance.barrier > 0:
            forces = forces + system.stiffness * system.linear.times(adjoint.x)
        return WeightedConditions(system.instance, system.point, replace(adjoint, forces=forces))

    def _by_start(self, adjoint: PrimalDual) -> Array:
        """Derivative (n_s,) of the weighted conditions by the given entries of s_0."""
        problem = self.system.instance.problem
        balance = self.system.linear.balance([adjoint.x, adjoint.costates, adjoint.forces])
        return np.where(problem.free_start, 0.0, balance[: problem.n_states])

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
