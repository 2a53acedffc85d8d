"""Cores of the problems that were solved last, shared by all threads."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

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

    @contextmanager
    def borrow(self, problem: OCP) -> Iterator[Core]:
        """One that is idle, or a new one; it belongs to the caller until the context ends."""
        with self._lock:
            idle = self._idle.setdefault(problem, [])
            self._idle.move_to_end(problem)
            while len(self._idle) > _PROBLEMS:
                self._idle.popitem(last=False)
            core = idle.pop() if idle else None
        core = core or Core(problem)
        yield core
        with self._lock:
            idle.append(core)


_cores = _Cores()
os.register_at_fork(after_in_child=_cores.forget)


def borrow_core(problem: OCP) -> AbstractContextManager[Core]:
    """A core for a problem, for the time of a context. Those of the last `_PROBLEMS` problems are kept."""
    return _cores.borrow(problem)
