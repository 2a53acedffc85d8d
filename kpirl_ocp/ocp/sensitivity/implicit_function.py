"""How a solution responds to what it was solved for: the implicit function theorem on the KKT conditions.

With v = (w, lambda, mu), p = (psi, s_0, c) and F(v; p) = (grad_w Lagrangian, defects, active constraints) = 0,

    dv/dp = -(dF/dv)^{-1} dF/dp.

`pull` is the vector-Jacobian product for a cotangent of w, `push` the Jacobian-vector product for a tangent of p.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions.parameter_derivatives import pull, push
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, PrimalDual, linearise, primal_dual
from kpirl_ocp.types import Array, Solution, Trajectory


@dataclass(frozen=True)
class Gradients:
    """Gradients of a function of the planned trajectory.

    psi: (n_psi,). s0: (n_s,). context: (n_c,).
    adjoint: (n_w,) the solution of the KKT system they come from; residual: of that system, relative.
    """

    psi: Array
    s0: Array
    context: Array
    adjoint: Array
    residual: float


@dataclass(frozen=True)
class Response:
    """The derivative of a solution, factorised once for any number of products."""

    system: KKTSystem
    factors: Factorisation

    @classmethod
    def at(cls, instance: Instance, solution: Solution) -> Response:
        """At a solution; whether it exists is for a certificate to say (`kpirl_ocp.irl.hypergradients.implicit`)."""
        system = linearise(instance, primal_dual(instance, solution))
        return cls(system, Factorisation(system))

    def pull(self, slope: Array, slope_s0: Array | None = None) -> Gradients:
        """Gradients of a function with gradient `slope` (n_w,) by w, and `slope_s0` (n_s,) by s_0 directly."""
        adjoint, residual = self.factors.adjoint(slope)
        system, n_s = self.system, len(self.system.H_last)
        by_psi, by_context = self.by_parameters(adjoint)
        by_start = system.H[0] @ system.by_stage(adjoint.w)[0][0] + system.F[0] @ adjoint.costates[:n_s]
        by_start += system.G[0] @ self._path_forces(adjoint).reshape(len(system.H), -1)[0]
        direct = np.zeros(n_s) if slope_s0 is None else slope_s0
        return Gradients(by_psi, direct - by_start[:n_s], by_context, adjoint.w, residual)

    def by_parameters(self, adjoint: PrimalDual) -> tuple[Array, Array]:
        """Gradients by psi and by the context, of what `Factorisation.adjoint` gives."""
        system, problem = self.system, self.system.instance.problem
        x, last = system.by_stage(adjoint.w)
        at = *system.instance.arguments(system.point), x, last, adjoint.costates, self._path_forces(adjoint)
        by_psi, by_context = call(problem, pull)(*at)
        return -by_psi, -by_context

    def _path_forces(self, adjoint: PrimalDual) -> Array:
        """Changes of the path constraints' forces (T n_h,), of the smoothed ones too."""
        system, instance = self.system, self.system.instance
        if not instance.barrier > 0:
            return instance.path_forces(adjoint.forces)
        return instance.path_forces(adjoint.forces + system.stiffness * system.times_rows(adjoint.w))

    def push(self, dpsi: Array, ds0: Array, dcontext: Array) -> Trajectory:
        """Change of states (T+1, n_s) and actions (T, n_u) when psi, s_0 and the context move."""
        system, instance = self.system, self.system.instance
        problem, n_s = instance.problem, len(system.H_last)
        dr, dr_last, ddefects, dpath = call(problem, push)(*instance.arguments(system.point), dpsi, dcontext)
        x = np.zeros((len(system.H), system.H.shape[1]))
        x[0, :n_s] = ds0
        dr = dr.reshape(x.shape) + (system.H @ x[:, :, None])[:, :, 0]
        ddefects = ddefects + (x[:, None, :] @ system.F).ravel()
        dpath = dpath + (x[:, None, :] @ system.G).ravel()
        values = np.concatenate([np.zeros(len(system.active) - len(dpath)), dpath])  # change of all inequalities
        right = -system.flat(dr, dr_last) - system.times_transposed_rows(system.stiffness * values)
        w = self.factors.solve(right, -ddefects, np.where(system.active, -values, 0.0))[0].w
        states = np.concatenate([ds0, w[: len(ddefects)]]).reshape(problem.horizon + 1, n_s)
        return Trajectory(states, w[len(ddefects) :].reshape(problem.horizon, -1))
