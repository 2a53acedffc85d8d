"""Whether functions are polynomials of low degree, read off the operations in their graphs."""

from __future__ import annotations

import casadi as ca
import numpy as np

_MOVING = (
    "INPUT OUTPUT CONST PARAMETER ASSIGN GETNONZEROS SETNONZEROS ADDNONZEROS RESHAPE TRANSPOSE HORZCAT VERTCAT DIAGCAT "
    "HORZSPLIT VERTSPLIT DIAGSPLIT HORZREPMAT HORZREPSUM PROJECT SPARSITY_CAST SUBREF SUBASSIGN"
)
_COMPUTING = "ADD SUB MUL NEG TWICE SQ MTIMES DOT BILIN RANK1"
_POLYNOMIAL = frozenset(getattr(ca, f"OP_{name}") for name in f"{_MOVING} {_COMPUTING}".split())


def is_polynomial(function: ca.Function) -> bool:
    """True if the function only adds and multiplies. (Division does not count, not even by a constant.)

    False for functions without a graph of operations (integrators, tables, callbacks), and for those that are declared
    not differentiable (`is_diff_in`): CasADi takes zero for their derivatives.
    """
    if not (all(function.is_diff_in()) and all(function.is_diff_out())):
        return False
    if function.is_a("Map"):
        return is_polynomial(function.info()["f"])
    if not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return False
    kinds = [function.instruction_id(index) for index in range(function.n_instructions())]
    called = [index for index, kind in enumerate(kinds) if kind == ca.OP_CALL]
    return all(kind in _POLYNOMIAL or kind == ca.OP_CALL for kind in kinds) and all(
        is_polynomial(function.instruction_MX(index).which_function()) for index in called
    )


def is_quadratic(function: ca.Function) -> bool:
    """True for a polynomial that is at most quadratic in each of its arguments.

    Its derivative by an argument is then affine in that argument, and cannot change abruptly within a small step, as
    that of a steep sigmoid or near a pole does.
    """
    return is_polynomial(function) and not any(_nonlinear(function, [i], 1) for i in range(function.n_in()))


def is_affine_in(function: ca.Function, arguments: list[int]) -> bool:
    """True if a polynomial is affine in these arguments together."""
    return not _nonlinear(function, arguments, 0)


def is_quadratic_in(function: ca.Function, arguments: list[int]) -> bool:
    """True if a polynomial is at most quadratic in these arguments together."""
    return not _nonlinear(function, arguments, 1)


def _nonlinear(function: ca.Function, arguments: list[int], derivatives: int) -> bool:
    """True if the function, or for derivatives = 1 its Jacobian by these arguments, is not affine in them."""
    function = function if function.is_a("SXFunction") else function.expand()  # dependence is seen through calls
    given = [ca.SX.sym("x", *function.size_in(i)) for i in range(function.n_in())]
    x = ca.SX.sym("x", sum(given[i].numel() for i in arguments))
    parts = ca.vertsplit(x, np.cumsum([0, *(given[i].numel() for i in arguments)]).tolist()) if arguments else []
    for i, part in zip(arguments, parts, strict=True):
        given[i] = ca.reshape(part, *given[i].shape)
    value = ca.veccat(*function.call(given, True, False))
    return any(ca.which_depends(ca.vec(ca.jacobian(value, x)) if derivatives else value, x, 2, False))
