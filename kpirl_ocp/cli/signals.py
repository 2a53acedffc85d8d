"""Ctrl-C and SIGTERM in commands: both raise KeyboardInterrupt, which CasADi must not swallow."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_AGAIN = 0.01  # [s] after which a delayed signal is tried again


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """A context in which SIGTERM, which cluster schedulers send, has the effect of Ctrl-C.

    Both are delayed while CasADi converts arguments, since it drops or replaces exceptions there.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield
        return
    numbers = [signal.SIGTERM, signal.SIGALRM]
    if callable(signal.getsignal(signal.SIGINT)):  # shells let jobs in the background ignore it
        numbers.append(signal.SIGINT)
    before = {number: signal.signal(number, _stop) for number in numbers}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, frame: FrameType | None) -> None:
    if number != signal.SIGINT and callable(signal.getsignal(signal.SIGINT)):
        signal.raise_signal(signal.SIGINT)  # so that the present handler of Ctrl-C is called
    elif _within_casadi(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    else:
        raise KeyboardInterrupt


def _within_casadi(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__") == "casadi.casadi":
            return True
        frame = frame.f_back
    return False
