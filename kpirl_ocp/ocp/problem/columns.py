"""Columns of B trajectories side by side, as expressions: recursions over time, and other orders.

The columns of an array (n, T B) are ordered by time, then by trajectory: T blocks of B columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import casadi as ca

_WRITTEN_OUT = 32  # so many steps, and no more, are written out one by one


def scan(stage: ca.Function, start: ca.MX, inputs: Sequence[ca.MX], steps: int, backwards: bool = False) -> list[ca.MX]:
    """Carry the first output of a stage to its first input, from the first to the last block or from the last on.

    Inputs and outputs (n, T B) are ordered by time either way; an input (n, B) is the same at every step. The same
    as `mapaccum`, but with a single copy. Many steps are taken in groups, with a copy more: compilers take more than
    twice the time for a function of twice the length.
    """
    size = 1 if steps <= _WRITTEN_OUT else math.isqrt(steps)
    ends = [*range(0, steps, size), steps]
    lengths = [end - begin for begin, end in pairwise(ends)]
    same = [array.size2() == start.size2() for array in inputs]
    groups = {length: stage if size == 1 else _group(stage, length, backwards, same) for length in lengths}
    blocks = [
        [array] * len(lengths) if alike else ca.horzsplit(array, [end * (array.size2() // steps) for end in ends])
        for array, alike in zip(inputs, same, strict=True)
    ]
    rows: list[list[ca.MX]] = [[] for _ in lengths]
    for i in reversed(range(len(lengths))) if backwards else range(len(lengths)):
        outputs = groups[lengths[i]].call([start, *(block[i] for block in blocks)])
        start, rows[i] = outputs[0], outputs if size == 1 else outputs[1:]
    return [ca.horzcat(*column) for column in zip(*rows, strict=True)]


def _group(stage: ca.Function, length: int, backwards: bool, same: Sequence[bool]) -> ca.Function:
    """Some steps: (carried, inputs as for `scan`) -> what is carried on, and all outputs side by side."""
    start, *inputs = stage.mx_in()
    widths = [array.size2() * (1 if alike else length) for array, alike in zip(inputs, same, strict=True)]
    wide = [ca.MX.sym("x", array.size1(), width) for array, width in zip(inputs, widths, strict=True)]
    outputs = scan(stage, start, wide, length, backwards)
    width = start.size2()
    carried = outputs[0][:, :width] if backwards else outputs[0][:, -width:]
    return ca.Function("group", [start, *wide], [carried, *outputs])


def map_shared(function: ca.Function, steps: int, inputs: Sequence[ca.MX], add: bool = False) -> list[ca.MX]:
    """The dense outputs of all steps side by side, or their sums; an input of one step's shape is the same at each.

    No input is repeated, and none handed over that does not matter: either takes O(T^2) memory where it has numbers
    for every step.
    """
    used = _used(function)
    share = [inputs[i].shape == function.size_in(i) for i in used]
    mapped = _with_inputs(function, used).map(steps, share, [add] * function.n_out())
    return mapped.call([inputs[i] for i in used])


def _used(function: ca.Function) -> list[int]:
    """The inputs that an output depends on."""
    symbols = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    outputs = ca.vertcat(*map(ca.vec, function.call(symbols)))
    return [i for i, symbol in enumerate(symbols) if ca.depends_on(outputs, symbol)]


def _with_inputs(function: ca.Function, used: Sequence[int]) -> ca.Function:
    """Of these inputs alone, with zeros for the others, and dense outputs."""
    symbols = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    given = [symbol if i in used else type(symbol).zeros(symbol.shape) for i, symbol in enumerate(symbols)]
    outputs = [ca.densify(output) for output in function.call(given, True, False)]
    return ca.Function(function.name(), [symbols[i] for i in used], outputs)


def reverse(array: ca.MX, width: int) -> ca.MX:
    """The blocks of `width` columns in opposite order."""
    if width == 1:
        return array[:, ::-1]
    return ca.horzcat(*reversed(ca.horzsplit(array, width)))


def sum_blocks(array: ca.MX, width: int) -> ca.MX:
    """The sum of all blocks of `width` columns."""
    rows = array.size1()
    return ca.reshape(ca.sum2(ca.reshape(array, rows * width, array.size2() // width)), rows, width)


def smallest_by_row(array: ca.MX) -> ca.MX:
    """(n, 1) the smallest number of every row (n, m), by halves; m is at least 1."""
    while array.size2() > 1:
        half = (array.size2() + 1) // 2
        array = ca.fmin(array[:, :half], array[:, -half:])
    return array


def largest_by_row(array: ca.MX) -> ca.MX:
    """(n, 1) the largest absolute value of every row (n, m)."""
    return -smallest_by_row(-ca.fabs(array))


def repeat(arrays: Iterable[ca.MX], count: int) -> list[ca.MX]:
    """Each array side by side, as inputs of `count` steps that are the same."""
    return [ca.repmat(array, 1, count) for array in arrays]


def by_trajectory(array: ca.MX, columns: int) -> ca.MX:
    """(n, T B), ordered by time, as (n T, B)."""
    return ca.horzcat(*(ca.vec(array[:, index::columns]) for index in range(columns)))


def regroup(array: ca.MX, period: int) -> ca.MX:
    """Columns 0, p, 2p .., then 1, p+1, .. : from an order by time to one by trajectory (p = B), and back (p = T)."""
    if period in (1, array.size2()):
        return array
    return ca.horzcat(*(array[:, first::period] for first in range(period)))


def symbols_like(name: str, arrays: Iterable[ca.MX]) -> list[ca.MX]:
    """New symbols of the same shapes."""
    return [ca.MX.sym(name, *array.shape) for array in arrays]
