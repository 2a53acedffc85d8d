"""Demonstrations of different lengths: one problem for each horizon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Demonstration

Problems: TypeAlias = OCP | Callable[[int], OCP]
"""One problem, or a function T -> problem with that horizon; psi means the same in all of them."""


def problems_of(problem: Problems, demonstrations: Sequence[Demonstration]) -> tuple[OCP, ...]:
    """The problem of every demonstration; those of one horizon share theirs.

    Raises ProblemError when the function gives no problem, another horizon, or different numbers of parameters.
    """
    if isinstance(problem, OCP):
        return (problem,) * len(demonstrations)
    if not callable(problem):
        raise ProblemError(f"problem must be an OCP, or a function T -> OCP, got {shown(problem)}.")
    made = {horizon: problem(horizon) for horizon in sorted({demo.horizon for demo in demonstrations})}
    for horizon, one in made.items():
        if not isinstance(one, OCP):
            raise ProblemError(f"the problem for the horizon {horizon} must be an OCP, got {shown(one)}.")
        if one.horizon != horizon:
            raise ProblemError(f"the problem for the horizon {horizon} has the horizon {one.horizon}.")
    counts = {one.n_parameters for one in made.values()}
    if len(counts) > 1:
        raise ProblemError(f"problems of all horizons must have the same parameters; they have {sorted(counts)}.")
    return tuple(made[demo.horizon] for demo in demonstrations)
