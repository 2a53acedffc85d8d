"""Rows of constraints that the schedule switches off: d_t g(s, u) constrains nothing where d_t is zero.

They are found by structure: a row is switched off if the zeros and ones of the schedule alone make it zero. A row
0 <= 0 would leave an interior-point method no interior; such rows become -1 <= 0. Solvers leave out rows 0 = 0.
"""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.statement.expressions import inputs_of, kind_of
from kpirl_ocp.types import Array, Mask

_SWITCHES = (0.0, 1.0)


def with_interior(function: ca.Function | None, schedule: Array) -> ca.Function | None:
    """g(.., d) <= 0 with -1 in the place of rows that are switched off; other values and all derivatives are g's."""
    if function is None or not _depends_on_stage(function):
        return function
    conditions = [(pattern, rows) for pattern in _patterns(schedule) if (rows := ~_rows(function, pattern)).any()]
    if not conditions:
        return function
    inputs, kind = inputs_of(function), kind_of(function)
    off = kind.zeros(function.size1_out(0))
    for pattern, rows in conditions:
        met = kind(1)
        for i in np.flatnonzero(~np.isnan(pattern)):
            met = ca.logic_and(met, inputs[-1][int(i)] == pattern[i])
        off = ca.fmax(off, met * ca.DM(rows.astype(float)))
    (values,) = function.call(inputs, True, False)
    return ca.Function(function.name(), inputs, [values - off], function.name_in(), function.name_out())


def live_rows(function: ca.Function | None, schedule: Array) -> Mask:
    """(len(schedule), n) True where a row of a stage function, whose last argument is d, is not switched off."""
    if function is None:
        return np.zeros((len(schedule), 0), bool)
    rows = np.ones((len(schedule), function.size1_out(0)), bool)
    if _depends_on_stage(function):
        known: dict[bytes, Mask] = {}
        for stage, pattern in enumerate(_switches(schedule)):
            key = pattern.tobytes()
            if key not in known:
                known[key] = _rows(function, pattern)
            rows[stage] = known[key]
    return rows


def _depends_on_stage(function: ca.Function) -> bool:
    return bool(function.jac_sparsity(0, function.n_in() - 1).nnz())


def _switches(schedule: Array) -> Array:
    """The schedule's zeros and ones; NaN for other numbers."""
    return np.where(np.isin(schedule, _SWITCHES), schedule, np.nan)


def _patterns(schedule: Array) -> Iterable[Array]:
    """One number of the stage that is zero or one, whatever the others are; then those of the schedule together."""
    for i in range(schedule.shape[1]):
        for value in _SWITCHES:
            yield np.where(np.arange(schedule.shape[1]) == i, value, np.nan)
    yield from {pattern.tobytes(): pattern for pattern in _switches(schedule)}.values()


def _rows(function: ca.Function, switches: Array) -> Mask:
    """(n,) True for rows that are not zero, whatever the numbers of the stage that are NaN."""
    (*inputs, free), kind = inputs_of(function), kind_of(function)
    d = ca.vertcat(*(free[i] if np.isnan(value) else kind(ca.sparsify(value)) for i, value in enumerate(switches)))
    (rows,) = function.call([*inputs, d], True, False)
    return np.array([rows[i].nnz() > 0 and not rows[i].is_zero() for i in range(rows.size1())], bool)
