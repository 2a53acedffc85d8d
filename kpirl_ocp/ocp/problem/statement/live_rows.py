"""Rows of constraints that the schedule switches off: d_t g(s, u) constrains nothing where d_t is zero.

They are found by structure: where a number of the stage is zero or one, it takes along what becomes zero by it.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.types import Array, Mask


def live_rows(function: ca.Function | None, schedule: Array) -> Mask:
    """(len(schedule), n) True where a row of a stage function, whose last argument is d, is not switched off."""
    if function is None:
        return np.zeros((len(schedule), 0), bool)
    rows = np.ones((len(schedule), function.size1_out(0)), bool)
    if not function.jac_sparsity(0, function.n_in() - 1).nnz():
        return rows
    switches = np.where(np.isin(schedule, (0.0, 1.0)), schedule, np.nan)
    patterns, members = np.unique(switches, axis=0, return_inverse=True, equal_nan=False)
    known: dict[bytes, Mask] = {}
    for number, pattern in enumerate(patterns):
        key = pattern.tobytes()
        if key not in known:
            known[key] = _rows(function, pattern)
        rows[members.ravel() == number] = known[key]
    return rows


def _rows(function: ca.Function, switches: Array) -> Mask:
    """(n,) True for rows that are not zero, whatever the numbers of the stage that are NaN."""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    *inputs, free = (kind.sym("x", function.size1_in(i)) for i in range(function.n_in()))
    d = ca.vertcat(*(free[i] if np.isnan(value) else kind(ca.sparsify(value)) for i, value in enumerate(switches)))
    (rows,) = function.call([*inputs, d], True, False)
    return np.array([rows[i].nnz() > 0 and not rows[i].is_zero() for i in range(rows.size1())], bool)
