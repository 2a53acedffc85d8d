"""Gradients at several solutions of a problem in one call into C, which releases the GIL."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.certificate import judged
from kpirl_ocp.ocp.sensitivity.evidence import MEASURED, AnswerLayout
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients, Workspace
from kpirl_ocp.types import Array, Solution


class _Answers:
    """Arrays into which the C code writes B gradients and their evidence, one row each.

    answers: (B, n) in the order of an `AnswerLayout`. active: (B, n_rows), nonzero for active rows. finite: (B,) zero
        where derivatives or slopes are not finite, so that there is no answer.
    """

    def __init__(self, problem: OCP, layout: AnswerLayout, count: int) -> None:
        self.answers, self.finite = np.empty((count, layout.size)), np.empty(count, np.intc)
        self.active = np.empty((count, len(rows_of(problem).inequality)))
        self.structure = c.Answers(*map(c.address_of, (self.answers, self.active)), c.address_of(self.finite))


def pull_each(problem: OCP, solutions: Sequence[Solution], rows: NDArray[np.void], slopes: Array) -> list[Gradients]:
    """`Sensitivity.pull` under the policy "flag" for B solutions of a problem, with one function each.

    Args:
        problem: the problem that was solved.
        solutions: B solutions that fit it.
        rows: the same (B,), see `as_rows`.
        slopes: dL/dS, then dL/dU of each (B, n_w).
    """
    barriers = np.array([each.barrier for each in solutions])
    questions = c.Questions(rows.ctypes.data, *map(c.address_of, (slopes, barriers)))
    with borrow_core(problem) as core:
        at, layout = core.kept(Workspace), core.kept(AnswerLayout)
        answers = _Answers(problem, layout, len(solutions))
        at.release()
        function = core.function(parameter_derivatives.pull, uses=len(solutions))
        addresses = at.here.address, at.nearby.address, core.address, function
        ends = ctypes.addressof(questions), ctypes.addressof(answers.structure)
        core.library.kpirl_mpc_certify_each(*addresses, len(solutions), *ends)
    return _gradients(problem, solutions, answers, layout)


def _gradients(problem: OCP, solutions: Sequence[Solution], found: _Answers, part: AnswerLayout) -> list[Gradients]:
    """One record per solution; their arrays are views of the answers."""
    undefined, answers = found.finite == 0, found.answers
    answers[undefined] = np.nan
    evidence = [
        None if nothing else dict(zip(MEASURED, row, strict=True))
        for row, nothing in zip(answers[:, part.measured].tolist(), undefined, strict=True)
    ]
    certificates = map(partial(judged, "flag", problem), solutions, found.active != 0, evidence)
    return list(map(Gradients, answers[:, part.psi], answers[:, part.s0], answers[:, part.context], certificates))
