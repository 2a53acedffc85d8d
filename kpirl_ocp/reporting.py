"""The written results of commands and scripts: numbers with settings and versions, and tables; Ctrl-C keeps them.

Child processes never hear Ctrl-C or SIGTERM, and this process loses neither while they start or are stopped.
"""

from __future__ import annotations

import contextlib
import json
import platform
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence, Set
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.episodes import write_whole

if TYPE_CHECKING:
    import joblib

_PACKAGES = ("kpirl-ocp", "casadi", "pin", "numpy", "scipy", "pybullet", "torch")
_STOPS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE = 0.5  # [s] with a thread that may feed another pool, which goes on


def write_metrics(directory: Path, settings: Mapping[str, Any], results: Mapping[str, Any]) -> Path:
    """`metrics.json`: settings, versions and results."""
    path = directory / "metrics.json"
    versions = {"python": platform.python_version()} | {package: _version(package) for package in _PACKAGES}
    content = {"settings": settings, "versions": versions, "results": results}
    write_whole(path, json.dumps(content, indent=2, default=_plain) + "\n")
    return path


@contextlib.contextmanager
def kept_if_interrupted(
    directory: Path, settings: Mapping[str, Any], results: Mapping[str, Any], progress: Callable[[], str]
) -> Iterator[None]:
    """A block in which Ctrl-C writes `metrics.json` with the results so far, and says how much `progress` there was."""
    try:
        yield
    except KeyboardInterrupt:
        path = write_metrics(directory, settings, results)
        raise KeyboardInterrupt(f"{progress()} are in {path}") from None


@contextlib.contextmanager
def said_if_interrupted(kept: Callable[[], str]) -> Iterator[None]:
    """A block in which Ctrl-C says what is `kept`; an empty text: nothing. What is said further inside goes first."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(str(stop) or kept()) from None


@contextlib.contextmanager
def deaf_children() -> Iterator[None]:
    """A block in which processes start that never hear Ctrl-C or SIGTERM: they are for this one, which kills them.

    They inherit the signal mask of the thread that starts them, as do threads that begin here. What is sent to this
    process meanwhile acts at the end of the block, and not within it, where it would leave a pool half made.
    """
    with contextlib.ExitStack() as stack:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
        stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        stack.enter_context(_signals_delayed())
        yield


@contextlib.contextmanager
def deaf_pool() -> Iterator[None]:
    """As `deaf_children`, for a pool, with whose first one Python starts a tracker of resources.

    That unblocks both signals when it has started (until Python 3.13), so it does before.
    """
    from joblib.externals.loky.backend import resource_tracker as loky_tracker

    for tracker in (resource_tracker, loky_tracker):
        tracker.ensure_running()
    with deaf_children():
        yield


def results_of(parallel: joblib.Parallel, tasks: Iterable[Any]) -> Generator[Any, None, None]:
    """Results of delayed tasks as they come, from deaf processes; what ends this generator stops them.

    parallel: returns a generator.
    """
    with contextlib.ExitStack() as stack:
        with deaf_pool():
            running = parallel(tasks)
            stack.callback(_close, running)
        yield from running
        stack.pop_all()  # all are there: the processes stay, for what comes next


def _close(running: Generator[Any, None, None]) -> None:
    with pool_ending():
        running.close()


def feeders() -> set[threading.Thread]:
    """The threads that feed the processes of pools."""
    return {thread for thread in threading.enumerate() if thread.name == "QueueFeederThread"}


@contextlib.contextmanager
def pool_ending(others: Set[threading.Thread] = frozenset()) -> Iterator[None]:
    """A block that kills the processes of loky's pool, and is not interrupted by signals.

    A wait for a thread that a signal interrupts takes that thread for ended (until Python 3.13): the program then ends
    without it, and leaves behind the processes that the thread was about to stop. Threads that fed the processes are
    waited for, too: Python does not, and where it ends within one that gives back a semaphore, loky reports a leak.

    others: feeders of other pools, which go on.
    """
    with _signals_delayed(), _dropped_tasks_unsaid():
        yield
        for thread in feeders() - others:
            thread.join(_PATIENCE)


@contextlib.contextmanager
def _dropped_tasks_unsaid() -> Iterator[None]:
    """A block in which loky's thread may end with the KeyError of a task that was dropped before it was handed out.

    It has killed the processes by then.
    """
    said = threading.excepthook

    def hook(ended: threading.ExceptHookArgs) -> None:
        name = ended.thread.name if ended.thread else ""
        if not (name == "ExecutorManagerThread" and issubclass(ended.exc_type, KeyError)):
            said(ended)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = said


@contextlib.contextmanager
def _signals_delayed() -> Iterator[None]:
    """A block after which this thread is sent the signals that reached Python in it.

    The mask of one thread does not keep them out: the system gives them to another, and Python's handlers run in the
    main thread whichever it was.
    """
    noted: set[int] = set()
    with contextlib.ExitStack() as stack:
        stack.callback(_raise, noted)
        for number in _STOPS if threading.current_thread() is threading.main_thread() else ():
            known = signal.getsignal(number)
            if known not in (None, signal.SIG_IGN):  # None: a handler of C, which Python could not put back
                stack.callback(signal.signal, number, signal.signal(number, lambda came, _: noted.add(came)))
        yield


def _raise(numbers: Iterable[int]) -> None:
    for number in numbers:
        signal.raise_signal(number)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


def plus_minus(mean: float, deviation: float) -> str:
    """Three digits of the mean and two of the deviation, without exponents where both are easily read: 175 ± 140."""
    return f"{digits(mean, 3)} ± {digits(deviation, 2)}"


def spread(values: ArrayLike) -> str:
    """Mean and standard deviation of values (runs,), which is 0 where it is rounding; one run has no deviation."""
    runs = np.asarray(values, float)
    if len(runs) == 1:
        return digits(float(runs[0]), 3)
    deviation = runs.std()
    return plus_minus(runs.mean(), 0.0 if deviation < 1e-12 * np.abs(runs).max() else deviation)


def digits(value: float, count: int) -> str:
    """A number with so many digits, without an exponent where it is easily read."""
    size = abs(value)
    if not np.isfinite(value) or size == 0 or not 1e-4 <= size < 1e6:
        return f"{value:.{count}g}"
    places = count - 1 - int(np.floor(np.log10(size)))
    rounded = round(value, places)
    return f"{rounded:.{max(places, 0)}f}".rstrip("0").rstrip(".") if places > 0 else f"{rounded:.0f}"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Aligned columns, the first to the left, the others to the right."""
    cells = [list(map(str, header)), *([cell(value) for value in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]

    def line(row: Sequence[str]) -> str:
        return "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])

    return "\n".join([line(cells[0]), "  ".join("-" * width for width in widths), *map(line, cells[1:])])


def cell(value: Any) -> str:
    """A value as text; floats get four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
