"""Ipopt on the multiple-shooting program (Waechter and Biegler, 2006)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.interrupts import call_solver
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.conditions.program import (
    limits_from,
    not_started,
    starting_point,
    trajectory_of,
    transcribe,
)
from kpirl_ocp.ocp.problem.layout import bound_multipliers, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.ocp.problem.threads import one_at_a_time
from kpirl_ocp.types import Array, Solution, Status

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
        start, psi, context = problem.inputs(s0, psi, context)
        w = starting_point(problem, start, psi, context, guess)
        if not np.isfinite(np.concatenate([w, psi, context])).all():
            return not_started(problem, w, psi, context, "the start, psi or the context holds NaN or infinity")
        solver, program = _build(problem, self, warm=isinstance(guess, Solution)), transcribe(problem)
        lower, upper = limits_from(problem, start)
        arguments = {
            "x0": w,
            "p": np.concatenate([psi, context]),
            "lbx": lower,
            "ubx": upper,
            "lbg": program.lower,
            "ubg": 0.0,
        }
        if isinstance(guess, Solution):
            arguments["lam_x0"] = bound_multipliers(guess.multipliers)
            arguments["lam_g0"] = program.multipliers(guess.multipliers)
        result = call_solver(solver, **arguments)
        return self._solution(problem, start, psi, context, result, solver.stats())

    def _solution(
        self, problem: OCP, s0: Array, psi: Array, context: Array, result: dict[str, ca.DM], stats: dict[str, object]
    ) -> Solution:
        w, nu, lam = (result[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        trajectory = trajectory_of(problem, w, s0)
        multipliers = unpack_multipliers(problem, nu, *np.split(lam, [transcribe(problem).n_equalities]))
        residuals, word = (
            audit(problem, psi, context, trajectory, multipliers, self.barrier),
            str(stats["return_status"]),
        )
        (objective, *_) = transcribe(problem).values(w, psi, context)
        return Solution(
            trajectory=trajectory,
            multipliers=multipliers,
            objective=float(objective),  # Ipopt says 0 where it is not finite
            residuals=residuals,
            status=self._status(word, residuals.worst),
            iterations=min(max(int(str(stats["iter_count"])), 0), self.max_iterations),  # unset when it never started
            psi=psi,
            context=context,
            barrier=self.barrier,
            message=f"Ipopt: {word}",
        )

    def _status(self, word: str, residual: float) -> Status:
        """Converged is what meets the tolerance, whether Ipopt is content, and wanted more, or not."""
        if residual <= self.tolerance:
            return Status.CONVERGED
        status = _STATUS.get(word, Status.FAILED)
        return Status.STALLED if status is Status.CONVERGED else status


@lru_cache(maxsize=64)
def _build(problem: OCP, solver: Ipopt, warm: bool) -> ca.Function:
    program = transcribe(problem)
    w, *numbers = program.symbols
    nlp = {"x": w, "p": ca.vertcat(*numbers), "f": program.values(*program.symbols)[0], "g": program.rows}
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
    return ca.nlpsol("ipopt", "ipopt", nlp, {"ipopt": options, "print_time": False, "show_eval_warnings": False})
