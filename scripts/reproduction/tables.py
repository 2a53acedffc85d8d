"""Numbers of several seeds as table cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kpirl_ocp import reporting
from kpirl_ocp.types import Array


def spread(values: Sequence[Any] | Array) -> str:
    """Mean and standard deviation over seeds; tests of one seed are averaged first. One seed has no deviation."""
    return reporting.spread(per_seed(values)) if len(values) else "not learned"


def demonstrations(count: int) -> str:
    """Their number and the noun."""
    return "1 demonstration" if count == 1 else f"{count} demonstrations"


def per_seed(values: Sequence[Any] | Array) -> Array:
    """Means (seeds,)."""
    return np.array([np.mean(value) for value in values])


def restlessness(losses: Sequence[Array]) -> float:
    """Share of outer iterations in which the training loss rose by more than 1 %."""
    rises = [np.mean(np.diff(run) > 0.01 * run[:-1]) for run in losses if len(run) > 1]
    return float(np.mean(rises)) if rises else 0.0
