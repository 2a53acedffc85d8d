"""Stage functions from CasADi expressions of the symbols of a problem."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import casadi as ca

from kpirl_ocp.errors import ProblemError

Expression: TypeAlias = "ca.MX | ca.SX"
_STAGE = ("state", "action", "parameters", "context", "stage")
_END = ("state", "parameters", "context", "stage")
_SEEN = {
    "dynamics": _STAGE,
    "stage_cost": _STAGE,
    "terminal_cost": _END,
    "path_constraint": _STAGE,
    "path_equality": _STAGE,
    "terminal_constraint": _END,
    "terminal_equality": _END,
    "observation": ("state",),
}


def state_functions(
    symbols: Mapping[str, Expression | None], **expressions: Expression | float | None
) -> dict[str, ca.Function | None]:
    """A function of every expression, of the symbols that it may depend on; None stays None.

    symbols: state, action, parameters, context and stage; None for those that there are not.

    Raises ProblemError for symbols that are no columns of symbols, and for expressions of other symbols.
    """
    kind = type(symbols["state"])
    if kind not in (ca.SX, ca.MX):
        raise ProblemError(f"state must be a symbol, casadi.SX.sym or casadi.MX.sym, got {symbols['state']!r}.")
    known = {name: _symbol(name, symbol, kind) for name, symbol in symbols.items()}
    return {
        name: None if value is None else _function(name, value, {role: known[role] for role in _SEEN[name]}, kind)
        for name, value in expressions.items()
    }


def _symbol(name: str, symbol: Expression | None, kind: Any) -> Expression:
    if symbol is None:
        return kind.sym(name, 0)
    if type(symbol) is not kind:
        raise ProblemError(f"{name} must be of the kind of the state, casadi.{kind.__name__}, got {symbol!r}.")
    if not symbol.is_valid_input() or (symbol.size2() != 1 and symbol.numel()):
        raise ProblemError(f"{name} must be a column of symbols, got {symbol!r} of shape {symbol.shape}.")
    return symbol


def _function(name: str, value: Expression | float, symbols: Mapping[str, Expression], kind: Any) -> ca.Function:
    try:
        expression = kind(value)
    except (NotImplementedError, TypeError) as error:
        raise ProblemError(f"{name} must be a casadi.{kind.__name__} like the state, got {value!r}.") from error
    strangers = strange(expression, symbols)
    if strangers:
        raise ProblemError(
            f"{name} depends on {', '.join(strangers)}: its symbols are not among those passed in that it may depend "
            f"on ({', '.join(symbols)})."
        )
    try:
        return ca.Function(name, list(symbols.values()), [expression])
    except RuntimeError as error:
        raise ProblemError(f"{name} makes no function; CasADi says: {str(error).splitlines()[-1]}") from error


def strange(expression: Expression, symbols: Mapping[str, Expression]) -> list[str]:
    """Names of the symbols in an expression that are not among these."""
    known = {_identity(part) for symbol in symbols.values() for part in ca.symvar(symbol)}
    return [part.name() for part in ca.symvar(expression) if _identity(part) not in known]


def _identity(symbol: Expression) -> int:
    return int(symbol.element_hash() if isinstance(symbol, ca.SX) else symbol.__hash__())
