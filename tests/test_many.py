"""Many solves at once: the numbers of single solves, whatever the number of threads."""

import numpy as np
import pytest
from problems import TABLE

from kpirl_ocp import Riccati, Status
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.solvers import solve_many

CASE = TABLE["integrator"]()
STARTS = CASE.demonstration.s0 + np.linspace(-0.2, 0.2, 12)[:, None] * [1.0, 0.0]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_many_solves_give_the_numbers_of_single_ones(threads):
    found = solve_many(CASE.problem, STARTS, CASE.psi, CASE.demonstration.context, threads=threads)
    for start, solution in zip(STARTS, found, strict=True):
        single = Riccati().solve(CASE.problem, start, CASE.psi, CASE.demonstration.context)
        assert solution.status is single.status is Status.CONVERGED
        np.testing.assert_array_equal(solution.actions, single.actions)
        np.testing.assert_array_equal(solution.multipliers.dynamics, single.multipliers.dynamics)


def test_everything_may_differ_from_solve_to_solve():
    scales = np.linspace(0.5, 2, 12)
    psi = CASE.psi * scales[:, None]
    first = solve_many(CASE.problem, STARTS, psi, CASE.demonstration.context)
    again = solve_many(CASE.problem, STARTS, psi, CASE.demonstration.context, guesses=first)
    for one, other, numbers in zip(first, again, psi, strict=True):
        np.testing.assert_array_equal(one.psi, numbers)
        np.testing.assert_allclose(other.actions, one.actions, rtol=0, atol=1e-6)
        assert other.iterations <= 5


def test_every_solve_has_its_own_status():
    starts = [STARTS[0], [0.0, 50.0], STARTS[1]]  # the second is much too fast for the bounds
    found = solve_many(CASE.problem, starts, CASE.psi, CASE.demonstration.context)
    assert [solution.status.ok for solution in found] == [True, False, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(s0=np.zeros((3, 5))), r"s0 must be numbers of shape \(B, 2\) or \(2,\), got \(3, 5\)"),
        (dict(s0="start"), "s0 must be numbers"),
        (dict(psi=np.zeros((4, 3))), "as many of everything"),
        (dict(guesses=[None]), "as many of everything"),
        (dict(threads=0), "threads must be at least 1"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    given = dict(s0=STARTS, psi=CASE.psi, context=CASE.demonstration.context) | arguments
    with pytest.raises(ProblemError, match=message):
        solve_many(CASE.problem, **given)
