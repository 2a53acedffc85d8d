"""Static decisions: numbers that do not change over the horizon, such as its duration or a design.

They become states (s, q) with q' = q and a free initial value, so that every solver that allows a free initial state
solves for them.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import Bounds, bounds_of
from kpirl_ocp.ocp.problem.statement.draft import Draft
from kpirl_ocp.ocp.problem.statement.expressions import Expression, symbols_of
from kpirl_ocp.types import Array


def add_static(draft: Draft, static: Expression, bounds: Bounds) -> None:
    """Add q within bounds."""
    symbols_of(**{name: own[0] for name, own in draft.symbols.items()}, static=static)
    lower, upper = bounds_of("static_bounds", bounds, (static.numel(),))
    draft.add_states(static, lower, upper)
    draft.additions = replace(draft.additions, static=tuple(_start(lower, upper).tolist()))


def check_static(draft: Draft, static: Expression) -> None:
    """Raise ProblemError for a q that nothing uses."""
    own = {"dynamics": draft.state.numel()}
    rows = [value[: own.get(name, value.numel())] for name, value in draft.expressions.items() if value is not None]
    for i, found in enumerate(ca.which_depends(ca.vertcat(*rows), static, 1, False)):
        if not found:
            raise ProblemError(f"static[{i}] is used nowhere: dynamics, costs and constraints do not depend on it.")


def _start(lower: Array, upper: Array) -> Array:
    """The middle of bounds; where one of them is infinite zero, or one unit off a bound that is in the way.

    Not on the bound: a final time of zero, where nothing moves, tells a solver nothing about the time that it takes.
    """
    bounded = np.isfinite(lower) & np.isfinite(upper)
    nearest = np.clip(0.0, lower, upper)
    with np.errstate(invalid="ignore"):
        return np.where(bounded, (lower + upper) / 2, nearest + (nearest == lower) - (nearest == upper))
