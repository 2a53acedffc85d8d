"""A problem while it is being stated: expressions, to which rows, states and actions are added before they become
functions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED, bounds_of, horizon_of, schedule_of
from kpirl_ocp.ocp.problem.statement.expressions import (
    CONSTRAINTS,
    Expression,
    check_rows,
    expression_of,
    function_of,
    symbols_of,
    unknown_symbols,
)
from kpirl_ocp.types import Array


@dataclass(frozen=True)
class Additions:
    """States and actions that a statement has added after those of the user.

    static: (n_q,) what the static decisions start from.
    end_slacks: number of states that are slacks of soft constraints at s_T; they start from zero.
    slacks: number of actions that are slacks of soft constraints.
    """

    static: tuple[float, ...] = ()
    end_slacks: int = 0
    slacks: int = 0

    @property
    def states(self) -> Array:
        """Initial values of all added states."""
        return np.array([*self.static, *[0.0] * self.end_slacks])


class Draft:
    """Symbols, expressions and bounds of a problem; `fields` makes those of an `OCP` out of them.

    Rows, costs, states and actions that are added may depend on the user's symbols and on added ones.
    """

    def __init__(
        self, symbols: Mapping[str, Expression | None], horizon: int, schedule: ArrayLike | None, **expressions: Any
    ) -> None:
        self.symbols = symbols_of(**symbols)
        self.kind: Any = type(symbols["state"])
        self.horizon, self.additions = horizon_of(horizon), Additions()
        self.schedule = schedule_of(schedule, self.horizon)
        expected = (self.horizon + 1, self.symbols["stage"][0].numel())
        if self.schedule.shape != expected:
            got = "none" if schedule is None else self.schedule.shape
            raise ProblemError(f"schedule must have a column for every number of the stage, {expected}, got {got}.")
        self.expressions = {
            name: None if value is None else expression_of(name, value, self.kind)
            for name, value in expressions.items()
        }
        for name in CONSTRAINTS:
            if self.expressions[name] is not None:
                check_rows(name, self.expressions[name])
        n_s, n_u = self.state.numel(), self.action.numel()
        self.bounds: dict[str, tuple[Array, Array] | None] = {
            "action_bounds": bounds_of("action_bounds", UNBOUNDED, (self.horizon, n_u)),
            "state_bounds": bounds_of("state_bounds", UNBOUNDED, (self.horizon + 1, n_s)),
            "initial_bounds": None,
        }
        self._after: Expression | None = None

    @property
    def state(self) -> Expression:
        """The user's state."""
        return self.symbols["state"][0]

    @property
    def action(self) -> Expression:
        """The user's action."""
        return self.symbols["action"][0]

    @property
    def after_start(self) -> Expression:
        """A number of the stage that is 0 at t = 0 and 1 later on; the schedule has it from the first use on."""
        if self._after is None:
            self._after = self.kind.sym("after_start")
            self.symbols["stage"].append(self._after)
            self.schedule = np.column_stack([self.schedule, np.minimum(np.arange(self.horizon + 1.0), 1.0)])
        return self._after

    def append(self, name: str, *rows: Expression) -> None:
        """Rows to a constraint, or to the dynamics."""
        before = self.expressions[name]
        self.expressions[name] = ca.vertcat(*([] if before is None else [before]), *rows)

    def add(self, name: str, cost: Expression) -> None:
        """A term to a cost."""
        self.expressions[name] = self.expressions[name] + cost

    def add_states(self, symbol: Expression, lower: ArrayLike, upper: ArrayLike) -> None:
        """States that keep their value, which is a decision within bounds."""
        self.symbols["state"].append(symbol)
        self.append("dynamics", symbol)
        shape = (symbol.numel(),)
        self._widen("initial_bounds", bounds_of("static_bounds", (lower, upper), shape))
        self._widen("state_bounds", bounds_of("state_bounds", UNBOUNDED, (self.horizon + 1, *shape)))

    def add_actions(self, symbol: Expression) -> None:
        """Actions that are not negative."""
        self.symbols["action"].append(symbol)
        self._widen("action_bounds", bounds_of("action_bounds", (0.0, np.inf), (self.horizon, symbol.numel())))

    def put_bounds(self, name: str, numbers: tuple[Array, Array]) -> None:
        """Numbers as the bounds of the user's own entries."""
        length = numbers[0].shape[-1]
        before = self.bounds[name] or numbers
        self.bounds[name] = (
            np.concatenate([numbers[0], before[0][..., length:]], axis=-1),
            np.concatenate([numbers[1], before[1][..., length:]], axis=-1),
        )

    def check_bound(self, name: str, bound: Expression) -> None:
        """Raise ProblemError for a bound that depends on states or actions, or on symbols that were not passed in."""
        allowed = [symbol for role in ("parameters", "context", "stage") for symbol in self.symbols[role]]
        unknown = unknown_symbols(bound, [*allowed, *self.symbols["state"][1:]])
        if unknown:
            raise ProblemError(
                f"{name} depends on {', '.join(unknown)}: bounds may depend on parameters, context, stage and static."
            )

    def fields(self) -> dict[str, Any]:
        """The arguments of `OCP`."""
        functions = {
            name: None if value is None else function_of(name, value, self.symbols)
            for name, value in self.expressions.items()
        }
        sizes = {"horizon": self.horizon, "schedule": self.schedule, "additions": self.additions}
        return functions | self.bounds | sizes

    def _widen(self, name: str, added: tuple[Array, Array]) -> None:
        before = self.bounds[name]
        if before is None:  # initial_bounds: all of the user's s_0 is given
            before = np.zeros(self.state.numel()), np.zeros(self.state.numel())
        self.bounds[name] = (np.hstack([before[0], added[0]]), np.hstack([before[1], added[1]]))
