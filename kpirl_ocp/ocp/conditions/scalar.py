"""Functions written out in scalar operations: CasADi evaluates them much faster than small matrices."""

from __future__ import annotations

import casadi as ca

_EXPANDED = 20_000  # nodes of a graph of matrices that is written out in scalars, at most


def scalar(functions: list[ca.Function | None]) -> list[ca.Function | None]:
    """All in scalar operations, or none of them."""
    try:
        return [function if function is None else _expand(function) for function in functions]
    except (RuntimeError, _TooLarge):
        return functions


class _TooLarge(Exception):
    """A graph of matrices with too many nodes to be written out in scalars."""


def _expand(function: ca.Function) -> ca.Function:
    if function.is_a("SXFunction"):
        return function
    if function.n_nodes() > _EXPANDED:
        raise _TooLarge
    return function.expand()
