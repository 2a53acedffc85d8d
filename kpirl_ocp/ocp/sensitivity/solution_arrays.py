"""Solutions as flat rows of numbers, for the C code."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from operator import attrgetter

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.interior_point.results import solution_rows
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array, Solution, floats

_FLOAT = np.dtype(float)


def check_solution(problem: OCP, solution: Solution, name: str = "the solution") -> None:
    """Raise ProblemError when the arrays of a solution do not fit the problem, or these are no problem and solution."""
    if not isinstance(problem, OCP) or not isinstance(solution, Solution):
        raise ProblemError(
            f"an OCP and {name} of it are needed, in this order, got {shown(problem)}, {shown(solution)}."
        )
    arrays, shapes = _arrays(problem)
    for (part, shape), array in zip(shapes.items(), arrays(solution), strict=True):
        if isinstance(array, np.ndarray) and array.shape == shape and array.dtype == _FLOAT:
            continue
        given = floats(f"{name}'s {part}", array).shape
        if given != shape:
            raise ProblemError(f"{name}'s {part} must be {shape}, got {given}: it is of another problem.")


def as_row(problem: OCP, solution: Solution) -> Array:
    """A solution that fits a problem as a row (n,), see `SolutionRows`."""
    arrays, _ = _arrays(problem)
    return np.concatenate(arrays(solution)[:-2], axis=None, dtype=float)


def as_rows(problem: OCP, solutions: Sequence[Solution]) -> Array:
    """Solutions that fit a problem as rows (B, n), see `SolutionRows`."""
    layout, (arrays, _) = solution_rows(problem), _arrays(problem)
    rows = layout.empty(len(solutions))
    found = zip(*(arrays(each)[:-2] for each in solutions), strict=True)
    for part, of_all in zip(layout.parts(rows), found, strict=True):
        part[...] = of_all
    return rows


@lru_cache(maxsize=64)
def _arrays(problem: OCP) -> tuple[attrgetter[tuple[Array, ...]], dict[str, tuple[int, ...]]]:
    """A getter of a solution's arrays in the order of a row, then psi and context; and their shapes by name."""
    shapes = solution_rows(problem).shapes | {"psi": (problem.n_parameters,), "context": (problem.n_context,)}
    return attrgetter(*shapes), shapes
