"""Sequential quadratic programming on the multiple-shooting program: CasADi's `sqpmethod` with its QP solver `qrqp`.

Slower than `riccati`, because it knows nothing of stages; but all of it is code that CasADi generates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.conditions.nlp import bound_multipliers, pack, transcribe, unpack, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import refuse_features
from kpirl_ocp.ocp.problem.solver import Guess, guess_actions
from kpirl_ocp.ocp.problem.threads import one_at_a_time
from kpirl_ocp.types import Array, Solution, Status, Trajectory


@dataclass(frozen=True)
class SQP:
    """Exact Hessians, made convex where they are not; bounds and path constraints; warm start from a `Solution`.

    tolerance: on `KKTResiduals.worst`.
    max_iterations: quadratic programs before it gives up.
    """

    tolerance: float = 1e-8
    max_iterations: int = 50

    def __post_init__(self) -> None:
        if not self.tolerance > 0 or self.max_iterations < 1:
            raise ProblemError("SQP needs tolerance > 0 and max_iterations >= 1.")

    @one_at_a_time
    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`. A `Solution` as guess also hands over its multipliers."""
        start, psi, context = problem.inputs(s0, psi, context)
        refuse_features(problem, "SQP")
        nlp = transcribe(problem)
        if guess is None:
            w = pack(problem.simulate(start, guess_actions(problem, None), psi))
        else:
            w = pack(Trajectory(problem.as_states(guess.states), problem.as_actions(guess.actions)))
        n_path = problem.horizon * problem.n_path
        lam_w, lam_g = np.zeros(len(w)), np.zeros(nlp.n_defects + n_path)
        if isinstance(guess, Solution):
            lam_w = bound_multipliers(guess.multipliers)
            lam_g = np.concatenate([guess.multipliers.dynamics.ravel(), guess.multipliers.path.ravel()])
        lower = np.concatenate([np.zeros(nlp.n_defects), np.full(n_path, -np.inf)])
        parameters = np.concatenate([start, psi, context])
        function = program(problem, self)
        found = function(w, parameters, nlp.lower, nlp.upper, lower, np.zeros(len(lower)), lam_w, lam_g)
        w, objective, _, lam_w, lam_g, _ = (np.array(array).ravel() for array in found)
        trajectory = unpack(problem, start, w)
        multipliers = unpack_multipliers(problem, lam_w, lam_g)
        residuals = audit(problem, psi, context, trajectory, multipliers)
        stats = function.stats()
        iterations = int(stats["iter_count"])
        return Solution(
            trajectory=trajectory,
            multipliers=multipliers,
            objective=float(objective[0]),
            residuals=residuals,
            status=self._status(residuals.worst, iterations, w),
            iterations=iterations,
            psi=psi,
            context=context,
            message=f"sqpmethod: {stats['return_status']}",
        )

    def _status(self, residual: float, iterations: int, w: Array) -> Status:
        if not np.isfinite(w).all() or not np.isfinite(residual):
            return Status.NOT_FINITE
        if residual <= self.tolerance:
            return Status.CONVERGED
        return Status.ITERATION_LIMIT if iterations >= self.max_iterations else Status.STALLED


@lru_cache(maxsize=64)
def program(problem: OCP, solver: SQP) -> ca.Function:
    """(w, (s0, psi, c), bounds of w, bounds of defects and path, lam_w, lam_g) -> w, J, g, lam_w, lam_g, lam_p."""
    nlp = transcribe(problem)
    objective, defects, path = nlp.values(*(nlp.symbols[name] for name in ("w", "s0", "psi", "c")))
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    options = {
        "qpsol": "qrqp",
        "qpsol_options": quiet,
        "convexify_strategy": "regularize",
        "max_iter": solver.max_iterations,
        "tol_pr": solver.tolerance,
        "tol_du": solver.tolerance,
        "error_on_fail": False,
        "show_eval_warnings": False,
        **{f"print_{what}": False for what in ("header", "iteration", "status", "time")},
    }
    inputs = {"x": nlp.symbols["w"], "p": nlp.symbols["p"], "f": objective, "g": ca.vertcat(defects, path)}
    return ca.nlpsol("sqp_program", "sqpmethod", inputs, options)
