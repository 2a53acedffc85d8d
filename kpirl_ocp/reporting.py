"""The frame of every script: readable errors, settings and versions beside the results, tables."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import KpirlError

_PACKAGES = ("kpirl-ocp", "casadi", "pin", "numpy", "scipy", "pybullet", "torch")


def run(main: Callable[[], None]) -> None:
    """Run a script; an error that the user can mend is one line on stderr and exit code 2."""
    try:
        main()
    except (KpirlError, OSError) as error:
        sys.exit(_fail(str(error)))


def _fail(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 2


def output_directory(path: str | Path) -> Path:
    """The directory, made if it does not exist."""
    directory = Path(path)
    directory.mkdir(parents=True, exist_ok=True)
    return directory


def write_metrics(directory: Path, settings: Mapping[str, Any], results: Mapping[str, Any]) -> Path:
    """`metrics.json`: settings, versions and results."""
    path = directory / "metrics.json"
    versions = {"python": platform.python_version()} | {package: _version(package) for package in _PACKAGES}
    content = {"settings": settings, "versions": versions, "results": results}
    path.write_text(json.dumps(content, indent=2, default=_plain) + "\n")
    return path


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
    """Mean and standard deviation of values (runs,); one run has no deviation."""
    runs = np.asarray(values, float)
    return plus_minus(runs.mean(), (runs - runs[0]).std()) if len(runs) > 1 else digits(float(runs[0]), 3)


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
