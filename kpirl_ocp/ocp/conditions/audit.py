"""How far a point is from the first-order conditions, measured without the solver that found it.

    grad_w (J + lambda.g_E + mu.g_I + nu.w) = 0,   g_E = 0,   g_I <= 0,   mu >= 0,   mu g_I = 0

and the same of the bounds on w, whose multipliers nu are positive at an upper and negative at a lower bound. With a
barrier tau, multiplier times slack is tau.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.layout import (
    bound_multipliers,
    equality_multipliers,
    given,
    inequality_multipliers,
    limits,
    pack,
)
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices, KKTResiduals, Mask, Multipliers, Trajectory, largest, max_or_nan


@dataclass(frozen=True, eq=False)
class BoundRows:
    """Finite lower bounds, then finite upper bounds, as signs * (limits - w[entries]) >= 0; all (n_bounds,).

    twice: True where the other side is bounded, too. equal: where it coincides.
    """

    entries: Indices
    signs: Array
    limits: Array
    twice: Mask
    equal: Mask

    def slack(self, w: Array) -> Array:
        """Distances (n_bounds,) from the bounds at w (n_w,); negative beyond them."""
        return self.signs * (self.limits - w[self.entries])

    def forces(self, nu: Array, slack: Array, barrier: float) -> Array:
        """Multipliers (n_bounds,) of both sides, not negative at a solution, from their difference nu (n_w,).

        With a barrier both sides push: there they follow from the slack, tau / slack, and a disagreement shows up in
        the stationarity.
        """
        forces = self.signs * nu[self.entries]
        forces = np.where(self.twice, np.maximum(forces, 0.0), forces)
        if barrier > 0:
            with np.errstate(divide="ignore"):
                forces = np.where(self.equal, forces, barrier / slack)
        return forces

    def push(self, forces: Array, n_w: int) -> Array:
        """Net force (n_w,): upper minus lower."""
        return np.bincount(self.entries, self.signs * forces, n_w).astype(float)


@lru_cache(maxsize=64)
def bound_rows(problem: OCP) -> BoundRows:
    """All finite bounds of w."""
    lower, upper = limits(problem)
    low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    entries = np.concatenate([low, high])
    return BoundRows(
        entries=entries,
        signs=np.repeat([-1.0, 1.0], [len(low), len(high)]),
        limits=np.concatenate([lower[low], upper[high]]),
        twice=np.bincount(entries, minlength=len(lower))[entries] > 1,
        equal=(lower == upper)[entries],
    )


def audit(
    problem: OCP, psi: Array, context: Array, trajectory: Trajectory, multipliers: Multipliers, barrier: float = 0.0
) -> KKTResiduals:
    """Measure the first-order conditions at a point; NaN in any function gives NaN residuals."""
    program, bounds = transcribe(problem), bound_rows(problem)
    w, lam, mu = pack(trajectory), equality_multipliers(multipliers), inequality_multipliers(multipliers)
    _, g_E, g_I = (np.array(value).ravel() for value in program.values(w, psi, context))
    cost_gradient, gradient = (np.array(value).ravel() for value in program.first(w, psi, context, lam, mu))
    slack, decided = np.concatenate([bounds.slack(w), -g_I]), ~given(problem)
    on_bounds = bounds.forces(bound_multipliers(multipliers), slack[: len(bounds.entries)], barrier)
    forces, unequal = np.concatenate([on_bounds, mu]), np.concatenate([~bounds.equal, np.ones(len(mu), bool)])
    return KKTResiduals(
        stationarity=largest((gradient + bounds.push(on_bounds, len(w)))[decided]),
        feasibility=largest(np.concatenate([g_E, np.minimum(slack, 0.0)])),
        complementarity=largest((forces * slack - barrier)[unequal]),
        sign=largest(np.minimum(forces, 0.0)[unequal]),
        scale=max_or_nan(1.0, largest(cost_gradient[decided]), largest(lam), largest(mu)),
    )
