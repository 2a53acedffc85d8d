"""Ipopt on the multiple-shooting program (Waechter and Biegler, 2006)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.interrupts import call_solver
from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.guards import one_at_a_time
from kpirl_ocp.ocp.problem.layout import pack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.ocp.solvers.instance import Instance, nonlinear_program
from kpirl_ocp.types import Solution, Status

_STATUS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Search_Direction_Becomes_Too_Small": Status.STALLED,
    "Restoration_Failed": Status.STALLED,
    "Error_In_Step_Computation": Status.STALLED,
    "Diverging_Iterates": Status.DIVERGED,
    "Invalid_Number_Detected": Status.NOT_FINITE,
}


@dataclass(frozen=True)
class Ipopt:
    """Interior-point solver with exact Hessian for every problem; warm start from a `Solution`.

    tolerance: Ipopt's own, on the unscaled program.
    max_iterations: before it gives up.
    barrier: complementarity tau at which to stop. Zero solves the problem itself; tau > 0 solves
        min J - tau sum log(slack), whose solution is a smooth function of psi.
    """

    tolerance: float = 1e-10
    max_iterations: int = 500
    barrier: float = 0.0

    def __post_init__(self) -> None:
        check_settings(self, "tolerance", "barrier", "max_iterations")
        if not self.tolerance > 0 or not self.barrier >= 0 or self.max_iterations < 1:
            raise ProblemError("Ipopt needs tolerance > 0, barrier >= 0 and max_iterations >= 1.")

    def with_barrier(self, barrier: float) -> Ipopt:
        """This solver for the problem smoothed with tau = barrier."""
        return replace(self, barrier=barrier)

    @one_at_a_time
    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        instance = Instance.of(problem, s0, psi, context, guess)
        if not instance.finite:
            return instance.not_started()
        solver = _build(problem, self, warm=isinstance(guess, Solution))
        point = instance.point(call_solver(solver, **instance.arguments(guess)))
        stats = solver.stats()
        word = str(stats["return_status"])
        (objective, *_) = transcribe(problem).values(pack(point[0]), instance.psi, instance.context)
        return instance.solution(
            point,
            self.tolerance,
            lambda _: _short_of_tolerance(word),
            objective=float(objective),  # Ipopt says 0 where it is not finite
            iterations=int(stats["iter_count"]) if "iterations" in stats else 0,  # else the count is unset
            message=f"Ipopt: {word}",
            barrier=self.barrier,
        )


def _short_of_tolerance(word: str) -> Status:
    """The status where the residuals miss the tolerance, whether Ipopt is content or not."""
    status = _STATUS.get(word, Status.FAILED)
    return Status.STALLED if status is Status.CONVERGED else status


@lru_cache(maxsize=64)
def _build(problem: OCP, solver: Ipopt, warm: bool) -> ca.Function:
    options = {
        "tol": solver.tolerance,
        "max_iter": solver.max_iterations,
        "mu_target": solver.barrier,
        "acceptable_iter": 0,
        "nlp_scaling_method": "none",  # tolerances and multipliers in the user's units; mu_target is scaled with them
        "bound_relax_factor": 0.0,  # the default moves every bound by 1e-8
        "print_level": 0,
        "sb": "yes",
    }
    if solver.barrier > 0:
        # Start at the one barrier problem to be solved; kappa_d would add a linear term to one-sided constraints.
        # The tolerance bounds multiplier * slack - tau, so it has to be small beside tau.
        tolerance = min(solver.tolerance, max(1e-6 * solver.barrier, 1e-13))
        options |= {"tol": tolerance, "mu_init": solver.barrier, "kappa_d": 0.0}
    if warm:
        options |= {
            "warm_start_init_point": "yes",
            "mu_init": solver.barrier or 1e-6,
            "warm_start_bound_push": 1e-8,
            "warm_start_slack_bound_push": 1e-8,
            "warm_start_mult_bound_push": 1e-8,
            "warm_start_bound_frac": 1e-8,
            "warm_start_slack_bound_frac": 1e-8,
        }
    return ca.nlpsol(
        "ipopt",
        "ipopt",
        nonlinear_program(problem),
        {"ipopt": options, "print_time": False, "show_eval_warnings": False},
    )
