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


def arrays_of(problem: OCP, solution: Solution, name: str = "the solution") -> Sequence[Array]:
    """The arrays of a solution in the order of a row, see `as_rows`.

    Raises ProblemError when they do not fit the problem, or these are no problem and solution.
    """
    if not isinstance(problem, OCP) or not isinstance(solution, Solution):
        raise ProblemError(
            f"an OCP and {name} of it are needed, in this order, got {shown(problem)}, {shown(solution)}."
        )
    getter, names, shapes = _getter(problem)
    arrays = getter(solution)
    plain = set(map(type, arrays)) == _ARRAYS and set(map(_dtype, arrays)) == _FLOATS
    if plain and [*map(_shape, arrays)] == shapes:
        return arrays
    found = [floats(f"{name}'s {part}", array) for part, array in zip(names, arrays, strict=True)]
    for part, shape, array in zip(names, shapes, found, strict=True):
        if array.shape != shape:
            raise ProblemError(f"{name}'s {part} must be {shape}, got {array.shape}: it is of another problem.")
    return found


def as_rows(problem: OCP, solutions: Sequence[Sequence[Array]]) -> NDArray[np.void]:
    """The arrays of solutions (`arrays_of`) as rows (B,): those of `solution_row`, then psi and context.

    `numpy.concatenate` would hand the interpreter's lock to another thread after each array.
    """
    row = [(name, float, shape) for name, shape in zip(*_getter(problem)[1:], strict=True)]
    return np.array([tuple(each) for each in solutions], row)


def as_row(arrays: Sequence[Array]) -> bytes:
    """Those of one solution as a row, in less time."""
    try:
        return b"".join(arrays)  # type: ignore[arg-type]
    except TypeError:  # not contiguous
        return b"".join(array.tobytes() for array in arrays)


@lru_cache(maxsize=64)
def _getter(problem: OCP) -> tuple[attrgetter[tuple[Array, ...]], list[str], list[tuple[int, ...]]]:
    """A getter of a solution's arrays in the order of a row, their names and their shapes."""
    row = solution_row(problem)
    names, shapes = [*(row.names or ()), "psi", "context"], [row[name].shape for name in row.names or ()]
    return attrgetter(*names), names, [*shapes, (problem.n_parameters,), (problem.n_context,)]
