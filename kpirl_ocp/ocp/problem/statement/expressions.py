"""Stage functions from CasADi expressions of the symbols of a problem, and symbols for the inputs of functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array

Expression: TypeAlias = "ca.MX | ca.SX"
Symbols = Mapping[str, Sequence[Expression]]
"""The symbols of every argument: state, action, parameters, context, stage; each may have several."""

_SHORT = {"state": "s", "action": "u", "parameters": "psi", "context": "c", "stage": "d"}
_RELATIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)
_STAGE = ("state", "action", "parameters", "context", "stage")
_END = ("state", "parameters", "context", "stage")
ARGUMENTS = {
    "dynamics": _STAGE,
    "stage_cost": _STAGE,
    "path_constraint": _STAGE,
    "path_equality": _STAGE,
    "terminal_cost": _END,
    "terminal_constraint": _END,
    "terminal_equality": _END,
    "observation": ("state",),
}
"""The arguments that each stage function has."""
CONSTRAINTS = ("path_constraint", "path_equality", "terminal_constraint", "terminal_equality")


def symbols_of(**given: Expression | None) -> dict[str, list[Expression]]:
    """Checked symbols by argument; an empty one where there is none. All are of the kind of the state, SX or MX.

    Raises ProblemError for anything but a column of symbols, for another kind, and for a symbol with two places.
    """
    kind = type(given["state"])
    if kind not in (ca.SX, ca.MX):
        raise ProblemError(f"state must be a symbol, casadi.SX.sym or casadi.MX.sym, got {shown(given['state'])}.")
    symbols = {name: _symbol(name, symbol, kind) for name, symbol in given.items()}
    _check_places(symbols)
    return {name: [symbol] for name, symbol in symbols.items()}


def _check_places(symbols: Mapping[str, Expression]) -> None:
    """Raise ProblemError for a symbol that has two places."""
    places: dict[int, str] = {}
    for name, symbol in symbols.items():
        for part in _repeated(symbol):
            raise ProblemError(f"{name} holds {part.name()} more than once: a symbol has one place.")
        for part in ca.symvar(symbol):
            other = places.setdefault(identity(part), name)
            if other != name:
                raise ProblemError(f"{part.name()} is among both {other} and {name}: a symbol has one place.")


def _repeated(symbol: Expression) -> list[Expression]:
    """The entries of a column of SX symbols that it holds before; CasADi refuses an MX that does."""
    if not isinstance(symbol, ca.SX):
        return []
    entries = symbol.elements()
    known = [identity(entry) for entry in entries]
    return [entry for i, entry in enumerate(entries) if known[i] in known[:i]]


def _symbol(name: str, symbol: Expression | None, kind: Any) -> Expression:
    if symbol is None:
        return kind.sym(name, 0)
    if type(symbol) is not kind:
        raise ProblemError(f"{name} must be of the kind of the state, casadi.{kind.__name__}, got {shown(symbol)}.")
    if not symbol.is_valid_input() or (symbol.size2() != 1 and symbol.numel()):
        matrix = "" if symbol.size2() == 1 else f": use ca.reshape(column, {symbol.size1()}, {symbol.size2()}) of one"
        raise ProblemError(f"{name} must be a column of symbols, got {shown(symbol)} of shape {symbol.shape}{matrix}.")
    return symbol


def expression_of(name: str, value: Expression | float, kind: Any) -> Expression:
    """A value as an expression of this kind. Raises ProblemError for anything else."""
    try:
        return kind(value)
    except (NotImplementedError, TypeError, RuntimeError) as error:
        hint = ": put its entries into one column by casadi.vertcat" if isinstance(value, list | tuple) else ""
        raise ProblemError(
            f"{name} must be a casadi.{kind.__name__} like the state, got {shown(value)}{hint}."
        ) from error


def check_rows(name: str, column: Expression) -> None:
    """Raise ProblemError for a row that is a relation, a <= b, of value 0 or 1, where a - b is to be <= 0, or 0."""
    for part in _parts(column):
        if any(part.is_op(relation) for relation in _RELATIONS):
            wanted = "zero, a - b for a == b" if name.endswith("equality") else "at most zero, a - b for a <= b"
            raise ProblemError(f"{name} holds a relation, {shown(part)}: state the expression that is to be {wanted}.")


def _parts(column: Expression) -> list[Expression]:
    """The rows of an SX; the columns of which an MX is put together."""
    if isinstance(column, ca.SX):
        return list(column.elements())
    if column.is_op(ca.OP_VERTCAT) or column.is_op(ca.OP_RESHAPE):
        return [part for i in range(column.n_dep()) for part in _parts(column.dep(i))]
    return [column]


def function_of(name: str, expression: Expression, symbols: Symbols) -> ca.Function:
    """The function of an expression, with one column for every one of its `ARGUMENTS`.

    Raises ProblemError for an expression of other symbols, and names them.
    """
    parts = {argument: symbols[argument] for argument in ARGUMENTS[name]}
    unknown = unknown_symbols(expression, [symbol for own in parts.values() for symbol in own])
    if unknown:
        raise ProblemError(
            f"{name} depends on {', '.join(unknown)}: its symbols are not among those passed in that it may depend "
            f"on ({', '.join(parts)})."
        )
    try:
        inner = ca.Function(name, [symbol for own in parts.values() for symbol in own], [expression])
    except RuntimeError as error:
        raise ProblemError(f"{name} makes no function; CasADi says: {str(error).splitlines()[-1]}") from error
    kind = type(expression)
    inputs = [kind.sym(_SHORT[argument], sum(map(_length, own))) for argument, own in parts.items()]
    split = [part for column, own in zip(inputs, parts.values(), strict=True) for part in _split(column, own)]
    names = [_SHORT[argument] for argument in parts]
    return ca.Function(name, inputs, inner.call(split, True, False), names, [name])


def kind_of(*functions: ca.Function) -> Any:
    """`ca.SX` if all of these are SX functions, so that they can be called with it, else `ca.MX`."""
    return ca.SX if all(function.is_a("SXFunction") for function in functions) else ca.MX


def inputs_of(function: ca.Function) -> list[Any]:
    """A new dense symbol for every input of a function, of its kind."""
    kind = kind_of(function)
    return [kind.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]


def depends(expression: Expression, *symbols: Expression) -> list[bool]:
    """Which rows of a column depend on any of these symbols."""
    found = [ca.which_depends(expression, symbol, 1, True) for symbol in symbols if symbol.numel()]
    return [any(row) for row in zip(*found, strict=True)] if found else [False] * expression.numel()


def values_of(expression: Expression) -> Array | None:
    """The numbers of a column that depends on no symbol, else None."""
    return None if ca.symvar(expression) else dense(ca.evalf(ca.densify(expression))).ravel()


def unknown_symbols(expression: Expression, symbols: Iterable[Expression]) -> list[str]:
    """Names of the symbols in an expression that are not among these."""
    known = {identity(part) for symbol in symbols for part in ca.symvar(symbol)}
    return [part.name() for part in ca.symvar(expression) if identity(part) not in known]


def identity(symbol: Expression) -> int:
    """A number that two handles of the same symbol share."""
    return int(symbol.element_hash() if isinstance(symbol, ca.SX) else symbol.__hash__())


def _split(column: Expression, parts: Sequence[Expression]) -> list[Expression]:
    pieces = ca.vertsplit(column, np.cumsum([0, *map(_length, parts)]).tolist())
    return [ca.reshape(piece, *part.shape) for piece, part in zip(pieces, parts, strict=True)]


def _length(symbol: Expression) -> int:
    return int(symbol.numel())
