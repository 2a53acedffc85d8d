"""The word INFEASIBLE for solvers that do not say why they gave up."""

from __future__ import annotations

from kpirl_ocp.ocp.conditions.program import trajectory_of
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Status


def shown_infeasible(problem: OCP, w: Array, s0: Array, psi: Array, context: Array) -> bool:
    """Whether feasibility restoration of `Riccati`, from w (n_w,), ends where the violation is stationary."""
    found = Riccati().solve(problem, s0, psi, context, guess=trajectory_of(problem, w, s0))
    return found.status is Status.INFEASIBLE
