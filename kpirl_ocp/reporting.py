"""The written results of commands and scripts: settings and versions beside the numbers, tables; Ctrl-C keeps them."""

from __future__ import annotations

import contextlib
import json
import platform
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.episodes import write_whole

_PACKAGES = ("kpirl-ocp", "casadi", "pin", "numpy", "scipy", "pybullet", "torch")
_STOPS = (signal.SIGINT, signal.SIGTERM)


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

    Ignoring is what they inherit, so that this process does not hear them either while they start.
    """
    with signals_kept():
        if threading.current_thread() is threading.main_thread():  # which alone may say so
            for number in _STOPS:
                signal.signal(number, signal.SIG_IGN)
        yield


@contextlib.contextmanager
def signals_kept() -> Iterator[None]:
    """A block after which Ctrl-C and SIGTERM do what they did before, whatever handles them within."""
    before = {number: signal.getsignal(number) for number in _STOPS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


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
    cells = [list(map(str, header)), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]

    def line(row: Sequence[str]) -> str:
        return "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])

    return "\n".join([line(cells[0]), "  ".join("-" * width for width in widths), *map(line, cells[1:])])


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
