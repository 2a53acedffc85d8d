"""The verdicts on one answer, and their counts."""

from __future__ import annotations

from collections import Counter
from enum import Enum

import numpy as np

from kpirl_ocp import FiniteDifference, GradientDescent, Implicit, Unrolled
from kpirl_ocp.errors import KpirlError
from stress.certificates.case import Case
from stress.certificates.steps import is_slope_of_the_steps, is_smooth, is_stated, steps_for


class Verdict(Enum):
    """Of a certificate, or of a number that a peer returned."""

    RIGHT = "certified and right"
    RIGHTLY_FLAGGED = "flagged, and rightly so"
    WRONGLY_FLAGGED = "flagged though right"
    WRONG = "certified and wrong"


METHODS = {
    "Implicit": lambda case: Implicit(case.solver, case.loss, "flag"),
    "FiniteDifference": lambda case: FiniteDifference(case.solver, case.loss, policy="flag"),
    "Unrolled": lambda case: Unrolled(steps_for(case), case.loss, "flag"),
}


def stated(case: Case, method: str) -> bool:
    """Whether a method takes the case at all, or refuses its constraints in a sentence."""
    return method != "Unrolled" or is_stated(case)


def judge(case: Case, method: str = "Implicit") -> Verdict:
    """Differentiate one case by a method and look at its certificate."""
    try:
        found = METHODS[method](case)(case.problem, case.demonstration, case.psi, case.guess)
    except KpirlError:  # refused in a sentence
        return flagged(case, method)
    if not found.certificate.certified:
        return flagged(case, method)
    solution, gradient = found.certificate.solution, np.asarray(found.gradient)
    solver = steps_for(case) if method == "Unrolled" else case.solver
    of_steps = method != "Implicit" and isinstance(solver, GradientDescent)
    right = case.truth(solution.trajectory).agrees(gradient) or (
        of_steps and is_slope_of_the_steps(case, gradient, solver)
    )
    return Verdict.RIGHT if right else Verdict.WRONG


def flagged(case: Case, method: str) -> Verdict:
    """A certificate was due, or not: of the minimiser, or of what gradient steps make of psi."""
    due = is_smooth(case, steps_for(case)) if method == "Unrolled" else case.due
    return Verdict.WRONGLY_FLAGGED if due else Verdict.RIGHTLY_FLAGGED


def healthy(counts: Counter) -> float:
    """The share of right answers among those that were right or due."""
    right, missed = counts[Verdict.RIGHT], counts[Verdict.WRONGLY_FLAGGED]
    return right / max(right + missed, 1)
