"""The implicit function theorem on the KKT conditions: products with the derivative of a solution.

With v = (w, lambda, mu), p = (psi, s_0, c) and F(v; p) = (grad_w Lagrangian, defects, active constraints) = 0,

    dv/dp = -(dF/dv)^{-1} dF/dp.

`pull` is the vector-Jacobian product for a cotangent of w, `push` the Jacobian-vector product for a tangent of p.
Whether the derivative exists is for a certificate to say (`sensitivity`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.conditions.nlp import unpack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, PrimalDual, linearise, primal_dual
from kpirl_ocp.types import Array, Solution, Trajectory


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
        """Gradients of a function of w, from the solution of its adjoint system (`Factorisation.adjoint`)."""
        system, problem = self.system, self.system.instance.problem
        n_s, forces, (x, last) = problem.n_states, self._path_forces(adjoint), system.by_stage(adjoint.w)
        at = *system.instance.arguments(system.point), x, last, adjoint.costates, forces
        by_psi, by_context = call(problem, parameter_derivatives.pull)(*at)
        by_start = system.H[0] @ x[0] + system.F[0] @ adjoint.costates[:n_s]
        by_start += system.G[0] @ forces.reshape(problem.horizon, -1)[0]
        return ByParameters(-by_psi, -by_start[:n_s], -by_context)

    def push(self, direction: ByParameters) -> tuple[Trajectory, float]:
        """Change of the trajectory when psi, s_0 and the context move, and the relative residual of its system."""
        system, instance = self.system, self.system.instance
        problem, n_s = instance.problem, instance.problem.n_states
        at = *instance.arguments(system.point), direction.psi, direction.context
        dr, dr_last, ddefects, dpath = call(problem, parameter_derivatives.push)(*at)
        x = np.zeros((problem.horizon, n_s + problem.n_actions))
        x[0, :n_s] = direction.s0
        dr = dr.reshape(x.shape) + (system.H @ x[:, :, None])[:, :, 0]
        ddefects = ddefects + (x[:, None, :] @ system.F).ravel()
        dpath = dpath + (x[:, None, :] @ system.G).ravel()
        values = np.concatenate([np.zeros(len(system.active) - len(dpath)), dpath])  # change of all inequalities
        right = -system.flat(dr, dr_last) - system.times_transposed_rows(system.stiffness * values)
        change, residual = self.factors.solve(right, -ddefects, np.where(system.active, -values, 0.0))
        return unpack(problem, direction.s0, change.w), residual

    def _path_forces(self, adjoint: PrimalDual) -> Array:
        """Changes of the path constraints' forces (T n_h,), of the smoothed ones too."""
        system, instance = self.system, self.system.instance
        if not instance.barrier > 0:
            return instance.path_forces(adjoint.forces)
        return instance.path_forces(adjoint.forces + system.stiffness * system.times_rows(adjoint.w))
