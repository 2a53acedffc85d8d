"""Which solvers can be exported, and how."""

from __future__ import annotations

import kpirl_ocp.ocp.export.descent as descent
import kpirl_ocp.ocp.export.riccati as riccati
import kpirl_ocp.ocp.export.sqp as sqp
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.ocp.solvers.sqp import SQP

ALTERNATIVES = (
    "Riccati() iterates until convergence, Riccati(steps=1, barrier=1e-2) is the real-time iteration, "
    "GradientDescent(steps, step_size, project) takes a fixed number of gradient steps, and SQP() solves with "
    "CasADi's sqpmethod and qrqp"
)


def target_of(problem: OCP, solver: Solver) -> Target:
    """The solver as C. Raises ProblemError, with the alternatives, for one that cannot be exported."""
    if isinstance(solver, Riccati):
        return riccati.target(problem, solver)
    if isinstance(solver, GradientDescent):
        return descent.target(problem, solver)
    if isinstance(solver, SQP):
        return sqp.target(problem, solver)
    if not hasattr(solver, "solve") or isinstance(solver, type):
        raise ProblemError(f"the solver must be one such as Riccati() or SQP(), got {solver!r}. {ALTERNATIVES}.")
    raise ProblemError(f"{type(solver).__name__} needs libraries that cannot be exported as C. {ALTERNATIVES}.")
