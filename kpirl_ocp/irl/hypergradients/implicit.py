"""The implicit gradient: differentiate the KKT conditions at the solution of any solver.

With v = (w, lambda, mu) and F(v; psi) = (grad_w Lagrangian, defects, active constraints) = 0, the implicit function
theorem gives

    dL/dpsi = -vbar . dF/dpsi,    (dF/dv) vbar = (dL/dw, 0, 0),

one adjoint solve with the symmetric KKT matrix, however many parameters there are. It takes a backward and a forward
pass over the stages (`kpirl_ocp.ocp.sensitivity`): O(T) in time and memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import (
    HypergradientResult,
    enforce,
    nonfinite_failures,
)
from kpirl_ocp.irl.hypergradients.loss import Loss, data_of, squared_distance
from kpirl_ocp.irl.hypergradients.smoothness import LossAt
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import BarrierSolver, Guess, Solver, StageDerivatives, solve_and_linearise
from kpirl_ocp.ocp.sensitivity.certificate import check_policy
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import sensitivity
from kpirl_ocp.ocp.solvers.many import side_by_side
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Demonstration, Solution


@dataclass(frozen=True, repr=False)
class Implicit(Brief):
    """The gradient of the loss at the solution of the OCP.

    solver: any solver; the policy "smooth" needs one that can solve the smoothed problem (Riccati, Ipopt).
    policy: for a gradient that is not certified, "raise" CertificateError or "flag" it in the certificate;
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

    @property
    def inner(self) -> Solver:
        """The solver, under the policy "smooth" that of the smoothed problem."""
        if self.policy == "smooth" and isinstance(self.solver, BarrierSolver):
            return self.solver.with_barrier(self.barrier)
        return self.solver

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """Loss, gradient (n_psi,) and certificate at psi (n_psi,); arguments and errors as in `Hypergradient`."""
        return enforce(self.policy, self._evaluate(problem, psi, demonstration, guess))

    def batch(
        self,
        problem: OCP,
        demonstrations: Sequence[Demonstration],
        psi: ArrayLike,
        guesses: Sequence[Guess] | None = None,
    ) -> list[HypergradientResult]:
        """One result per demonstration, the numbers of single calls; with `Riccati` side by side in threads.

        guesses: initial guesses, one per demonstration; None starts all from zero actions.
        """
        threads = None if isinstance(self.solver, Riccati) and len(demonstrations) > 1 else 1
        one = partial(self._evaluate, problem, psi)
        found = side_by_side(one, demonstrations, guesses or [None] * len(demonstrations), threads=threads)
        return [enforce(self.policy, result) for result in found]

    def _evaluate(
        self, problem: OCP, psi: ArrayLike, demonstration: Demonstration, guess: Guess
    ) -> HypergradientResult:
        numbers = demonstration.s0, psi, demonstration.context
        solution, derivatives = solve_and_linearise(self.inner, problem, *numbers, guess)
        return differentiate(problem, demonstration, solution, self.loss, derivatives)


def differentiate(
    problem: OCP,
    demonstration: Demonstration,
    solution: Solution,
    loss: Loss = squared_distance,
    derivatives: StageDerivatives | None = None,
) -> HypergradientResult:
    """Loss, implicit gradient and certificate at a solution by any solver. Nothing is raised: read the certificate.

    Where Newton steps improve the solution (`SensitivityCertificate.distance`), the loss is that of the improved plan.

    derivatives: those at the solution, if the solver returned them (`solve_and_linearise`).
    """
    derivative = sensitivity(problem, solution, "flag", derivatives)
    at = LossAt(problem, loss, data_of(loss, problem, demonstration), derivative.plan)
    found, tangent = derivative.pull_and_move(at.slopes)
    certificate, nonfinite, kinks = found.certificate, nonfinite_failures(at.value, found.psi), at.kinks(tangent)
    if nonfinite or kinks:
        certificate = replace(certificate, failures=(*nonfinite, *certificate.failures, *kinks))
    return HypergradientResult(at.value, found.psi, certificate)
