"""CasADi's sqpmethod with qrqp as C: the whole solver is generated; what is written by hand fills its arguments."""

from __future__ import annotations

from kpirl_ocp.ocp.codegen.target import Target, dynamics
from kpirl_ocp.ocp.conditions.stage_derivatives import first
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.sqp import SQP, program


def target(problem: OCP, solver: SQP) -> Target:
    """The generated solver, and first derivatives to audit what it found."""
    return Target(
        kind="sqp",
        functions=[dynamics(problem), first(problem), program(problem, solver)],
        sources=("sqp.h", "sqp.c"),
        workspace="sqp.h",
        macros={},
        steps=0,
        max_iterations=solver.max_iterations,
        tolerance=solver.tolerance,
        barrier=0.0,
        single_tolerance=solver.tolerance,
        counts=False,
    )
