"""Functions that are smooth wherever they are defined, by the operations in their graphs."""

from __future__ import annotations

import casadi as ca

_MOVING = (
    "INPUT OUTPUT CONST PARAMETER ASSIGN GETNONZEROS SETNONZEROS ADDNONZEROS RESHAPE TRANSPOSE HORZCAT VERTCAT DIAGCAT "
    "HORZSPLIT VERTSPLIT DIAGSPLIT HORZREPMAT HORZREPSUM PROJECT SPARSITY_CAST SUBREF SUBASSIGN"
)
_COMPUTING = "ADD SUB MUL DIV NEG TWICE SQ INV EXP EXPM1 SIN COS TAN SINH COSH TANH ATAN ERF MTIMES DOT BILIN RANK1"
_SMOOTH = frozenset(getattr(ca, f"OP_{name}") for name in f"{_MOVING} {_COMPUTING}".split())


def is_smooth(function: ca.Function) -> bool:
    """Is every operation of the function smooth where it is defined? Roots and powers are not: |x| is sqrt(x^2).

    Functions without a graph of operations (integrators, tables, callbacks) count as not smooth.
    """
    if function.is_a("Map"):
        return is_smooth(function.info()["f"])
    if not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return False
    kinds = [function.instruction_id(index) for index in range(function.n_instructions())]
    called = [index for index, kind in enumerate(kinds) if kind == ca.OP_CALL]
    return all(kind in _SMOOTH or kind == ca.OP_CALL for kind in kinds) and all(
        is_smooth(function.instruction_MX(index).which_function()) for index in called
    )
