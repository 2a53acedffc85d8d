"""The last part of a statement: bounds, static decisions and soft constraints, in the order that they need."""

from __future__ import annotations

from typing import Any

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED, Bounds
from kpirl_ocp.ocp.problem.statement.draft import Draft
from kpirl_ocp.ocp.problem.statement.expressions import Expression
from kpirl_ocp.ocp.problem.statement.moving_bounds import bound_actions, bound_start, bound_states
from kpirl_ocp.ocp.problem.statement.soft import Soft, soften
from kpirl_ocp.ocp.problem.statement.static import add_static, check_static


def complete(
    draft: Draft,
    action_bounds: Bounds,
    state_bounds: Bounds,
    initial_bounds: Bounds | None,
    static: Expression | None,
    static_bounds: Bounds,
    soft: Soft | None,
) -> dict[str, Any]:
    """The fields of an `OCP`. Raises ProblemError for what does not fit the draft."""
    stated = draft.expressions["observation"] is None and (static is not None or soft is not None)
    if stated:
        draft.expressions["observation"] = draft.state
    if static is not None:
        add_static(draft, static, static_bounds)
    elif static_bounds is not UNBOUNDED:
        raise ProblemError("static_bounds must be left out where there is no static decision.")
    bound_actions(draft, action_bounds)
    bound_start(draft, initial_bounds)
    bound_states(draft, state_bounds)
    if soft is not None:
        soften(draft, soft)
    if static is not None:
        check_static(draft, static)
    return draft.fields()
