"""Recursions over the columns of arrays, and functions of some columns at a time."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.ocp.problem.columns import in_blocks, scan


@pytest.mark.parametrize(
    ("columns", "expected"), [(1, {1}), (31, {31}), (33, {32, 1}), (50, {25}), (64, {32}), (97, {32, 1})]
)
def test_columns_in_blocks_give_what_they_give_together(columns, expected):
    weights, widths = ca.DM(np.random.default_rng(0).normal(size=(3, 2))), set()

    def function(x, y):
        widths.add(x.size2())
        return [weights @ x, ca.sin(x) * y, ca.MX(1, x.size2())]

    x, y = (ca.MX.sym(name, 2, columns) for name in "xy")
    blocks = ca.Function("blocks", [x, y], in_blocks(function, [x, y]))
    assert widths == expected
    together = ca.Function("together", [x, y], function(x, y))
    point = [np.random.default_rng(1).normal(size=(2, columns)) for _ in range(2)]
    for one, other in zip(blocks(*point), together(*point), strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(other))


@pytest.mark.parametrize("steps", [1, 4, 40])
@pytest.mark.parametrize("backwards", [False, True])
def test_an_input_of_one_block_is_the_same_at_every_step(steps, backwards):
    x, y, c = (ca.MX.sym(name, 2, 3) for name in "xyc")
    stage = ca.Function("stage", [x, y, c], [c * x + y, x - y])
    Y = ca.MX.sym("Y", 2, 3 * steps)
    point = [np.random.default_rng(2).uniform(size=size) for size in ((2, 3), (2, 3 * steps), (2, 3))]
    both = [scan(stage, x, [Y, constant], steps, backwards) for constant in (c, ca.repmat(c, 1, steps))]
    found, expected = (ca.Function("along", [x, Y, c], outputs)(*point) for outputs in both)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(other))


@pytest.mark.parametrize("steps", [1, 4, 40])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_running_array_is_handed_on_and_ends_with_the_last_step(steps, backwards):
    x, y, low = (ca.MX.sym(name, 2, 3) for name in ("x", "y", "low"))
    stage = ca.Function("stage", [x, y, low], [0.5 * x + y, ca.fmin(low, y)])
    Y = ca.MX.sym("Y", 2, 3 * steps)
    point = [np.random.default_rng(2).uniform(size=size) for size in ((2, 3), (2, 3 * steps), (2, 3))]
    along = ca.Function("along", [x, Y, low], scan(stage, x, [Y], steps, backwards, running=[low]))
    states, least = map(np.array, along(*point))
    blocks = np.split(point[1], steps, axis=1)
    np.testing.assert_array_equal(least, np.min([*blocks, point[2]], axis=0))
    np.testing.assert_array_equal(states, np.array(scan_by_hand(point[0], blocks, backwards)))


def scan_by_hand(x, blocks, backwards):
    """0.5 x + y, side by side in the order of the blocks."""
    states = []
    for y in reversed(blocks) if backwards else blocks:
        x = 0.5 * x + y
        states.append(x)
    return np.hstack(states[::-1] if backwards else states)
