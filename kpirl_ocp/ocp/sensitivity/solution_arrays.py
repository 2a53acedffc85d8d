"""Solutions as flat rows of numbers, for the C code."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.interior_point.results import solution_row
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array, Solution, floats

_ARRAYS, _FLOATS = {np.ndarray}, {np.dtype(float)}
_dtype, _shape = attrgetter("dtype"), attrgetter("shape")


def check_solution(problem: OCP, solution: Solution, name: str = "the solution") -> None:
    """Raise ProblemError when the arrays of a solution do not fit the problem, or these are no problem and solution."""
    if not isinstance(problem, OCP) or not isinstance(solution, Solution):
        raise ProblemError(
            f"an OCP and {name} of it are needed, in this order, got {shown(problem)}, {shown(solution)}."
        )
    arrays, shapes = _arrays(problem)
    own = arrays(solution)
    if _are_plain(own) and [*map(_shape, own)] == [*shapes.values()]:
        return
    for (part, shape), array in zip(shapes.items(), own, strict=True):
        given = floats(f"{name}'s {part}", array).shape
        if given != shape:
            raise ProblemError(f"{name}'s {part} must be {shape}, got {given}: it is of another problem.")


def as_rows(problem: OCP, solutions: Sequence[Solution]) -> NDArray[np.void]:
    """Solutions that fit a problem as rows (B,), see `solution_row`.

    `numpy.concatenate` would hand the interpreter's lock to another thread after each array.
    """
    arrays, _ = _arrays(problem)
    return np.array([arrays(each)[:-2] for each in solutions], solution_row(problem))


def as_row(problem: OCP, solution: Solution) -> bytes:
    """One solution that fits a problem, as in `as_rows`, of which it takes a third of the time."""
    arrays, _ = _arrays(problem)
    parts = arrays(solution)[:-2]
    if _are_plain(parts) and all(part.flags.c_contiguous for part in parts):
        return b"".join(parts)  # type: ignore[arg-type]
    return as_rows(problem, [solution]).tobytes()


def _are_plain(values: tuple[object, ...]) -> bool:
    """True if all are numpy's arrays of floating-point numbers."""
    return set(map(type, values)) == _ARRAYS and set(map(_dtype, values)) == _FLOATS


@lru_cache(maxsize=64)
def _arrays(problem: OCP) -> tuple[attrgetter[tuple[Array, ...]], dict[str, tuple[int, ...]]]:
    """A getter of a solution's arrays in the order of a row, then psi and context; and their shapes by name."""
    row = solution_row(problem)
    shapes = {name: row[name].shape for name in row.names or ()}
    shapes |= {"psi": (problem.n_parameters,), "context": (problem.n_context,)}
    return attrgetter(*shapes), shapes
