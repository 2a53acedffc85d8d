"""The verdicts on one answer, and their counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import Enum

import numpy as np

from kpirl_ocp import FiniteDifference, GradientDescent, Implicit, Unrolled
from kpirl_ocp.errors import KpirlError
from kpirl_ocp.irl.hypergradients.loss import data_of
from stress.certificates.case import TOLERANCE, Case


class Verdict(Enum):
    """Of a certificate, or of a number that a peer returned."""

    RIGHT = "certified and right"
    RIGHTLY_FLAGGED = "flagged, and rightly so"
    WRONGLY_FLAGGED = "flagged though right"
    WRONG = "certified and wrong"


STEPS = GradientDescent(steps=100, step_size=0.1)
METHODS = {
    "Implicit": lambda case: Implicit(case.solver, case.loss, "flag"),
    "FiniteDifference": lambda case: FiniteDifference(case.solver, case.loss, policy="flag"),
    "Unrolled": lambda case: Unrolled(STEPS, case.loss, "flag"),
}


def judge(case: Case, method: str = "Implicit") -> Verdict:
    """Differentiate one case by a method and look at its certificate."""
    try:
        found = METHODS[method](case)(case.problem, case.demonstration, case.psi, case.guess)
    except KpirlError:  # refused in a sentence
        return flagged(case)
    if not found.certificate.certified:
        return flagged(case)
    solution, gradient = found.certificate.solution, np.asarray(found.gradient)
    solver = STEPS if method == "Unrolled" else case.solver
    of_steps = method != "Implicit" and isinstance(solver, GradientDescent)
    right = case.truth(solution.trajectory).agrees(gradient) or (
        of_steps and is_slope_of_the_steps(case, gradient, solver)
    )
    return Verdict.RIGHT if right else Verdict.WRONG


def is_slope_of_the_steps(case: Case, gradient: np.ndarray, solver: GradientDescent) -> bool:
    """Whether a gradient (n_psi,) is the slope to both sides of what gradient descent makes of psi, at one small step.

    Steps that end before the minimum have a derivative of their own, which is what is certified of them.
    """
    loss, data = case.loss(case.problem), data_of(case.loss, case.problem, case.demonstration)

    def value(psi: np.ndarray) -> float:
        plan = solver.solve(case.problem, case.demonstration.s0, psi, case.demonstration.context, case.guess)
        return float(loss(plan.states.T, plan.actions.T, data))

    centre, unit = value(case.psi), np.maximum(1e-3, np.abs(case.psi))
    return any(_agree(value, centre, case.psi, h * unit, gradient) for h in (1e-4, 1e-5, 1e-6, 1e-7))


def _agree(
    value: Callable[[np.ndarray], float], centre: float, psi: np.ndarray, steps: np.ndarray, gradient: np.ndarray
) -> bool:
    sides = [
        [sign * (value(psi + sign * step) - centre) / step.sum() for step in np.diag(steps)] for sign in (1.0, -1.0)
    ]
    bound = TOLERANCE * (np.abs(gradient) + np.abs(gradient).max()) + 1e-14 * abs(centre) / steps + 1e-12
    return bool((np.abs(np.array(sides) - gradient) <= bound).all())


def flagged(case: Case) -> Verdict:
    """A certificate was due, or not."""
    return Verdict.WRONGLY_FLAGGED if case.due else Verdict.RIGHTLY_FLAGGED


def healthy(counts: Counter) -> float:
    """The share of right answers among those that were right or due."""
    right, missed = counts[Verdict.RIGHT], counts[Verdict.WRONGLY_FLAGGED]
    return right / max(right + missed, 1)
