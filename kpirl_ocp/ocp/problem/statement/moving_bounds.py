"""Bounds that are expressions of parameters, context, stage or static decisions: rows of constraints.

So they are differentiated, as every constraint is. Entries that are numbers stay bounds.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.statement.checks import Bounds, bounds_of, shown
from kpirl_ocp.ocp.problem.statement.draft import Draft
from kpirl_ocp.ocp.problem.statement.expressions import Expression, depends, expression_of
from kpirl_ocp.types import Array


def bound_actions(draft: Draft, bounds: Bounds) -> None:
    """Bounds of the user's action."""
    shape = (draft.horizon, draft.action.numel())
    rows = _numbers_and_rows(draft, "action_bounds", bounds, draft.action, shape)
    if rows:
        draft.append("path_constraint", *(row for _, row in rows))


def bound_states(draft: Draft, bounds: Bounds) -> None:
    """Bounds of the user's state, at a given entry of s_0 without effect."""
    shape = (draft.horizon + 1, draft.state.numel())
    rows = _numbers_and_rows(draft, "state_bounds", bounds, draft.state, shape)
    initial = draft.bounds["initial_bounds"]
    for entry, row in rows:
        if initial is None or not initial[0][entry] < initial[1][entry]:
            after = draft.after_start
            row = after * row + after - 1  # -1 at t = 0
        draft.append("path_constraint", row)


def bound_start(draft: Draft, bounds: Bounds | None) -> None:
    """Bounds of the user's s_0; None where all of it is given."""
    if bounds is None:
        return
    rows = _numbers_and_rows(draft, "initial_bounds", bounds, draft.state, (draft.state.numel(),))
    for _, row in rows:
        draft.append("path_constraint", (1 - draft.after_start) * row - draft.after_start)  # -1 later on


def _numbers_and_rows(
    draft: Draft, name: str, bounds: Bounds, bounded: Expression, shape: tuple[int, ...]
) -> list[tuple[int, Expression]]:
    """Note the numbers among the bounds; the others as rows <= 0, with the entry that each is about."""
    try:
        lower, upper = bounds
    except (TypeError, ValueError) as error:
        got = f"not a pair for every entry, got {shown(bounds)}"
        raise ProblemError(f"{name} must be (lower, upper), {got}.") from error
    numbers, rows = [], []
    for bound, sign in ((lower, -1), (upper, 1)):
        plain, moving = _split(draft, name, bound, shape[-1], sign)
        numbers.append(plain)
        if moving is not None:
            rows += [(i, sign * (bounded[i] - moving[i])) for i in _moving(moving)]
    draft.put_bounds(name, bounds_of(name, (numbers[0], numbers[1]), shape))
    return rows


def _split(draft: Draft, name: str, bound: Any, length: int, sign: int) -> tuple[Any, Expression | None]:
    """A bound with infinity where it is no number, and as an expression if it is one."""
    if not isinstance(bound, ca.SX | ca.MX):
        return bound, None
    moving = expression_of(name, bound, draft.kind)
    draft.check_bound(name, moving)
    if moving.shape not in ((1, 1), (length, 1)):
        raise ProblemError(f"{name} as an expression must have length {length} or 1, got the shape {moving.shape}.")
    moving = ca.densify(moving) * draft.kind.ones(length)
    symbols = ca.symvar(moving)
    values: Array = dense(ca.Function("bound", symbols, [moving])(*[1.0] * len(symbols))).ravel()
    values[_moving(moving)] = sign * np.inf
    return values, moving


def _moving(bound: Expression) -> list[int]:
    """The entries that depend on any symbol."""
    return [i for i, found in enumerate(depends(bound, *ca.symvar(bound))) if found]
