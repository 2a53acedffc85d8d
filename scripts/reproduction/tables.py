"""Numbers of several seeds as table cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kpirl_ocp.reporting import plus_minus
from kpirl_ocp.types import Array


def spread(values: Sequence[Any] | Array) -> str:
    """Mean and standard deviation over seeds; tests of one seed are averaged first."""
    runs = per_seed(values)
    return plus_minus(runs.mean(), (runs - runs[0]).std()) if len(runs) else "not learned"


def per_seed(values: Sequence[Any] | Array) -> Array:
    """Means (seeds,)."""
    return np.array([np.mean(value) for value in values])
