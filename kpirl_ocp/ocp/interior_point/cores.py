"""Cores of the problems that were solved last, shared by all threads."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from contextlib import AbstractContextManager

from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.problem.ocp import OCP

_PROBLEMS = 64  # whose memory and functions are kept


class _Cores:
    """Cores that nobody uses at the moment, of the problems that were solved last. Shared by all threads."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew, as a forked process must: the lock may have been held."""
        self._lock = threading.Lock()
        self._idle: OrderedDict[OCP, list[Core]] = OrderedDict()

    def take(self, problem: OCP) -> tuple[Core | None, list[Core]]:
        """One that is idle, if there is one, and the list to which it belongs when nobody uses it."""
        with self._lock:
            idle = self._idle.setdefault(problem, [])
            self._idle.move_to_end(problem)
            while len(self._idle) > _PROBLEMS:
                self._idle.popitem(last=False)
            return idle.pop() if idle else None, idle

    def give_back(self, core: Core, idle: list[Core]) -> None:
        """To its list."""
        with self._lock:
            idle.append(core)


class _Borrowed(AbstractContextManager[Core]):
    """A core that is idle, or a new one: the caller's until the context ends, and nobody's after an error."""

    def __init__(self, problem: OCP) -> None:
        self._problem = problem

    def __enter__(self) -> Core:
        core, self._idle = _cores.take(self._problem)
        self._core = core or Core(self._problem)
        return self._core

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None:
            _cores.give_back(self._core, self._idle)


_cores = _Cores()
os.register_at_fork(after_in_child=_cores.forget)


def borrow_core(problem: OCP) -> AbstractContextManager[Core]:
    """A core for a problem, for the time of a context. Those of the last `_PROBLEMS` problems are kept."""
    return _Borrowed(problem)
