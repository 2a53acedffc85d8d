"""Residuals of the first-order conditions, measured without the solver that found the point.

    grad_w (J + lambda.g_E + mu.g_I + nu.w) = 0,   g_E = 0,   g_I <= 0,   mu >= 0,   mu g_I = 0

and the same for the bounds on w, whose multipliers nu are positive at an upper and negative at a lower bound. With a
barrier parameter tau, multiplier times slack is tau instead of zero.
"""

from __future__ import annotations

import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.constraints import BoundRows, Inequalities
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import (
    bound_multipliers,
    equality_multipliers,
    given,
    inequality_multipliers,
    limits,
    pack,
)
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Trajectory, largest, max_or_nan


def audit(
    problem: OCP, psi: Array, context: Array, trajectory: Trajectory, multipliers: Multipliers, barrier: float = 0.0
) -> KKTResiduals:
    """Measure the first-order conditions at a point; a function that is not finite there gives NaN residuals."""
    program, bounds = transcribe(problem), BoundRows.of(*limits(problem))
    w, lam, mu = pack(trajectory), equality_multipliers(multipliers), inequality_multipliers(multipliers)
    objective, g_E, g_I = (dense(value).ravel() for value in program.values(w, psi, context))
    cost_gradient, gradient = (dense(value).ravel() for value in program.first(w, psi, context, lam, mu))
    rows, decided = Inequalities.at(bounds, w, g_I), ~given(problem)
    forces, unequal = rows.forces(bound_multipliers(multipliers), mu, barrier), ~rows.equal
    push = bounds.net_force(forces[: len(bounds.entries)], len(w))
    with np.errstate(invalid="ignore", over="ignore"):
        products = forces * rows.slack - barrier
    return KKTResiduals(
        stationarity=largest((gradient + push)[decided]) if np.isfinite(objective).all() else np.nan,
        feasibility=largest(np.concatenate([g_E, np.minimum(rows.slack, 0.0)])),
        complementarity=largest(products[unequal]),
        sign=largest(np.minimum(forces, 0.0)[unequal]),
        scale=max_or_nan(1.0, largest(cost_gradient[decided]), largest(lam), largest(mu)),
    )
