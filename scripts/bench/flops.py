"""Floating-point operations in the dense products of a CasADi function, counted in its graph.

Element-wise work is left out, so that a rate in GFLOP/s that uses this count is never flattered.
"""

from __future__ import annotations

import casadi as ca


def products(function: ca.Function) -> int:
    """Multiplications and additions of all matrix products, in calls and maps too; 2 m k n for (m, k) (k, n)."""
    if function.is_a("Map"):
        inner = function.info()
        return int(inner["n"]) * products(inner["f"])
    if not function.is_a("MXFunction"):
        return 0  # scalar graphs have no products
    total, found = 0, {}
    for index in range(function.n_instructions()):
        kind = function.instruction_id(index)
        if kind == ca.OP_MTIMES:
            result, left = (function.instruction_MX(index).dep(i) for i in (0, 1))
            total += 2 * left.nnz() * result.size2()
        elif kind == ca.OP_CALL:
            called = function.instruction_MX(index).which_function()
            key = called.__hash__()
            if key not in found:
                found[key] = products(called)
            total += found[key]
    return total
