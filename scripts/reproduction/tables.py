"""Numbers of several seeds as table cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kpirl_ocp.reporting import digits, plus_minus
from kpirl_ocp.types import Array


def spread(values: Sequence[Any] | Array) -> str:
    """Mean and standard deviation over seeds; tests of one seed are averaged first. One seed has no deviation."""
    runs = per_seed(values)
    if len(runs) == 0:
        return "not learned"
    return plus_minus(runs.mean(), (runs - runs[0]).std()) if len(runs) > 1 else digits(runs[0], 3)


def demonstrations(count: int) -> str:
    """Their number and the noun."""
    return "1 demonstration" if count == 1 else f"{count} demonstrations"


def per_seed(values: Sequence[Any] | Array) -> Array:
    """Means (seeds,)."""
    return np.array([np.mean(value) for value in values])
