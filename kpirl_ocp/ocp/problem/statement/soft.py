"""Soft constraints: h <= 0 may be violated at a price.

    minimise  ... + sum_t  linear . sigma_t + quadratic . sigma_t^2 / 2,     h(s_t, u_t) <= sigma_t,  sigma_t >= 0

The slacks sigma_t are added to the actions. Rows of h on states alone hold softly at s_T too: their slacks there are
states that keep their value, at the same price. With a linear price above the multiplier of the hard constraint, the
solution is that of the hard constraint where it has one (Fletcher, 1987, section 12.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.ocp.problem.statement.draft import Draft
from kpirl_ocp.ocp.problem.statement.expressions import Expression, check_rows, depends, expression_of, values_of


@dataclass(frozen=True, eq=False)
class Soft:
    """A soft constraint.

    constraint: h(s, u, psi, c, d), to be <= 0; an expression (n,).
    linear, quadratic: prices of its violation, each a number or (n,); expressions of parameters, context and stage are
        welcome, and are differentiated.
    """

    constraint: Expression
    linear: Expression | float = 0.0
    quadratic: Expression | float = 0.0


def soften(draft: Draft, soft: Soft) -> None:
    """Add a soft constraint. Raises ProblemError for prices that do not bound the violation."""
    if not isinstance(soft, Soft):
        raise ProblemError(f"soft must be a Soft(constraint, linear=.., quadratic=..), got {shown(soft)}.")
    h = expression_of("soft.constraint", soft.constraint, draft.kind)
    check_rows("soft.constraint", h)
    if not h.is_column():
        raise ProblemError(f"soft.constraint must be a column, got the shape {h.shape}.")
    prices = [_price(draft, name, getattr(soft, name), h.numel()) for name in ("linear", "quadratic")]
    _check_prices(*prices)
    sigma = draft.kind.sym("slack", h.numel())
    draft.add_actions(sigma)
    draft.append("path_constraint", h - sigma)
    draft.add("stage_cost", _cost(sigma, *prices))
    draft.additions = replace(draft.additions, slacks=h.numel())
    still = [row for row, moved in enumerate(depends(h, draft.action)) if not moved]
    if still:
        last = draft.kind.sym("end_slack", len(still))
        draft.add_states(last, 0.0, np.inf)
        draft.append("terminal_constraint", h[still] - last)
        draft.add("terminal_cost", _cost(last, *(price[still] for price in prices)))
        draft.additions = replace(draft.additions, end_slacks=len(still))


def _cost(sigma: Expression, linear: Expression, quadratic: Expression) -> Expression:
    return ca.dot(linear, sigma) + ca.dot(quadratic, sigma**2) / 2


def _price(draft: Draft, name: str, value: Expression | float, length: int) -> Expression:
    price = expression_of(f"soft.{name}", value, draft.kind)
    if price.shape not in ((1, 1), (length, 1)):
        raise ProblemError(f"soft.{name} must have length {length} or 1, got the shape {price.shape}.")
    draft.check_bound(f"soft.{name}", price)
    return ca.densify(price) * draft.kind.ones(length)


def _check_prices(linear: Expression, quadratic: Expression) -> None:
    values = {"linear": values_of(linear), "quadratic": values_of(quadratic)}
    known = [value for value in values.values() if value is not None]
    for name, value in values.items():
        if value is not None and not ((value >= 0) & (value < np.inf)).all():
            raise ProblemError(f"soft.{name} must not be negative, nor infinity or NaN.")
    if len(known) == 2 and not (known[0] + known[1] > 0).all():
        raise ProblemError("soft needs a linear or quadratic price above zero for every row.")
