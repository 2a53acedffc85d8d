"""Checks of what users hand to a problem; every refusal is one sentence that names the argument."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.sizes import LONGEST
from kpirl_ocp.types import Array, refuse_masked

Bounds = tuple[ArrayLike, ArrayLike]
UNBOUNDED: Bounds = (-np.inf, np.inf)


def horizon_of(value: object) -> int:
    """T as an int. Raises ProblemError unless it is a whole number between 1 and a million."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not 1 <= value <= LONGEST:  # type: ignore[operator]
        expected = f"a whole number of at least 1 step and at most {LONGEST}"
        raise ProblemError(f"horizon must be {expected}, got {shown(value)}.")
    return int(value)  # type: ignore[call-overload]


def numbers(name: str, value: ArrayLike) -> Array:
    """A float64 array. Raises ProblemError for anything that is not made of numbers."""
    refuse_masked(name, value)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biuf":
            return array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError):
        pass
    raise ProblemError(f"{name} must be an array of numbers, got {shown(value)}.")


def number(name: str, value: ArrayLike, expected: str, lower: float, upper: float = np.inf) -> float:
    """A number strictly between two others. Raises ProblemError, which says what was `expected`, for anything else."""
    found = numbers(name, value)
    if found.shape or not lower < found < upper:
        raise ProblemError(f"{name} must be {expected}, got {shown(value)}.")
    return float(found)


def check_settings(owner: object, *names: str) -> None:
    """Raise ProblemError unless these attributes of a solver are numbers, whole ones if they count."""
    for name in names:
        value, whole = getattr(owner, name), name in ("max_iterations", "steps")
        kinds = (int, np.integer) if whole else (int, float, np.integer, np.floating)
        if not isinstance(value, kinds) or isinstance(value, bool):
            expected = "a whole number" if whole else "a number"
            raise ProblemError(f"{name} of {type(owner).__name__} must be {expected}, got {shown(value)}.")


def vector(name: str, value: ArrayLike, *lengths: int) -> Array:
    """A float64 vector of one of these lengths, in memory of its own: later changes of `value` leave it as it is.

    Raises ProblemError for anything else.
    """
    array = numbers(name, value)
    if array.ndim > 1 and array.size != max(array.shape):
        raise ProblemError(f"{name} must be a vector of length {_or(lengths)}, got the shape {array.shape}.")
    if array.size not in lengths:
        raise ProblemError(f"{name} must have length {_or(lengths)}, got {array.size}.")
    return array.flatten()


def matrix(name: str, axes: str, value: ArrayLike, *shapes: tuple[int, int]) -> Array:
    """A float64 matrix of one of these shapes, row by row in memory. Raises ProblemError for anything else."""
    array = value if type(value) is np.ndarray and value.dtype == float else numbers(name, value)
    if array.shape not in shapes:
        raise ProblemError(f"{name} must be {axes} = {_or(shapes)}, got {array.shape}.")
    return array if array.flags.carray else np.require(array, requirements=("C", "A"))


def schedule_of(value: ArrayLike | None, horizon: int) -> Array:
    """The numbers d_t (T+1, n_d) of all stages; (T+1, 0) for none. Raises ProblemError for another shape, or NaN."""
    schedule = numbers("schedule", np.zeros((horizon + 1, 0)) if value is None else value)
    if schedule.ndim == 2 and not schedule.shape[1]:  # of another horizon
        schedule = np.zeros((horizon + 1, 0))
    if schedule.ndim != 2 or len(schedule) != horizon + 1 or not np.isfinite(schedule).all():
        raise ProblemError(f"schedule must be finite and (T+1, n_d) = ({horizon + 1}, n_d), got {schedule.shape}.")
    return schedule


def bounds_of(name: str, bounds: Bounds, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Lower and upper, each broadcast to a shape; of rows that are all alike there may be any number.

    Raises ProblemError when they make no interval.
    """
    expected = " or ".join(dict.fromkeys(str(shape[i:]) for i in reversed(range(len(shape)))))
    try:
        given = [numbers(name, bound) for bound in bounds]
        lower, upper = (np.array(np.broadcast_to(_one_row(bound, shape), shape)) for bound in given)
    except ProblemError:
        raise
    except (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError) as error:
        raise ProblemError(f"{name} must be (lower, upper), each a number or {expected}.") from error
    if not lower.size and any(np.isfinite(bound).any() for bound in given):
        raise ProblemError(f"{name} must be left out: there is nothing to bound, the shape is {shape}.")
    if len(shape) == 2 and _is_pairs(*given):
        raise ProblemError(f"{name} must be (lower, upper), each {expected}, not a pair for every entry, got {bounds}.")
    if not ((lower <= upper) & (lower < np.inf) & (upper > -np.inf)).all():
        raise ProblemError(
            f"{name} must be numbers: no lower bound above its upper bound or at inf, no upper bound at -inf."
        )
    return lower, upper


def check_function(name: str, function: object, sizes: tuple[int, ...], length: int | None) -> None:
    """Raise ProblemError unless columns of these sizes go in and one column (of this length, if any) comes out."""
    if not isinstance(function, ca.Function):
        raise ProblemError(f"{name} must be a casadi.Function, got {shown(function)}.")
    found = tuple(function.size1_in(i) for i in range(function.n_in()))
    columns = all(function.size2_in(i) == 1 for i in range(function.n_in()))
    one = function.n_out() == 1 and function.size2_out(0) == 1
    if found != sizes or not columns or not one or function.size1_out(0) != (length or function.size1_out(0)):
        raise ProblemError(
            f"{name} must take column vectors of lengths {sizes} and return one column"
            f"{'' if length is None else f' of length {length}'}; it is {function}."
        )


def _is_pairs(first: Array, second: Array) -> bool:
    """True for [(a, b), (a, b)] with a < b, which would hold both entries fast throughout."""
    return first.shape == second.shape == (2,) and bool((first == second).all() and first[0] < first[1])


def _one_row(bound: Array, shape: tuple[int, ...]) -> Array:
    """The row of a bound that is the same at every stage, so that a problem can be given another horizon."""
    same = bound.ndim == len(shape) == 2 and len(bound) > 0 and bool((bound == bound[:1]).all())
    return bound[0] if same else bound


def shown(value: object) -> str:
    """A value for a message, cut where it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def _or(alternatives: Sequence[object]) -> str:
    return " or ".join(str(one) for one in dict.fromkeys(alternatives))
