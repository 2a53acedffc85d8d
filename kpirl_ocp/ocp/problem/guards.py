"""Guards against what CasADi does to threads and to Ctrl-C.

Two threads that evaluate the same function at once, or two functions that share a part, crash the process. Solvers that
run in CasADi take turns; `Riccati` and `GradientDescent` run compiled code and need not. If Ctrl-C comes while CasADi
converts numbers, it raises SystemError, or gives None in their place; here both become KeyboardInterrupt again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import casadi as ca
import numpy as np

from kpirl_ocp.types import Array

_lock = threading.RLock()
_P = ParamSpec("_P")
_R = TypeVar("_R")


def one_at_a_time(method: Callable[_P, _R]) -> Callable[_P, _R]:
    """The same callable behind a lock that all guarded ones share."""

    @wraps(method)
    def guarded(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _lock:
            try:
                return method(*args, **kwargs)
            except SystemError as error:
                if isinstance(error.__cause__, KeyboardInterrupt):
                    raise error.__cause__ from None
                raise

    return guarded


def dense(matrix: ca.DM) -> Array:
    """The numbers (rows, columns) of a matrix; KeyboardInterrupt where CasADi dropped it."""
    numbers = matrix.full()
    if numbers is None:
        raise KeyboardInterrupt
    return np.asarray(numbers, float)
