"""A problem is solved in whatever units its states, actions, costs and constraints are stated."""

import casadi as ca
import numpy as np
import pytest
from reference import REFERENCES
from reference.checks import coarse, solve
from units import drawn_units, in_units, start_in_units

from kpirl_ocp import OCP, Riccati, Status

PROBLEMS = {reference.name: reference for reference in REFERENCES}
DRAWN = [
    ("double integrator, minimum time", 7),
    ("Goddard rocket", 1),
    ("glider", 6),
    ("glider", 8),
    ("rocket landing in a cone", 1),
    ("rocket landing in a cone", 4),
    ("brachistochrone", 8),
    ("particle steering", 1),
    ("robot arm", 29),
]


def solved_in_drawn_units(case, seed):
    """The solution, and the units."""
    problem, units = case.problem, drawn_units(case.problem, seed)
    s0, guess = start_in_units(problem, problem.inputs(case.s0, case.psi, ())[0], case.guess, units)
    return Riccati().solve(in_units(problem, **units), s0, case.psi, guess=guess), units


@pytest.mark.parametrize(("name", "seed"), DRAWN)
def test_a_classic_problem_is_solved_in_units_that_are_drawn(name, seed):
    """Of the brachistochrone and the particle, rounding of stiff rows makes a pivot negative at the minimum."""
    case = coarse(PROBLEMS[name])
    found, units = solved_in_drawn_units(case, seed)
    expected = solve(case, Riccati()).raise_if_failed()
    np.testing.assert_allclose(found.raise_if_failed().objective / units["cost"], expected.objective, rtol=1e-6)


@pytest.mark.parametrize("seed", [18, 34])
def test_a_point_far_from_feasible_is_not_infeasible_for_the_units_that_it_is_in(seed):
    """A chain hangs where it can; its states are 1e3 to 1e5 here, so that no gradient by them is large."""
    found, _ = solved_in_drawn_units(coarse(PROBLEMS["hanging chain"]), seed)
    assert found.status is not Status.INFEASIBLE


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e3])
def test_states_that_are_zero_by_cancellation_do_not_count_in_units_of_their_rounding(unit):
    """Two pendulums swing up side by side; their distance is zero, but for rounding, and so is its integral."""
    s, u, step = ca.SX.sym("s", 6), ca.SX.sym("u", 2), 0.05
    angles, rates = ca.vertcat(s[0], s[2]), ca.vertcat(s[1], s[3])
    rates = rates + step * (u - 9.81 * ca.sin(angles) - 0.1 * rates)
    angles = angles + step * rates
    apart = ca.vertcat(rates[0] - rates[1], ca.sin(s[0]) - ca.sin(s[2]) + ca.sin(s[4]) * rates[0])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=60,
        dynamics=ca.vertcat(angles[0], rates[0], angles[1], rates[1], s[4:] + unit * step * apart),
        stage_cost=0.01 * (ca.sumsqr(u) + ca.sumsqr(s)),
        terminal_cost=50 * (ca.sumsqr(s[:4] - ca.DM([np.pi, 0, np.pi, 0]))) + ca.sumsqr(s[4:]),
        action_bounds=(-5, 5),
    )
    plan = Riccati().solve(problem, [0.3, 0.1, 0.3, 0.1, 0, 0]).raise_if_failed()
    assert plan.status.name == "CONVERGED"
    assert np.abs(plan.states[:, 4:]).max() <= 1e-12 * max(unit, 1)
