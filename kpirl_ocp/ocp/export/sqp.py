"""CasADi's sqpmethod with qrqp as C: the solver is generated, its arguments and its end are written by hand."""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.portable_c import STAGE
from kpirl_ocp.ocp.codegen.target import Target, dynamics, named
from kpirl_ocp.ocp.codegen.templates import PREFIX
from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.sqp import SQP, program


def target(problem: OCP, solver: SQP) -> Target:
    """The generated solver, and first derivatives for the audit of its result."""
    transcribed = transcribe(problem)
    places = [*np.flatnonzero(transcribed.live), *len(transcribed.live) + np.arange(transcribed.n_inequalities)]
    rows = f"const int {PREFIX}_exported_rows[] = {{{', '.join(map(str, places))}}};"
    return Target(
        kind="sqp",
        functions=[dynamics(problem), audit(problem), program(problem, solver)],
        interfaces={"dynamics": STAGE},
        transition="dynamics",
        sources=("sqp.h", "sqp.c"),
        workspace="sqp.h",
        macros={"N_ROWS": len(places), "N_EQUALITIES": transcribed.n_equalities},
        data=f"\n/* see {PREFIX}_sqp.c */\nextern const int {PREFIX}_exported_rows[];\n{rows}\n",
        steps=0,
        max_iterations=solver.max_iterations,
        tolerance=solver.tolerance,
        barrier=0.0,
        single_tolerance=1e-4,
        restores=False,
    )


def audit(problem: OCP) -> ca.Function:
    """(w, psi, c, multipliers of the live rows) -> J, the live rows, and the gradients of J and of the Lagrangian."""
    transcribed = transcribe(problem)
    inputs = dict(zip(("w", "psi", "context"), transcribed.symbols, strict=True))
    n_live = transcribed.n_equalities
    known = inputs["multipliers"] = ca.MX.sym("multipliers", n_live + transcribed.n_inequalities)
    lam, mu = ca.MX.zeros(len(transcribed.live)), known[n_live:]
    lam[np.flatnonzero(transcribed.live).tolist()] = known[:n_live]
    cost = transcribed.values(*transcribed.symbols)[0]
    by_cost, gradient = transcribed.first(*transcribed.symbols, lam, mu)
    outputs = {"cost": cost, "rows": transcribed.rows, "cost_gradient": by_cost, "gradient": gradient}
    return named("audit", inputs, outputs)
