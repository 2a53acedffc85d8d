"""The word INFEASIBLE for solvers that do not say why they gave up."""

from __future__ import annotations

from kpirl_ocp.ocp.conditions.program import trajectory_of
from kpirl_ocp.ocp.solvers.instance import Instance
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Status


def shown_infeasible(instance: Instance) -> bool:
    """Whether feasibility restoration of `Riccati`, from the same start, ends where the violation is stationary."""
    problem, numbers = instance.problem, (instance.s0, instance.psi, instance.context)
    found = Riccati().solve(problem, *numbers, guess=trajectory_of(problem, instance.w, instance.s0))
    return found.status is Status.INFEASIBLE
