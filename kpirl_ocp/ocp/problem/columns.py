"""Expressions for B trajectories, stored side by side as columns: recursions over time, and changes of order.

The columns of an array (n, T B) are ordered by time, then by trajectory: T blocks of B columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import pairwise

import casadi as ca

from kpirl_ocp.ocp.problem.statement.expressions import inputs_of

_WRITTEN_OUT = 32  # up to this many steps are written out one by one
_TOGETHER = 32  # columns of one block: what is computed for them stays in the second-level cache until it is used


def scan(
    stage: ca.Function,
    start: ca.MX,
    inputs: Sequence[ca.MX],
    steps: int,
    backwards: bool = False,
    running: Sequence[ca.MX] = (),
) -> list[ca.MX]:
    """Apply a stage function block by block, forwards or backwards; its first output is its first input at the next.

    Inputs and outputs (n, T B) are ordered by time in both cases; an input (n, B) is used at every step. The result is
    that of `mapaccum`, but arrays are copied only once. Many steps are split into groups that are functions of their
    own, at the price of one more copy: compilers take more than twice the time for a function of twice the length.

    running: arrays (n, B) that the stage takes as its last inputs and gives, changed, as its last outputs; the result
    ends with those of the last step alone.
    """
    size = 1 if steps <= _WRITTEN_OUT else math.isqrt(steps)
    ends = [*range(0, steps, size), steps]
    lengths = [end - begin for begin, end in pairwise(ends)]
    same = [array.size2() == start.size2() for array in inputs]
    alone = len(running)
    groups = {length: stage if size == 1 else _group(stage, length, backwards, same, alone) for length in lengths}
    blocks = [
        [array] * len(lengths) if alike else ca.horzsplit(array, [end * (array.size2() // steps) for end in ends])
        for array, alike in zip(inputs, same, strict=True)
    ]
    rows: list[list[ca.MX]] = [[] for _ in lengths]
    for i in reversed(range(len(lengths))) if backwards else range(len(lengths)):
        outputs = groups[lengths[i]].call([start, *(block[i] for block in blocks), *running])
        end = len(outputs) - alone
        start, rows[i], running = outputs[0], outputs[0 if size == 1 else 1 : end], outputs[end:]
    return [*(ca.horzcat(*column) for column in zip(*rows, strict=True)), *running]


def _group(stage: ca.Function, length: int, backwards: bool, same: Sequence[bool], alone: int) -> ca.Function:
    """Several steps as one function: (start, inputs as for `scan`) -> first output of the last step, all outputs.

    alone: how many of the stage's inputs are `running`.
    """
    start, *inputs = stage.mx_in()
    inputs, running = inputs[: len(same)], inputs[len(inputs) - alone :]
    widths = [array.size2() * (1 if alike else length) for array, alike in zip(inputs, same, strict=True)]
    wide = [ca.MX.sym("x", array.size1(), width) for array, width in zip(inputs, widths, strict=True)]
    outputs = scan(stage, start, wide, length, backwards, running)
    width = start.size2()
    carried = outputs[0][:, :width] if backwards else outputs[0][:, -width:]
    return ca.Function("group", [start, *wide, *running], [carried, *outputs])


def map_shared(function: ca.Function, steps: int, inputs: Sequence[ca.MX], add: bool = False) -> list[ca.MX]:
    """The dense outputs of all steps side by side, or their sums. An input with the shape of one step is used at each.

    Inputs are not repeated, and those that no output depends on are not passed: either would take O(T^2) memory for an
    input that itself holds numbers for every step.
    """
    used = _used(function)
    share = [inputs[i].shape == function.size_in(i) for i in used]
    mapped = _with_inputs(function, used).map(steps, share, [add] * function.n_out())
    return mapped.call([inputs[i] for i in used])


def in_blocks(function: Callable[..., Sequence[ca.MX]], inputs: Sequence[ca.MX]) -> list[ca.MX]:
    """The outputs, side by side, of a function of any number of columns, for some columns of all inputs at a time.

    Inputs, outputs and all in between have a column for each, so that the order of evaluation is free.
    """
    columns = inputs[0].size2()
    width = next((n for n in range(_TOGETHER, _TOGETHER // 2, -1) if columns % n == 0), _TOGETHER)
    whole, rest = columns - columns % width, columns % width
    parts = [
        _of_columns(function, inputs, size).map(count).call([array[:, begin:end] for array in inputs])
        for begin, end, size, count in ((0, whole, width, whole // width), (whole, columns, rest, 1))
        if end > begin
    ]
    return [ca.horzcat(*outputs) for outputs in zip(*parts, strict=True)]


def _of_columns(function: Callable[..., Sequence[ca.MX]], inputs: Sequence[ca.MX], count: int) -> ca.Function:
    symbols = [ca.MX.sym("x", array.size1(), count) for array in inputs]
    return ca.Function("block", symbols, [ca.densify(output) for output in function(*symbols)])


def _used(function: ca.Function) -> list[int]:
    """Indices of the inputs that an output depends on."""
    symbols = inputs_of(function)
    outputs = ca.vertcat(*map(ca.vec, function.call(symbols)))
    return [i for i, symbol in enumerate(symbols) if ca.depends_on(outputs, symbol)]


def _with_inputs(function: ca.Function, used: Sequence[int]) -> ca.Function:
    """The function of these inputs alone, with zeros for the others and dense outputs."""
    symbols = inputs_of(function)
    given = [symbol if i in used else type(symbol).zeros(symbol.shape) for i, symbol in enumerate(symbols)]
    outputs = [ca.densify(output) for output in function.call(given, True, False)]
    return ca.Function(function.name(), [symbols[i] for i in used], outputs)


def reverse(array: ca.MX, width: int) -> ca.MX:
    """The blocks of `width` columns in reverse order."""
    if width == 1:
        return array[:, ::-1]
    return ca.horzcat(*reversed(ca.horzsplit(array, width)))


def sum_blocks(array: ca.MX, width: int) -> ca.MX:
    """The sum of all blocks of `width` columns."""
    rows = array.size1()
    return ca.reshape(ca.sum2(ca.reshape(array, rows * width, array.size2() // width)), rows, width)


def smallest_block(array: ca.MX, width: int) -> ca.MX:
    """(n, B) entry by entry the smallest number of all blocks of `width` columns, by repeated halving."""
    while array.size2() > width:
        half = (array.size2() // width + 1) // 2 * width
        array = ca.fmin(array[:, :half], array[:, -half:])
    return array


def smallest(first: ca.MX, *others: ca.MX) -> ca.MX:
    """Entry by entry the smallest number of arrays of the same shape."""
    return reduce(ca.fmin, others, first)


def largest_block(array: ca.MX, width: int) -> ca.MX:
    """(n, B) entry by entry the largest absolute value of all blocks."""
    return -smallest_block(-ca.fabs(array), width)


def smallest_by_column(array: ca.MX) -> ca.MX:
    """(1, B) the smallest number in each column of an array (n, B)."""
    return ca.horzcat(*map(ca.mmin, ca.horzsplit(array)))


def repeat(arrays: Iterable[ca.MX], count: int) -> list[ca.MX]:
    """Each array repeated side by side, as an input that is the same in `count` steps."""
    return [ca.repmat(array, 1, count) for array in arrays]


def by_trajectory(array: ca.MX, columns: int) -> ca.MX:
    """An array (n, T B), ordered by time, as (n T, B): one column per trajectory."""
    return ca.horzcat(*(ca.vec(array[:, index::columns]) for index in range(columns)))


def regroup(array: ca.MX, period: int) -> ca.MX:
    """Columns 0, p, 2p .., then 1, p+1, .. : from an order by time to one by trajectory (p = B), and back (p = T)."""
    if period in (1, array.size2()):
        return array
    return ca.horzcat(*(array[:, first::period] for first in range(period)))


def symbols_like(name: str, arrays: Iterable[ca.MX]) -> list[ca.MX]:
    """New symbols of the same shapes as the arrays."""
    return [ca.MX.sym(name, *array.shape) for array in arrays]
