"""The verdict on one answer, and their counts."""

from __future__ import annotations

from collections import Counter
from enum import Enum

import numpy as np

from kpirl_ocp import Implicit
from kpirl_ocp.errors import KpirlError
from stress.certificates.case import Case


class Verdict(Enum):
    """Of a certificate, or of a number that a peer returned."""

    RIGHT = "certified and right"
    RIGHTLY_FLAGGED = "flagged, and rightly so"
    WRONGLY_FLAGGED = "flagged though right"
    WRONG = "certified and wrong"


def judge(case: Case) -> Verdict:
    """Differentiate one case with `Implicit` and look at its certificate."""
    try:
        found = Implicit(case.solver, case.loss, "flag")(case.problem, case.demonstration, case.psi, case.guess)
    except KpirlError:  # refused in a sentence
        return flagged(case)
    if not found.certificate.certified:
        return flagged(case)
    truth = case.truth(found.certificate.solution.trajectory)
    return Verdict.RIGHT if truth.agrees(np.asarray(found.gradient)) else Verdict.WRONG


def flagged(case: Case) -> Verdict:
    """A certificate was due, or not."""
    return Verdict.WRONGLY_FLAGGED if case.due else Verdict.RIGHTLY_FLAGGED


def healthy(counts: Counter) -> float:
    """The share of right answers among those that were right or due."""
    right, missed = counts[Verdict.RIGHT], counts[Verdict.WRONGLY_FLAGGED]
    return right / max(right + missed, 1)
