"""A problem whose first action is given: its optimal cost is the state-action value Q(s_0, u_0; psi, c)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of, kind_of

_AT_STAGES = ("dynamics", "stage_cost", "path_constraint", "path_equality")
_AT_END = ("terminal_cost", "terminal_constraint", "terminal_equality")


def with_first_action(problem: OCP) -> OCP:
    """The problem with u_0 given by the last entries of the context.

    Slacks that `from_expressions` has added stay free. Bounds do not count for what is given; path constraints do.

    Returns:
        The problem with the context (c, u_0) of length n_c + n_u, and a last column (1, 0, .., 0) of the schedule, with
        which the path equality u_t = u_0 holds at t = 0 alone.
    """
    n_u = problem.n_stated_actions
    functions: dict[str, Any] = {name: _longer(getattr(problem, name), n_u) for name in (*_AT_STAGES, *_AT_END)}
    inputs = inputs_of(functions["stage_cost"])
    _, u, _, c, d = inputs
    before = functions["path_equality"]
    rows = [*([] if before is None else [before(*inputs)]), d[-1] * (u[:n_u] - c[problem.n_context :])]
    functions["path_equality"] = ca.Function("path_equality", inputs, [ca.vertcat(*rows)])
    lower, upper = (np.array(bound, float) for bound in problem.action_bounds)
    lower[0, :n_u], upper[0, :n_u] = -np.inf, np.inf
    first = np.eye(problem.horizon + 1, 1)
    schedule = np.hstack([np.asarray(problem.schedule), first])
    return replace(problem, action_bounds=(lower, upper), schedule=schedule, **functions)


def _longer(function: ca.Function | None, n_u: int) -> ca.Function | None:
    """A stage or terminal function with n_u more numbers in the context and one more in the stage."""
    if function is None:
        return None
    kind, sizes = kind_of(function), [function.size1_in(i) for i in range(function.n_in())]
    more = [0] * (len(sizes) - 2) + [n_u, 1]
    inputs = [kind.sym(f"x{i}", size + extra) for i, (size, extra) in enumerate(zip(sizes, more, strict=True))]
    seen = [x[:size] for x, size in zip(inputs, sizes, strict=True)]
    return ca.Function(function.name(), inputs, function.call(seen, True, False))
