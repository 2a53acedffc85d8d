"""CasADi's sqpmethod with qrqp as C: the whole solver is generated; what is written by hand fills its arguments."""

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
    """The generated solver, and first derivatives to audit what it found."""
    live = transcribe(problem).live
    places = np.flatnonzero(np.concatenate(live))
    rows = f"const int {PREFIX}_exported_rows[] = {{{', '.join(map(str, places))}}};"
    return Target(
        kind="sqp",
        functions=[dynamics(problem), audit(problem), program(problem, solver)],
        interfaces={"dynamics": STAGE},
        transition="dynamics",
        sources=("sqp.h", "sqp.c"),
        workspace="sqp.h",
        macros={"N_ROWS": len(places), "N_EQUALITIES": int(live[0].sum())},
        data=f"\n/* see {PREFIX}_sqp.c */\nextern const int {PREFIX}_exported_rows[];\n{rows}\n",
        steps=0,
        max_iterations=solver.max_iterations,
        tolerance=solver.tolerance,
        barrier=0.0,
        single_tolerance=1e-4,
        counts=False,
    )


def audit(problem: OCP) -> ca.Function:
    """(w, psi, c, multipliers of the live rows) -> J, the live rows, and the gradients of J and of the Lagrangian."""
    transcribed = transcribe(problem)
    inputs = dict(zip(("w", "psi", "context"), transcribed.symbols, strict=True))
    inputs["multipliers"] = ca.MX.sym("multipliers", sum(int(on.sum()) for on in transcribed.live))
    every = ca.MX.zeros(sum(map(len, transcribed.live)))
    every[np.flatnonzero(np.concatenate(transcribed.live)).tolist()] = inputs["multipliers"]
    lam, mu = every[: len(transcribed.live[0])], every[len(transcribed.live[0]) :]
    cost = transcribed.values(*transcribed.symbols)[0]
    by_cost, gradient = transcribed.first(*transcribed.symbols, lam, mu)
    outputs = {"cost": cost, "rows": transcribed.rows, "cost_gradient": by_cost, "gradient": gradient}
    return named("audit", inputs, outputs)
