"""Gradients of functions of several solutions of a problem, in one call into C in which other threads may run."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.problem.layout import by_stage
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.certificate import Policy, judged
from kpirl_ocp.ocp.sensitivity.evidence import fields_of
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.ocp.sensitivity.solution_arrays import check_solution, solution_arrays, structure_of
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import Gradients, Workspace
from kpirl_ocp.types import Array, Solution


def pull_each(problem: OCP, given: Sequence[tuple[Solution, Array, Array]], policy: Policy) -> list[Gradients]:
    """`Sensitivity.pull` for several solutions of a problem, each with the slopes of a function.

    Args:
        problem: that was solved.
        given: a solution, dL/dS (T+1, n_s) and dL/dU (T, n_u), for each.
        policy: "raise" or "flag", as in `sensitivity`.

    Raises:
        CertificateError: under the policy "raise", for the first that is not certified.
        ProblemError: shapes that do not fit the problem.
    """
    pulls = [_Pull(problem, *each) for each in given]
    questions = (c.Question * len(pulls))(*(pull.question for pull in pulls))
    answers = (c.Answer * len(pulls))(*(pull.answer for pull in pulls))
    with borrow_core(problem) as core:
        at = core.kept(Workspace)
        at.leave()
        function = core.function(parameter_derivatives.pull, uses=len(pulls))
        addresses = at.here.address, at.nearby.address, core.address, function
        ends = ctypes.addressof(questions), ctypes.addressof(answers)
        core.library.kpirl_mpc_certify_each(*addresses, len(pulls), *ends)
    return [pull.gradients(answer, policy) for pull, answer in zip(pulls, answers, strict=True)]


class _Pull:
    """The arrays of one gradient, and the structures that show them to the C code."""

    def __init__(self, problem: OCP, solution: Solution, by_states: Array, by_actions: Array) -> None:
        check_solution(problem, solution)
        self._problem, self._solution = problem, solution
        self._slope = by_stage(problem.as_states(by_states), problem.as_actions(by_actions))
        self._numbers, self._arrays = Instance.of(problem, solution).numbers, solution_arrays(solution)
        self._found, self._active = ByParameters.empty(problem), np.empty(len(rows_of(problem).inequality))

    @property
    def question(self) -> Any:
        """`kpirl_mpc_question`."""
        numbers = c.Numbers(*map(c.address_of, self._numbers))
        return c.Question(numbers, structure_of(self._arrays), c.address_of(self._slope), self._solution.barrier)

    @property
    def answer(self) -> Any:
        """`kpirl_mpc_answer`, to be filled."""
        return c.Answer(gradients=self._found.structure, active=c.address_of(self._active))

    def gradients(self, answer: Any, policy: Policy) -> Gradients:
        """With the evidence that was found. Raises CertificateError as `pull_each` does."""
        evidence = fields_of(answer.evidence) if answer.finite else None
        certificate = judged(policy, self._problem, self._solution, self._active != 0, evidence)
        if evidence is None:
            return Gradients.undefined(self._problem, certificate)
        return Gradients.of_plan(self._problem, self._slope, self._found, certificate)
