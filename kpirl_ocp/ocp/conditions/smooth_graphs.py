"""Functions that are smooth wherever they are defined, by the operations in their graphs."""

from __future__ import annotations

import casadi as ca

_MOVING = (
    "INPUT OUTPUT CONST PARAMETER ASSIGN GETNONZEROS SETNONZEROS ADDNONZEROS RESHAPE TRANSPOSE HORZCAT VERTCAT DIAGCAT "
    "HORZSPLIT VERTSPLIT DIAGSPLIT HORZREPMAT HORZREPSUM PROJECT SPARSITY_CAST SUBREF SUBASSIGN"
)
_COMPUTING = "ADD SUB MUL DIV NEG TWICE SQ INV EXP EXPM1 SIN COS TAN SINH COSH TANH ATAN ERF MTIMES DOT BILIN RANK1"
_POLYNOMIAL = "ADD SUB MUL NEG TWICE SQ MTIMES DOT BILIN RANK1"


def _kinds(names: str) -> frozenset[int]:
    return frozenset(getattr(ca, f"OP_{name}") for name in names.split())


_SMOOTH, _POLYNOMIALS = _kinds(f"{_MOVING} {_COMPUTING}"), _kinds(f"{_MOVING} {_POLYNOMIAL}")


def is_smooth(function: ca.Function) -> bool:
    """Is every operation of the function smooth where it is defined? Roots and powers are not: |x| is sqrt(x^2).

    Functions without a graph of operations (integrators, tables, callbacks) count as not smooth.
    """
    return _consists_of(function, _SMOOTH)


def is_polynomial(function: ca.Function) -> bool:
    """Does the function add and multiply, and nothing else? (A division is taken for none, by a constant even.)"""
    return _consists_of(function, _POLYNOMIALS)


def _consists_of(function: ca.Function, allowed: frozenset[int]) -> bool:
    if function.is_a("Map"):
        return _consists_of(function.info()["f"], allowed)
    if not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return False
    kinds = [function.instruction_id(index) for index in range(function.n_instructions())]
    called = [index for index, kind in enumerate(kinds) if kind == ca.OP_CALL]
    return all(kind in allowed or kind == ca.OP_CALL for kind in kinds) and all(
        _consists_of(function.instruction_MX(index).which_function(), allowed) for index in called
    )
