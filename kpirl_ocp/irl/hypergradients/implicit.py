"""The implicit gradient: differentiate the KKT conditions at a solution, whatever solver found it.

With v = (w, lambda, mu) and F(v; psi) = (grad_w Lagrangian, defects, active constraints) = 0, the implicit function
theorem gives

    dL/dpsi = -vbar . dF/dpsi,    (dF/dv) vbar = (dL/dw, 0, 0),

one adjoint solve with the symmetric KKT matrix, however many parameters there are. It is a backward and a forward
sweep over the stages (`kpirl_ocp.ocp.sensitivity.implicit_function`): O(T) in time and memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import (
    Certificate,
    HypergradientResult,
    check_policy,
    enforce,
    not_finite,
    seen,
)
from kpirl_ocp.irl.hypergradients.loss import Loss, squared_distance
from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import refuse_features
from kpirl_ocp.ocp.problem.solver import BarrierSolver, Guess, Solver, StageDerivatives, solve_and_linearise
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.implicit_function import Response
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, linearise, primal_dual
from kpirl_ocp.ocp.sensitivity.nearby_tests import Probe, probe
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Demonstration, Mask, Solution, Status

# What a certified gradient needs. Every bound sits well above what rounding and a solver tolerance of 1e-10 leave
# behind, and well below what a healthy problem shows.
KKT_RESIDUAL = 1e-6
CURVATURE = 1e-8
QUALIFICATION = 1e-5
STEP = 1e-5
MARGIN = 1e-7
CHANGE = 1e-4
KINK = 1e-3
LINEAR_RESIDUAL = 1e-8


@dataclass(frozen=True, kw_only=True)
class ImplicitCertificate(Certificate):
    """Evidence for an implicit gradient.

    kkt_residual: of the solution, relative (`KKTResiduals.worst`).
    curvature: smallest eigenvalue of the reduced Hessian over the largest |eigenvalue| of the condensed Hessian; the
        second-order condition asks it to be positive. Its sign is exact, its size an estimate from above. Infinite when
        the active constraints leave no freedom.
    qualification: smallest singular value of the normalised active Jacobian (LICQ); infinite when nothing is active.
    step: length of a Newton step on the KKT conditions with this active set, relative: the error of the solution.
    margin: smallest multiplier of an active and slack of an inactive row after that step (strict complementarity);
        infinite without inequalities.
    change: relative change of the adjoint under the step: is the solution close enough to differentiate?
    kink: relative disagreement of second derivatives with differences of the gradient: is the problem smooth here?
    linear_residual: of the adjoint system, relative.
    active: (n_ineq,) bool; finite lower bounds of w, finite upper bounds of w, then path constraints stage by stage.
    barrier: tau; above zero the gradient is that of the smoothed problem.
    """

    kkt_residual: float
    curvature: float
    qualification: float
    step: float
    margin: float
    change: float
    kink: float
    linear_residual: float
    active: Mask
    barrier: float


@dataclass(frozen=True)
class Implicit:
    """The gradient of the loss at the solution of the OCP.

    solver: any solver; the policy "smooth" needs one that can solve the smoothed problem (Riccati, Ipopt).
    policy: what to do with a gradient that is not certified: "raise" CertificateError, "flag" it in the certificate;
        "smooth" solves and differentiates the smoothed problem instead, always, so that loss and gradient agree.
    barrier: tau of "smooth"; the smoothed loss differs from the loss by O(tau), or by O(sqrt(tau)) where a
        bound is weakly active.
    """

    solver: Solver = Riccati()
    loss: Loss = squared_distance
    policy: Literal["raise", "flag", "smooth"] = "raise"
    barrier: float = 1e-4

    def __post_init__(self) -> None:
        check_policy(self.policy, ("raise", "flag", "smooth"))
        if self.policy == "smooth" and not (isinstance(self.solver, BarrierSolver) and self.barrier > 0):
            raise ProblemError(
                "policy='smooth' needs barrier > 0 and a solver for the smoothed problem: Riccati() or Ipopt()."
            )

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """See `Hypergradient`."""
        solver: Solver = self.solver
        if self.policy == "smooth" and isinstance(solver, BarrierSolver):
            solver = solver.with_barrier(self.barrier)
        numbers = demonstration.s0, psi, demonstration.context
        solution, derivatives = solve_and_linearise(solver, problem, *numbers, guess)
        return enforce(self.policy, differentiate(problem, demonstration, psi, solution, self.loss, derivatives))


def differentiate(
    problem: OCP,
    demonstration: Demonstration,
    psi: ArrayLike,
    solution: Solution,
    loss: Loss = squared_distance,
    derivatives: StageDerivatives | None = None,
) -> HypergradientResult:
    """Loss, implicit gradient and certificate at a solution that any solver found; read the certificate.

    derivatives: at the solution, where the solver ended with them.
    """
    s0, psi, context = problem.inputs(demonstration.s0, psi, demonstration.context)
    refuse_features(problem, "the implicit gradient")
    evaluate = call(problem, _loss_and_slope(loss))
    (value,), slope = evaluate(solution.states, solution.actions, seen(problem, demonstration).T)
    value = float(value)
    instance = Instance(problem, s0, psi, context, solution.barrier)
    system = linearise(instance, primal_dual(instance, solution), derivatives=derivatives)
    if not system.finite or not np.isfinite(slope).all():
        return _undefined(value, len(psi), solution, system.active)

    response = Response(system, Factorisation(system, slope))
    adjoint, residual = response.factors.adjoint(slope)
    gradient, _ = response.by_parameters(adjoint)

    nearby = Probe(np.inf, np.nan, np.inf, np.inf)
    if np.isfinite(adjoint.w).all():
        nearby = probe(system, response.factors, slope, adjoint)
    evidence = ImplicitCertificate(
        solution=solution,
        failures=(),
        kkt_residual=solution.residuals.worst,
        curvature=response.factors.curvature,
        qualification=response.factors.qualification,
        step=nearby.step,
        margin=nearby.margin,
        change=nearby.change,
        kink=nearby.kink,
        linear_residual=residual,
        active=system.active,
        barrier=solution.barrier,
    )
    failures = tuple(not_finite(value, gradient) + _failures(evidence))
    return HypergradientResult(value, gradient, replace(evidence, failures=failures))


@lru_cache(maxsize=64)
def _loss_and_slope(loss: Loss) -> Callable[[OCP], ca.Function]:
    """problem -> (S (n_s, T+1), U (n_u, T), Z (n_z, T+1)) -> L and dL/dw (n_w,)."""

    def build(problem: OCP) -> ca.Function:
        states = ca.MX.sym("S", problem.n_states, problem.horizon + 1)
        actions = ca.MX.sym("U", problem.n_actions, problem.horizon)
        observed = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
        value = loss(problem)(states, actions, observed)
        slope = ca.vertcat(ca.vec(ca.gradient(value, states)[:, 1:]), ca.vec(ca.gradient(value, actions)))
        return ca.Function("loss_and_slope", [states, actions, observed], [ca.densify(x) for x in (value, slope)])

    return build


def _undefined(loss: float, n_parameters: int, solution: Solution, active: Mask) -> HypergradientResult:
    """The answer where derivatives are NaN or infinite: NaN, and said so."""
    gradient = np.full(n_parameters, np.nan)
    names = ("curvature", "qualification", "step", "margin", "change", "kink", "linear_residual")
    certificate = ImplicitCertificate(
        solution=solution,
        failures=(*not_finite(loss, gradient), _not_converged(solution)),
        kkt_residual=solution.residuals.worst,
        active=active,
        barrier=solution.barrier,
        **dict.fromkeys(names, np.nan),
    )
    return HypergradientResult(loss, gradient, certificate)


def _not_converged(solution: Solution) -> str:
    return f"The solver did not converge: {solution.status.name}, {solution.status.value}"


def _failures(found: ImplicitCertificate) -> list[str]:
    """A sentence for every condition that does not hold; comparisons are written so that NaN fails."""
    conditions = (
        (found.solution.status is Status.CONVERGED, _not_converged(found.solution)),
        (
            found.kkt_residual <= KKT_RESIDUAL,
            f"The KKT residual is {found.kkt_residual:.1e}, above {KKT_RESIDUAL:.0e}: solve to a tighter tolerance.",
        ),
        (
            found.curvature >= CURVATURE,
            f"The reduced Hessian has relative eigenvalue {found.curvature:.1e}, below {CURVATURE:.0e}: this is no "
            "strict minimum; add effort weight, or start elsewhere.",
        ),
        (
            found.qualification >= QUALIFICATION,
            f"Active constraints depend on each other (singular value {found.qualification:.1e}): remove one.",
        ),
        (
            found.step <= STEP,
            f"A Newton step still moves the solution by {found.step:.1e}: solve to a tighter tolerance, or scale the "
            "cost up.",
        ),
        (
            found.margin >= MARGIN,
            f"An inequality is weakly active, or its side is unclear (margin {found.margin:.1e}): the gradient may "
            "differ on either side; use policy='smooth'.",
        ),
        (
            found.change <= CHANGE,
            f"A Newton step changes the adjoint by {found.change:.1e} of itself: the solution is too far from exact, "
            "or about to jump; solve to a tighter tolerance, rescale the cost, or add effort weight.",
        ),
        (
            found.kink <= KINK,
            f"Second derivatives disagree with differences by {found.kink:.1e}: the solution sits on a kink; use a "
            "smooth cost and dynamics (softplus or tanh for ReLU).",
        ),
        (
            found.linear_residual <= LINEAR_RESIDUAL,
            f"The KKT system was solved to {found.linear_residual:.1e} only: it is close to singular.",
        ),
    )
    return [text for holds, text in conditions if not holds]
