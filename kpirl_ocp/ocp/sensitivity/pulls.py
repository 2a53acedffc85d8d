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
from kpirl_ocp.ocp.sensitivity.evidence import MEASURED
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients, Workspace
from kpirl_ocp.types import Array, Solution


class _Answers:
    """Arrays into which the C code writes B gradients and their evidence, one row each.

    by_parameters: (B, n_psi), (B, n_s), (B, n_c). evidence: (B, 8), in the order of `MEASURED`. active: (B, n_rows),
        nonzero for active rows. finite: (B,) zero where derivatives or slopes are not finite; the rows of the first two
        are then not set.
    """

    def __init__(self, problem: OCP, count: int) -> None:
        self.by_parameters, self.evidence = ByParameters.empty(problem, count), np.empty((count, len(MEASURED)))
        self.active, self.finite = np.empty((count, len(rows_of(problem).inequality))), np.empty(count, np.intc)
        own = map(c.address_of, (self.evidence, self.active))
        self.structure = c.Answers(self.by_parameters.structure, *own, c.address_of(self.finite))


def pull_each(problem: OCP, solutions: Sequence[Solution], rows: NDArray[np.void], slopes: Array) -> list[Gradients]:
    """`Sensitivity.pull` under the policy "flag" for B solutions of a problem, with one function each.

    Args:
        problem: the problem that was solved.
        solutions: B solutions that fit it.
        rows: the same (B,), see `as_rows`.
        slopes: dL/dx of each (B, n_w), see `by_stage`.
    """
    barriers, answers = np.array([each.barrier for each in solutions]), _Answers(problem, len(solutions))
    questions = c.Questions(rows.ctypes.data, *map(c.address_of, (slopes, barriers)))
    with borrow_core(problem) as core:
        at = core.kept(Workspace)
        at.release()
        function = core.function(parameter_derivatives.pull, uses=len(solutions))
        addresses = at.here.address, at.nearby.address, core.address, function
        ends = ctypes.addressof(questions), ctypes.addressof(answers.structure)
        core.library.kpirl_mpc_certify_each(*addresses, len(solutions), *ends)
    return _gradients(problem, solutions, answers)


def _gradients(problem: OCP, solutions: Sequence[Solution], answers: _Answers) -> list[Gradients]:
    """One record per solution; their arrays are views of the answers."""
    undefined = answers.finite == 0
    for by in answers.by_parameters:
        by[undefined] = np.nan
    evidence = [
        None if nothing else dict(zip(MEASURED, row, strict=True))
        for row, nothing in zip(answers.evidence.tolist(), undefined, strict=True)
    ]
    certificates = map(partial(judged, "flag", problem), solutions, answers.active != 0, evidence)
    return list(map(Gradients, *answers.by_parameters, certificates))
