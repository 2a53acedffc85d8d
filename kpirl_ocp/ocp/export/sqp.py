"""CasADi's sqpmethod with qrqp as C: the whole solver is generated; what is written by hand fills its arguments."""

from __future__ import annotations

from kpirl_ocp.ocp.export.target import Target, dynamics
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.sqp import SQP, program
from kpirl_ocp.ocp.stages import first


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
