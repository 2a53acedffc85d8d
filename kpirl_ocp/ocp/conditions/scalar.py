"""Functions in scalar operations (SX), which CasADi evaluates much faster than operations on small matrices (MX)."""

from __future__ import annotations

import casadi as ca

_EXPANDED = 20_000  # nodes of the largest MX graph that is expanded


def scalar(functions: list[ca.Function | None]) -> list[ca.Function | None]:
    """All functions expanded to SX; or all as they are, if one of them cannot be expanded or is too large."""
    try:
        return [function if function is None else _expand(function) for function in functions]
    except (RuntimeError, _TooLarge):
        return functions


class _TooLarge(Exception):
    """An MX graph with too many nodes to be expanded."""


def _expand(function: ca.Function) -> ca.Function:
    if function.is_a("SXFunction"):
        return function
    if function.n_nodes() > _EXPANDED:
        raise _TooLarge
    return function.expand()
