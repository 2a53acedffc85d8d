"""Calls in another process, for solvers that may never end: after a time limit, or on Ctrl-C, the process is ended.

It is started with the first call, serves one call at a time, and ends with this process. A problem is sent once.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import IO, Any, cast
from weakref import WeakKeyDictionary, finalize

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.reporting import deaf_children

_MOST = 64  # problems that one process keeps
# Without '', the working directory, which may hold sources of the package that are not the ones imported here.
_PROGRAM = f"import sys; sys.path[:] = filter(None, sys.path); from {__name__} import serve; serve()"


class ChildProcess:
    """Calls `method(problem, *arguments)` elsewhere; method is picklable, as bound methods of solvers are."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stop: Callable[[], Any] = lambda: None
        self._known: WeakKeyDictionary[OCP, int] = WeakKeyDictionary()
        self._sent = 0

    def call(self, limit: float, method: Callable[..., Any], problem: OCP, *arguments: Any) -> Any:
        """The result, or None if there was none within the limit [s], or the process died.

        Raises what the method raises.
        """
        with self._lock:
            finished = False
            try:
                sending, receiving = self._begin()
                number, new = self._number(problem)
                sending.send((number, problem if new else None, method, arguments))
                if not receiving.poll(limit):
                    return None
                result, error = receiving.recv()
                finished = True
            except (EOFError, BrokenPipeError, ConnectionResetError):
                return None
            finally:  # also when interrupted
                if not finished:
                    self._end()
        if error is not None:
            raise error
        return result

    def _begin(self) -> tuple[Connection, Connection]:
        if self._sent >= _MOST:
            self._end()
        if self._process is None or self._process.poll() is not None:
            self._known.clear()
            self._sent = 0
            with deaf_children():
                self._process, self._ends = _started()
            self._stop = finalize(self, _stop, self._process, self._ends, os.getpid())  # at exit, too
        return self._ends

    def _number(self, problem: OCP) -> tuple[int, bool]:
        """The number of a problem, and whether it has to be sent."""
        if problem in self._known:
            return self._known[problem], False
        self._known[problem] = self._sent
        self._sent += 1
        return self._known[problem], True

    def _end(self) -> None:
        self._stop()
        self._process = None


def _started() -> tuple[subprocess.Popen[bytes], tuple[Connection, Connection]]:
    """A process that serves, and the ends for sending and receiving."""
    path = os.pathsep.join(path or os.getcwd() for path in sys.path)
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
    )
    to, back = (cast("IO[bytes]", pipe).fileno() for pipe in (process.stdin, process.stdout))
    return process, (Connection(os.dup(to), readable=False), Connection(os.dup(back), writable=False))


def _stop(process: subprocess.Popen[bytes], ends: tuple[Connection, Connection], owner: int) -> None:
    """End the process that this one, not one that it was forked from, has started, and close the ends."""
    if os.getpid() != owner:
        return
    process.kill()
    process.communicate()
    for end in ends:
        end.close()


def serve() -> None:
    """Answer calls on the standard streams until they are closed.

    SIGTERM ends it even in a solve without an end, should the process that would kill it be gone.
    """
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    receiving, sending = Connection(os.dup(0), writable=False), Connection(os.dup(1), readable=False)
    os.dup2(2, 1)  # whatever a solver prints
    problems: dict[int, OCP] = {}
    while True:
        try:
            number, problem, method, arguments = receiving.recv()
        except EOFError:
            return
        if problem is not None:
            problems[number] = problem
        try:
            sending.send((method(problems[number], *arguments), None))
        except Exception as error:  # whatever it is, it belongs to the caller
            sending.send((None, error))
