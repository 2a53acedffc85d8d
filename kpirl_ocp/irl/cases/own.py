"""A user's own problem: a function in a Python file that returns an OCP and its numbers."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from inspect import isfunction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from kpirl_ocp.errors import FileError, ProblemError, suggestion
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array

_EXPECTED = "it must return an OCP and a dictionary with its numbers"
_KEYS = ("s0", "psi", "context", "observations", "step_size")


@dataclass(frozen=True, eq=False)
class OwnProblem:
    """An optimal-control problem with numbers.

    s0: (n_states,). psi: (n_parameters,). context: (n_context,).
    observations: (T+1, n_observations) of a demonstration, or None.
    step_size: of gradient descent, or None.
    """

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    observations: Array | None
    step_size: float | None


def load_own(place: str) -> OwnProblem:
    """Call the function at `FILE.py:FUNCTION` and check what it returns.

    Raises:
        FileError: there is no such Python file.
        ProblemError: the function is missing, file or function raise, or the returned parts do not fit together.
    """
    path, _, name = place.rpartition(":")
    with _neighbours(Path(path)):
        function = _function(path, _module(Path(path)), name)
        try:
            returned = function()
        except (Exception, SystemExit) as error:
            raise ProblemError(_raised(place, Path(path), error)) from error
    return _checked(place, returned)


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """A block in which a file may import its neighbours."""
    folder = str(path.parent.resolve())
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # the file has removed it
            sys.path.remove(folder)


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"kpirl_own.{path.stem}", path)  # else numpy.py would be numpy
    if spec is None or spec.loader is None or not path.is_file():
        raise FileError(f"there is no Python file {path}.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # where dataclasses look up annotations
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ProblemError(_raised(str(path), path, error)) from error
    return module


def _function(path: str, module: ModuleType, name: str) -> Callable[[], object]:
    found = getattr(module, name, None)
    if callable(found):
        return found
    if isinstance(found, OCP):
        raise ProblemError(
            f"{path}: {name!r} is an OCP, not a function. Write one that returns it with your numbers, such as "
            f"`def start(): return {name}, {_numbers(found)}`, and give {path}:start."
        )
    if found is not None:
        raise ProblemError(
            f"{path}: {name!r} is not a function, but of type {type(found).__name__}. Give a function; {_EXPECTED}."
        )
    own = [key for key, value in vars(module).items() if isfunction(value) and value.__module__ == module.__name__]
    there = f"; it has {', '.join(own)}." if own else "; it has none."
    raise ProblemError(f"{path} has no function {name!r}{suggestion(name, own) or there}")


def _numbers(problem: OCP) -> str:
    """The dictionary that belongs to a problem, with zeros for numbers."""
    lengths = {"s0": problem.n_states, "psi": problem.n_parameters, "context": problem.n_context}
    zeros = (f'"{name}": {[0] * n if n < 4 else f"[0] * {n}"}' for name, n in lengths.items() if n)
    return f"{{{', '.join(zeros)}}}"


def _raised(place: str, path: Path, error: BaseException) -> str:
    """A sentence about an error, with the last line of the file that led there, if one did."""
    said = " ".join(f"{place} raised {type(error).__name__}: {error}".split()).rstrip(":")
    if isinstance(error, SyntaxError):  # which says where by itself
        return f"{said}."
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()]
    return f"{said} (line {lines[-1]} of {path.name})" if lines else f"{said}."


def _checked(place: str, returned: object) -> OwnProblem:
    if not (isinstance(returned, tuple) and len(returned) == 2):
        instead = f", such as `return problem, {_numbers(returned)}`" if isinstance(returned, OCP) else ""
        raise ProblemError(f"{place}: {_EXPECTED}, not {type(returned).__name__}{instead}.")
    problem, numbers = returned
    if not (isinstance(problem, OCP) and isinstance(numbers, Mapping)):
        raise ProblemError(f"{place}: {_EXPECTED}, not {type(problem).__name__} and {type(numbers).__name__}.")
    for key in numbers:
        if key not in _KEYS:
            hint = suggestion(str(key), _KEYS) or f"; there are {', '.join(_KEYS)}."
            raise ProblemError(f"{place}: there is no number {key!r}{hint}")
    shapes = {"s0": (problem.n_states,), "psi": (problem.n_parameters,), "context": (problem.n_context,)}
    arrays = {name: _array(place, numbers, name, shape) for name, shape in shapes.items()}
    observed = (problem.horizon + 1, problem.n_observations)
    observations = _array(place, numbers, "observations", observed) if "observations" in numbers else None
    return OwnProblem(problem, observations=observations, step_size=_step_size(place, numbers), **arrays)


def _array(place: str, numbers: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    if name not in numbers and 0 in shape:
        return np.zeros(shape)
    if name not in numbers:
        raise ProblemError(f"{place}: the numbers have no {name!r}, which must be of shape {shape}.")
    try:
        value = np.array(numbers[name], float)
    except (TypeError, ValueError):
        value = np.array(np.nan)
    if value.shape != shape and value.size == np.prod(shape) and len(shape) == 1:
        value = value.reshape(shape)
    if value.shape != shape or not np.isfinite(value).all():
        raise ProblemError(f"{place}: {name} must be finite and of shape {shape}, got {shown(numbers[name])}.")
    return value


def _step_size(place: str, numbers: Mapping[str, Any]) -> float | None:
    value = numbers.get("step_size")
    if value is not None and not (
        isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value) and value > 0
    ):
        raise ProblemError(f"{place}: step_size must be a positive number, got {value!r}.")
    return value
