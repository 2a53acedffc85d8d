"""The filter of the line search, alone: what it refuses, what it adds, and what it forgets."""

import ctypes

import numpy as np
import pytest

from kpirl_ocp.ocp.interior_point import library as c

SIZE = 64
EPSILON = np.finfo(float).eps


class Merit(ctypes.Structure):
    """`kpirl_mpc_merit`."""

    _fields_ = [(name, ctypes.c_double) for name in ("theta", "phi", "log_sum")]


class Filter(ctypes.Structure):
    """`kpirl_mpc_filter`."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("largest", "small", "feasible")),
        ("pairs", Merit * SIZE),
        ("count", ctypes.c_int),
    ]


def accepts(known, before, trial, slope=-1.0, length=1.0, price=0.0):
    function = c.library().kpirl_mpc_filter_accepts
    function.argtypes = [ctypes.c_void_p, Merit, *[ctypes.c_double] * 3, Merit]
    return bool(function(ctypes.addressof(known), Merit(*before), slope, length, price, Merit(*trial)))


def filter_of(*pairs, feasible=1e-12, small=1e-4):
    known = Filter(largest=100.0, small=small, feasible=feasible, count=len(pairs))
    for i, pair in enumerate(pairs):
        known.pairs[i] = Merit(*pair)
    return known


def pairs_of(known):
    return [(pair.theta, pair.phi) for pair in known.pairs[: known.count]]


@pytest.mark.parametrize(
    ("trial", "accepted"),
    [
        ((0.9, 2.0), True),  # less violation, whatever the objective
        ((1.0, 0.9), True),  # a lower objective, whatever the violation
        ((1.0, 1.0), False),
        ((101.0, 0.0), False),
        ((np.nan, 0.0), False),
        ((0.0, np.inf), False),
        ((0.0, np.nan), False),
    ],
)
def test_a_step_has_to_reduce_violation_or_objective_and_stay_finite(trial, accepted):
    assert accepts(filter_of(), (1.0, 1.0), trial) is accepted


@pytest.mark.parametrize(("left", "rise", "accepted"), [(0.0, 0.9, True), (0.0, 1.1, False), (0.6, 0.9, False)])
def test_where_violation_is_rounding_the_objective_may_rise_by_what_is_gone_of_it_times_its_price(left, rise, accepted):
    feasible, price = 1e-12, 1e6
    trial = left * feasible, 1.0 + rise * price * feasible
    assert accepts(filter_of(feasible=feasible), (feasible, 1.0), trial, slope=0.0, price=price) is accepted
    assert not accepts(
        filter_of(feasible=feasible), (2 * feasible, 1.0), (2 * feasible, trial[1]), slope=0.0, price=price
    )


@pytest.mark.parametrize("further", [0.0, 0.1])
@pytest.mark.parametrize("higher", [0.0, 0.1])
def test_what_is_better_than_an_earlier_pair_in_neither_is_refused(further, higher):
    known, theta, phi = filter_of((0.5, -1.0)), 0.5 + further, -1.0 + higher
    assert not accepts(known, (1.0, 1.0), (theta + 1e-6, phi + 1e-6))
    assert accepts(known, (1.0, 1.0), (0.5 - 1e-6, phi + 1e-6))
    assert accepts(known, (1.0, 1.0), (theta + 1e-6, -1.0 - 1e-6))


def test_rounding_of_violation_and_objective_is_no_reason_to_refuse():
    """Each is compared with its own rounding: `feasible`, and 10 epsilon of the objective."""
    known = filter_of((0.5, 1e3), feasible=1e-8)
    assert accepts(known, (1.0, 1e3), (0.5 + 0.9e-8, 1e3 + 1e-3))
    assert not accepts(known, (1.0, 1e3), (0.5 + 1.1e-8, 1e3 + 1e-3))
    assert accepts(known, (1.0, 1e3), (0.6, 1e3 + 9e3 * EPSILON))
    assert not accepts(known, (1.0, 1e3), (0.6, 1e3 + 11e3 * EPSILON))


def test_the_point_that_is_left_joins_the_filter_with_a_margin_and_replaces_pairs_that_it_covers():
    known = filter_of((2.0, 3.0), (0.5, 9.0), (1.0, 2.0))
    assert accepts(known, (1.0, 2.0), (0.4, 5.0))
    assert pairs_of(known) == [(0.5, 9.0), (1.0 - 1e-5, 2.0 - 1e-8)]


def test_where_the_violation_is_small_beside_the_slope_the_objective_decides_and_the_filter_stays():
    known = filter_of()
    before, fall = (1e-6, 1.0), 1e-4  # Armijo's share of the slope
    assert not accepts(known, before, (0.0, 1.0 - 0.9 * fall))
    assert accepts(known, before, (1e-3, 1.0 - 1.1 * fall))
    assert accepts(known, before, (0.0, 1.0 - 0.6 * fall), length=0.5)
    assert pairs_of(known) == []
    assert accepts(known, before, (0.0, 1.0), slope=1.0)  # uphill, so that the violation decides
    assert accepts(known, before, (0.0, 1.0), slope=-1e-4)  # too flat: |slope|^2.3 < violation^1.1
    assert known.count == 1


def test_a_full_filter_forgets_its_oldest_pair():
    pairs = [(2.0 + i, -float(i)) for i in range(SIZE)]  # none covers another
    known = filter_of(*pairs)
    assert accepts(known, (1.0, 1.0), (0.5, 1.0))
    assert pairs_of(known) == [*pairs[1:], (1.0 - 1e-5, 1.0 - 1e-8)]


def test_pairs_that_are_kept_are_those_of_another_barrier_function():
    """phi = J - tau sum log y of two points, J = 1 and 2, sums 3 and -5, for tau = 0.1, then 0.4."""
    known = filter_of((0.5, 1 - 0.1 * 3, 3), (0.2, 2 + 0.1 * 5, -5))
    function = c.library().kpirl_mpc_shift_filter
    function.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double]
    function.restype = None
    function(ctypes.addressof(known), 0.1, 0.4)
    np.testing.assert_allclose(pairs_of(known), [(0.5, 1 - 0.4 * 3), (0.2, 2 + 0.4 * 5)], rtol=4 * EPSILON)
