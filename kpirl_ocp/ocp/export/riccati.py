"""The interior-point method as C: which functions are generated, and which files control them."""

from __future__ import annotations

import casadi as ca

from kpirl_ocp.ocp.codegen.target import Target, dynamics
from kpirl_ocp.ocp.conditions.parameter_derivatives import pull
from kpirl_ocp.ocp.conditions.stage_derivatives import first, second, values
from kpirl_ocp.ocp.interior_point.feedback_rollout import follow
from kpirl_ocp.ocp.interior_point.newton_step import corrected_step, newton_step, rows
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati


def target(problem: OCP, solver: Riccati) -> Target:
    """Values, first and second derivatives, Newton steps, line search along the dynamics, and the pull-back of psi."""
    at = rows(problem)
    functions: list[ca.Function] = [
        dynamics(problem),
        *(build(problem) for build in (values, first, second, newton_step, corrected_step, follow, pull)),
    ]
    return Target(
        kind="riccati",
        functions=functions,
        sources=[
            *(f"{name}{end}" for name in ("rows", "start", "newton", "filter", "riccati") for end in (".h", ".c")),
            "adjoint.c",
        ],
        workspace="riccati.h",
        macros={
            "MAX_ITERATIONS": solver.max_iterations,
            "N_LOWER": len(at.lower),
            "N_UPPER": len(at.upper),
            "N_FIXED": len(at.fixed),
            "STATE_CONSTRAINTS": int(problem.has_state_constraints),
        },
        steps=solver.steps or 0,
        max_iterations=solver.max_iterations,
        tolerance=solver.tolerance,
        barrier=solver.barrier,
        single_tolerance=1e-3,
    )
