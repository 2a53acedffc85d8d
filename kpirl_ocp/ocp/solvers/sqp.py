"""Sequential quadratic programming on the multiple-shooting program: CasADi's `sqpmethod` with its QP solver `qrqp`.

Slower than `riccati`, because its quadratic programs know nothing of stages, and slow where hundreds of bounds become
active; but all of it is code that CasADi generates. Hessians are those of `conditions.curvature`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.interrupts import call_solver
from kpirl_ocp.ocp.conditions.curvature import hessian
from kpirl_ocp.ocp.problem.guards import one_at_a_time
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.ocp.solvers.infeasible import shown_infeasible
from kpirl_ocp.ocp.solvers.instance import Instance, nonlinear_program
from kpirl_ocp.types import Solution, Status


@dataclass(frozen=True)
class SQP:
    """Exact Hessians, with a weight where they bend down, for every problem; warm start from a `Solution`.

    Steps are shortened to a third at most, because the penalty of the merit function never falls: far from a solution
    the violation may grow, and a start may fail that `Riccati` solves.

    tolerance: on `KKTResiduals.worst`.
    max_iterations: quadratic programs before it gives up.
    """

    tolerance: float = 1e-8
    max_iterations: int = 200

    def __post_init__(self) -> None:
        check_settings(self, "tolerance", "max_iterations")
        if not 0 < self.tolerance < np.inf or self.max_iterations < 1:
            raise ProblemError("SQP needs tolerance > 0 and max_iterations >= 1.")

    @one_at_a_time
    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        instance = Instance.of(problem, s0, psi, context, guess)
        if not instance.finite:
            return instance.not_started()
        solver = program(problem, self)
        result = call_solver(solver, **instance.arguments(guess))
        iterations, word = _statistics(solver)

        def judge(residual: float) -> Status:
            if not np.isfinite(residual):
                return Status.NOT_FINITE
            if shown_infeasible(instance):
                return Status.INFEASIBLE
            return Status.ITERATION_LIMIT if iterations >= self.max_iterations else Status.STALLED

        return instance.solution(
            instance.point(result),
            self.tolerance,
            judge,
            objective=float(result["f"]),
            iterations=iterations,
            message=f"sqpmethod: {word}",
        )


def _statistics(solver: ca.Function) -> tuple[int, str]:
    """Iterations and CasADi's word, which is missing where a quadratic program was not solved."""
    try:
        stats = solver.stats()
    except RuntimeError:
        return 0, "no word"
    return int(stats["iter_count"]), str(stats["return_status"])


@lru_cache(maxsize=64)
def program(problem: OCP, solver: SQP) -> ca.Function:
    """The solver of `conditions.program.transcribe`, by the names of `casadi.nlpsol`; p is (psi, c)."""
    return ca.nlpsol("sqp", "sqpmethod", nonlinear_program(problem), _options(solver) | {"hess_lag": hessian(problem)})


def _options(solver: SQP) -> dict[str, Any]:
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    return {
        "qpsol": "qrqp",
        # it marks degenerate bounds as active by the smallest numbers there are, which do not last
        "qpsol_options": quiet | {"min_lam": 1e-12},
        "max_iter_ls": 6,  # 0.8^5 = 0.33
        "max_iter": solver.max_iterations,
        "tol_pr": solver.tolerance,
        "tol_du": solver.tolerance,
        "error_on_fail": False,
        "show_eval_warnings": False,
        **{f"print_{what}": False for what in ("header", "iteration", "status", "time")},
    }
