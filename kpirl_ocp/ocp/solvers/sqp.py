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
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.conditions.curvature import hessian
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
from kpirl_ocp.ocp.solvers.infeasible import shown_infeasible
from kpirl_ocp.types import Array, Solution, Status

_GAVE_UP = (Status.STALLED, Status.ITERATION_LIMIT)


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
        start, psi, context = problem.inputs(s0, psi, context)
        w = starting_point(problem, start, psi, context, guess)
        if not np.isfinite(np.concatenate([w, psi, context])).all():
            return not_started(problem, w, psi, context, "the start, psi or the context holds NaN or infinity")
        solver, transcribed = program(problem, self), transcribe(problem)
        lower, upper = limits_from(problem, start)
        known = {}
        if isinstance(guess, Solution):
            known["lam_x0"] = bound_multipliers(guess.multipliers)
            known["lam_g0"] = transcribed.multipliers(guess.multipliers)
        p = np.concatenate([psi, context])
        result = call_solver(solver, x0=w, p=p, lbx=lower, ubx=upper, lbg=transcribed.lower, ubg=0.0, **known)
        return self._solution(problem, start, psi, context, w, result, solver)

    def _solution(
        self,
        problem: OCP,
        s0: Array,
        psi: Array,
        context: Array,
        begun: Array,
        result: dict[str, ca.DM],
        solver: ca.Function,
    ) -> Solution:
        w, nu, lam = (result[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        trajectory = trajectory_of(problem, w, s0)
        multipliers = unpack_multipliers(problem, nu, *np.split(lam, [transcribe(problem).n_equalities]))
        residuals = audit(problem, psi, context, trajectory, multipliers)
        iterations, word = _statistics(solver)
        status = self._status(residuals.worst, iterations)
        if status in _GAVE_UP and shown_infeasible(problem, begun, s0, psi, context):
            status = Status.INFEASIBLE
        return Solution(
            trajectory=trajectory,
            multipliers=multipliers,
            objective=float(result["f"]),
            residuals=residuals,
            status=status,
            iterations=iterations,
            psi=psi,
            context=context,
            message=f"sqpmethod: {word}",
        )

    def _status(self, residual: float, iterations: int) -> Status:
        if not np.isfinite(residual):
            return Status.NOT_FINITE
        if residual <= self.tolerance:
            return Status.CONVERGED
        return Status.ITERATION_LIMIT if iterations >= self.max_iterations else Status.STALLED


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
    transcribed = transcribe(problem)
    w, *numbers = transcribed.symbols
    objective = transcribed.values(*transcribed.symbols)[0]
    inputs = {"x": w, "p": ca.vertcat(*numbers), "f": objective, "g": transcribed.rows}
    return ca.nlpsol("sqp", "sqpmethod", inputs, _options(solver) | {"hess_lag": hessian(problem)})


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
