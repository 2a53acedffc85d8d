"""Ctrl-C in a solver of CasADi, which turns it into a RuntimeError or, with Ipopt, into a status like any other."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import casadi as ca


def call_solver(solver: ca.Function, **arguments: Any) -> dict[str, ca.DM]:
    """Call a solver of CasADi with named inputs. Raises KeyboardInterrupt if Ctrl-C came meanwhile."""
    with _noting_ctrl_c() as came:
        try:
            result = solver(**arguments)
        except (RuntimeError, SystemError):  # which of them Ctrl-C becomes depends on the version of Python
            if not came():
                raise
    if came():
        raise KeyboardInterrupt
    return result


@contextlib.contextmanager
def _noting_ctrl_c() -> Iterator[Callable[[], bool]]:
    """A block whose value says whether Ctrl-C raised KeyboardInterrupt in it; only the main thread gets signals."""
    raised: list[int] = []
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield lambda: False
        return

    def note(number: int, frame: FrameType | None) -> None:
        try:
            handler(number, None)  # wherever CasADi is
        except KeyboardInterrupt:
            raised.append(number)
            raise

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(raised)
    finally:
        signal.signal(signal.SIGINT, handler)
