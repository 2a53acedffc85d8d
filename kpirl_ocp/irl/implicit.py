"""The implicit gradient: differentiate the KKT conditions at a solution, whatever solver found it.

With v = (w, lambda, mu) and F(v; psi) = (grad_w Lagrangian, defects, active constraints) = 0, the implicit function
theorem gives

    dL/dpsi = -vbar . dF/dpsi,    (dF/dv) vbar = (dL/dw, 0, 0),

one adjoint solve with the symmetric KKT matrix (`kpirl_ocp.ocp.sensitivity`), however many parameters there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradient import Certificate, HypergradientResult, check_policy, enforce, not_finite, seen
from kpirl_ocp.irl.loss import Loss, squared_distance
from kpirl_ocp.ocp.ipopt import Ipopt
from kpirl_ocp.ocp.kkt import pack, transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.sensitivity import Adjoint, KKTSystem, linearise, solve_adjoint
from kpirl_ocp.ocp.solver import Guess, Solver
from kpirl_ocp.types import Array, Demonstration, Mask, Solution, Status

# What a certified gradient needs. Every bound sits well above what rounding and a solver tolerance of 1e-10 leave
# behind, and well below what a healthy problem shows.
KKT_RESIDUAL = 1e-6
CURVATURE = 1e-8  # smallest eigenvalue of the reduced Hessian over the largest of the condensed Hessian
QUALIFICATION = 1e-7  # smallest singular value of the active Jacobian, rows of length one
MARGIN = 1e-5  # larger of multiplier and slack; a weakly active row has about sqrt(1e-11) of both after Ipopt
LINEAR_RESIDUAL = 1e-8


@dataclass(frozen=True, kw_only=True)
class ImplicitCertificate(Certificate):
    """Evidence for an implicit gradient.

    kkt_residual: of the solution, relative (`KKTResiduals.worst`).
    curvature: smallest eigenvalue of the reduced Hessian over the largest |eigenvalue| of the condensed Hessian; the
        second-order condition asks it to be positive. Infinite when the active constraints leave no freedom.
    qualification: smallest singular value of the normalised active Jacobian (LICQ); infinite when nothing is active.
    margin: smallest of max(multiplier, slack) over the inequalities (strict complementarity); infinite without any.
    linear_residual: of the KKT system, relative.
    active: (n_ineq,) bool; finite lower bounds of w, finite upper bounds of w, then path constraints stage by stage.
    barrier: tau; above zero the gradient is that of the smoothed problem.
    """

    kkt_residual: float
    curvature: float
    qualification: float
    margin: float
    linear_residual: float
    active: Mask
    barrier: float


@dataclass(frozen=True)
class Implicit:
    """The gradient of the loss at the solution of the OCP.

    solver: any solver; the policy "smooth" needs one that can solve the smoothed problem (Ipopt).
    policy: what to do with a gradient that is not certified: "raise" CertificateError, "flag" it in the certificate;
        "smooth" solves and differentiates the smoothed problem instead, always, so that loss and gradient agree.
    barrier: tau of "smooth"; the smoothed loss differs from the loss by O(tau), or by O(sqrt(tau)) where a
        bound is weakly active.
    """

    solver: Solver = Ipopt()
    loss: Loss = squared_distance
    policy: Literal["raise", "flag", "smooth"] = "raise"
    barrier: float = 1e-4

    def __post_init__(self) -> None:
        check_policy(self.policy, ("raise", "flag", "smooth"))
        if self.policy == "smooth" and not (isinstance(self.solver, Ipopt) and self.barrier > 0):
            raise ProblemError("policy='smooth' needs barrier > 0 and a solver for the smoothed problem: Ipopt().")

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """See `Hypergradient`."""
        solver: Solver = self.solver
        if self.policy == "smooth" and isinstance(solver, Ipopt):
            solver = solver.with_barrier(self.barrier)
        solution = solver.solve(problem, demonstration.s0, psi, demonstration.context, guess)
        return enforce(self.policy, differentiate(problem, demonstration, psi, solution, self.loss))


def differentiate(
    problem: OCP, demonstration: Demonstration, psi: ArrayLike, solution: Solution, loss: Loss = squared_distance
) -> HypergradientResult:
    """Loss, implicit gradient and certificate at a solution that any solver found; read the certificate."""
    s0, psi, context = problem.inputs(demonstration.s0, psi, demonstration.context)
    observed = seen(problem, demonstration)
    outputs = _loss_and_slope(problem, loss)(solution.states.T, solution.actions.T, observed)
    value, slope = float(outputs[0]), np.array(outputs[1]).ravel()
    system = linearise(problem, psi, context, solution)
    if system.finite and np.isfinite(slope).all():
        adjoint = solve_adjoint(system, slope, problem.horizon * problem.n_states)
    else:
        adjoint = Adjoint.undefined(slope, problem.horizon * problem.n_states, system.n_path)
    lam, mu = solution.multipliers.dynamics.ravel(), solution.multipliers.path.ravel()
    arguments = (pack(solution.trajectory), s0, psi, context, lam, mu, adjoint.w, adjoint.dynamics, adjoint.path)
    gradient = -np.array(transcribe(problem).cross(*arguments)).ravel()
    return HypergradientResult(value, gradient, _certificate(solution, system, adjoint, value, gradient))


@lru_cache(maxsize=64)
def _loss_and_slope(problem: OCP, loss: Loss) -> ca.Function:
    """(S (n_s, T+1), U (n_u, T), Z (n_z, T+1)) -> L and dL/dw (n_w,)."""
    states = ca.MX.sym("S", problem.n_states, problem.horizon + 1)
    actions = ca.MX.sym("U", problem.n_actions, problem.horizon)
    observed = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    value = loss(problem)(states, actions, observed)
    slope = ca.vertcat(ca.vec(ca.gradient(value, states)[:, 1:]), ca.vec(ca.gradient(value, actions)))
    return ca.Function("loss_and_slope", [states, actions, observed], [value, slope])


def _certificate(
    solution: Solution, system: KKTSystem, adjoint: Adjoint, loss: float, gradient: Array
) -> ImplicitCertificate:
    residual = solution.residuals.worst
    conditions = (
        (
            solution.status is Status.CONVERGED,
            f"The solver did not converge: {solution.status.name}, {solution.status.value}",
        ),
        (
            residual <= KKT_RESIDUAL,
            f"The KKT residual is {residual:.1e}, above {KKT_RESIDUAL:.0e}: solve to a tighter tolerance.",
        ),
        (
            adjoint.curvature >= CURVATURE,
            f"The reduced Hessian has relative eigenvalue {adjoint.curvature:.1e}, below {CURVATURE:.0e}: this is no "
            "strict minimum; add effort weight, or start elsewhere.",
        ),
        (
            adjoint.qualification >= QUALIFICATION,
            f"Active constraints depend on each other (singular value {adjoint.qualification:.1e}): remove one.",
        ),
        (
            system.margin >= MARGIN,
            f"An inequality is weakly active (multiplier and slack at most {system.margin:.1e}): the gradient differs "
            "on either side; use policy='smooth'.",
        ),
        (
            adjoint.residual <= LINEAR_RESIDUAL,
            f"The KKT system was solved to {adjoint.residual:.1e} only: it is close to singular.",
        ),
    )
    return ImplicitCertificate(
        solution=solution,
        failures=tuple(not_finite(loss, gradient) + [text for holds, text in conditions if not holds]),
        kkt_residual=residual,
        curvature=adjoint.curvature,
        qualification=adjoint.qualification,
        margin=system.margin,
        linear_residual=adjoint.residual,
        active=system.counted if solution.barrier == 0 else np.zeros_like(system.counted),
        barrier=solution.barrier,
    )
