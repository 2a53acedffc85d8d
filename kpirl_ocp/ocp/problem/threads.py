"""One thread at a time in CasADi: two that evaluate one function at once, or functions that share a part, end the
process.

Solvers that run in CasADi take turns; `Riccati` and `GradientDescent` run compiled code and need not. Ctrl-C that comes
while CasADi hands over numbers, which makes a SystemError of it, is Ctrl-C again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

_lock = threading.RLock()
_P = ParamSpec("_P")
_R = TypeVar("_R")


def one_at_a_time(method: Callable[_P, _R]) -> Callable[_P, _R]:
    """A callable guarded so that one thread at a time is in any of those that are guarded."""

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
